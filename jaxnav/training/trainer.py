"""The two arms of a run: the method alone, and the method with the layout estimator."""

import dataclasses
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams
from jaxnav.layout import Setting
from jaxnav.policies.acting import Acting
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.config import ARMS, RunConfig
from jaxnav.training.devices import everywhere, replicated, state_sharding
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
        self._starts = {name: jax.jit(learner.init) for name, learner in self.learners.items()}
        self._restarts = {name: jax.jit(learner.restart, donate_argnums=0) for name, learner in self.learners.items()}

    def abstract(self, params: EnvParams) -> States:
        """Shapes of every seed's state, and on which devices it is."""
        return jax.eval_shape(self.init, params)

    def init(self, params: EnvParams) -> States:
        """Every seed before its first update."""
        states: States = {}
        for name, start in self._starts.items():
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
        if not self._compiled:  # one at a time: a compilation takes half a gigabyte, and two at once are hardly quicker
            self._compiled = {name: self._compile(name, states[name][0], params) for name in self.learners}
        with ThreadPoolExecutor(min(len(tasks), os.cpu_count() or 1)) as pool:
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


class ShardedArms(Arms):
    """The same on a mesh of devices: one arm after the other, all its seeds in one call.

    Between calls the states are those of `Arms` with their episodes cut, so that a run may go on with other devices.
    """

    def __init__(self, config: RunConfig, env: ObjectNav, setting: Setting, priors: jax.Array, mesh: Mesh) -> None:
        super().__init__(config, env, setting, everywhere(mesh, priors))
        self._mesh, self._place = mesh, state_sharding(mesh)
        self._root, self._scalars = everywhere(mesh, (self._root, self._scalars))
        self._given: EnvParams | None = None
        for name, learner in self.learners.items():
            self._starts[name] = jax.jit(learner.init, out_shardings=self._place)
            self._restarts[name] = jax.jit(learner.restart, out_shardings=self._place, donate_argnums=0)

    def abstract(self, params: EnvParams) -> States:
        """Shapes of every seed's state, and on which devices it is."""
        states = jax.eval_shape(super().init, params)
        places = jax.tree.map(lambda _: self._place, states, is_leaf=lambda node: isinstance(node, LearnerState))
        return jax.tree.map(lambda leaf, place: leaf.update(sharding=place), states, jax.tree.broadcast(places, states))

    def init(self, params: EnvParams) -> States:
        """Every seed before its first update."""
        return super().init(self._everywhere(params))

    def restart(self, states: States, params: EnvParams) -> States:
        """Every seed with new episodes in other scenes. The states are donated."""
        return super().restart(states, self._everywhere(params))

    def train(self, states: States, params: EnvParams) -> tuple[States, Metrics]:
        """One chunk of updates of every seed, with its metrics. The states are donated."""
        params = self._everywhere(params)
        if not self._compiled:
            self._compiled = {name: self._compile_all(name, states[name], params) for name in self.learners}
        done: States = {}
        metrics: Metrics = {}
        for name, train in self._compiled.items():
            done[name], values = train(states[name], self._scalars, params, self._priors)
            rows = jax.device_get(values)
            metrics[name] = [{key: float(value[seed]) for key, value in rows.items()} for seed in range(self._seeds)]
        return done, metrics

    def _everywhere(self, params: EnvParams) -> EnvParams:
        if params is not self._given:  # copied once for as long as a bank is used
            self._given, self._placed = params, everywhere(self._mesh, params)
        return self._placed

    def _compile_all(self, name: str, states: list[LearnerState], params: EnvParams) -> Any:
        learner, num_updates = self.learners[name], self._chunk

        def train(states: list[LearnerState], scalars: Any, params: EnvParams, priors: jax.Array) -> Any:
            stacked = jax.tree.map(lambda *seeds: jnp.stack(seeds), *states)
            stacked = jax.lax.with_sharding_constraint(stacked, state_sharding(self._mesh, stacked=True))
            stacked, metrics = jax.vmap(lambda state: learner.train(state, scalars, params, priors, num_updates))(
                stacked
            )
            return [jax.tree.map(lambda leaf, i=i: leaf[i], stacked) for i in range(len(states))], metrics

        places = [self._place] * len(states), replicated(self._mesh)
        call = jax.jit(train, out_shardings=places, donate_argnums=0)
        with jax.set_mesh(self._mesh):
            return call.lower(states, self._scalars, params, self._priors).compile()


def _learner(config: RunConfig, env: ObjectNav, setting: Setting | None) -> Learner:
    spec = PolicySpec(config.method, len(env.categories), config.sizes, config.direct, config.done_gate)
    if setting:
        setting = dataclasses.replace(setting, gap="none")  # training has no use for it
    return Learner(Acting(env, setting), spec, config.ppo, config.counterfactual)
