"""Runs trained side by side, with different settings of PPO."""

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


def file_times(folder):
    """When each file below a folder was written, except for its lock."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("[!.]*") if path.is_file()}


@pytest.mark.slow
def test_a_run_of_a_batch_is_the_run_that_train_gives(tmp_path):
    """Bit for bit, with best policies by validation and experience dropout, whose first draw precedes training."""
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

    # The second run is that of `train` with its settings.
    second_run = batch[1]
    ppo = dataclasses.replace(config.ppo, **{name: float(values[1]) for name, values in settings.items()})
    alone = jaxnav.train(dataclasses.replace(config, run_dir=tmp_path / "alone", ppo=ppo))
    assert second_run.config == dataclasses.replace(alone.config, run_dir=tmp_path / "run" / "1")
    assert second_run.log() == alone.log()
    assert second_run.success_by_budget() == alone.success_by_budget()
    # All parameters of both seeds.
    jax.tree.map(np.testing.assert_array_equal, second_run.policies().params, alone.policies().params)

    # The first run has other settings.
    params = [run.policies().params for run in batch]
    assert any(jax.tree.leaves(jax.tree.map(lambda first, second: (first != second).any(), *params)))

    # The runs are finished, so that the same call trains and measures nothing.
    reach_times = [(run.config.run_dir / REACH_FILE).stat().st_mtime_ns for run in batch]
    repeated = train_batch(config, callback=chunk_rows.append, **settings)
    assert len(chunk_rows) == 2
    assert [run.log() for run in repeated] == [run.log() for run in batch]
    assert [(run.config.run_dir / REACH_FILE).stat().st_mtime_ns for run in repeated] == reach_times

    # Other settings are another batch.
    settings["learning_rate"] = [1e-2, 2e-2]
    with pytest.raises(InputError) as error:
        train_batch(config, **settings)
    assert_message_names(error.value, str(tmp_path / "run"), "learning_rate: [0.01, 0.03] != [0.01, 0.02]")

    # A run of the batch has no training state of its own, and is not trained over.
    times_before = file_times(batch[0].config.run_dir)
    with pytest.raises(InputError) as error:
        jaxnav.train(batch[0].config)
    assert_message_names(error.value, str(batch[0].config.run_dir), "without the state", "train_batch")
    assert file_times(batch[0].config.run_dir) == times_before

    # The batch itself is no run.
    with pytest.raises(InputError, match=r"of a batch, give the folder of one run, such as RUN/0"):
        jaxnav.Run.open(config.run_dir).policies()


@pytest.mark.exhaustive
def test_a_batch_of_one_run_is_not_the_run_without_its_setting(tmp_path):
    config = tiny_config(tmp_path, arms=("layout",), counterfactual="none")
    train_batch(config, learning_rate=[3e-2])
    with pytest.raises(InputError) as error:
        jaxnav.train(config)
    assert_message_names(error.value, str(config.run_dir), "learning_rate: 0.03 != 0.01")


@pytest.mark.parametrize(
    ("settings", "parts"),
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
def test_a_batch_refuses_impossible_settings(tmp_path, settings, parts):
    config = tiny_config(tmp_path, arms=("layout",), counterfactual="none")
    with pytest.raises(InputError) as error:
        train_batch(config, **settings)
    assert_message_names(str(error.value), *parts)
    assert not (tmp_path / "run").exists()


def test_points_differ_in_the_settings_alone(tmp_path):
    config = tiny_config(tmp_path)
    points = list_run_configs(config, {"gamma": [0.9, 0.99]})
    assert [point.ppo.gamma for point in points] == [0.9, 0.99]
    assert [point.run_dir for point in points] == [tmp_path / "run" / "0", tmp_path / "run" / "1"]
    for point in points:
        changed = dataclasses.replace(
            point, run_dir=config.run_dir, ppo=dataclasses.replace(point.ppo, gamma=config.ppo.gamma)
        )
        assert changed == config
