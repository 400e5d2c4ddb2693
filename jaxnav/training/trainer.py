"""Trainers of all arms and seeds of a run, side by side.

`Trainer` trains on one device, with seeds in parallel threads. `ShardedTrainer` trains on a mesh of devices. Both share
an interface: `init` starts all seeds, `train` does a chunk of updates, `restart` gives the seeds new episodes,
`keep_best` keeps the policies with the best validation scores, and `pack` and `unpack` convert the states from and to
those in a checkpoint.
"""

import dataclasses
import functools
import operator
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxnav.env.objectnav import EnvParams
from jaxnav.numerics.device_means import SEED_AXIS
from jaxnav.numerics.trees import count_array_bytes
from jaxnav.policies.method import Knowledge, Stage
from jaxnav.training.devices import replicate_on_devices, replicated_sharding, state_sharding
from jaxnav.training.ppo import Learner, LearnerState, PPOScalars

#: States by arm and seed, as in a checkpoint.
SeedStates = dict[str, list[LearnerState]]
#: States by arm, as a trainer holds them; see `Trainer.unpack`.
TrainerStates = dict[str, Any]
#: Metrics of a chunk of updates, by arm and seed.
SeedMetrics = dict[str, list[dict[str, float]]]

#: Number folded into the run's key for each arm: policies without and with the layout estimator.
ARM_KEY_PURPOSES = {"baseline": 0, "layout": 1}

#: Options of XLA for programs that run a few times and compute little: they are compiled in half the time.
_RUN_ONCE = {"xla_backend_optimization_level": 0}


