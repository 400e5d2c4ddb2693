"""Configurations of experiments: their runs, refused settings, and the packaged experiments."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from support.processes import REPOSITORY

from jaxnav.errors import InputError
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import (
    EXPERIMENTS,
    AgentRun,
    ExperimentConfig,
    agent_runs,
    check_experiment,
    measured_runs,
    part_settings,
)
from jaxnav.experiments.driver import check_measurements, list_parts
from jaxnav.experiments.pages import check_page
from jaxnav.experiments.table import has_part
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.config_files import apply_yaml
from jaxnav.runs.run import run_settings

#: Experiments that measure finished runs.
FINISHED_RUN_EXPERIMENTS = ("account", "cde", "mixture", "handover", "instrument")
WORLDS = {"near": {"world": "rooms"}, "far": {"world": "apartments", "seeds": 4}}
AGENTS = {"plain": {}, "wide": {"sizes": {"hidden": 256}, "seeds": 5}}


def make_config(**changes: Any) -> ExperimentConfig:
    config = ExperimentConfig(worlds=WORLDS, agents=AGENTS, base=RunConfig(seeds=2, total_steps=1000))
    return dataclasses.replace(config, **changes)


def list_names(runs: list[AgentRun]) -> list[str]:
    return [run.name for run in runs]


def find_run(config: ExperimentConfig, name: str) -> AgentRun:
    (run,) = [run for run in agent_runs(config) if run.name == name]
    return run


# Runs of an experiment


def test_agents_override_settings_of_worlds_which_override_the_base():
    config = make_config()
    seeds = {run.name: run.config.seeds for run in agent_runs(config)}
    # The base has two seeds, the world `far` four, and the agent `wide` five.
    assert seeds == {"near-plain": 2, "near-wide": 5, "far-plain": 4, "far-wide": 5}

    # All settings that neither a world nor an agent changes are those of the base.
    far_wide = find_run(config, "far-wide").config
    assert (far_wide.world, far_wide.total_steps, far_wide.sizes.hidden) == ("apartments", 1000, 256)
    assert far_wide.sizes == dataclasses.replace(RunConfig().sizes, hidden=256)


def test_each_run_has_its_own_folder():
    config = make_config(runs=Path("somewhere"), agents={"hoz:PERMUTED": {"method": "hoz"}})
    run_dirs = [run.config.run_dir for run in agent_runs(config)]

    # A hyphen replaces the colon, which some file systems refuse.
    assert run_dirs == [Path("somewhere/near-hoz-PERMUTED"), Path("somewhere/far-hoz-PERMUTED")]


@pytest.mark.parametrize(
    ("patterns", "names"),
    [
        ({"left_out": ("far-*",)}, ["near-plain", "near-wide"]),
        ({"left_out": ("*-wide", "far-plain")}, ["near-plain"]),
        ({"only": ("*-wide",)}, ["near-wide", "far-wide"]),
        ({"only": ("near-*", "far-wide"), "left_out": ("*-wide",)}, ["near-plain"]),
    ],
)
def test_patterns_select_the_measured_runs(patterns, names):
    config = check_experiment(make_config(**patterns))
    assert list_names(measured_runs(config, "evaluation")) == names


def test_left_out_runs_do_not_exist_and_unselected_runs_do():
    config = make_config(only=("near-*",), left_out=("*-wide",))
    assert list_names(agent_runs(config)) == ["near-plain", "far-plain"]


def test_measured_runs_match_by_agent_or_by_world_and_agent():
    config = make_config(measure={"evaluation": ["wide", "far-plain"], "trials": []})
    assert list_names(measured_runs(config, "evaluation")) == ["near-wide", "far-plain", "far-wide"]
    assert measured_runs(config, "trials") == []


def test_missing_scenes_are_no_error_for_readers_of_results():
    config = check_experiment(make_config(worlds={"near": {"scenes": "missing.jsonl.gz"}}))
    assert find_run(config, "near-plain").config.scenes == Path("missing.jsonl.gz")


def test_part_settings_differ_for_other_runs_and_evaluations():
    config = make_config()
    plain_run = find_run(config, "near-plain")
    wide_run = find_run(config, "near-wide")
    settings = part_settings(config, plain_run, [wide_run])

    # The folder of the runs and the title are no part of the settings.
    renamed_config = make_config(runs=Path("elsewhere"), title="Another")
    assert settings == part_settings(renamed_config, plain_run, [wide_run])

    # Another run, another setting of the evaluation, another reference, and no reference.
    longer_run = wide_run._replace(config=dataclasses.replace(wide_run.config, total_steps=2000))
    assert settings != part_settings(config, wide_run, [wide_run])
    assert settings != part_settings(make_config(episodes=7), plain_run, [wide_run])
    assert settings != part_settings(config, plain_run, [longer_run])
    assert settings != part_settings(config, plain_run, [])


# Finished runs in place of agents


def test_finished_runs_replace_the_agents(drawn_run):
    run_dir = drawn_run.config.run_dir
    config = check_experiment(
        ExperimentConfig(run=run_dir, reference=str(run_dir), agents={}, pages={"docs/account.md": "account"})
    )

    # The run determines the world, and all files are written to its folder.
    runs = agent_runs(config)
    assert list_names(runs) == ["rooms-main", "rooms-anonymous"]
    for run in runs:
        assert run.is_external
        assert run.config.run_dir == run_dir
        assert run_settings(run.config) == run_settings(check_config(drawn_run.config))
    assert config.results == run_dir / "results"
    assert config.pages == {str(run_dir / "account.md"): "account"}


def test_finished_runs_of_agents_keep_their_settings_and_references(drawn_run):
    finished = {"run": str(drawn_run.config.run_dir), "against": ["plain/layout"]}
    config = make_config(worlds={"near": {}}, agents={"plain": {}, "done": finished})
    runs = agent_runs(check_experiment(config))
    assert run_settings(runs[1].config) == run_settings(check_config(drawn_run.config))
    assert runs[1].against == ("plain/layout",)
    assert [run.is_external for run in runs] == [False, True]


# Refusals


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        # The evaluation.
        ({"shifts": ()}, "shifts"),
        ({"shifts": (0.5, 0.5)}, "shifts"),
        ({"shifts": (1.0, 0.0)}, "shifts"),
        ({"shifts": (0.0, 2.0)}, "shifts"),
        ({"shifts": (float("nan"),)}, "shifts"),
        ({"epsilon": ()}, "epsilon"),
        ({"epsilon": (-1.0,)}, "epsilon"),
        ({"epsilon": (float("inf"),)}, "epsilon"),
        ({"epsilon": (float("nan"),)}, "epsilon"),
        ({"episodes": 0}, "episodes"),
        ({"steps": 0}, "steps"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**32}, "seed"),
        ({"decodings": ()}, "decodings"),
        # Names.
        ({"worlds": {"a/b": {}}}, "'a/b'"),
        ({"agents": {"": {}}}, "''"),
        ({"worlds": {"a": {}, "a-b": {}}, "agents": {"b-c": {}, "c": {}}}, "a-b-c"),
        # Runs.
        ({"base": RunConfig(seeds=0)}, "near-plain.*seeds"),
        ({"base": RunConfig(devices="cluster")}, "near-plain.*devices"),
        ({"agents": {"plain": {"devices": "cluster"}}}, "near-plain.*devices"),
        ({"worlds": {"near": {"world": "flats"}}}, "worlds.near.*world"),
        ({"agents": {"plain": {"sizes": {"hiden": 8}}}}, "agents.plain.*sizes.hiden"),
        ({"agents": {"plain": {"ppo": {"rollout": 0}}}}, "near-plain.*ppo.rollout"),
        ({"worlds": {}}, "worlds"),
        ({"agents": {}}, "agents"),
        ({"left_out": ("*",)}, "left_out"),
        ({"only": ("nothing-*",)}, "only"),
        # References.
        ({"agents": {"plain": {"against": ["plane"]}}}, "agents.plain.against.*'plane'"),
        ({"agents": {"plain": {"against": ["plain/layuot"]}}}, "agents.plain.against.*'layuot'"),
        ({"agents": {"plain": {"against": "plain"}}}, "agents.plain.against"),
        ({"agents": {"plain": {"run": "nowhere"}}}, "nowhere"),
        ({"agents": {"plain": {"against": ["wide/random"]}, "wide": {"seeds": 5}}}, "near-plain.*seeds"),
        # Measurements and groups.
        ({"measure": {"evaluation": ["plane"]}}, "measure.evaluation"),
        ({"measure": {"evaluation": ["plain", "plane"]}}, "measure.evaluation: 'plane'"),
        ({"groups": {"plain": {"agents": ["wide"], "variant": "stde", "against": "layout"}}}, "groups.plain"),
        ({"measure": {"evaluation": "plain"}}, "measure.evaluation"),
        ({"measure": {"evaluation": [1]}}, "measure.evaluation"),
        ({"groups": {"all": {}}}, "groups.all"),
        ({"groups": {"all": {"agents": [], "variant": "stde", "against": "layout"}}}, "groups.all.agents"),
        ({"groups": {"all": {"agents": ["plane"], "variant": "stde", "against": "layout"}}}, "groups.all.agents"),
        ({"groups": {"all": {"agents": ["plain"], "variant": "std", "against": "layout"}}}, "groups.all.variant"),
        (
            {"groups": {"all": {"agents": ["plain"], "variant": "stde", "against": "plane/layout"}}},
            "groups.all.against",
        ),
        # Folds are worlds, each of one dataset.
        ({"folds": {"all": "near"}}, "folds.all: 'near'"),
        ({"folds": {"all": []}}, r"folds.all: \[\]"),
        ({"folds": {"all": ["nowhere"]}}, "folds.all: 'nowhere'"),
        ({"folds": {"near": ["near"]}}, "folds.near: a world"),
        ({"folds": {"all": ["near"], "both": ["near"]}}, "listed twice"),
        (
            {"worlds": {"near": {}, "far": {}}, "folds": {"all": ["near", "far"]}, "left_out": ("far-plain",)},
            "left_out: plain .*far",
        ),
        # Finished runs.
        ({"run": Path("nowhere")}, "nowhere"),
        ({"reference": "nowhere"}, "reference.*nowhere"),
        ({"run": Path("nowhere"), "agents": {"plain": {}}}, "nowhere"),
    ],
)
def test_invalid_settings_are_refused_by_name(changes, message):
    with pytest.raises(InputError, match=message) as refusal:
        check_experiment(make_config(**changes))
    assert "\n" not in str(refusal.value)


def test_a_finished_run_is_refused_next_to_other_agents(drawn_run):
    with pytest.raises(InputError, match=r"run: .*already has agents"):
        check_experiment(make_config(run=drawn_run.config.run_dir))


def test_finished_runs_refuse_settings(drawn_run):
    agents = {"done": {"run": str(drawn_run.config.run_dir), "seeds": 3}}
    with pytest.raises(InputError, match=r"agents\.done.*seeds"):
        check_experiment(make_config(agents=agents))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measure": {"trails": ["*"]}}, "measure: 'trails'"),
        # These measurements compare shifts.
        ({"measure": {"growth": ["*"]}, "shifts": (0.5,)}, "shifts"),
        ({"measure": {"mixture": ["*"]}, "shifts": (0.5,)}, "shifts"),
        ({"removals": ("surprise, papper*",)}, "removals: 'surprise, papper"),
    ],
)
def test_impossible_measurements_are_refused_by_name(changes, message):
    with pytest.raises(InputError, match=message):
        check_measurements(make_config(**changes))


# Packaged experiments


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_packaged_experiments_are_valid(name, drawn_run, monkeypatch):
    monkeypatch.chdir(REPOSITORY)
    config = apply_yaml(ExperimentConfig(), name, EXPERIMENTS)
    if name in FINISHED_RUN_EXPERIMENTS:
        config = dataclasses.replace(config, run=drawn_run.config.run_dir, reference=str(drawn_run.config.run_dir))
    config = check_measurements(config)

    # Every page can be written, and every part has its own file.
    for document, template in config.pages.items():
        check_page(Path(document), template)
    parts = list_parts(config, Bench(config, Console(quiet=True)))
    assert len({part.name for part in parts}) == len(parts) > 0


@pytest.mark.parametrize("name", sorted(set(EXPERIMENTS) - set(FINISHED_RUN_EXPERIMENTS)))
def test_committed_results_are_recognized(name, monkeypatch):
    monkeypatch.chdir(REPOSITORY)
    packaged_config = apply_yaml(ExperimentConfig(), name, EXPERIMENTS)

    # Results on `val` are complete unless a page says that they are not finished; those on `test` may be missing.
    is_unfinished = any("**Not finished:**" in Path(page).read_text() for page in packaged_config.pages)
    for split in ("val", "test"):
        may_be_missing = is_unfinished or split == "test"
        config = check_experiment(dataclasses.replace(packaged_config, split=split))
        for part in list_parts(config, Bench(config, Console(quiet=True))):
            path = config.results / split / f"{part.name}.jsonl"
            assert has_part(path, part.settings) or (may_be_missing and not path.exists()), path
