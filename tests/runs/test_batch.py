"""Runs trained side by side, with different settings of PPO."""

import dataclasses

import jax
import numpy as np
import pytest
from support.refusals import assert_message_names
from support.tiny_run import tiny_config

import jaxnav
from jaxnav.errors import InputError
from jaxnav.runs.batch import list_points, train_batch

LEARNING_RATES = (1e-2, 3e-2)
ENTROPIES = (0.0, 0.1)


@pytest.mark.slow
def test_each_run_of_a_batch_is_the_run_that_train_gives(tmp_path):
    """Two settings of PPO differ between the runs, and experience is dropped, which is drawn before the first step."""
    config = tiny_config(tmp_path, arms=("layout",), counterfactual="none")
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, experience=0.5))
    chunk_rows = []
    batch = train_batch(
        config,
        callback=chunk_rows.append,
        learning_rate=LEARNING_RATES,
        entropy=np.array(ENTROPIES),
        experience=[0.5, 0.9],
    )
    # Two chunks; in each, a row for both seeds of both runs.
    assert [(row["step"], row["seed"]) for rows in chunk_rows for row in rows] == [
        *((2, seed) for seed in range(4)),
        *((4, seed) for seed in range(4)),
    ]

    for index, run in enumerate(batch):
        ppo = dataclasses.replace(
            config.ppo,
            learning_rate=LEARNING_RATES[index],
            entropy=ENTROPIES[index],
            experience=(0.5, 0.9)[index],
        )
        alone = jaxnav.train(dataclasses.replace(config, run_dir=tmp_path / f"alone-{index}", ppo=ppo))
        assert run.config == dataclasses.replace(alone.config, run_dir=tmp_path / "run" / str(index))
        assert run.log() == alone.log()

        # All parameters of both seeds are the same, bit for bit.
        jax.tree.map(np.testing.assert_array_equal, run.policies().params, alone.policies().params)

    # The setting reached the training: the runs differ.
    params = [run.policies().params for run in batch]
    assert any(jax.tree.leaves(jax.tree.map(lambda first, second: (first != second).any(), *params)))

    # The runs are finished, so that the same call trains nothing.
    repeated = train_batch(
        config, callback=chunk_rows.append, learning_rate=LEARNING_RATES, entropy=ENTROPIES, experience=[0.5, 0.9]
    )
    assert len(chunk_rows) == 2
    assert repeated == batch

    # Other settings are another batch.
    with pytest.raises(InputError) as error:
        train_batch(config, learning_rate=(1e-2, 2e-2), entropy=ENTROPIES, experience=[0.5, 0.9])
    assert_message_names(str(error.value), str(tmp_path / "run"), "learning_rate: [0.01, 0.03] != [0.01, 0.02]")


@pytest.mark.parametrize(
    ("settings", "parts"),
    [
        ({}, ("no settings", "learning_rate")),
        ({"num_envs": [1, 2]}, ("num_envs", "cannot differ", "learning_rate")),
        ({"learning_rate": 1e-3}, ("learning_rate", "shape ()", "a list")),
        ({"learning_rate": []}, ("learning_rate", "shape (0,)", "a list")),
        ({"learning_rate": [1e-3], "entropy": [0.0, 0.1]}, ("different numbers", "learning_rate", "entropy")),
        ({"learning_rate": [1e-3, -1.0]}, ("learning_rate", "-1.0", "positive number")),
        ({"guidance": [0.0, 0.5]}, ("guidance", "0 in some runs")),
        ({"experience": [0.8, 1.0]}, ("experience", "1 in some runs")),
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
    points = list_points(config, {"gamma": [0.9, 0.99]})
    assert [point.ppo.gamma for point in points] == [0.9, 0.99]
    assert [point.run_dir for point in points] == [tmp_path / "run" / "0", tmp_path / "run" / "1"]
    for point in points:
        changed = dataclasses.replace(point, run_dir=config.run_dir, ppo=dataclasses.replace(point.ppo, gamma=0.99))
        assert changed == config
