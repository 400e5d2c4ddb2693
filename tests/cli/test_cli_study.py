"""The study command: its options, its refusals, and the results of a finished run."""

import pytest
from support.commands import contents, refusal
from support.tiny_run import draw_run, tiny_config

from jaxnav import __main__ as commands
from jaxnav.cli.study import parse_study
from jaxnav.experiments.config import EXPERIMENTS
from jaxnav.runs.run import Run

#: An experiment that needs no policies: frontier search.
EXPERIMENT = r"""
title: "Search \e[31m in red"
pages: {PAGE: TEMPLATE}
measure: {frontier: [main]}
shifts: [0.0]
episodes: 8
"""
TEMPLATE = """# {{ config.title }}

{{ summary }}

{% for row in table.rows %}
{{ line(row.run, row.metric, row.value.mean | f(".2f")) }}
{% endfor %}
"""


@pytest.fixture(scope="module")
def drawn_run(tmp_path_factory) -> Run:
    return draw_run(tiny_config(tmp_path_factory.mktemp("runs")))


@pytest.fixture
def experiment(tmp_path):
    """File of a small experiment, with a template and a page next to it."""
    template_path = tmp_path / "template.md"
    template_path.write_text(TEMPLATE)
    page_path = tmp_path / "page.md"
    path = tmp_path / "experiment.yaml"
    path.write_text(EXPERIMENT.replace("PAGE", str(page_path)).replace("TEMPLATE", str(template_path)))
    return path


def study(*options) -> int:
    """Run the study command, and return its exit code."""
    return commands.main(["study", *map(str, options)])


# Help and refusals


def test_study_help_lists_experiments_and_settings(capsys):
    with pytest.raises(SystemExit, match="0"):
        study("--help")
    words = capsys.readouterr().out.replace(",", " ").split()
    assert {*EXPERIMENTS, "--run", "--reference", "--split", "--episodes"} <= set(words)


def test_config_option_selects_another_version_of_an_experiment(capsys):
    config = parse_study(["study", "--config", "rooms", "--episodes", "7"])
    assert config == parse_study(["study_rooms", "--episodes", "7"])

    # A version that does not exist is refused.
    assert study("study", "--config", "quik") == 2
    assert "--config quik: is unknown; choose from ithor, rooms" in refusal(capsys)
    assert study("table3", "--config", "quick") == 2
    assert "table3 has no other version; omit --config" in refusal(capsys)


def test_results_option_moves_the_pages_unless_they_are_given():
    pages = {"docs/few_scenes.md": "factors"}
    assert parse_study(["few_scenes"]).pages == pages
    # Pages of other results are written next to them: stored pages are replaced only if the command names them.
    assert parse_study(["few_scenes", "--results", "new/results"]).pages == {"new/results/few_scenes.md": "factors"}
    assert parse_study(["few_scenes", "--results=new"]).pages == {"new/few_scenes.md": "factors"}
    assert parse_study(["few_scenes", "--results", "new", "--pages", "{docs/few_scenes.md: factors}"]).pages == pages


def test_study_lists_the_experiments_for_an_unknown_one(capsys):
    assert study("studdy") == 2
    error = refusal(capsys)
    for name in ("studdy", *EXPERIMENTS):
        assert name in error


@pytest.mark.parametrize(
    ("options", "error_part"),
    [
        (["--shifts", "1", "0"], "shifts"),
        (["--epsilon", "-1"], "epsilon"),
        (["--episodes", "0"], "episodes"),
        (["--only", "nothing"], "only"),
        (["--base.seeds", "0"], "seeds"),
        (["--base.devices", "cluster"], "devices"),
        (["--worlds", "{a/b: {}}"], "a/b"),
        (["--agents", "{main: {sedes: 1}}"], "agents.main"),
        (["--agents", "{main: {against: [plane]}}"], "plane"),
        (["--measure", "{trails: ['*']}"], "trails"),
        (["--measure", "{mixture: ['*']}"], "shifts"),
        (["--pages", "{page.md: no_such_page}"], "no_such_page"),
        (["--run", "nowhere"], "nowhere"),
        (["--reference", "nowhere"], "reference"),
    ],
)
def test_study_refuses_bad_settings_in_one_line_and_writes_nothing(
    experiment, tmp_path, monkeypatch, capsys, options, error_part
):
    monkeypatch.chdir(tmp_path)
    contents_before = contents(tmp_path)
    assert study(experiment, *options) == 2
    output = capsys.readouterr()
    assert output.out == ""
    (error,) = output.err.splitlines()
    assert error.startswith("error: ")
    assert error_part in error
    assert contents(tmp_path) == contents_before


@pytest.mark.parametrize(("option", "value"), [("--split", "all"), ("--worlds", "[1"), ("--agents", "{near: 1}")])
def test_study_names_options_of_wrong_type(experiment, capsys, option, value):
    with pytest.raises(SystemExit, match="2"):
        study(experiment, option, value)
    assert option in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "error_part"),
    [("shifts: [0.0", "line"), ("shfits: [0.0]", "shfits"), ("shifts: 0.0", "shifts"), ("agents: {a: 1}", "agents")],
)
def test_study_names_file_and_key_of_a_bad_config(tmp_path, capsys, text, error_part):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    assert study(path) == 2
    error = refusal(capsys)
    assert str(path) in error
    assert error_part in error


@pytest.mark.parametrize("name", ["account", "mixture", "instrument", "compare"])
def test_former_commands_name_their_replacement(capsys, name):
    assert commands.main([name, "run"]) == 2
    error = refusal(capsys)
    replacement = error.partition("jaxnav study ")[2].split()[0]
    assert replacement in EXPERIMENTS
    assert name == "compare" or replacement == name


# Finished runs


def test_study_of_a_run_prints_and_stores_the_results(experiment, drawn_run, capsys):
    run_dir = drawn_run.config.run_dir
    assert study(experiment, "--run", run_dir) == 0
    output = capsys.readouterr().out
    # Control characters of a title would change the terminal.
    assert "# Search \\x1b[31m in red" in output
    assert "| main | sr | " in output
    assert (run_dir / "page.md").exists()
    assert [path.stem for path in (run_dir / "results" / "val").iterdir()] == ["rooms-main-frontier"]


@pytest.mark.exhaustive
def test_study_account_of_a_run_over_itself_is_zero_for_the_baseline(drawn_run, capsys):
    # The run itself stands in for layout-blind agents, so that its baseline has no lead.
    run_dir = drawn_run.config.run_dir
    assert study("account", "--run", run_dir, "--reference", run_dir, "--episodes", 24) == 0
    output = capsys.readouterr().out
    assert output.strip() == (run_dir / "account.md").read_text().strip()

    # Each shift has one row of the baseline.
    for shift in (0, 1):
        section = output.partition(f"Leads at shift {shift}")[2].partition("Leads at")[0]
        (baseline_row,) = [line for line in section.splitlines() if line.startswith("| `main` | best")]
        assert baseline_row.count("+0.0") >= 4
