"""One update and its rollout as compiled programs.

Learning, forward and backward, is not a program of its own: its operations and seconds are those of the update less
those of the rollout in the same turn.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from _flops import matmul_flops
from _setup import TrainingSetup

from jaxnav.training.ppo import collect_rollout


class Program(NamedTuple):
    """A compiled program with its arguments.

    Attributes:
      call: runs it once.
      flops: floating-point operations of its matrix products.
      compile_s: seconds to trace and to compile it.
      temp_gb: temporary memory besides arguments and results; None if the device does not report it.
    """

    call: Callable[[], Any]
    flops: int
    compile_s: float
    temp_gb: float | None


def compile_program(function: Callable[..., Any], *arguments: Any) -> Program:
    """Compile a function for these arguments."""
    start_time = time.perf_counter()
    traced = jax.jit(function).trace(*arguments)
    compiled = traced.lower().compile()
    compile_s = round(time.perf_counter() - start_time, 2)

    memory = compiled.memory_analysis()
    temp_gb = round(memory.temp_size_in_bytes / 2**30, 3) if memory else None
    return Program(lambda: compiled(*arguments), matmul_flops(traced.jaxpr.jaxpr), compile_s, temp_gb)


def compile_update(setup: TrainingSetup, arm: str) -> Program:
    """Compile one update of a fresh seed: rollout and learning."""
    return compile_program(setup.trainer.learners[arm].update, *setup.update_arguments(arm))


def compile_rollout(setup: TrainingSetup, arm: str) -> Program:
    """Compile the rollout of the same update."""
    learner = setup.trainer.learners[arm]
    state, _, env_params, knowledge = setup.update_arguments(arm)

    def act(state: Any, env_params: Any, knowledge: Any) -> Any:
        policy = learner.agent_loop.bind(state.params)
        use_coin = learner.counterfactual == "coin"
        return collect_rollout(
            learner.agent_loop,
            policy,
            state.agent,
            state.key,
            env_params,
            knowledge,
            num_steps=learner.config.rollout,
            use_coin=use_coin,
        )

    return compile_program(act, state, env_params, knowledge)


def compile_phases(setup: TrainingSetup) -> dict[str, Program]:
    """Compile `ARM update` and `ARM rollout` of every arm."""
    programs = {}
    for arm in setup.trainer.learners:
        programs[f"{arm} update"] = compile_update(setup, arm)
        programs[f"{arm} rollout"] = compile_rollout(setup, arm)
    return programs
