"""The driver of experiments: measured parts, reused results, refusals, and files of interrupted experiments."""

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
from support.processes import start_python
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
#: A page with all results and the number of missing ones.
TEMPLATE = """# {{ config.title }}

{{ summary }}

Missing: {{ missing | length }}.
{% for row in table.rows %}
{{ line(row.run, row.shift, row.decoding, row.value.mean) }}
{% endfor %}
"""


# Measurements that take no time


@pytest.fixture
def measure_calls(monkeypatch) -> list[tuple[str, Any]]:
    """Calls of two measurements that stand in for all measurements: agent, and shift or `summary`."""
    calls: list[tuple[str, Any]] = []

    def measure_shift(bench: Bench, run: AgentRun, shift: float) -> Iterator[ResultRow]:
        calls.append((run.agent, shift))
        yield ResultRow(world=run.world, run=run.agent, shift=shift, metric="sr", value=Interval(50.0 + shift))

    def measure_summary(bench: Bench, run: AgentRun) -> Iterator[ResultRow]:
        calls.append((run.agent, "summary"))
        yield ResultRow(world=run.world, run=run.agent, metric="spl", value=Interval(25.0))

    measurements = {"shifts": Measurement(measure_shift, parts="shifts"), "summary": Measurement(measure_summary)}
    monkeypatch.setattr(driver, "MEASUREMENTS", measurements)
    return calls


#: Calls and result files of the experiment of `make_config`, in order.
ALL_CALLS = [("a", 0.0), ("a", 0.5), ("b", 0.0), ("b", 0.5), ("b", "summary")]
ALL_FILES = ["near-a-shifts-0", "near-a-shifts-0.5", "near-b-shifts-0", "near-b-shifts-0.5", "near-b-summary"]


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
        measure={"shifts": ["*"], "summary": ["b"]},
        shifts=(0.0, 0.5),
    )
    return check_experiment(dataclasses.replace(config, **changes))


def results_folder(folder: Path) -> Path:
    """Folder of the results on `val`."""
    return folder / "results" / "val"


def test_driver_measures_every_part_and_writes_the_page(measure_calls, tmp_path):
    config = make_config(tmp_path)
    (text,) = run_experiment(config, QUIET)
    assert measure_calls == ALL_CALLS
    assert sorted(path.stem for path in results_folder(tmp_path).iterdir()) == ALL_FILES
    page = (tmp_path / "docs" / "page.md").read_text()
    assert page.strip() == text.strip()
    assert "# Two agents" in page
    assert "Missing: 0." in page
    assert "| b | 0.5 |  | 50.5 |" in page


def test_page_counts_the_missing_results_of_agents_that_were_not_selected(measure_calls, tmp_path):
    (text,) = run_experiment(make_config(tmp_path, only=("near-a",)), QUIET)
    assert measure_calls == ALL_CALLS[:2]
    assert "Missing: 3." in text  # two shifts and the summary of b


def test_driver_reuses_everything_the_second_time(measure_calls, tmp_path):
    config = make_config(tmp_path)
    run_experiment(config, QUIET)

    # A person writes a text between the marks of the page.
    document = tmp_path / "docs" / "page.md"
    mark = "<!-- reading -->"
    document.write_text(document.read_text().replace(f"{mark}\n\n{mark}", f"{mark}\nBy hand.\n{mark}"))
    files_before = contents(tmp_path)
    measure_calls.clear()

    # The second run measures nothing and changes no file.
    run_experiment(config, QUIET)
    assert measure_calls == []
    assert contents(tmp_path) == files_before
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

    # The first call is interrupted; its outcomes are still needed.
    monkeypatch.setattr(driver, "MEASUREMENTS", {"summary": Measurement(measure)})
    config = make_config(tmp_path, measure={"summary": ["b"]})
    with pytest.raises(KeyboardInterrupt):
        run_experiment(config, QUIET)
    assert folders[0].is_dir()

    # The second call finds the folder, which is removed after the part.
    run_experiment(config, QUIET)
    assert folders == [folders[0]] * 2
    assert not folders[0].exists()

    # Other settings have another folder.
    changed_config = dataclasses.replace(config, episodes=7, results=tmp_path / "others")
    run_experiment(changed_config, QUIET)
    assert folders[2].name != folders[0].name


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


@pytest.mark.parametrize("damage", [Path.unlink, truncate, lambda path: path.write_text("")])
def test_driver_measures_parts_again_that_are_missing_or_damaged(measure_calls, tmp_path, damage):
    config = make_config(tmp_path)
    run_experiment(config, QUIET)
    files_before = contents(tmp_path)
    measure_calls.clear()

    # The last shift is damaged, and an earlier part is missing: the page after the earlier part lacks the last shift.
    results = results_folder(tmp_path)
    damage(results / "near-b-shifts-0.5.jsonl")
    (results / "near-a-shifts-0.jsonl").unlink()
    run_experiment(config, QUIET)
    assert measure_calls == [("a", 0.0), ("b", 0.5)]
    assert contents(tmp_path) == files_before


