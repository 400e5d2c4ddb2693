"""The paper's tables beside the results of a comparison, in Markdown.

`TABLE_1`, `TABLE_2_AI2THOR`, `TABLE_2_ROBOTHOR` and `TABLE_3` hold the numbers as printed in Zhang et al., CVPR 2023.
`write_paper_tables` writes a page that lays them beside our results and judges which of their orderings hold.
"""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxnav.errors import InputError
from jaxnav.evaluation.report import METRIC_COLUMNS
from jaxnav.evaluation.statistics import Interval
from jaxnav.store.files import list_differences
from jaxnav.study.claims import Claim
from jaxnav.study.compare_config import VARIANT_LABELS
from jaxnav.study.document import reading_section, table_lines, write_markdown
from jaxnav.study.records import METRIC_SCALE, AgentResult, AgentScores, RunScores, find_result, from_json

# The paper's numbers


class PaperRow(NamedTuple):
    """One row of a table.

    Attributes:
      sr, spl: percent.
      dts: metres.
    """

    sr: float
    spl: float
    dts: float


#: Method and variant. In Tables 2 and 3, methods with the layout use sTDE.
PaperAgent = tuple[str, str]
#: Rows of a table, by agent.
PaperRows = Mapping[PaperAgent, PaperRow]

#: Ablation of ORG, AI2-THOR, val.
TABLE_1: PaperRows = {
    ("org", "baseline"): PaperRow(66.48, 38.42, 0.54),
    ("org", "layout"): PaperRow(71.40, 39.11, 0.49),
    ("org", "tde"): PaperRow(69.24, 38.38, 0.52),
    ("org", "stde"): PaperRow(74.95, 41.68, 0.47),
}
#: AI2-THOR and RoboTHOR, test.
_TABLE_2: Mapping[PaperAgent, tuple[PaperRow, PaperRow]] = {
    ("random", "random"): (PaperRow(4.68, 2.42, 1.36), PaperRow(2.92, 1.34, 2.40)),
    ("rgb", "baseline"): (PaperRow(59.06, 34.56, 0.68), PaperRow(27.48, 16.45, 2.08)),
    ("sp", "baseline"): (PaperRow(62.19, 37.60, 0.61), PaperRow(26.22, 16.90, 2.06)),
    ("savn", "baseline"): (PaperRow(63.27, 38.20, 0.56), PaperRow(28.53, 18.27, 1.96)),
    ("eotp", "baseline"): (PaperRow(65.61, 38.93, 0.55), PaperRow(28.84, 18.82, 1.95)),
    ("org", "baseline"): (PaperRow(66.53, 39.00, 0.54), PaperRow(29.64, 19.13, 1.95)),
    ("tpn", "baseline"): (PaperRow(68.60, 39.40, 0.54), PaperRow(30.05, 19.05, 1.89)),
    ("vtnet", "baseline"): (PaperRow(70.10, 39.60, 0.52), PaperRow(31.62, 19.63, 1.87)),
    ("hoz", "baseline"): (PaperRow(70.38, 39.04, 0.48), PaperRow(32.27, 20.48, 1.85)),
    ("eotp", "stde"): (PaperRow(69.62, 40.02, 0.52), PaperRow(37.37, 22.00, 1.81)),
    ("org", "stde"): (PaperRow(74.85, 41.56, 0.47), PaperRow(39.27, 22.81, 1.77)),
    ("vtnet", "stde"): (PaperRow(75.25, 41.69, 0.47), PaperRow(41.53, 23.87, 1.72)),
    ("hoz", "stde"): (PaperRow(75.05, 41.53, 0.46), PaperRow(42.13, 24.54, 1.67)),
}
#: AI2-THOR, test.
TABLE_2_AI2THOR: PaperRows = {agent: ai2thor for agent, (ai2thor, _) in _TABLE_2.items()}
#: RoboTHOR, test.
TABLE_2_ROBOTHOR: PaperRows = {agent: robothor for agent, (_, robothor) in _TABLE_2.items()}
#: Gibson, val; its RGBD+RL is `rgb`, whose view of the floor is what depth would give. Random's 0.04 looks like a
#: fraction among percentages.
TABLE_3: PaperRows = {
    ("random", "random"): PaperRow(0.04, 0.04, 3.89),
    ("rgb", "baseline"): PaperRow(8.42, 2.87, 3.23),
    ("semexp", "baseline"): PaperRow(65.35, 33.52, 1.56),
    ("semexp", "stde"): PaperRow(66.96, 34.33, 1.53),
}

# The page

