"""The compare command: from training to the document, and what it refuses."""

import json

import numpy as np
import pytest
from support.commands import CONFIG, contents, evaluate, refusal

from jaxnav.cli import study as command
from jaxnav.evaluation.statistics import Interval
from jaxnav.study import compare
from jaxnav.study.document import READING_MARK
from jaxnav.study.records import AgentScores, RunScores, TrainingSummary

OWN = ("method: ", "method_sizes: ")  # every run has its own, or one method alone has them
BASE = "".join(f"  {line}\n" for line in CONFIG.strip().splitlines() if not line.startswith(OWN))
COMPARE = f"""
worlds:
  near: {{world: rooms}}
  far: {{worlds: {{num_val: 5}}}}
methods: [anonymous, org]
ablations: {{org: [rgb]}}
episodes: 24
base:
{BASE}"""

RUNS = ["anonymous-fused", "org-fused", "org-streams", "rgb-fused", "rgb-streams"]
PARTS = ["near-frontier", "far-frontier", *(f"{world}-{name}" for world in ("near", "far") for name in RUNS)]


def run(folder, *options):
    """Run the command with all its files below a folder."""
    config = folder / "compare.yaml"
    config.write_text(COMPARE)
    places = {"results": "results", "document": "docs/table.md", "runs": "runs"}
    given = [part for name, place in places.items() for part in (f"--{name}", str(folder / place))]
    return command.compare_main(["--config", str(config), *given, *map(str, options)])


def tables(folder):
    """Return the cells of the document's rows, by section and first cell."""
    results = {}
    for section in (folder / "docs" / "table.md").read_text().split("### ")[1:]:
        title, *lines = section.splitlines()
        rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("|")]
        results.setdefault(title, {row[0]: row[1:] for row in rows})  # of the first world
    return results


def agent(variant, decoding, successes):
    """Return a line of two seeds that succeed so often in each of three scenes of four episodes."""
    sums = np.tile(np.array(successes, float), (2, 1))
    return AgentScores(variant, decoding, sr=sums, spl=sums / 2.0, dts=4.0 - sums)


@pytest.fixture
def steps(monkeypatch):
    """Replace all work; return the names of its steps."""
    names = []

    def drawn(name, lines, training=None):
        names.append(name)
        scenes = ("a", "b", "c")
        return RunScores(scenes, ("Kitchen",) * 3, np.array([4, 4, 4]), tuple(lines), training)

    def frontier(config, shared, console):
        return drawn(
            "far-frontier" if shared.worlds.num_val == 5 else "near-frontier", [agent("frontier", "argmax", (4, 4, 4))]
        )

    def entry(config, entry, console):
        more = entry.decision == "streams"
        lines = [agent("random", "sample", (0, 1, 0))]
        for decoding in ("argmax", "sample"):
            lines += [agent(arm, decoding, (1, 2, 2 + more)) for arm in entry.run.arms]
            lines += [agent("stde", decoding, (1, 3, 3))] * ("layout" in entry.run.arms)
        budget = {"exploration": 1280, "imitation": 0, "learning": 512}
        return drawn(entry.name, lines, TrainingSummary(budget, 90.0, (10.0, 12.5), ("Note of all.",)))

    monkeypatch.setattr(compare, "measure_frontier", frontier)
    monkeypatch.setattr(compare, "measure_run", entry)
    return names


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_numbers_of_the_document_are_those_of_an_evaluation(tmp_path):
    options = ("--worlds", "{near: {}}", "--methods", "org", "--ablations", "{}")
    assert run(tmp_path, *options) == 0
    results, target = tables(tmp_path), tmp_path / "eval.json"
    agents = {"fused": "`org`", "streams": "`org`, streams"}
    names = {"baseline": "", "layout": " + w", "stde": " + w + sTDE"}
    for decision, name in agents.items():
        assert evaluate(tmp_path / "runs" / f"near-org-{decision}", "--episodes", 24, "--json", target) == 0
        report = json.loads(target.read_text())
        titles = {"random": "Random", "oracle": "Shortest path"}
        titles |= {variant: name + text for variant, text in names.items()}
        rows = [row for row in report["rows"] if row["variant"] in titles]
        assert len(rows) == (8 if decision == "fused" else 6)
        for row in rows:
            section = results[f"Success, {'sampled' if row['decoding'] == 'sample' else 'best'} actions"]
            cells = [
                f"{Interval.from_json(row[metric]):.{digits}f}"
                for metric, digits in zip(("sr", "spl", "dts"), (1, 1, 2), strict=True)
            ]
            assert section[titles[row["variant"]]] == cells
        for difference in report["differences"]:
            if difference["metric"] == "sr" and difference["to"] in names:
                section = results[
                    f"Improvements, {'sampled' if difference['decoding'] == 'sample' else 'best'} actions"
                ]
                title = f"{name}{names[difference['to']]} over {name}{names[difference['from']]}"
                assert section[title][0] == f"{Interval.from_json(difference):+z.1f}"
    # Again: nothing is done anew.
    before = contents(tmp_path)
    assert run(tmp_path, *options) == 0
    assert contents(tmp_path) == before