@pytest.mark.parametrize(
    ("changes", "calls"),
    [
        ({"agents": {"a": {}, "b": {"seeds": 4}, "c": {}}}, [("c", 0.0), ("c", 0.5)]),
        ({"shifts": (0.0, 0.5, 1.0)}, [("a", 1.0), ("b", 1.0)]),
        ({"split": "test"}, ALL_CALLS),
        ({"title": "Two others", "runs": Path("elsewhere")}, []),
    ],
)
def test_driver_measures_only_the_parts_that_an_experiment_adds(measure_calls, tmp_path, changes, calls):
    # The summary has no shift, so that it is left out where the shifts change.
    measure = {"shifts": ["*"]}
    if "shifts" not in changes:
        measure["summary"] = ["b"]
    run_experiment(make_config(tmp_path, measure=measure), QUIET)
    measure_calls.clear()
    run_experiment(make_config(tmp_path, measure=measure, **changes), QUIET)
    assert measure_calls == calls


@pytest.mark.parametrize("changes", [{"agents": {"a": {"seed": 1}, "b": {"seeds": 4}}}, {"episodes": 30}])
def test_driver_refuses_to_lose_results_of_other_settings(measure_calls, tmp_path, changes):
    run_experiment(make_config(tmp_path), QUIET)
    files_before = contents(tmp_path)
    measure_calls.clear()

    with pytest.raises(InputError, match=r"near-a-shifts-0\.jsonl.*(seed|episodes)"):
        run_experiment(make_config(tmp_path, **changes), QUIET)
    assert measure_calls == []
    assert contents(tmp_path) == files_before

    # Another folder has no results to lose.
    run_experiment(make_config(tmp_path, results=tmp_path / "others", **changes), QUIET)
    assert measure_calls == ALL_CALLS


def test_driver_refuses_to_lose_results_of_another_format(measure_calls, tmp_path):
    run_experiment(make_config(tmp_path), QUIET)

    # The head of a file tells its format.
    path = results_folder(tmp_path) / "near-a-shifts-0.jsonl"
    head_line, *row_lines = path.read_text().splitlines(keepends=True)
    other_head = json.loads(head_line) | {"format": 2}
    path.write_text("".join([json.dumps(other_head) + "\n", *row_lines]))
    files_before = contents(tmp_path)
    measure_calls.clear()

    with pytest.raises(InputError, match=r"near-a-shifts-0\.jsonl: holds no results of format \d+; move it away"):
        run_experiment(make_config(tmp_path), QUIET)
    assert measure_calls == []
    assert contents(tmp_path) == files_before


def test_driver_goes_on_where_it_was_stopped(measure_calls, tmp_path, monkeypatch):
    run_experiment(make_config(tmp_path / "complete"), QUIET)
    expected_files = contents(tmp_path / "complete")

    # Ctrl-C while the second part is measured.
    config = make_config(tmp_path / "stopped")
    with monkeypatch.context() as patches:
        interrupted_measure = interrupt_second(driver.MEASUREMENTS["shifts"].measure)
        patches.setitem(driver.MEASUREMENTS, "shifts", Measurement(interrupted_measure, parts="shifts"))
        with pytest.raises(KeyboardInterrupt):
            run_experiment(config, QUIET)
    assert [path.stem for path in results_folder(tmp_path / "stopped").iterdir()] == ALL_FILES[:1]
    page = (tmp_path / "stopped" / "docs" / "page.md").read_text()
    assert "Missing: 4." in page
    assert " | 50.0 |" in page

    # The next run measures the missing parts only.
    measure_calls.clear()
    run_experiment(config, QUIET)
    assert measure_calls == ALL_CALLS[1:]
    assert contents(tmp_path / "stopped") == expected_files


def interrupt_second(measure):
    """Make a measurement that is interrupted within its second part."""
    num_calls = 0

    def measure_or_interrupt(*arguments) -> Iterator[ResultRow]:
        nonlocal num_calls
        num_calls += 1
        for row in measure(*arguments):
            yield row
            if num_calls == 2:
                raise KeyboardInterrupt

    return measure_or_interrupt


def test_driver_refuses_a_foreign_document_before_it_measures(measure_calls, tmp_path):
    config = make_config(tmp_path)
    document = tmp_path / "docs" / "page.md"
    document.parent.mkdir()
    document.write_text("My own notes.")
    with pytest.raises(InputError, match=r"page\.md"):
        run_experiment(config, QUIET)
    assert measure_calls == []
    assert document.read_text() == "My own notes."


def test_experiments_share_a_folder_and_ignore_results_of_other_evaluations(measure_calls, tmp_path):
    first_config = make_config(tmp_path, agents={"a": {}}, measure={"shifts": ["*"]})
    second_config = make_config(tmp_path, agents={"b": {}}, measure={"shifts": ["*"]})
    run_experiment(first_config, QUIET)
    run_experiment(second_config, QUIET)
    assert load_results(first_config)["val"].distinct("run") == ["a", "b"]
    assert load_results(dataclasses.replace(first_config, episodes=7)) == {}


