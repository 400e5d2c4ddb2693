"""jaxnav's trainer as a process.

Started as `python benchmarks/_jaxnav_worker.py ARM EPOCHS MINIBATCHES UPDATES`. ARM is `baseline` (the method without
layout and without the spatial memory; its loss is PPO's alone) or `layout` (as in the default run: with the memory, the
layout estimator beside the rollout, and the counterfactual branch distilled).
"""

import dataclasses
import sys

from _setup import set_up
from _worker import serve

from jaxnav.runs.config import RunConfig


def main(arm: str, epochs: int, minibatches: int, updates: int) -> None:
    ppo = dataclasses.replace(RunConfig().ppo, epochs=epochs, minibatches=minibatches)
    plain = {"counterfactual": "none", "spatial_memory": False} if arm == "baseline" else {}
    config = dataclasses.replace(RunConfig(), arms=(arm,), ppo=ppo, **plain)
    setup = set_up(config)
    learner, (state, _, params, knowledge) = setup.trainer.learners[arm], setup.arguments(arm)
    scalars = ppo.scalars(10**9)  # so many updates that the learning rate stays as it is

    def train(state):
        state, metrics = learner.train(state, scalars, params, knowledge, updates)
        return state, (metrics["episodes"], metrics["episodes"] * metrics["success"])

    serve(train, state, updates * config.update_steps, state.params)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
