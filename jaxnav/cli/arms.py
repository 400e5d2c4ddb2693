"""The two arms of a run: the method alone, and the method with the layout estimator."""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

from jaxnav.cli.config import ARMS, RunConfig
from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams
from jaxnav.layout import Setting
from jaxnav.policies.acting import Acting
from jaxnav.policies.spec import PolicySpec
from jaxnav.training.learner import Learner, LearnerState

#: The seeds of every arm.
States = dict[str, list[LearnerState]]
Metrics = dict[str, list[dict[str, float]]]


class Arms:
    """All arms and seeds of a run; each arm is compiled once, and seeds of both run side by side on the cores.

    Attributes:
      learners: the learner of each arm.
    """

    def __init__(self, config: RunConfig, env: ObjectNav, setting: Setting, priors: jax.Array) -> None:
        settings = {"baseline": None, "layout": setting}
        self.learners = {name: _learner(config, env, settings[name]) for name in config.arms}
        self._scalars = config.ppo.scalars(config.total_updates)
        self._priors = priors
        self._root = jax.random.key(config.seed)
        self._seeds = config.seeds
        self._chunk = config.chunk
        self._compiled: dict[str, Any] = {}
        self._restarts = {name: jax.jit(learner.restart, donate_argnums=0) for name, learner in self.learners.items()}

    def init(self, params: EnvParams) -> States:
        """Every seed before its first update."""
        starts = {name: jax.jit(learner.init) for name, learner in self.learners.items()}
        states: States = {}
        for name, start in starts.items():
            root = jax.random.fold_in(self._root, ARMS.index(name))
            states[name] = [start(jax.random.fold_in(root, seed), params, self._priors) for seed in range(self._seeds)]
        return states

    def restart(self, states: States, params: EnvParams) -> States:
        """Every seed with new episodes in other scenes. The states are donated."""
        return {
            name: [self._restarts[name](state, params, self._priors) for state in seeds]
            for name, seeds in states.items()
        }

    def train(self, states: States, params: EnvParams) -> tuple[States, Metrics]:
        """One chunk of updates of every seed, with its metrics. The states are donated."""
        tasks = [(name, seed) for seed in range(self._seeds) for name in self.learners]
        with ThreadPoolExecutor(min(len(tasks), os.cpu_count() or 1)) as pool:
            if not self._compiled:
                compiled = pool.map(lambda name: self._compile(name, states[name][0], params), self.learners)
                self._compiled = dict(zip(self.learners, compiled, strict=True))
            results = list(pool.map(lambda task: self._train(task[0], states[task[0]][task[1]], params), tasks))
        done: States = {name: [] for name in self.learners}
        metrics: Metrics = {name: [] for name in self.learners}
        for (name, _), (state, values) in zip(tasks, results, strict=True):
            done[name].append(state)
            metrics[name].append({key: float(value) for key, value in values.items()})
        return done, metrics

    def _compile(self, name: str, state: LearnerState, params: EnvParams) -> Any:
        learner, num_updates = self.learners[name], self._chunk

        def train(state: LearnerState, scalars: Any, params: EnvParams, priors: jax.Array) -> Any:
            return learner.train(state, scalars, params, priors, num_updates)

        return jax.jit(train, donate_argnums=0).lower(state, self._scalars, params, self._priors).compile()

    def _train(self, name: str, state: LearnerState, params: EnvParams) -> tuple[LearnerState, dict[str, jax.Array]]:
        return jax.block_until_ready(self._compiled[name](state, self._scalars, params, self._priors))


def _learner(config: RunConfig, env: ObjectNav, setting: Setting | None) -> Learner:
    spec = PolicySpec(config.method, len(env.categories), config.sizes, config.direct, config.done_gate)
    return Learner(Acting(env, setting), spec, config.ppo, config.counterfactual)
