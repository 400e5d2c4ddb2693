"""Committed pages are written from the committed results, which are those of the packaged experiments."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import pytest
from rich.console import Console
from support.processes import REPOSITORY
from support.tiers import params_by_tier

from jaxnav.experiments import pages
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import EXPERIMENTS, ExperimentConfig, agent_runs, check_experiment
from jaxnav.experiments.driver import Part, list_parts, write_pages
from jaxnav.experiments.pages import READING_MARK, max_trained_steps
from jaxnav.experiments.table import read_part, write_part
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.local_policy import LocalPolicy
from jaxnav.runs.config_files import apply_yaml

#: Experiments whose results are committed; the remaining experiments measure a run that the user gives.
COMMITTED: dict[str, ExperimentConfig] = {}
for _name in EXPERIMENTS:
    _config = apply_yaml(ExperimentConfig(), _name, EXPERIMENTS)
    if _config.results != ExperimentConfig().results:
        COMMITTED[_name] = check_experiment(_config)


@pytest.fixture(autouse=True)
def skip_figures(monkeypatch):
    """Pages are written without drawing figures, from the root of the checkout, to which paths are relative."""
    monkeypatch.chdir(REPOSITORY)

    def name_figure(document, name, table, shifts, fields):
        return f"images/{document.stem}/{name}.png"

    monkeypatch.setattr(pages, "_draw_figure", name_figure)


def list_all_parts(config: ExperimentConfig) -> list[Part]:
    return list_parts(config, Bench(config, Console(quiet=True)))


def copy_documents(config: ExperimentConfig, folder: Path) -> ExperimentConfig:
    """Experiment with copies of its documents in a folder."""
    copies = {}
    for document, template in config.pages.items():
        copies[str(shutil.copy(document, folder))] = template
    return dataclasses.replace(config, pages=copies)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMITTED)
def test_committed_documents_are_written_from_the_committed_results(name, tmp_path):
    config = COMMITTED[name]
    copied_config = copy_documents(config, tmp_path)
    write_pages(copied_config, list_all_parts(copied_config))
    for document, copied_document in zip(config.pages, copied_config.pages, strict=True):
        content = Path(document).read_bytes()
        assert Path(copied_document).read_bytes() == content

        # The figures of the document are committed, too.
        for image in re.findall(r"!\[[^\]]*\]\((images/[^)]+)\)", content.decode()):
            assert (Path(document).parent / image).is_file()


def test_every_committed_file_of_results_belongs_to_an_experiment():
    known_paths = set()
    for config in COMMITTED.values():
        for split in ("val", "test"):
            split_config = dataclasses.replace(config, split=split)
            known_paths |= {config.results / split / f"{part.name}.jsonl" for part in list_all_parts(split_config)}
    committed_paths = {path.relative_to(REPOSITORY) for path in (REPOSITORY / "results").rglob("*.jsonl")}
    assert committed_paths
    assert committed_paths <= known_paths


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMITTED)
def test_committed_results_are_rewritten_without_a_change(name, tmp_path):
    new_path = tmp_path / "part.jsonl"
    for path in sorted(COMMITTED[name].results.rglob("*.jsonl")):
        head_line, *row_lines = path.read_text().splitlines()
        head = json.loads(head_line)
        write_part(new_path, head["settings"], read_part(path))
        new_head_line, *new_row_lines = new_path.read_text().splitlines()
        assert new_row_lines == row_lines
        assert json.loads(new_head_line)["shared"] == head["shared"]


#: Experiments whose pages together use all templates of tables.
SLOW_EXPERIMENTS = ["claims", "streams", "table2", "table3", "study_rooms", "accounts", "removal_houses"]


@pytest.mark.parametrize("name", params_by_tier(COMMITTED, slow=SLOW_EXPERIMENTS))
def test_pages_can_be_written_with_partial_results(name, tmp_path):
    """Pages are written after every part, so that an interrupted experiment has them."""
    config = dataclasses.replace(copy_documents(COMMITTED[name], tmp_path), results=tmp_path / "results")
    parts = list_all_parts(config)
    (config.results / "val").mkdir(parents=True)
    page_indices = (0, len(parts) // 3, 2 * len(parts) // 3, len(parts) - 1)

    # Copy one part after another, and write the pages after the first, the last and some parts between them. An
    # unfinished experiment lacks results, which its page says.
    for index, part in enumerate(parts):
        path = COMMITTED[name].results / "val" / f"{part.name}.jsonl"
        if path.exists():
            shutil.copy(path, config.results / "val")
        if index in page_indices:
            for text in write_pages(config, parts):
                assert text.count(READING_MARK) == 2
                assert "nan" not in re.findall(r"\w+", text)


# Agents of the tables


@pytest.mark.parametrize("name", ["table2", "real"])
def test_table_2_has_the_methods_of_the_paper(name):
    # Further agents are layout-blind agents, EOTP adapted to ever changing scenes, and more seeds of ORG.
    methods = set(COMMITTED[name].agents) - {"anonymous", "eotp:ADAPTED", "org-again"}
    hosts = {method for method in methods if not method.endswith("-streams")}
    assert hosts == {"rgb", "sp", "savn", "eotp", "org", "tpn", "vtnet", "hoz"}

    # Hosts of the layout are trained without it, with it, and with two streams.
    for run in agent_runs(COMMITTED[name]):
        hosts_layout = find_method(run.config.method).hosts_layout
        if run.agent.endswith("-streams"):
            assert (run.config.decision, run.config.arms) == ("streams", ("layout",))
        else:
            assert (run.config.decision, "layout" in run.config.arms) == ("fused", hosts_layout)
        if hosts_layout and run.agent in hosts:
            assert f"{run.agent}-streams" in methods


@pytest.mark.parametrize("name", ["table2", "table3", "ablations", "real", "real_homes"])
def test_all_methods_of_a_world_learn_from_equally_many_steps(name):
    runs_by_world: dict[str, list] = {}
    for run in agent_runs(COMMITTED[name]):
        # `semexp:NEAREST` learns nothing, and `belief` fits predictors.
        if run.agent not in ("semexp:NEAREST", "belief"):
            runs_by_world.setdefault(run.world, []).append(run)
    for runs in runs_by_world.values():
        assert len({max_trained_steps([run]) for run in runs}) == 1
        assert {run.config.seeds for run in runs} <= {3, 5}


@pytest.mark.parametrize("name", ["table3", "real_homes"])
def test_rollouts_have_two_choices_of_methods_that_choose_goals(name):
    for run in agent_runs(COMMITTED[name]):
        assert run.config.ppo.rollout >= 2 * LocalPolicy.interval
