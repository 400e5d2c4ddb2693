"""The trainer: all arms and seeds of a run, side by side."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxnav.env.types import EnvParams
from jaxnav.policies.methods import Knowledge, Stage
from jaxnav.training.config import PPOScalars
from jaxnav.training.devices import everywhere, replicated, state_sharding
from jaxnav.training.learner import Learner, LearnerState
from jaxnav.training.shares import SEEDS

#: Of every arm its seeds, as a checkpoint holds them.
Seeds = dict[str, list[LearnerState]]
#: The same as a trainer holds them; see `Trainer.unpack`.
States = dict[str, Any]
Metrics = dict[str, list[dict[str, float]]]

#: Purposes of the keys of the arms: policies without and with the layout estimator.
ARM_KEYS = {"baseline": 0, "layout": 1}


class Trainer:
    """Train all arms and seeds of a run.

    Each arm is compiled once for each stage of its method, and seeds of all arms run side by side on the cores.

    Attributes:
      learners: the learner of each arm, by name.
    """

    def __init__(
        self,
        learners: Mapping[str, Learner],
        stages: Sequence[tuple[Stage, PPOScalars]],
        knowledge: Knowledge,
        key: jax.Array,
        seeds: int,
        chunk: int,
    ) -> None:
        """Prepare; nothing is compiled yet.

        Args:
          learners: of each arm, a name in `ARM_KEYS`.
          stages: of training, with the traced settings of PPO in each.
          knowledge: what was learned before training.
          key: typed PRNG key [] of all arms and seeds.
          seeds: S, of each arm.
          chunk: updates of one call of `train`.
        """
        self.learners = dict(learners)
        self._scalars, self._knowledge, self._key = tuple(scalars for _, scalars in stages), knowledge, key
        self._stages = [stage for stage, _ in stages]
        self._seeds, self._chunk = seeds, chunk
        self._compiled: dict[tuple[str, int], Any] = {}
        self._starts = {name: jax.jit(self._learner(name, 0).init) for name in self.learners}
        self._restarts: dict[tuple[str, int], Any] = {}
        self._keeps = {name: jax.jit(learner.keep, donate_argnums=0) for name, learner in self.learners.items()}

    def abstract(self, params: EnvParams) -> Seeds:
        """Return shapes and devices of every seed's state."""
        return jax.eval_shape(self.init, params)

    def pack(self, seeds: Seeds) -> States:
        """Return the states that a checkpoint held."""
        return seeds

    def unpack(self, states: States) -> Seeds:
        """Return the states that a checkpoint is to hold."""
        return states

    def init(self, params: EnvParams) -> States:
        """Start every seed."""
        states: States = {}
        for name, start in self._starts.items():
            root = jax.random.fold_in(self._key, ARM_KEYS[name])
            keys = [jax.random.fold_in(root, seed) for seed in range(self._seeds)]
            states[name] = [start(key, params, self._knowledge) for key in keys]
        return states

    def restart(self, states: States, params: EnvParams, stage: int = 0) -> States:
        """Give every seed new episodes; donates the states."""
        return {
            name: [self._restart(name, stage)(state, params, self._knowledge) for state in seeds]
            for name, seeds in states.items()
        }

    def keep(self, states: States, scores: Mapping[str, Sequence[float]]) -> States:
        """Keep every policy that none of its seed outscored; donates the states."""
        return {
            name: [
                self._keeps[name](state, jnp.float32(score)) for state, score in zip(seeds, scores[name], strict=True)
            ]
            for name, seeds in states.items()
        }

    def train(self, states: States, params: EnvParams, stage: int = 0) -> tuple[States, Metrics]:
        """Do a chunk of updates; donates the states.

        Args:
          states: of every seed.
          params: the environment's.
          stage: number of the stage, see `training.config.stage_at`.

        Returns:
          The states after the chunk, and its metrics.
        """
        tasks = [(name, seed) for seed in range(self._seeds) for name in self.learners]
        for name in self.learners:  # one at a time: a compilation takes half a gigabyte, and two are hardly quicker
            self._compile(name, stage, states[name], params)
        with ThreadPoolExecutor(min(len(tasks), os.cpu_count() or 1)) as pool:
            results = list(pool.map(lambda task: self._call(task, stage, states, params), tasks))
        after: States = {name: [] for name in self.learners}
        metrics: Metrics = {name: [] for name in self.learners}
        for (name, _), (state, values) in zip(tasks, results, strict=True):
            after[name].append(state)
            metrics[name].append({key: float(value) for key, value in values.items()})
        return after, metrics

    def _compile(self, name: str, stage: int, states: Any, params: EnvParams) -> Any:
        """Compile the chunk of an arm, unless it is."""
        if (name, stage) not in self._compiled:
            learner, num_updates = self._learner(name, stage), self._chunk

            def train(state: LearnerState, scalars: PPOScalars, params: EnvParams, knowledge: Knowledge) -> Any:
                return learner.train(state, scalars, params, knowledge, num_updates)

            given = states[0], self._scalars[stage], params, self._knowledge
            lowered = jax.jit(train, donate_argnums=0).lower(*given)
            self._compiled[name, stage] = lowered.compile()
        return self._compiled[name, stage]

    def _call(self, task: tuple[str, int], stage: int, states: States, params: EnvParams) -> Any:
        (name, seed), call = task, self._compiled[task[0], stage]
        given = states[name][seed], self._scalars[stage], params, self._knowledge
        return jax.block_until_ready(call(*given))

    def _learner(self, name: str, stage: int) -> Learner:
        """Return the learner of an arm in a stage."""
        return dataclasses.replace(self.learners[name], stage=self._stages[stage])

    def _restart(self, name: str, stage: int) -> Any:
        """Return what gives an arm new episodes in a stage."""
        if (name, stage) not in self._restarts:
            self._restarts[name, stage] = self._restarter(self._learner(name, stage))
        return self._restarts[name, stage]

    def _restarter(self, learner: Learner) -> Any:
        return jax.jit(learner.restart, donate_argnums=0)


