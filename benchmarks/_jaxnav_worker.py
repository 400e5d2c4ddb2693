"""jaxnav's trainer as a process.

Started as `python benchmarks/_jaxnav_worker.py ARM EPOCHS MINIBATCHES UPDATES`. ARM is `baseline` (the method without
layout; its loss is PPO's alone) or `layout` (the layout estimator runs beside the rollout, and the counterfactual
branch is distilled).
"""

import dataclasses
import sys

from _setup import set_up
from _worker import serve

from jaxnav.runs.config import RunConfig

COUNTERFACTUAL = {"baseline": "none", "layout": "distil"}


def main(arm: str, epochs: int, minibatches: int, updates: int) -> None:
    ppo = dataclasses.replace(RunConfig().ppo, epochs=epochs, minibatches=minibatches)
    config = dataclasses.replace(RunConfig(), arms=(arm,), counterfactual=COUNTERFACTUAL[arm], ppo=ppo)
    setup = set_up(config)
    learner, (state, _, params, knowledge) = setup.trainer.learners[arm], setup.arguments(arm)
    scalars = ppo.scalars(10**9)  # so many updates that the learning rate stays as it is

    def train(state):
        state, metrics = learner.train(state, scalars, params, knowledge, updates)
        return state, (metrics["episodes"], metrics["episodes"] * metrics["success"])

    serve(train, state, updates * config.update_steps, state.params)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
