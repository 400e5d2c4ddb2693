"""The training runs change what they are called after."""

from pathlib import Path

from jaxnav.study.config import RUN_CHANGES, StudyConfig, study_run_config, study_run_configs


def test_every_run_changes_what_it_is_called_after():
    config = StudyConfig(runs=Path("somewhere"))
    main = study_run_config(config, "main")
    assert main.run_dir == Path("somewhere/main")
    for name in RUN_CHANGES:
        run = study_run_config(config, name)
        assert run.run_dir == Path("somewhere") / name
        assert (run == main) == (name == "main")
        assert (run.seeds, run.total_steps, run.worlds.num_val) == (5, 2_000_000, 80)
    assert study_run_config(config, "coin").arms == ("layout",)
    assert study_run_config(config, "released").layout.setting == "released"
    assert study_run_config(config, "shaping").worlds.shaping == 1.0
    assert study_run_config(config, "shaping").worlds.num_test == 80
    assert study_run_config(StudyConfig(real=Path("file.jsonl")), "real").scenes == Path("file.jsonl")


def test_main_comes_first_and_real_last():
    config = StudyConfig(trainings=("coin", "main", "coin"), real=Path("file.jsonl"))
    assert list(study_run_configs(config)) == ["main", "coin", "real"]
