"""jaxnav's trainer as a process.

Started as `python benchmarks/_jaxnav_worker.py ARM EPOCHS MINIBATCHES UPDATES`. ARM is `baseline` (the method without
layout and without the spatial memory; its loss is PPO's alone) or `layout` (as in the default run: with the memory, the
layout estimator beside the rollout, and the counterfactual branch distilled).
"""

import dataclasses
import sys

from _setup import set_up_training
from _trainer_worker import serve

from jaxnav.runs.config import RunConfig


def main(arm: str, epochs: int, minibatches: int, num_updates: int) -> None:
    ppo = dataclasses.replace(RunConfig().ppo, epochs=epochs, minibatches=minibatches)
    config = dataclasses.replace(RunConfig(), arms=(arm,), ppo=ppo)
    if arm == "baseline":
        config = dataclasses.replace(config, counterfactual="none", spatial_memory=False)

    setup = set_up_training(config)
    learner = setup.trainer.learners[arm]
    state, _, env_params, knowledge = setup.update_arguments(arm)
    scalars = ppo.scalars(10**9)  # so many updates that the learning rate stays constant

    def train(state):
        return learner.train(state, scalars, env_params, knowledge, num_updates)[0]

    serve(train, state)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
