"""jaxnav's trainer as a process: `python benchmarks/_jaxnav_worker.py ARM EPOCHS MINIBATCHES UPDATES`.

ARM is `baseline` (the method without layout; its loss is PPO's alone) or `layout` (the layout estimator runs beside the
rollout, with the gap that `train.py` leaves out, and the counterfactual branch is distilled).
"""

import dataclasses
import sys

import jax
from _worker import serve

from jaxnav.env.make import make
from jaxnav.layout import SETTINGS
from jaxnav.policies.acting import Acting
from jaxnav.policies.spec import PolicySpec
from jaxnav.training.calibration import layout_priors
from jaxnav.training.config import PPOConfig
from jaxnav.training.exploration import explore
from jaxnav.training.learner import Learner


def main(arm: str, epochs: int, minibatches: int, updates: int) -> None:
    env, params = make("rooms")
    counts = jax.jit(explore, static_argnums=0)(env, params, jax.random.key(0)).counts
    setting = SETTINGS["calibrated"]
    priors = layout_priors(counts, setting)
    config = dataclasses.replace(PPOConfig(), epochs=epochs, minibatches=minibatches)
    layout = arm == "layout"
    acting = Acting(env, setting if layout else None)
    learner = Learner(acting, PolicySpec(), config, "distil" if layout else "none")
    scalars = config.scalars(10**9)  # so many updates that the learning rate stays as it is

    def train(state):
        state, metrics = learner.train(state, scalars, params, priors, updates)
        return state, (metrics["episodes"], metrics["episodes"] * metrics["success"])

    state = jax.jit(learner.init)(jax.random.key(0), params, priors)
    serve(train, state, updates * config.num_envs * config.rollout, state.params)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
