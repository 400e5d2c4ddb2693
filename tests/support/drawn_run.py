"""A run as training leaves it, whose policies were drawn instead of trained."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.gaps import CooccurrenceEvidence
from jaxnav.layout import ESTIMATORS
from jaxnav.policies.method import Knowledge
from jaxnav.runs.config import RunConfig
from jaxnav.runs.config_files import apply_yaml
from jaxnav.runs.policies import POLICIES_DIR, export_policy
from jaxnav.runs.run import Run, claim_run_dir
from jaxnav.scenes.task import DONE
from jaxnav.training.calibration import Exploration, co_visibility_from_counts, layout_priors
from support.commands import SEEDS, write_config
from support.tiny_world import random_params

#: With weak prior rows a view changes the belief much: large gaps, which sTDE acts on.
SETTING = dataclasses.replace(ESTIMATORS["calibrated"], strength=1.0)


def tiny_config(folder, **changes) -> RunConfig:
    """The settings of the command's tests."""
    folder.mkdir(exist_ok=True)
    return dataclasses.replace(apply_yaml(RunConfig(), write_config(folder)), run_dir=folder / "run", **changes)


def draw_run(config) -> Run:
    """A run with policies that act by what they see.

    Those of a few updates never choose Done, so that all their episodes are alike.
    """
    claim_run_dir(config)
    categories = len(config.task.categories)
    counts = np.random.default_rng(0).integers(0, 9, (NUM_PRIORS, categories, categories)).astype(np.float32)
    counts[:, np.arange(categories), np.arange(categories)] = 9  # no pair is seen more often than each of the two
    explored = Exploration(jnp.asarray(counts), jnp.int32(1280), jnp.int32(600))
    odds = np.triu(np.random.default_rng(1).normal(size=counts.shape), 1).astype(np.float32)
    signs = CooccurrenceEvidence(jnp.asarray(odds), co_visibility_from_counts(explored.counts))
    knowledge = Knowledge(layout_priors(explored.counts, SETTING), cooccurrence=signs)
    for number, arm in enumerate(config.arms):
        for seed in range(SEEDS):
            params = random_params(SEEDS * number + seed, config.policy_spec(categories))
            params["actor"]["bias"] = params["actor"]["bias"].at[DONE].set(-2.0)  # episodes of several steps
            setting = SETTING if arm == "layout" else None
            folder = config.run_dir / POLICIES_DIR / f"{arm}-{seed}"
            export_policy(folder, config, params, knowledge, setting, explored)
    return Run(config)
