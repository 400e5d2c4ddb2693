"""The one tiny run of the tests: its settings, and the run trained by the command or drawn at random.

Two seeds of two arms on four rooms of each split, so a training takes seconds:
`write_config` and `tiny_config` give its settings, `finished_run` a directory that the train command has finished, and
`draw_run` a directory with policies that act by what they see.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.gaps import CooccurrenceEvidence
from jaxnav.layout import ESTIMATORS, EstimatorConfig
from jaxnav.policies.method import Knowledge
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.config_files import apply_yaml
from jaxnav.runs.policies import POLICIES_DIR, export_policy
from jaxnav.runs.run import Run, claim_run_dir
from jaxnav.scenes.task import DONE
from jaxnav.training.calibration import Exploration, co_visibility_from_counts, layout_priors
from support.commands import train
from support.tiny_world import random_params

CONFIG_YAML = """
method: org
seeds: 2
total_steps: 512  # 4 updates, 2 chunks
counterfactual: distil
chunk: 2
save_every: 1
validations: 0
worlds: {num_train: 4, num_val: 4, num_test: 4, train_step_limit: 10, step_limit: 12, large_step_limit: 14}
layout: {setting: calibrated, walks: 64, steps: 20}
sizes: {hidden: 16, view_outputs: 8, appearance: 4, row_hidden: 8, row_outputs: 2}
method_sizes: {relation_layers: 1}
ppo: {num_envs: 16, rollout: 8, epochs: 1, minibatches: 2, learning_rate: 1e-2, distil: 0.1}
"""
NUM_SEEDS = 2
POLICY_NAMES = ("baseline-0", "baseline-1", "layout-0", "layout-1")

#: Weak prior rows let a view change the belief much. The gaps are then large enough for sTDE to act on.
DRAWN_ESTIMATOR = dataclasses.replace(ESTIMATORS["calibrated"], strength=1.0)


def write_config(folder: Path, num_seeds: int = NUM_SEEDS) -> Path:
    """Write the settings as `tiny.yaml` into a folder, and return the file."""
    config_file = folder / "tiny.yaml"
    config_file.write_text(CONFIG_YAML.replace(f"seeds: {NUM_SEEDS}", f"seeds: {num_seeds}"))
    return config_file


def tiny_config(folder: Path, **changes: Any) -> RunConfig:
    """Return the settings of the tiny run, with changes, for the run directory `folder / "run"`."""
    folder.mkdir(exist_ok=True)
    config = apply_yaml(RunConfig(), write_config(folder))
    return check_config(dataclasses.replace(config, run_dir=folder / "run", **changes))


def finished_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the config file and the directory of a run that the train command has finished.

    The run is trained once for all tests of a session. The directory also holds the temporary file that a process
    leaves when it is killed while it writes the config.
    """
    folder = tmp_path_factory.getbasetemp() / "finished"
    config_file = folder / "tiny.yaml"
    run_dir = folder / "run"
    if not folder.exists():
        run_dir.mkdir(parents=True)
        (run_dir / ".config.json.123.tmp").write_text("{")
        assert train(write_config(folder), run_dir) == 0
    return config_file, run_dir


def draw_run(config: RunConfig, layout_estimator: EstimatorConfig = DRAWN_ESTIMATOR) -> Run:
    """Fill a run directory with random policies of every arm and seed, and return the run.

    Policies of a few updates never choose Done, so all their episodes are alike; random ones act by what they see.
    With K categories, the exploration counts, the log odds and the layout priors have the shape [NUM_PRIORS, K, K].
    """
    claim_run_dir(config)
    num_categories = len(config.task.categories)
    shape = (NUM_PRIORS, num_categories, num_categories)

    # No pair is seen more often than each of its two categories.
    counts = np.random.default_rng(0).integers(0, 9, shape).astype(np.float32)
    counts[:, np.arange(num_categories), np.arange(num_categories)] = 9
    exploration = Exploration(jnp.asarray(counts), jnp.asarray(counts), jnp.int32(1280), jnp.int32(600))

    # What exploration would have taught: co-occurrence evidence above the diagonal, and a prior per room type.
    log_odds = np.triu(np.random.default_rng(1).normal(size=shape), 1).astype(np.float32)
    evidence = CooccurrenceEvidence(jnp.asarray(log_odds), co_visibility_from_counts(exploration.counts))
    knowledge = Knowledge(layout_priors(exploration.counts, layout_estimator), cooccurrence=evidence)

    for arm_index, arm in enumerate(config.arms):
        for seed in range(NUM_SEEDS):
            params = random_params(NUM_SEEDS * arm_index + seed, config.policy_spec(num_categories))
            params["actor"]["bias"] = params["actor"]["bias"].at[DONE].set(-2.0)  # episodes of several steps
            estimator_config = layout_estimator if arm == "layout" else None
            policy_dir = config.run_dir / POLICIES_DIR / f"{arm}-{seed}"
            export_policy(policy_dir, config, params, knowledge, estimator_config, exploration)
    return Run(config)