#: Methods whose input has more structure than a list of detections.
STRUCTURED_METHODS = ("sp", "eotp", "org", "tpn", "vtnet", "hoz")
#: Methods into which the paper puts the layout.
LAYOUT_HOSTS = ("eotp", "org", "vtnet", "hoz")
PAPER_VARIANT_LABELS = {**VARIANT_LABELS, "tde": " + w + TDE"}
#: Gains of a host: a variant and its reference.
GAIN_COMPARISONS = (("stde", "baseline"), ("layout", "baseline"), ("stde", "layout"), ("layout", "tde"))
#: Settings of a run that belong to its method.
METHOD_SETTINGS = ("method", "method_sizes", "arms", "imitation")
MIN_SR_EFFECT = 2.0  # points, the least effect that would matter
#: Results of the runs with one core in one world, by method.
MethodScores = Mapping[str, RunScores]


class PaperTable(NamedTuple):
    """One table of the paper.

    Attributes:
      title: subject and data set.
      rows: its rows.
      world: our world beside it.
    """

    title: str
    rows: PaperRows
    world: str


class HostPair(NamedTuple):
    """Results of a host with and without sTDE."""

    stde: AgentResult
    baseline: AgentResult


PAPER_TABLES = (
    PaperTable("Table 1: what ORG gains (AI2-THOR, val)", TABLE_1, "rooms"),
    PaperTable("Table 2: AI2-THOR, test", TABLE_2_AI2THOR, "rooms"),
    PaperTable("Table 2: RoboTHOR, test", TABLE_2_ROBOTHOR, "apartments"),
    PaperTable("Table 3: Gibson, val", TABLE_3, "houses"),
)
PAGE_HEAD = """# The paper's tables beside ours

S. Zhang et al., *Layout-based Causal Inference for Object Navigation*, CVPR 2023, Tables 1 to 3, beside our results.
All but the summary is written by `jaxnav compare --config table2 --paper docs/paper_tables.md`. Ours are best actions
in generated homes, split `{split}`, one recurrent core: means over seeds and episodes, with 95 % intervals over
training runs and scenes ([statistics.md](statistics.md)). [table2.md](table2.md) has sampled actions and two streams.

**What can be compared.** Not the numbers. Agents of the paper see images through a trained detector and are tested in
AI2-THOR, RoboTHOR and Gibson; ours see a grid through a simulated detector, have a map of where they have been, live
in generated homes, and learn by PPO. Orderings that say something of the world, and not of a simulator, can be:

* Random is far below everything, and RGB+RL below the methods that know more than a list of detections, as a group.
* A host with the layout is above the host. What w does and what sTDE does are told apart.
* Gains are larger in apartments than in rooms, and SemExp's is smaller.

Not the order of SP, SAVN, EOTP, ORG, TPN, VTNet and HOZ among themselves: their neighbours in the paper are half a
point to three points apart, less than two implementations of one method. Nor SemExp against RGBD+RL: its planner,
written by hand, does most of its work.

The verdicts are those of the study: *holds* where the interval is above 0, *refuted* below 0, *too small to matter*
where it ends below {points:g} points, else *cannot be told*. Bounds of differences between worlds are added, which is
wider than needed. A group is the mean of its methods that were run. What the paper says of ORG in rooms is of Table 1.
"""


def write_paper_tables(document: Path, results_folder: Path) -> None:
    """Write the page from all results in a folder.

    Args:
      document: the file; the text between its two lines `<!-- reading -->` is preserved.
      results_folder: folder of a split, with files WORLD-METHOD-DECISION.json of `jaxnav compare`.

    Raises:
      InputError: the file is another document, or a world's methods were compared with different settings.
    """
    data_by_name = {path.stem: json.loads(path.read_text()) for path in sorted(results_folder.glob("*.json"))}
    for table in PAPER_TABLES:
        _check_equal_settings(table, results_folder, data_by_name)

    # Results with one core, world by world.
    scores_by_world: dict[str, MethodScores] = {}
    for table in PAPER_TABLES:
        name_by_method = _fused_run_names(table.world, data_by_name)
        scores_by_world[table.world] = {
            method: from_json(RunScores, data_by_name[name]) for method, name in name_by_method.items()
        }

    lines = [PAGE_HEAD.format(split=results_folder.name, points=MIN_SR_EFFECT), *reading_section(document)]
    lines += ["## Which orderings hold", "", *_orderings_table(scores_by_world), ""]
    for table in PAPER_TABLES:
        lines += [f"## {table.title}", "", *_side_by_side_table(table, scores_by_world[table.world]), ""]
    write_markdown(document, lines)


def _fused_run_names(world: str, names: Iterable[str]) -> dict[str, str]:
    """Names of a world's results with one core, by method."""
    prefix = f"{world}-"
    suffix = "-fused"
    name_by_method = {}
    for name in names:
        if name.startswith(prefix) and name.endswith(suffix):
            name_by_method[name.removeprefix(prefix).removesuffix(suffix)] = name
    return name_by_method