# The command alone, on given results


def test_the_papers_tables_stand_beside_all_results_of_the_folder(steps, tmp_path):
    paper, rooms = tmp_path / "paper.md", ("--worlds", "{rooms: {}}")
    assert run(tmp_path, *rooms, "--paper", paper) == 0
    row = next(line for line in paper.read_text().splitlines() if line.startswith("| `org` + w | 71.40"))
    assert " | 41.7 [" in row  # 1 + 2 + 2 of 12 episodes
    assert "rooms-org-fused" in steps
    # Results that another call of the command has left stay on the page.
    assert run(tmp_path, "--worlds", "{apartments: {}}", "--ablations", "{}", "--paper", paper) == 0
    assert row in paper.read_text()


def test_the_document_holds_every_agent_and_every_improvement(steps, tmp_path):
    assert run(tmp_path) == 0
    assert steps == PARTS
    text, results = (tmp_path / "docs" / "table.md").read_text(), tables(tmp_path)
    assert "2 seeds of each policy" in text
    assert "512 in near, 512 in far. 24 episodes in each world, of the split `val`" in text
    assert "Not finished" not in text
    assert "## near: 3 scenes, 12 episodes" in text
    assert "* All runs: Note of all.\n" in text
    runs = ["`org`", "`org` + w", "`org` + w + sTDE", "`org`, streams + w", "`org`, streams + w + sTDE"]
    rows = [*runs, *(name.replace("org", "rgb") for name in runs)]
    for name in ("best", "sampled"):
        section = results[f"Success, {name} actions"]
        assert list(section)[2:] == ["Random", "Frontier search", "`anonymous`", *rows]
        improved = results[f"Improvements, {name} actions"]
        assert list(improved)[2:] == [
            "`org` over `anonymous`",
            "`org` + w over `org`",
            "`org` + w + sTDE over `org` + w",
            "`org` + w + sTDE over `org`",
            "`org`, streams + w + sTDE over `org`, streams + w",
            "`org`, streams + w over `org` + w",
            "`org`, streams + w + sTDE over `org` + w + sTDE",
            *(f"{one} over {one.replace('org', 'rgb')}" for one in runs),
        ]
    assert results["Success, best actions"]["`org` + w"][0].startswith("41.7 [")
    assert results["Improvements, best actions"]["`org` + w + sTDE over `org` + w"][0].startswith("+16.7 [")
    assert results["Improvements, best actions"]["`org`, streams + w over `org` + w"][2].startswith("-0.08 [")
    assert results["What the runs took"]["`org`, streams"] == ["1,280", "0", "512", "1.5", "10.0 → 12.5"]


def test_runs_are_left_out_by_their_names_and_the_document_says_so(steps, tmp_path):
    assert run(tmp_path, "--left-out", "far-*-fused", "*rgb-streams") == 0
    assert steps == [part for part in PARTS if "rgb-streams" not in part and part[:4] + part[-6:] != "far--fused"]
    text = (tmp_path / "docs" / "table.md").read_text()
    assert "\nLeft out in near, for what they would take: `rgb`, streams.\n" in text
    assert "\nLeft out in far, for what they would take: `anonymous`; `org`; `rgb`; `rgb`, streams.\n" in text
    assert "Not finished" not in text


def test_random_choices_stand_beside_the_method_that_makes_them(steps, tmp_path):
    """1 of 12 episodes against 5; no method here chooses actions, so there are no random ones."""
    only = ("--methods", "semexp", "--ablations", "{}", "--worlds", "{near: {}}", "--decisions", "fused")
    assert run(tmp_path, *only) == 0
    results = tables(tmp_path)
    rows = ["`semexp`", "`semexp` + w", "`semexp` + w + sTDE", "`semexp`, random choices"]
    assert list(results["Success, best actions"])[2:] == ["Frontier search", *rows]
    assert results["Success, best actions"][rows[-1]][0].startswith("8.3 [")
    improved = results["Improvements, best actions"]
    # By scene 1 - 0, 2 - 1 and 2 - 0 of four: all runs are alike, so their number does not widen the interval.
    assert improved["`semexp` over `semexp`, random choices"][0].startswith("+33.3 [")
    assert "`semexp` + w + sTDE over `semexp`, random choices" in improved
    assert run(tmp_path, *only[:1], "semexp", "rgb", *only[2:]) == 0
    assert "Random" in tables(tmp_path)["Success, best actions"]