class Trainer:
    """Trainer of all arms and seeds of a run on one device.

    Each arm has S policies, which may differ in their seed and in traced settings of PPO.

    Each arm is compiled once for each stage of its method. The seeds of all arms run side by side on the cores.

    Attributes:
      learners: learner of each arm, by name.
    """

    def __init__(
        self,
        learners: Mapping[str, Learner],
        stages: Sequence[Stage],
        stage_scalars: Sequence[PPOScalars],
        knowledge: Knowledge,
        key: jax.Array,
        seeds: Sequence[int],
        chunk_size: int,
    ) -> None:
        """Prepare the trainer; nothing is compiled yet.

        Args:
          learners: learner of each arm, named as in `ARM_KEY_PURPOSES`.
          stages: stages of training, in order.
          stage_scalars: traced settings of PPO of each stage, leaves [S].
          knowledge: layout priors and statistics from before training.
          key: typed PRNG key [] of all arms and seeds.
          seeds: seed of each of the S policies; policies with other settings may have the same seed.
          chunk_size: updates in one call of `train`.
        """
        self.learners = dict(learners)
        self._stages = list(stages)
        self._stage_scalars = list(stage_scalars)
        self._knowledge = knowledge
        self._key = key
        self._seeds = list(seeds)
        self._chunk_size = chunk_size

        # Jitted functions by arm, and those that restart by (arm, stage index). JAX compiles them at their first call.
        self._init_functions = {}
        self._keep_best_functions = {}
        self._restart_functions = {}
        for arm, learner in self.learners.items():
            self._init_functions[arm] = self._jit_init(self._stage_learner(arm, 0))
            self._keep_best_functions[arm] = self._jit_update(learner.keep_if_best, (0, 0))
            for stage_index in range(len(self._stages)):
                restart = self._stage_learner(arm, stage_index).restart_episodes
                self._restart_functions[arm, stage_index] = self._jit_update(restart, (0, None, None, 0))
        self._compiled: dict[tuple[str, int], Any] = {}

    def abstract_states(self, env_params: EnvParams) -> SeedStates:
        """Shapes, dtypes and shardings of all states in a checkpoint."""
        # `jax.eval_shape` cannot trace functions that are jitted with `compiler_options`.
        init_functions = {arm: self._stage_learner(arm, 0).init for arm in self.learners}
        return jax.eval_shape(functools.partial(self._init_seeds, init_functions), env_params)

    def pack(self, seed_states: SeedStates) -> TrainerStates:
        """Turn the states of a checkpoint into those that the trainer holds."""
        return seed_states

    def unpack(self, states: TrainerStates) -> SeedStates:
        """Turn states that the trainer holds into those of a checkpoint."""
        return states

    def init(self, env_params: EnvParams) -> TrainerStates:
        """Start all seeds, each with a key of its own."""
        return self._init_seeds(self._init_functions, env_params)

    def _init_seeds(
        self, init_functions: Mapping[str, Callable[..., LearnerState]], env_params: EnvParams
    ) -> SeedStates:
        """Start all seeds by the function of each arm."""
        seed_states: SeedStates = {}
        for arm, init in init_functions.items():
            arm_key = jax.random.fold_in(self._key, ARM_KEY_PURPOSES[arm])
            seed_states[arm] = []
            for policy_index, seed in enumerate(self._seeds):
                seed_key = jax.random.fold_in(arm_key, seed)
                experience_prob = self._policy_scalars(0, policy_index).experience_prob
                seed_states[arm].append(init(seed_key, env_params, self._knowledge, experience_prob))
        return seed_states

    def restart(self, states: TrainerStates, env_params: EnvParams, stage_index: int = 0) -> TrainerStates:
        """Start new episodes in all seeds; donates the states."""
        new_states: TrainerStates = {}
        for arm, arm_states in states.items():
            restart = self._restart_functions[arm, stage_index]
            new_states[arm] = []
            for policy_index, state in enumerate(arm_states):
                experience_prob = self._policy_scalars(stage_index, policy_index).experience_prob
                new_states[arm].append(restart(state, env_params, self._knowledge, experience_prob))
        return new_states

    def keep_best(self, states: TrainerStates, scores: Mapping[str, Sequence[float]]) -> TrainerStates:
        """Keep each seed's present policy as its best one, unless an earlier one scored higher; donates the states.

        Args:
          states: training states of all seeds.
          scores: score of each present policy, by arm and seed.
        """
        new_states: TrainerStates = {}
        for arm, arm_states in states.items():
            new_states[arm] = []
            for state, score in zip(arm_states, scores[arm], strict=True):
                new_states[arm].append(self._keep_best_functions[arm](state, jnp.float32(score)))
        return new_states

    def estimate_state_bytes(self, env_params: EnvParams) -> int:
        """Bytes of the training states of all seeds, without creating them."""
        num_bytes = 0
        for arm in self.learners:
            scalars = self._policy_scalars(0, 0)
            init = self._stage_learner(arm, 0).init
            state = jax.eval_shape(init, self._key, env_params, self._knowledge, scalars.experience_prob)
            num_bytes += len(self._seeds) * count_array_bytes(state)
        return num_bytes

    def estimate_temporary_bytes(self, stage_index: int) -> int:
        """Bytes of the temporary arrays of a stage's compiled programs, as many as run at once in one memory."""
        program_bytes = []
        for arm in self.learners:
            statistics = self._compiled[arm, stage_index].memory_analysis()
            program_bytes.append(0 if statistics is None else statistics.temp_size_in_bytes)
        return self._num_programs_in_memory * max(program_bytes)

    def is_compiled(self, stage_index: int) -> bool:
        """True if the updates of every arm in a stage are compiled."""
        return all((arm, stage_index) in self._compiled for arm in self.learners)

    def compile(self, arm: str, states: TrainerStates, env_params: EnvParams, stage_index: int = 0) -> None:
        """Compile a chunk of updates of an arm in a stage, for arguments like these, unless this is done."""
        if (arm, stage_index) in self._compiled:
            return
        learner = self._stage_learner(arm, stage_index)
        state = self._state_argument(states[arm])
        arguments = (state, self._scalars_argument(stage_index), env_params, self._knowledge)
        self._compiled[arm, stage_index] = self._compile_train(learner, arguments)

    def train(
        self, states: TrainerStates, env_params: EnvParams, stage_index: int = 0
    ) -> tuple[TrainerStates, SeedMetrics]:
        """Do a chunk of updates in all seeds; donates the states.

        Args:
          states: training states of all seeds.
          env_params: parameters of the training environment.
          stage_index: index of the stage, see `training.config.stage_index_at`.

        Returns:
          The states after the chunk, and its metrics.
        """
        # One arm at a time: a compilation takes half a gigabyte, and two in parallel are hardly faster.
        for arm in self.learners:
            self.compile(arm, states, env_params, stage_index)

        def train_seed(job: tuple[str, int]) -> Any:
            arm, policy_index = job
            scalars = self._policy_scalars(stage_index, policy_index)
            train = self._compiled[arm, stage_index]
            return jax.block_until_ready(train(states[arm][policy_index], scalars, env_params, self._knowledge))

        # Seeds of all arms run in threads, as many as there are cores.
        jobs = [(arm, policy_index) for policy_index in range(len(self._seeds)) for arm in self.learners]
        with ThreadPoolExecutor(self._num_threads) as pool:
            results = list(pool.map(train_seed, jobs))

        # Results by arm, in the order of the seeds.
        new_states: TrainerStates = {arm: [] for arm in self.learners}
        metrics: SeedMetrics = {arm: [] for arm in self.learners}
        for (arm, _), (state, values) in zip(jobs, results, strict=True):
            new_states[arm].append(state)
            metrics[arm].append({name: float(value) for name, value in values.items()})
        return new_states, metrics

    @property
    def _num_threads(self) -> int:
        """Number of policies that train at once, one for each core."""
        return min(len(self.learners) * len(self._seeds), os.cpu_count() or 1)

    @property
    def _num_programs_in_memory(self) -> int:
        """Number of programs whose arrays share one memory; an accelerator runs one program after another."""
        return self._num_threads if jax.default_backend() == "cpu" else 1

    def _policy_scalars(self, stage_index: int, policy_index: int) -> PPOScalars:
        """Traced settings of a policy in a stage."""
        return jax.tree.map(operator.itemgetter(policy_index), self._stage_scalars[stage_index])

    def _stage_learner(self, arm: str, stage_index: int) -> Learner:
        """Learner of an arm in a stage."""
        return dataclasses.replace(self.learners[arm], stage=self._stages[stage_index])

    def _state_argument(self, arm_states: Any) -> LearnerState:
        """State that the compiled function of an arm takes."""
        return arm_states[0]

    def _scalars_argument(self, stage_index: int) -> PPOScalars:
        """Traced settings of a stage as the compiled function takes them."""
        return self._policy_scalars(stage_index, 0)

    # How a learner's functions are compiled; a trainer on several devices does it differently.

    def _jit_init(self, learner: Learner) -> Any:
        return jax.jit(learner.init, compiler_options=_RUN_ONCE)

    def _jit_update(self, function: Callable[..., LearnerState], seed_axes: tuple[int | None, ...]) -> Any:
        """Jit a function of states, which it donates.

        Args:
          function: takes the state of one policy first.
          seed_axes: axes of `vmap` over policies, of the arguments; unused on one device.
        """
        return jax.jit(function, donate_argnums=0, compiler_options=_RUN_ONCE)

    def _compile_train(self, learner: Learner, arguments: tuple[Any, ...]) -> Any:
        def train(state: LearnerState, scalars: PPOScalars, env_params: EnvParams, knowledge: Knowledge) -> Any:
            return learner.train(state, scalars, env_params, knowledge, self._chunk_size)

        # Lower from shapes: restored arrays would give another cache key, so that a resumed run compiles again.
        shapes = jax.eval_shape(lambda *arrays: arrays, *arguments)
        # With JAX_DISABLE_JIT all loops would be unrolled into one enormous program.
        with jax.disable_jit(False):
            return jax.jit(train, donate_argnums=0).lower(*shapes).compile()


