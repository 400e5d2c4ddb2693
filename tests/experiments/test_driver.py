"""The driver of experiments: what it measures, what it reuses, and what it leaves when it is stopped."""

import dataclasses
import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from support.commands import contents
from support.processes import run as start_python
from support.tiny_run import CONFIG_YAML

import jaxnav
from jaxnav.cli import study as command
from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments import driver
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import AgentRun, ExperimentConfig, check_experiment
from jaxnav.experiments.driver import Measurement, Part, list_parts, load_results, run_experiment
from jaxnav.experiments.table import ResultRow
from jaxnav.runs.config_files import apply_yaml
from jaxnav.runs.run import Run

QUIET = Console(quiet=True)
#: A page with all results, and the number of those that are missing.
TEMPLATE = """# {{ config.title }}

{{ summary }}

Missing: {{ missing | length }}.
{% for row in table.rows %}
{{ line(row.run, row.shift, row.decoding, row.value.mean) }}
{% endfor %}
"""


# Measurements that take no time


@pytest.fixture
def measured(monkeypatch) -> list[tuple[str, Any]]:
    """Replace all measurements by two that only say of what they were taken; returns what they said."""
    calls: list[tuple[str, Any]] = []

    def measure_shift(bench: Bench, run: AgentRun, shift: float) -> Iterator[ResultRow]:
        calls.append((run.agent, shift))
        yield ResultRow(world=run.world, run=run.agent, shift=shift, metric="sr", value=Interval(50.0 + shift))

    def measure_run(bench: Bench, run: AgentRun) -> Iterator[ResultRow]:
        calls.append((run.agent, "whole"))
        yield ResultRow(world=run.world, run=run.agent, metric="spl", value=Interval(25.0))

    measurements = {"shifts": Measurement(measure_shift, parts="shifts"), "whole": Measurement(measure_run)}
    monkeypatch.setattr(driver, "MEASUREMENTS", measurements)
    return calls


#: What the experiment of `make_config` measures, in order, and the files that it leaves.
ALL_CALLS = [("a", 0.0), ("a", 0.5), ("b", 0.0), ("b", 0.5), ("b", "whole")]
ALL_FILES = ["near-a-shifts-0", "near-a-shifts-0.5", "near-b-shifts-0", "near-b-shifts-0.5", "near-b-whole"]


def make_config(folder: Path, **changes: Any) -> ExperimentConfig:
    """An experiment with all its files below a folder."""
    folder.mkdir(exist_ok=True)
    template = folder / "template.md"
    template.write_text(TEMPLATE)
    config = ExperimentConfig(
        title="Two agents",
        results=folder / "results",
        runs=folder / "runs",
        pages={str(folder / "docs" / "page.md"): str(template)},
        worlds={"near": {}},
        agents={"a": {}, "b": {"seeds": 4}},
        measure={"shifts": ["*"], "whole": ["b"]},
        shifts=(0.0, 0.5),
    )
    return check_experiment(dataclasses.replace(config, **changes))


def results_of(folder: Path) -> Path:
    return folder / "results" / "val"


def test_driver_measures_every_part_and_writes_the_page(measured, tmp_path):
    config = make_config(tmp_path)
    (text,) = run_experiment(config, QUIET)
    assert measured == ALL_CALLS
    assert sorted(path.stem for path in results_of(tmp_path).iterdir()) == ALL_FILES
    page = (tmp_path / "docs" / "page.md").read_text()
    assert page.strip() == text.strip()
    assert "# Two agents" in page
    assert "Missing: 0." in page
    assert "| b | 0.5 |  | 50.5 |" in page


def test_page_tells_what_is_missing_of_agents_that_were_not_selected(measured, tmp_path):
    (text,) = run_experiment(make_config(tmp_path, only=("near-a",)), QUIET)
    assert measured == ALL_CALLS[:2]
    assert "Missing: 3." in text  # both shifts of b, and its whole


