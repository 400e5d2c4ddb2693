"""Batches of runs that are trained side by side with different settings of PPO."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
from support.refusals import assert_message_names
from support.tiny_run import tiny_config

import jaxnav
from jaxnav.errors import InputError
from jaxnav.runs.batch import list_run_configs, train_batch
from jaxnav.runs.run import REACH_FILE


def list_file_times(folder):
    """Modification time of each file below a folder, except for its lock."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("[!.]*") if path.is_file()}


@pytest.mark.slow
def test_run_of_a_batch_is_bit_identical_to_a_single_run(tmp_path):
    """The runs select the best policy by validation, and draw experience dropout for the first time before training."""
    config = tiny_config(tmp_path, arms=("layout",), counterfactual="none", validations=1)
    settings: dict[str, Any] = {
        "learning_rate": [1e-2, 3e-2],
        "entropy": np.array([0.0, 0.1]),
        "experience": (0.5, 0.9),
    }
    chunk_rows = []
    batch = train_batch(config, callback=chunk_rows.append, **settings)
    # Two chunks; in each, a row for both seeds of both runs.
    assert [(row["step"], row["seed"]) for rows in chunk_rows for row in rows] == [
        *((2, seed) for seed in range(4)),
        *((4, seed) for seed in range(4)),
    ]

    # The second run equals a run that `train` gives with its settings.
    second_run = batch[1]
    second_settings = {name: float(values[1]) for name, values in settings.items()}
    ppo = dataclasses.replace(config.ppo, **second_settings)
    single_run = jaxnav.train(dataclasses.replace(config, run_dir=tmp_path / "single", ppo=ppo))
    assert second_run.config == dataclasses.replace(single_run.config, run_dir=tmp_path / "run" / "1")
    assert second_run.log() == single_run.log()
    assert second_run.success_by_budget() == single_run.success_by_budget()
    # All parameters of both seeds.
    jax.tree.map(np.testing.assert_array_equal, second_run.policies().params, single_run.policies().params)

    # The first run has other settings.
    params_of_runs = [run.policies().params for run in batch]
    is_different = jax.tree.map(lambda first_leaf, second_leaf: (first_leaf != second_leaf).any(), *params_of_runs)
    assert any(jax.tree.leaves(is_different))

    # The runs are finished, so a repeated call trains and measures nothing.
    reach_times = [(run.config.run_dir / REACH_FILE).stat().st_mtime_ns for run in batch]
    repeated_batch = train_batch(config, callback=chunk_rows.append, **settings)
    assert len(chunk_rows) == 2
    assert [run.log() for run in repeated_batch] == [run.log() for run in batch]
    assert [(run.config.run_dir / REACH_FILE).stat().st_mtime_ns for run in repeated_batch] == reach_times

    # Other settings make another batch, which is refused in this directory.
    settings["learning_rate"] = [1e-2, 2e-2]
    with pytest.raises(InputError) as error:
        train_batch(config, **settings)
    assert_message_names(error.value, str(tmp_path / "run"), "learning_rate: [0.01, 0.03] != [0.01, 0.02]")

    # A run of the batch has no training state of its own, and `train` does not overwrite it.
    times_before = list_file_times(batch[0].config.run_dir)
    with pytest.raises(InputError) as error:
        jaxnav.train(batch[0].config)
    assert_message_names(error.value, str(batch[0].config.run_dir), "without the state", "train_batch")
    assert list_file_times(batch[0].config.run_dir) == times_before

    # The batch itself is no run.
    with pytest.raises(InputError, match=r"of a batch, give the folder of one run, such as RUN/0"):
        jaxnav.Run.open(config.run_dir).policies()


@pytest.mark.exhaustive
def test_batch_of_one_run_is_not_the_run_without_its_setting(tmp_path):
    config = tiny_config(tmp_path, arms=("layout",), counterfactual="none")
    train_batch(config, learning_rate=[3e-2])
    with pytest.raises(InputError) as error:
        jaxnav.train(config)
    assert_message_names(error.value, str(config.run_dir), "learning_rate: 0.03 != 0.01")


@pytest.mark.parametrize(
    ("settings", "message_parts"),
    [
        ({}, ("no settings", "learning_rate")),
        ({"num_envs": [1, 2]}, ("num_envs", "cannot differ", "learning_rate")),
        ({"learning_rate": 1e-3}, ("learning_rate", "shape ()", "a list")),
        ({"learning_rate": ["fast", 1e-3]}, ("learning_rate", "'fast'", "a list of numbers")),
        ({"learning_rate": [[1], [1, 2]]}, ("learning_rate", "[[1], [1, 2]]", "a list of numbers")),
        ({"final_guidance": [None, 0.1]}, ("final_guidance", "nan", "change the value")),
        ({"learning_rate": [1e-3] * 513}, ("513 runs x 2 seeds", "at most 1,024")),
        ({"learning_rate": []}, ("learning_rate", "shape (0,)", "a list")),
        ({"learning_rate": [1e-3], "entropy": [0.0, 0.1]}, ("different numbers", "learning_rate", "entropy")),
        ({"learning_rate": [1e-3, -1.0]}, ("learning_rate", "-1.0", "positive number")),
        ({"guidance": [0.0, 0.5]}, ("guidance", "two programs", "two batches")),
        ({"final_guidance": [0.0, 0.5]}, ("final_guidance", "two programs", "two batches")),
        ({"experience": [0.8, 1.0]}, ("experience", "two programs", "two batches")),
    ],
)
def test_batch_refuses_impossible_settings(tmp_path, settings, message_parts):
    config = tiny_config(tmp_path, arms=("layout",), counterfactual="none")
    with pytest.raises(InputError) as error:
        train_batch(config, **settings)
    assert_message_names(str(error.value), *message_parts)
    assert not (tmp_path / "run").exists()


def test_configs_of_a_batch_differ_only_in_settings_and_directory(tmp_path):
    config = tiny_config(tmp_path)
    run_configs = list_run_configs(config, {"gamma": [0.9, 0.99]})
    assert [run_config.ppo.gamma for run_config in run_configs] == [0.9, 0.99]
    assert [run_config.run_dir for run_config in run_configs] == [tmp_path / "run" / "0", tmp_path / "run" / "1"]

    # Each equals the configuration of the batch, once its setting and its directory are restored.
    for run_config in run_configs:
        ppo = dataclasses.replace(run_config.ppo, gamma=config.ppo.gamma)
        assert dataclasses.replace(run_config, run_dir=config.run_dir, ppo=ppo) == config