# Parts of real measurements


def parts_by_name(config: ExperimentConfig) -> dict[str, Part]:
    return {part.name: part for part in list_parts(config, Bench(config, QUIET))}


def changed_parts(settings: dict[str, dict], other_settings: dict[str, dict]) -> set[str]:
    """Names of the parts whose settings differ."""
    return {name for name in settings if settings[name] != other_settings[name]}


def test_parts_depend_on_the_agents_that_they_compare(tmp_path):
    def settings_by_part(other_seed: int, variant: str = "stde") -> dict[str, dict]:
        config = make_config(
            tmp_path,
            agents={"a": {"against": ["b"]}, "b": {"seed": other_seed}, "c": {}, "anonymous": {"seed": other_seed}},
            measure={"evaluation": ["a", "c"], "groups": ["c"], "account": ["a"], "trials": ["a"]},
            groups={"all": {"agents": ["b"], "variant": variant, "against": "layout"}},
        )
        return {name: part.settings for name, part in parts_by_name(config).items()}

    # The evaluation of `a` is compared with `b`, the group holds `b`, and the account is against `anonymous`.
    settings = settings_by_part(0)
    expected_parts = {"near-a-evaluation", "near-c-groups", "near-a-account"}
    assert changed_parts(settings, settings_by_part(1)) == expected_parts

    # A group depends on the variants that it compares.
    assert changed_parts(settings, settings_by_part(0, variant="tde")) == {"near-c-groups"}
    assert list(settings) == [
        *("near-a-evaluation", "near-c-evaluation", "near-c-groups", "near-a-account"),
        *("near-a-trials-0", "near-a-trials-0.5"),
    ]


# Whole experiments


def write_experiment(folder: Path, text: str) -> Path:
    path = folder / "experiment.yaml"
    path.write_text(text)
    return path


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_experiment_from_training_to_its_page(tmp_path, capsys):
    # The settings of the tiny run, without its seeds, are the base of the runs.
    base_lines = [f"  {line}\n" for line in CONFIG_YAML.strip().splitlines() if not line.startswith("seeds")]
    base = "".join(base_lines)
    document = tmp_path / "docs" / "page.md"
    path = write_experiment(
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

    # The runs have the settings of the file, and the stored scores equal those of an evaluation.
    run = Run.open(tmp_path / "runs" / "near-main")
    assert Run.open(tmp_path / "runs" / "near-anonymous").config.method == "anonymous"
    expected_results = jaxnav.evaluate(run, shift=0.0, episodes=24, form=("residual",))
    table = load_results(apply_yaml(ExperimentConfig(), path))["val"]
    for row in expected_results.report["rows"]:
        if row["variant"] in ("baseline", "layout"):
            fields = {
                "world": "near",
                "run": "main",
                "variant": row["variant"],
                "decoding": row["decoding"],
                "shift": 0.0,
            }
            # Files hold seven digits.
            assert table.find(fields, metric="sr").mean == pytest.approx(row["sr"]["mean"], rel=1e-6)
            assert table.has(fields, reference="anonymous", metric="sr")
    training_time = table.find(world="near", run="main", metric="training (s)").mean
    assert training_time == pytest.approx(run.times()[-1]["wall_s"], rel=1e-6)
    assert "near: main, val" in document.read_text()

    # The second command changes no file.
    files_before = contents(tmp_path)
    assert command.main([str(path)]) == 0
    assert contents(tmp_path) == files_before


def files_below(folder: Path, name: str) -> dict[str, bytes]:
    """Bytes of the files of a folder whose relative path begins with a name."""
    return {path: data for path, data in contents(folder).items() if path.startswith(name)}


@pytest.mark.exhaustive
@pytest.mark.timeout(900)
def test_a_killed_experiment_goes_on_to_the_same_files(drawn_run, tmp_path):
    template = tmp_path / "template.md"
    template.write_text(TEMPLATE)

    def start(folder: Path):
        folder.mkdir(exist_ok=True)
        run = f"{{run: {drawn_run.config.run_dir}}}"
        path = write_experiment(
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

    # Kill the process once the first of two parts is written.
    killed_folder = tmp_path / "killed"
    complete_folder = tmp_path / "complete"
    first_part = results_folder(killed_folder) / "near-a-evaluation.jsonl"
    process = start(killed_folder)
    while process.poll() is None and not first_part.exists():
        time.sleep(0.01)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert [path.name for path in results_folder(killed_folder).glob("*.jsonl")] == [first_part.name]
    modified_ns = first_part.stat().st_mtime_ns

    # The next process finishes the experiment and does not measure the first part again. Its files equal those of an
    # uninterrupted experiment.
    for folder in (killed_folder, complete_folder):
        process = start(folder)
        _, error = process.communicate()
        assert process.returncode == 0, error
    assert first_part.stat().st_mtime_ns == modified_ns
    for name in ("page.md", "results"):
        complete_files = files_below(complete_folder, name)
        assert complete_files != {}
        assert files_below(killed_folder, name) == complete_files