def _check_equal_settings(
    table: PaperTable, results_folder: Path, data_by_name: Mapping[str, Mapping[str, Any]]
) -> None:
    """Refuse methods of a table that differ in settings that do not belong to the method."""
    table_methods = {method for method, _ in table.rows}
    settings_by_name = {}
    for method, name in _fused_run_names(table.world, data_by_name).items():
        if method in table_methods:
            study = data_by_name[name].get("study", {})
            shared_settings = {
                setting: value for setting, value in study.get("run", {}).items() if setting not in METHOD_SETTINGS
            }
            settings_by_name[name] = {**study, "run": shared_settings}

    for name, settings in settings_by_name.items():
        first_name = next(iter(settings_by_name))
        differences = list_differences(settings, settings_by_name[first_name])
        if differences:
            raise InputError(
                f"{results_folder / name}.json: was compared with other settings than {first_name}.json "
                f"({'; '.join(differences)}); compare both with the same ones"
            )


def _side_by_side_table(table: PaperTable, scores_by_method: MethodScores) -> list[str]:
    """Table of the paper's numbers and ours."""
    rows = []
    for (method, variant), paper_row in table.rows.items():
        name = "Random" if method == "random" else f"`{method}`{PAPER_VARIANT_LABELS[variant]}"
        paper_cells = [f"{value:.2f}" for value in paper_row]
        our_cells = ["-"] * len(METRIC_SCALE)
        result = _agent_result(scores_by_method, method, variant)
        if result:
            our_cells = [f"{result.interval(metric):.{METRIC_COLUMNS[metric][1]}f}" for metric in METRIC_SCALE]
        rows.append((name, *paper_cells, *our_cells))

    titles = [METRIC_COLUMNS[metric][0] for metric in METRIC_SCALE]
    paper_titles = [f"paper: {title}" for title in titles]
    our_titles = [f"our {table.world}: {title}" for title in titles]
    return table_lines(("", *paper_titles, *our_titles), rows)


def _agent_result(scores_by_method: MethodScores, method: str, variant: str) -> AgentResult | None:
    """Result of an agent with best actions, or None if it was not evaluated.

    Random acts in the results of every run; `rgb` is one whose choices are actions.
    """
    return find_result(scores_by_method.get("rgb" if method == "random" else method), variant, "argmax")


# Orderings


def _orderings_table(scores_by_world: Mapping[str, MethodScores]) -> list[str]:
    """Table of every ordering of the paper with our effect and verdict."""
    rows: list[tuple[str, ...]] = []
    for world, paper_rows in (("rooms", TABLE_2_AI2THOR), ("apartments", TABLE_2_ROBOTHOR), ("houses", TABLE_3)):
        scores_by_method = scores_by_world[world]
        if not scores_by_method:
            rows.append((f"{world}: all", "-", "-", "not run"))
            continue

        rows += _group_rows(world, scores_by_method, paper_rows)

        # In rooms, the numbers of ORG are those of Table 1, which has all its variants.
        gain_rows = {**paper_rows, **TABLE_1} if world == "rooms" else paper_rows
        for host in (*LAYOUT_HOSTS, "semexp"):
            if (host, "stde") in paper_rows:
                rows += _host_gain_rows(world, scores_by_method, host, gain_rows)

    rows += _world_comparison_rows(scores_by_world)
    return table_lines(("in SR points", "paper", "ours", "verdict"), rows)


def _group_rows(world: str, scores_by_method: MethodScores, paper_rows: PaperRows) -> list[tuple[str, ...]]:
    """Compare the methods as a group with Random and with RGB+RL."""
    learned_methods = [method for method, variant in paper_rows if variant == "baseline"]
    structured_methods = [method for method in learned_methods if method in STRUCTURED_METHODS]
    rows = []
    for reference, methods in ((("random", "random"), learned_methods), (("rgb", "baseline"), structured_methods)):
        if not methods:
            continue
        results = {}
        for method in methods:
            result = _agent_result(scores_by_method, method, "baseline")
            if result:
                results[method] = result

        # The paper's difference, over the methods that were run if there are any.
        compared_methods = list(results) or methods
        paper_mean = sum(paper_rows[method, "baseline"].sr for method in compared_methods) / len(compared_methods)
        paper_effect = paper_mean - paper_rows[reference].sr

        our_effect = Interval(math.nan)
        reference_result = _agent_result(scores_by_method, *reference)
        if results and reference_result:
            our_effect = _mean_result(list(results.values())).difference(reference_result, "sr")

        reference_label = "Random" if reference[0] == "random" else f"`{reference[0]}`"
        coverage = f" ({len(results)} of {len(methods)})" if results else ""
        rows.append(_ordering_row(f"{world}: methods over {reference_label}{coverage}", paper_effect, our_effect))
    return rows


