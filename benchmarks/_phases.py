"""One update and its rollout as compiled programs.

Learning, forward and backward, is no program: it is the update less the rollout, in operations and in seconds of the
same turn.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from _flops import matmul_flops
from _setup import Setup

from jaxnav.training.collect import collect


class Program(NamedTuple):
    """Hold a compiled program with its arguments.

    Attributes:
      call: runs it once.
      flops: floating-point operations of its matrix products.
      compile_s: seconds to trace and to compile it.
      temp_gb: memory that it takes beside arguments and results, where the device tells.
    """

    call: Callable[[], Any]
    flops: int
    compile_s: float
    temp_gb: float | None


def program(function: Callable[..., Any], *arguments: Any) -> Program:
    """Compile a function for these arguments."""
    began = time.perf_counter()
    traced = jax.jit(function).trace(*arguments)
    compiled = traced.lower().compile()
    taken = time.perf_counter() - began
    memory = compiled.memory_analysis()
    temp_gb = round(memory.temp_size_in_bytes / 2**30, 3) if memory else None
    return Program(lambda: compiled(*arguments), matmul_flops(traced.jaxpr.jaxpr), round(taken, 2), temp_gb)


def update(setup: Setup, arm: str) -> Program:
    """Compile one update of a fresh seed: rollout and learning."""
    return program(setup.trainer.learners[arm].update, *setup.arguments(arm))


def rollout(setup: Setup, arm: str) -> Program:
    """Compile the rollout of the same update."""
    learner, (state, _, params, knowledge) = setup.trainer.learners[arm], setup.arguments(arm)

    def act(state: Any, params: Any, knowledge: Any) -> Any:
        policy, coin = learner.acting.bind(state.params), learner.counterfactual == "coin"
        return collect(learner.acting, policy, state.agent, state.key, learner.config.rollout, coin, params, knowledge)

    return program(act, state, params, knowledge)


def phases(setup: Setup) -> dict[str, Program]:
    """Compile `ARM update` and `ARM rollout` of every arm."""
    return {
        f"{arm} {what}": compile_part(setup, arm)
        for arm in setup.trainer.learners
        for what, compile_part in (("update", update), ("rollout", rollout))
    }