class ShardedTrainer(Trainer):
    """Train on a mesh of devices.

    Arm by arm, all seeds in one call; between calls the seeds of an arm stay stacked and divided among the devices.
    """

    def __init__(self, *arguments: Any, mesh: Mesh, **named: Any) -> None:
        """Prepare as `Trainer`, on a mesh."""
        super().__init__(*arguments, **named)
        self._mesh, self._place, self._stacked = mesh, state_sharding(mesh), state_sharding(mesh, stacked=True)
        self._key, self._scalars, self._knowledge = everywhere(mesh, (self._key, self._scalars, self._knowledge))
        self._given: EnvParams | None = None
        self._stack = jax.jit(
            lambda seeds: jax.tree.map(lambda *leaves: jnp.stack(leaves), *seeds), out_shardings=self._stacked
        )
        self._unstack = jax.jit(
            lambda state: [jax.tree.map(lambda leaf, i=i: leaf[i], state) for i in range(self._seeds)],
            out_shardings=[self._place] * self._seeds,
        )
        for name, learner in self.learners.items():
            self._starts[name] = jax.jit(self._learner(name, 0).init, out_shardings=self._place)
            self._keeps[name] = jax.jit(jax.vmap(learner.keep), out_shardings=self._stacked, donate_argnums=0)

    def abstract(self, params: EnvParams) -> Seeds:
        """Return shapes and devices of every seed's state."""
        states = jax.eval_shape(super().init, params)
        places = jax.tree.map(lambda _: self._place, states, is_leaf=lambda node: isinstance(node, LearnerState))
        return jax.tree.map(lambda leaf, place: leaf.update(sharding=place), states, jax.tree.broadcast(places, states))

    def pack(self, seeds: Seeds) -> States:
        """Stack the seeds of every arm."""
        return {name: self._stack(states) for name, states in seeds.items()}

    def unpack(self, states: States) -> Seeds:
        """Copy every seed's state to all groups of devices."""
        return {name: self._unstack(state) for name, state in states.items()}

    def init(self, params: EnvParams) -> States:
        """Start every seed."""
        return self.pack(super().init(self._everywhere(params)))

    def restart(self, states: States, params: EnvParams, stage: int = 0) -> States:
        """Give every seed new episodes; donates the states."""
        params = self._everywhere(params)
        return {name: self._restart(name, stage)(state, params, self._knowledge) for name, state in states.items()}

    def keep(self, states: States, scores: Mapping[str, Sequence[float]]) -> States:
        """Keep policies; see `Trainer.keep`."""
        return {name: self._keeps[name](state, np.array(scores[name], np.float32)) for name, state in states.items()}

    def train(self, states: States, params: EnvParams, stage: int = 0) -> tuple[States, Metrics]:
        """Do a chunk of updates of every seed; see `Trainer.train`."""
        params = self._everywhere(params)
        after: States = {}
        metrics: Metrics = {}
        for name in self.learners:
            train = self._compile(name, stage, states[name], params)
            after[name], values = train(states[name], self._scalars[stage], params, self._knowledge)
            rows = jax.device_get(values)
            metrics[name] = [{key: float(value[seed]) for key, value in rows.items()} for seed in range(self._seeds)]
        return after, metrics

    def _restarter(self, learner: Learner) -> Any:
        restart = jax.vmap(learner.restart, in_axes=(0, None, None))
        return jax.jit(restart, out_shardings=self._stacked, donate_argnums=0)

    def _everywhere(self, params: EnvParams) -> EnvParams:
        if params is not self._given:  # copied once for as long as a bank is used
            self._given, self._placed = params, everywhere(self._mesh, params)
        return self._placed

    def _compile(self, name: str, stage: int, states: Any, params: EnvParams) -> Any:
        """Compile the chunk of an arm, unless it is."""
        if (name, stage) in self._compiled:
            return self._compiled[name, stage]
        learner, num_updates = self._learner(name, stage), self._chunk

        def train(states: LearnerState, scalars: PPOScalars, params: EnvParams, knowledge: Knowledge) -> Any:
            def one(state: LearnerState) -> Any:
                return learner.train(state, scalars, params, knowledge, num_updates)

            after, metrics = jax.vmap(one, spmd_axis_name=SEEDS)(states)
            table = jnp.stack(list(metrics.values()), axis=-1)  # exchanged as one array
            table = jax.lax.with_sharding_constraint(table, replicated(self._mesh))
            return after, dict(zip(metrics, jnp.unstack(table, axis=-1), strict=True))

        call = jax.jit(train, out_shardings=(self._stacked, replicated(self._mesh)), donate_argnums=0)
        with jax.set_mesh(self._mesh):
            self._compiled[name, stage] = call.lower(states, self._scalars[stage], params, self._knowledge).compile()
        return self._compiled[name, stage]
