"""The training runs change what they are called after."""

from pathlib import Path

from jaxnav.study.config import CHANGES, StudyConfig
from jaxnav.study.runs import run_config, study_runs


def test_every_run_changes_what_it_is_called_after():
    config = StudyConfig(runs=Path("somewhere"))
    main = run_config(config, "main")
    assert main.run_dir == Path("somewhere/main")
    for name in CHANGES:
        run = run_config(config, name)
        assert run.run_dir == Path("somewhere") / name
        assert (run == main) == (name == "main")
        assert (run.seeds, run.total_steps, run.worlds.num_val) == (5, 2_000_000, 80)
    assert run_config(config, "coin").arms == ("layout",)
    assert run_config(config, "released").layout.setting == "released"
    assert run_config(config, "shaping").worlds.shaping == 1.0
    assert run_config(config, "shaping").worlds.num_test == 80
    assert run_config(StudyConfig(real=Path("file.jsonl")), "real").scenes == Path("file.jsonl")


def test_main_comes_first_and_real_last():
    config = StudyConfig(trainings=("coin", "main", "coin"), real=Path("file.jsonl"))
    assert list(study_runs(config)) == ["main", "coin", "real"]