def test_only_what_is_missing_or_of_other_settings_is_done(steps, tmp_path, capsys):
    def again(*options):
        steps.clear()
        assert run(tmp_path, *options) == 0
        return steps

    assert again() == PARTS
    document = tmp_path / "docs" / "table.md"
    document.write_text(
        document.read_text().replace(f"{READING_MARK}\n\n{READING_MARK}", f"{READING_MARK}\nBy hand.\n{READING_MARK}")
    )
    before = contents(tmp_path)
    assert "were there already" not in capsys.readouterr().err
    assert again() == []
    assert f"{len(PARTS)} results in" in " ".join(capsys.readouterr().err.split())
    assert contents(tmp_path) == before
    (tmp_path / "results" / "val" / "near-org-fused.json").unlink()
    (tmp_path / "results" / "val" / "far-rgb-fused.json").write_text("{")
    assert again() == ["near-org-fused", "far-rgb-fused"]
    assert contents(tmp_path) == before
    # A method more leaves what is there; another threshold does not matter to a searcher, other episodes do.
    assert again("--methods", "anonymous", "org", "sp") == [
        f"{world}-sp-{how}" for world in ("near", "far") for how in ("fused", "streams")
    ]
    assert again("--epsilon", 0.2) == PARTS[2:]
    assert again("--episodes", 30, "--epsilon", 0.2) == PARTS


def test_an_interrupted_comparison_says_so_and_goes_on(steps, tmp_path, monkeypatch):
    measure = compare.measure_run

    def interrupted(config, entry, console):
        if entry.name == "near-org-streams":
            raise KeyboardInterrupt
        return measure(config, entry, console)

    monkeypatch.setattr(compare, "measure_run", interrupted)
    assert run(tmp_path) == 130
    text = (tmp_path / "docs" / "table.md").read_text()
    assert "**Not finished:** 8 of 10 runs are missing." in text
    assert "## near" in text
    assert "## far" not in text
    monkeypatch.setattr(compare, "measure_run", measure)
    steps.clear()
    assert run(tmp_path) == 0
    assert steps == PARTS[4:]


# Refusals


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--methods", "orgg", "--ablations", "{}"], "method 'orgg': is unknown; did you mean 'org'?"),
        (["--methods"], "methods: empty: give one or more, each once"),
        (["--methods", "org", "org"], "methods: org, org: give one or more, each once"),
        (["--ablations", "{vtnet: [rgb]}"], "ablations: 'vtnet' is none of the methods anonymous, org"),
        (["--unlearned", "eotp"], "unlearned: 'eotp' is not compared; leave it out"),
        (["--left-out", "near-*", "far-*"], "left_out: near-*, far-*: leaves no run to compare; give fewer patterns"),
        (["--worlds", "{}"], "worlds: empty: give one or more"),
        (["--worlds", "{a/b: {}}"], "worlds: 'a/b': is part of file names; give letters"),
        (["--worlds", "{flat: {world: flats}}"], "worlds.flat: world must be one of 'rooms', 'apartments'"),
        (["--worlds", "{flat: {seeds: 3}}"], "worlds.flat.seeds: a world may change world, scenes, worlds, detector"),
        (["--worlds", "{flat: {worlds: {shift: 2.0}}}"], "flat-anonymous-fused: config: worlds.shift is 2.0; give"),
        (["--base.seeds", "0"], "config: seeds is 0; give at least 1"),
        (["--base.method", "rgb"], "base.method: every run has its own; leave it out and give `methods`"),
        (["--episodes", "0"], "episodes: 0: give at least 1"),
        (["--epsilon", "-1"], "epsilon: -1.0: give a number from 0"),
        (["--base.devices", "cluster"], "base.devices: cluster: all runs are trained in one process"),
    ],
)
def test_bad_requests_are_refused_before_any_training(steps, tmp_path, capsys, options, problem):
    assert run(tmp_path, *options) == 2
    error = refusal(capsys)
    assert error.startswith(f"error: {tmp_path / 'compare.yaml'}: ")
    assert problem in error
    assert steps == []
    assert set(contents(tmp_path)) == {"compare.yaml"}


def test_another_document_is_refused(steps, tmp_path, capsys):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "table.md").write_text("My own notes.")
    assert run(tmp_path) == 2
    assert "give another --document" in refusal(capsys)
    assert steps == []


def test_a_mapping_of_another_kind_is_refused(tmp_path, capsys):
    for text in ("[1", "[near]", "{near: 1}"):
        with pytest.raises(SystemExit):
            run(tmp_path, "--worlds", text)
        assert "mapping" in capsys.readouterr().err