def _host_gain_rows(
    world: str, scores_by_method: MethodScores, host: str, paper_rows: PaperRows
) -> list[tuple[str, ...]]:
    """Compare a host with and without the layout, and step by step."""
    rows = []
    for variant, reference in GAIN_COMPARISONS:
        agent_label = f"`{host}`{PAPER_VARIANT_LABELS[variant]}"
        reference_label = f"`{host}`{PAPER_VARIANT_LABELS[reference]}"
        paper_gain = _paper_gain(paper_rows, host, variant, reference)
        our_gain = _our_gain(scores_by_method, host, variant, reference)
        rows.append(_ordering_row(f"{world}: {agent_label} over {reference_label}", paper_gain, our_gain))
    return rows


def _world_comparison_rows(scores_by_world: Mapping[str, MethodScores]) -> list[tuple[str, ...]]:
    """Compare the gains of hosts between worlds."""
    paper_gains = {}
    our_gains = {}
    for world, paper_rows in (("rooms", TABLE_2_AI2THOR), ("apartments", TABLE_2_ROBOTHOR)):
        pairs = _host_pairs(scores_by_world[world])
        hosts = list(pairs) or LAYOUT_HOSTS
        paper_gains[world] = sum(_paper_gain(paper_rows, host) for host in hosts) / len(hosts)
        our_gains[world] = _mean_host_gain(list(pairs.values()))
    paper_semexp_gain = _paper_gain(TABLE_3, "semexp")
    our_semexp_gain = _our_gain(scores_by_world["houses"], "semexp")

    return [
        _ordering_row(
            "gains of hosts: apartments over rooms",
            paper_gains["apartments"] - paper_gains["rooms"],
            _conservative_difference(our_gains["apartments"], our_gains["rooms"]),
        ),
        _ordering_row(
            "gains: hosts in rooms over `semexp` in houses",
            paper_gains["rooms"] - paper_semexp_gain,
            _conservative_difference(our_gains["rooms"], our_semexp_gain),
        ),
    ]


def _paper_gain(paper_rows: PaperRows, host: str, variant: str = "stde", reference: str = "baseline") -> float:
    """Gain in SR that the paper reports for a host; NaN if a row is missing."""
    if (host, variant) not in paper_rows or (host, reference) not in paper_rows:
        return math.nan
    return paper_rows[host, variant].sr - paper_rows[host, reference].sr


def _our_gain(
    scores_by_method: MethodScores, host: str, variant: str = "stde", reference: str = "baseline"
) -> Interval:
    """Gain in SR of a host; NaN if a variant was not evaluated."""
    agent_result = _agent_result(scores_by_method, host, variant)
    reference_result = _agent_result(scores_by_method, host, reference)
    if not (agent_result and reference_result):
        return Interval(math.nan)
    return agent_result.difference(reference_result, "sr")


def _host_pairs(scores_by_method: MethodScores) -> dict[str, HostPair]:
    """Results of the hosts that were evaluated with and without sTDE."""
    pairs = {}
    for host in LAYOUT_HOSTS:
        stde = _agent_result(scores_by_method, host, "stde")
        baseline = _agent_result(scores_by_method, host, "baseline")
        if stde and baseline:
            pairs[host] = HostPair(stde, baseline)
    return pairs


def _mean_host_gain(pairs: Sequence[HostPair]) -> Interval:
    """Mean gain of hosts; NaN without any."""
    if not pairs:
        return Interval(math.nan)
    mean_stde = _mean_result([pair.stde for pair in pairs])
    # Both means stand for the policies of one run, so that their clusters are shared.
    mean_baseline = _mean_result([pair.baseline for pair in pairs])._replace(run=mean_stde.run)
    return mean_stde.difference(mean_baseline, "sr")


def _conservative_difference(first: Interval, second: Interval) -> Interval:
    """Difference of independent worlds; bounds are added, so the interval is wide."""
    return Interval(first.mean - second.mean, first.low - second.high, first.high - second.low)


def _mean_result(results: Sequence[AgentResult]) -> AgentResult:
    """Result of a group: the mean of its methods, run by run."""
    values = {}
    for metric in METRIC_SCALE:
        values[metric] = sum(getattr(result.agent, metric) for result in results) / len(results)
    mean_agent: AgentScores = dataclasses.replace(results[0].agent, **values)
    return AgentResult(results[0].run, mean_agent)


def _ordering_row(text: str, paper_effect: float, our_effect: Interval) -> tuple[str, ...]:
    paper_cell = "-" if math.isnan(paper_effect) else f"{paper_effect:+.1f}"
    if math.isnan(our_effect.mean):
        return text, paper_cell, "-", "not run"
    verdict = Claim(text, "points", our_effect, MIN_SR_EFFECT).verdict
    return text, paper_cell, f"{our_effect:+z.1f}", verdict