class ShardedTrainer(Trainer):
    """Trainer of all arms and seeds of a run on a mesh of devices.

    Arms are trained one after the other, all seeds of an arm in one call. Between calls the states of an arm's seeds
    stay stacked, leaves [S, ...], and sharded over the devices.
    """

    def __init__(self, *arguments: Any, mesh: Mesh, **keywords: Any) -> None:
        """Prepare the trainer on a mesh; all other arguments are those of `Trainer`."""
        self._mesh = mesh
        self._seed_sharding = state_sharding(mesh)
        self._stacked_sharding = state_sharding(mesh, stacked=True)
        super().__init__(*arguments, **keywords)
        shared_arrays = (self._key, self._stage_scalars, self._knowledge)
        self._key, self._stage_scalars, self._knowledge = replicate_on_devices(mesh, shared_arrays)
        self._local_env_params: EnvParams | None = None

        def stack(arm_states: list[LearnerState]) -> LearnerState:
            return jax.tree.map(lambda *leaves: jnp.stack(leaves), *arm_states)

        def unstack(stacked_state: LearnerState) -> list[LearnerState]:
            return [jax.tree.map(operator.itemgetter(index), stacked_state) for index in range(len(self._seeds))]

        self._stack = jax.jit(stack, out_shardings=self._stacked_sharding)
        self._unstack = jax.jit(unstack, out_shardings=[self._seed_sharding] * len(self._seeds))

    def abstract_states(self, env_params: EnvParams) -> SeedStates:
        """Shapes, dtypes and shardings of all states in a checkpoint."""
        abstract_states = super().abstract_states(env_params)

        def add_shardings(state: LearnerState) -> LearnerState:
            shardings = jax.tree.broadcast(self._seed_sharding, state)
            return jax.tree.map(lambda leaf, sharding: leaf.update(sharding=sharding), state, shardings)

        return jax.tree.map(add_shardings, abstract_states, is_leaf=lambda node: isinstance(node, LearnerState))

    def estimate_state_bytes(self, env_params: EnvParams) -> int:
        """Bytes of the training states in the memory of a device; episodes, most of them, are divided."""
        return self._num_programs_in_memory * super().estimate_state_bytes(env_params) // self._mesh.size

    def pack(self, seed_states: SeedStates) -> TrainerStates:
        """Stack the states of each arm's seeds, and divide them among groups of devices."""
        return {arm: self._stack(arm_states) for arm, arm_states in seed_states.items()}

    def unpack(self, states: TrainerStates) -> SeedStates:
        """Unstack the states of each arm's seeds, and copy each of them to all groups of devices."""
        return {arm: self._unstack(stacked_state) for arm, stacked_state in states.items()}

    def init(self, env_params: EnvParams) -> TrainerStates:
        """Start all seeds."""
        return self.pack(super().init(self._replicate_env_params(env_params)))

    def restart(self, states: TrainerStates, env_params: EnvParams, stage_index: int = 0) -> TrainerStates:
        """Start new episodes in all seeds; donates the states."""
        env_params = self._replicate_env_params(env_params)
        new_states: TrainerStates = {}
        for arm, stacked_state in states.items():
            restart = self._restart_functions[arm, stage_index]
            experience_prob = self._stage_scalars[stage_index].experience_prob
            new_states[arm] = restart(stacked_state, env_params, self._knowledge, experience_prob)
        return new_states

    def keep_best(self, states: TrainerStates, scores: Mapping[str, Sequence[float]]) -> TrainerStates:
        """Keep each seed's present policy as its best one; see `Trainer.keep_best`."""
        new_states: TrainerStates = {}
        for arm, stacked_state in states.items():
            seed_scores = np.array(scores[arm], np.float32)
            new_states[arm] = self._keep_best_functions[arm](stacked_state, seed_scores)
        return new_states

    def train(
        self, states: TrainerStates, env_params: EnvParams, stage_index: int = 0
    ) -> tuple[TrainerStates, SeedMetrics]:
        """Do a chunk of updates in all seeds; see `Trainer.train`."""
        for arm in self.learners:
            self.compile(arm, states, env_params, stage_index)

        env_params = self._replicate_env_params(env_params)
        new_states: TrainerStates = {}
        metrics: SeedMetrics = {}
        for arm in self.learners:
            train = self._compiled[arm, stage_index]
            new_states[arm], values = train(states[arm], self._stage_scalars[stage_index], env_params, self._knowledge)

            # Metrics come as one array [S] for each name.
            arm_metrics = {name: value.tolist() for name, value in jax.device_get(values).items()}
            metrics[arm] = []
            for index in range(len(self._seeds)):
                metrics[arm].append({name: row[index] for name, row in arm_metrics.items()})
        return new_states, metrics

    def _replicate_env_params(self, env_params: EnvParams) -> EnvParams:
        """Copy parameters to all devices, once for as long as the same scenes are used."""
        if env_params is not self._local_env_params:
            self._local_env_params = env_params
            self._replicated_env_params = replicate_on_devices(self._mesh, env_params)
        return self._replicated_env_params

    def compile(self, arm: str, states: TrainerStates, env_params: EnvParams, stage_index: int = 0) -> None:
        """Compile a chunk of updates of an arm in a stage; see `Trainer.compile`."""
        super().compile(arm, states, self._replicate_env_params(env_params), stage_index)

    @property
    def _num_programs_in_memory(self) -> int:
        """Number of devices of the mesh that share one memory: those of this process, where they are parts of a CPU."""
        return self._mesh.local_mesh.size if jax.default_backend() == "cpu" else 1

    def _state_argument(self, arm_states: Any) -> LearnerState:
        return arm_states

    def _scalars_argument(self, stage_index: int) -> PPOScalars:
        return self._stage_scalars[stage_index]

    def _jit_init(self, learner: Learner) -> Any:
        return jax.jit(learner.init, out_shardings=self._seed_sharding, compiler_options=_RUN_ONCE)

    def _jit_update(self, function: Callable[..., LearnerState], seed_axes: tuple[int | None, ...]) -> Any:
        return jax.jit(
            jax.vmap(function, seed_axes),
            out_shardings=self._stacked_sharding,
            donate_argnums=0,
            compiler_options=_RUN_ONCE,
        )

    def _compile_train(self, learner: Learner, arguments: tuple[Any, ...]) -> Any:
        replicated = replicated_sharding(self._mesh)

        def train(stacked_state: LearnerState, scalars: PPOScalars, env_params: EnvParams, knowledge: Knowledge) -> Any:
            def train_seed(state: LearnerState, seed_scalars: PPOScalars) -> Any:
                return learner.train(state, seed_scalars, env_params, knowledge, self._chunk_size)

            new_state, metrics = jax.vmap(train_seed, spmd_axis_name=SEED_AXIS)(stacked_state, scalars)

            # Metrics are sent between devices as one array [S, names].
            table = jnp.stack(list(metrics.values()), axis=-1)
            table = jax.lax.with_sharding_constraint(table, replicated)
            return new_state, dict(zip(metrics, jnp.unstack(table, axis=-1), strict=True))

        jitted_train = jax.jit(train, out_shardings=(self._stacked_sharding, replicated), donate_argnums=0)
        with jax.set_mesh(self._mesh):
            return jitted_train.lower(*arguments).compile()