def test_driver_reuses_everything_the_second_time(measured, tmp_path):
    config = make_config(tmp_path)
    run_experiment(config, QUIET)
    document = tmp_path / "docs" / "page.md"
    mark = "<!-- reading -->"
    document.write_text(document.read_text().replace(f"{mark}\n\n{mark}", f"{mark}\nBy hand.\n{mark}"))
    before = contents(tmp_path)
    measured.clear()

    run_experiment(config, QUIET)
    assert measured == []
    assert contents(tmp_path) == before
    assert "By hand." in document.read_text()


def test_driver_keeps_unfinished_outcomes_only_until_a_part_is_finished(tmp_path, monkeypatch):
    folders = []

    def measure(bench: Bench, run: AgentRun) -> Iterator[ResultRow]:
        folders.append(bench.unfinished_folder)
        assert bench.unfinished_folder is not None
        bench.unfinished_folder.mkdir(parents=True, exist_ok=True)
        if len(folders) == 1:
            raise KeyboardInterrupt
        yield ResultRow(world=run.world, run=run.agent, metric="spl", value=Interval(25.0))

    monkeypatch.setattr(driver, "MEASUREMENTS", {"whole": Measurement(measure)})
    config = make_config(tmp_path, measure={"whole": ["b"]})
    with pytest.raises(KeyboardInterrupt):
        run_experiment(config, QUIET)
    assert folders[0].is_dir()
    run_experiment(config, QUIET)
    assert folders == [folders[0]] * 2
    assert not folders[0].exists()

    # Other settings have other outcomes.
    changed_config = dataclasses.replace(config, episodes=7, results=tmp_path / "others")
    run_experiment(changed_config, QUIET)
    assert folders[2].name != folders[0].name


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


@pytest.mark.parametrize("damage", [Path.unlink, truncate, lambda path: path.write_text("")])
def test_driver_measures_parts_again_that_are_missing_or_damaged(measured, tmp_path, damage):
    config = make_config(tmp_path)
    run_experiment(config, QUIET)
    before = contents(tmp_path)
    measured.clear()

    # The last part is damaged, and an earlier one is missing: the page after it is written without the damaged one.
    results = results_of(tmp_path)
    damage(results / "near-b-shifts-0.5.jsonl")
    (results / "near-a-shifts-0.jsonl").unlink()
    run_experiment(config, QUIET)
    assert measured == [("a", 0.0), ("b", 0.5)]
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("changes", "calls"),
    [
        ({"agents": {"a": {}, "b": {"seeds": 4}, "c": {}}}, [("c", 0.0), ("c", 0.5)]),
        ({"shifts": (0.0, 0.5, 1.0)}, [("a", 1.0), ("b", 1.0)]),
        ({"split": "test"}, ALL_CALLS),
        ({"title": "Two others", "runs": Path("elsewhere")}, []),
    ],
)
def test_driver_measures_what_an_experiment_has_more(measured, tmp_path, changes, calls):
    # Another shift does not concern what is measured at none.
    measure = {"shifts": ["*"]} if "shifts" in changes else {"shifts": ["*"], "whole": ["b"]}
    run_experiment(make_config(tmp_path, measure=measure), QUIET)
    measured.clear()
    run_experiment(make_config(tmp_path, measure=measure, **changes), QUIET)
    assert measured == calls


@pytest.mark.parametrize("changes", [{"agents": {"a": {"seed": 1}, "b": {"seeds": 4}}}, {"episodes": 30}])
def test_driver_refuses_to_lose_results_of_other_settings(measured, tmp_path, changes):
    run_experiment(make_config(tmp_path), QUIET)
    before = contents(tmp_path)
    measured.clear()

    with pytest.raises(InputError, match=r"near-a-shifts-0\.jsonl.*(seed|episodes)"):
        run_experiment(make_config(tmp_path, **changes), QUIET)
    assert measured == []
    assert contents(tmp_path) == before

    # In another folder there is nothing to lose.
    run_experiment(make_config(tmp_path, results=tmp_path / "others", **changes), QUIET)
    assert measured == ALL_CALLS


