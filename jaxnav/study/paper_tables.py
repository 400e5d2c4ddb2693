"""The paper's tables beside a comparison's results, in Markdown."""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxnav.errors import InputError
from jaxnav.evaluation.report_tables import COLUMNS
from jaxnav.evaluation.statistics import Interval
from jaxnav.store.manifest import differences
from jaxnav.study.claims import Claim
from jaxnav.study.codec import from_json
from jaxnav.study.compare_pairs import VARIANTS
from jaxnav.study.compare_report import SCALE, Line, Scores
from jaxnav.study.document import reading_section, write_lines
from jaxnav.study.paper_numbers import TABLE_1, TABLE_2_AI2THOR, TABLE_2_ROBOTHOR, TABLE_3, Agent, Printed
from jaxnav.study.tables import markdown

#: Methods that know more of what is seen than a list of detections.
STRUCTURED = ("sp", "eotp", "org", "tpn", "vtnet", "hoz")
#: Methods into which the paper puts the layout.
HOSTS = ("eotp", "org", "vtnet", "hoz")
#: Uses of policies as printed, and what is gained by one over another.
USES = {**VARIANTS, "tde": " + w + TDE"}
STEPS = (("stde", "baseline"), ("layout", "baseline"), ("stde", "layout"), ("layout", "tde"))
#: Settings of a run that belong to its method.
OF_A_METHOD = ("method", "method_sizes", "arms", "imitation")
POINTS = 2.0  # of SR; the least effect that would matter
#: Results of one world's methods, with one core, by method.
Parts = Mapping[str, Scores]
#: Results and lines of a host with and without sTDE.
Pair = tuple[tuple[Scores, Line], tuple[Scores, Line]]


class Table(NamedTuple):
    """Hold one table of the paper.

    Attributes:
      title: what it shows, and where.
      printed: its rows.
      world: ours, that it is laid beside.
    """

    title: str
    printed: Mapping[Agent, Printed]
    world: str


TABLES = (
    Table("Table 1: what ORG gains (AI2-THOR, val)", TABLE_1, "rooms"),
    Table("Table 2: AI2-THOR, test", TABLE_2_AI2THOR, "rooms"),
    Table("Table 2: RoboTHOR, test", TABLE_2_ROBOTHOR, "apartments"),
    Table("Table 3: Gibson, val", TABLE_3, "houses"),
)
HEAD = """# The paper's tables beside ours

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


def write_paper_tables(document: Path, results: Path) -> None:
    """Write the page from all results in a folder.

    Args:
      document: the file; what stands between its two lines `<!-- reading -->` is kept.
      results: folder of a split, with files WORLD-METHOD-DECISION.json of `jaxnav compare`.

    Raises:
      InputError: the document is another one, or a world's methods were compared with different settings.
    """
    records = {path.stem: json.loads(path.read_text()) for path in sorted(results.glob("*.json"))}
    for table in TABLES:
        _check_alike(table, results, records)
    found = {name: from_json(Scores, record) for name, record in records.items()}
    worlds = {table.world: _parts(table.world, found) for table in TABLES}
    lines = [HEAD.format(split=results.name, points=POINTS), *reading_section(document)]
    lines += ["## Which orderings hold", "", *_orderings(worlds), ""]
    for table in TABLES:
        lines += [f"## {table.title}", "", *_beside(table, worlds[table.world]), ""]
    write_lines(document, lines)


def _of_one_core(world: str, names: Iterable[str]) -> dict[str, str]:
    """Return the names of a world's results with one core, by method."""
    first, last = f"{world}-", "-fused"
    there = (name for name in names if name.startswith(first) and name.endswith(last))
    return {name.removeprefix(first).removesuffix(last): name for name in there}