def test_driver_refuses_to_lose_results_of_another_format(measured, tmp_path):
    run_experiment(make_config(tmp_path), QUIET)
    path = results_of(tmp_path) / "near-a-shifts-0.jsonl"
    head, *lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([json.dumps(json.loads(head) | {"format": 2}) + "\n", *lines]))
    before = contents(tmp_path)
    measured.clear()

    with pytest.raises(InputError, match=r"near-a-shifts-0\.jsonl: holds no results of format \d+; move it away"):
        run_experiment(make_config(tmp_path), QUIET)
    assert measured == []
    assert contents(tmp_path) == before


def test_driver_goes_on_where_it_was_stopped(measured, tmp_path, monkeypatch):
    run_experiment(make_config(tmp_path / "whole"), QUIET)
    expected = contents(tmp_path / "whole")

    # Ctrl-C while the second part is measured.
    config = make_config(tmp_path / "stopped")
    with monkeypatch.context() as patches:
        interrupted = Measurement(interrupt_second(driver.MEASUREMENTS["shifts"].measure), parts="shifts")
        patches.setitem(driver.MEASUREMENTS, "shifts", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_experiment(config, QUIET)
    assert [path.stem for path in results_of(tmp_path / "stopped").iterdir()] == ALL_FILES[:1]
    page = (tmp_path / "stopped" / "docs" / "page.md").read_text()
    assert "Missing: 4." in page
    assert " | 50.0 |" in page

    measured.clear()
    run_experiment(config, QUIET)
    assert measured == ALL_CALLS[1:]
    assert contents(tmp_path / "stopped") == expected


def interrupt_second(measure):
    """Measure once, and be interrupted within the second part."""
    num_calls = 0

    def measure_or_interrupt(*arguments) -> Iterator[ResultRow]:
        nonlocal num_calls
        num_calls += 1
        for row in measure(*arguments):
            yield row
            if num_calls == 2:
                raise KeyboardInterrupt

    return measure_or_interrupt


def test_driver_refuses_a_foreign_document_before_it_measures(measured, tmp_path):
    config = make_config(tmp_path)
    document = tmp_path / "docs" / "page.md"
    document.parent.mkdir()
    document.write_text("My own notes.")
    with pytest.raises(InputError, match=r"page\.md"):
        run_experiment(config, QUIET)
    assert measured == []
    assert document.read_text() == "My own notes."


def test_experiments_share_a_folder_and_ignore_results_of_other_evaluations(measured, tmp_path):
    first = make_config(tmp_path, agents={"a": {}}, measure={"shifts": ["*"]})
    second = make_config(tmp_path, agents={"b": {}}, measure={"shifts": ["*"]})
    run_experiment(first, QUIET)
    run_experiment(second, QUIET)
    assert load_results(first)["val"].distinct("run") == ["a", "b"]
    assert load_results(dataclasses.replace(first, episodes=7)) == {}


# Parts of real measurements


def parts_of(config: ExperimentConfig) -> dict[str, Part]:
    return {part.name: part for part in list_parts(config, Bench(config, QUIET))}


def test_parts_depend_on_the_agents_that_they_compare(tmp_path):
    def settings_of(other_seed: int, variant: str = "stde", shape: str = "layout") -> dict[str, dict]:
        config = make_config(
            tmp_path,
            agents={"a": {"against": ["b"]}, "b": {"seed": other_seed}, "c": {}, "anonymous": {"seed": other_seed}},
            measure={"evaluation": ["a", "c"], "groups": ["c"], "account": ["a"], "trials": ["a"]},
            groups={"all": {"agents": ["b"], "variant": variant, "against": shape}},
        )
        return {name: part.settings for name, part in parts_of(config).items()}

    # The evaluation of `a` is compared with `b`, the group holds `b`, and the account is against `anonymous`.
    before = settings_of(0)
    after = settings_of(1)
    assert {name for name in before if before[name] != after[name]} == {
        "near-a-evaluation",
        "near-c-groups",
        "near-a-account",
    }
    # Groups depend on what they compare.
    other_group = settings_of(0, variant="tde")
    assert {name for name in before if before[name] != other_group[name]} == {"near-c-groups"}
    assert list(before) == [
        *("near-a-evaluation", "near-c-evaluation", "near-c-groups", "near-a-account"),
        *("near-a-trials-0", "near-a-trials-0.5"),
    ]


# Whole experiments


def experiment_file(folder: Path, text: str) -> Path:
    path = folder / "experiment.yaml"
    path.write_text(text)
    return path


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_experiment_from_training_to_its_page(tmp_path, capsys):
    base = "".join(f"  {line}\n" for line in CONFIG_YAML.strip().splitlines() if not line.startswith("seeds"))
    document = tmp_path / "docs" / "page.md"
    path = experiment_file(
        tmp_path,
        f"""
results: {tmp_path / "results"}
runs: {tmp_path / "runs"}
pages: {{{document}: account}}
worlds: {{near: {{}}}}
agents:
  main: {{}}
  anonymous: {{method: anonymous, method_sizes: {{}}, arms: [baseline]}}
measure: {{account: [main], evaluation: [main]}}
shifts: [0.0]
episodes: 24
base:
  seeds: 2
  arms: [layout]
{base}""",
    )
    assert command.main([str(path)]) == 0
    capsys.readouterr()

    # The runs are what their settings say, and the numbers those of their evaluation.
    run = Run.open(tmp_path / "runs" / "near-main")
    assert Run.open(tmp_path / "runs" / "near-anonymous").config.method == "anonymous"
    expected = jaxnav.evaluate(run, shift=0.0, episodes=24, form=("residual",))
    table = load_results(apply_yaml(ExperimentConfig(), path))["val"]
    for row in expected.report["rows"]:
        if row["variant"] in ("baseline", "layout"):
            fields = {
                "world": "near",
                "run": "main",
                "variant": row["variant"],
                "decoding": row["decoding"],
                "shift": 0.0,
            }
            # Files have seven digits.
            assert table.find(fields, metric="sr").mean == pytest.approx(row["sr"]["mean"], rel=1e-6)
            assert table.has(fields, reference="anonymous", metric="sr")
    assert table.find(world="near", run="main", metric="training (s)").mean == pytest.approx(
        run.times()[-1]["wall_s"], rel=1e-6
    )
    assert "near: main, val" in document.read_text()

    # Nothing is done again.
    before = contents(tmp_path)
    assert command.main([str(path)]) == 0
    assert contents(tmp_path) == before


@pytest.mark.exhaustive
@pytest.mark.timeout(900)
def test_a_killed_experiment_goes_on_to_the_same_files(drawn_run, tmp_path):
    template = tmp_path / "template.md"
    template.write_text(TEMPLATE)

    def start(folder: Path):
        folder.mkdir(exist_ok=True)
        run = f"{{run: {drawn_run.config.run_dir}}}"
        path = experiment_file(
            folder,
            f"""
results: {folder / "results"}
pages: {{{folder / "page.md"}: {template}}}
worlds: {{near: {{}}}}
agents: {{a: {run}, b: {run}}}
shifts: [0.0]
episodes: 8
""",
        )
        return start_python(["-m", "jaxnav", "study", path])

    # Killed once the first of two parts is there.
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    first_part = results_of(killed) / "near-a-evaluation.jsonl"
    process = start(killed)
    while process.poll() is None and not first_part.exists():
        time.sleep(0.01)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert [path.name for path in results_of(killed).glob("*.jsonl")] == [first_part.name]
    written = first_part.stat().st_mtime_ns

    # Left alone, it ends with the same files; the first part is not measured again.
    for folder in (killed, whole):
        process = start(folder)
        _, error = process.communicate()
        assert process.returncode == 0, error
    assert first_part.stat().st_mtime_ns == written
    for name in ("page.md", "results"):
        killed_files = {path: data for path, data in contents(killed).items() if path.startswith(name)}
        assert killed_files == {path: data for path, data in contents(whole).items() if path.startswith(name)} != {}