def _check_alike(table: Table, results: Path, records: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse methods of a table that differ in more than what a method is."""
    shared, printed = {}, {method for method, _ in table.printed}
    for method, name in _of_one_core(table.world, records).items():
        if method not in printed:
            continue
        study = records[name].get("study", {})
        run = {key: value for key, value in study.get("run", {}).items() if key not in OF_A_METHOD}
        shared[name] = {**study, "run": run}
    for name, settings in shared.items():
        first = next(iter(shared))
        if different := differences(settings, shared[first]):
            raise InputError(
                f"{results / name}.json: was compared with other settings than {first}.json "
                f"({'; '.join(different)}); compare both with the same ones"
            )


def _parts(world: str, found: Mapping[str, Scores]) -> Parts:
    """Return the results of a world's methods with one core."""
    return {method: found[name] for method, name in _of_one_core(world, found).items()}


def _beside(table: Table, parts: Parts) -> list[str]:
    """Return rows of the paper's numbers and ours."""
    rows = []
    for (method, variant), printed in table.printed.items():
        one = _line(parts, method, variant)
        ours = (f"{one[0].summary(one[1], metric):.{COLUMNS[metric][1]}f}" for metric in SCALE) if one else 3 * ["-"]
        name = "Random" if method == "random" else f"`{method}`{USES[variant]}"
        rows.append((name, *(f"{each:.2f}" for each in printed), *ours))
    header = ("", *(f"{place}: {COLUMNS[metric][0]}" for place in ("paper", f"our {table.world}") for metric in SCALE))
    return markdown(header, rows)


def _line(parts: Parts, method: str, variant: str) -> tuple[Scores, Line] | None:
    """Return the results and the line of an agent, best actions.

    Random is that of a method that chooses actions, and is in every table.
    """
    part = parts.get("rgb" if method == "random" else method)
    line = part and part.line(variant, "argmax")
    return (part, line) if part and line else None


def _orderings(worlds: Mapping[str, Parts]) -> list[str]:
    """Return every ordering of the paper with its effect here."""
    rows = []
    for world, printed in (("rooms", TABLE_2_AI2THOR), ("apartments", TABLE_2_ROBOTHOR), ("houses", TABLE_3)):
        if not worlds[world]:
            rows.append((f"{world}: all", "-", "-", "not run"))
            continue
        rows += _levels(world, worlds[world], printed)
        for host in (host for host in (*HOSTS, "semexp") if (host, "stde") in printed):
            rows += _gains(world, worlds[world], host, {**printed, **TABLE_1} if world == "rooms" else printed)
    rows += _between(worlds)
    return markdown(("in SR points", "paper", "ours", "verdict"), rows)


def _levels(world: str, parts: Parts, printed: Mapping[Agent, Printed]) -> Iterable[tuple[str, ...]]:
    """Compare the methods as a group with Random and RGB+RL."""
    learned = [method for method, variant in printed if variant == "baseline"]
    groups = {("random", "random"): learned, ("rgb", "baseline"): [name for name in learned if name in STRUCTURED]}
    for (reference, variant), methods in groups.items():
        there = [(*one, method) for method in methods if (one := _line(parts, method, "baseline"))]
        if not methods:
            continue
        name = "Random" if reference == "random" else f"`{reference}`"
        text = f"{world}: methods over {name}" + (f" ({len(there)} of {len(methods)})" if there else "")
        compared = [method for *_, method in there] or methods
        level = sum(printed[method, "baseline"].sr for method in compared) / len(compared)
        other, effect = _line(parts, reference, variant), Interval(math.nan)
        if there and other:
            effect = there[0][0].difference(_mean([line for _, line, _ in there]), *other, "sr")
        yield _row(text, level - printed[reference, variant].sr, effect)


def _gains(world: str, parts: Parts, host: str, printed: Mapping[Agent, Printed]) -> Iterable[tuple[str, ...]]:
    """Compare a host with and without the layout, and step by step."""
    for variant, reference in STEPS:
        text = f"{world}: `{host}`{USES[variant]} over `{host}`{USES[reference]}"
        yield _row(text, _told(printed, host, variant, reference), _gain(parts, host, variant, reference))


def _told(printed: Mapping[Agent, Printed], host: str, variant: str = "stde", reference: str = "baseline") -> float:
    """Return what the paper says that a host gains, NaN for nothing."""
    if (host, variant) not in printed or (host, reference) not in printed:
        return math.nan
    return printed[host, variant].sr - printed[host, reference].sr


def _gain(parts: Parts, host: str, variant: str = "stde", reference: str = "baseline") -> Interval:
    one, other = _line(parts, host, variant), _line(parts, host, reference)
    return one[0].difference(one[1], *other, "sr") if one and other else Interval(math.nan)


def _between(worlds: Mapping[str, Parts]) -> Iterable[tuple[str, ...]]:
    """Compare the gains of hosts between worlds."""
    printed = {"rooms": TABLE_2_AI2THOR, "apartments": TABLE_2_ROBOTHOR}
    there = {name: _gaining(worlds[name]) for name in printed}
    told = {name: [_told(table, host) for host in there[name] or HOSTS] for name, table in printed.items()}
    paper = {name: sum(gains) / len(gains) for name, gains in told.items()}
    gains = {name: _group_gain(list(pairs.values())) for name, pairs in there.items()}
    semexp = TABLE_3["semexp", "stde"].sr - TABLE_3["semexp", "baseline"].sr
    larger = _apart(gains["apartments"], gains["rooms"])
    yield _row("gains of hosts: apartments over rooms", paper["apartments"] - paper["rooms"], larger)
    smaller = _apart(gains["rooms"], _gain(worlds["houses"], "semexp"))
    yield _row("gains: hosts in rooms over `semexp` in houses", paper["rooms"] - semexp, smaller)


def _gaining(parts: Parts) -> dict[str, Pair]:
    """Return results and lines with and without sTDE of the hosts that have both."""
    pairs = {host: (_line(parts, host, "stde"), _line(parts, host, "baseline")) for host in HOSTS}
    return {host: (one, other) for host, (one, other) in pairs.items() if one and other}


def _group_gain(there: list[Pair]) -> Interval:
    """Return the mean gain of hosts."""
    if not there:
        return Interval(math.nan)
    part = there[0][0][0]
    return part.difference(_mean([one[1] for one, _ in there]), part, _mean([other[1] for _, other in there]), "sr")


def _apart(a: Interval, b: Interval) -> Interval:
    """Return a less b, of worlds apart; bounds are added, so they are wide."""
    return Interval(a.mean - b.mean, a.low - b.high, a.high - b.low)


def _mean(lines: list[Line]) -> Line:
    """Return the line of a group, the mean of its methods, run by run."""
    values = {metric: sum(getattr(line, metric) for line in lines) / len(lines) for metric in SCALE}
    return dataclasses.replace(lines[0], **values)


def _row(text: str, paper: float, effect: Interval) -> tuple[str, ...]:
    told = "-" if math.isnan(paper) else f"{paper:+.1f}"
    if math.isnan(effect.mean):
        return text, told, "-", "not run"
    return text, told, f"{effect:+z.1f}", Claim(text, "points", effect, POINTS).verdict
