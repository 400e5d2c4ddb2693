"""One update of the learner and its rollout as compiled programs that know their floating-point operations.

What learns, forward and backward, is not a program of its own: it is the update less the rollout, in operations and in
seconds of the same turn.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr

from jaxnav.env.types import EnvParams
from jaxnav.policies.policy import bind
from jaxnav.runs.config import RunConfig
from jaxnav.training.collect import rollout
from jaxnav.training.learner import Learner
from jaxnav.training.trainer import Arms


class Program(NamedTuple):
    """A compiled program with its arguments.

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


def matmul_flops(jaxpr: Jaxpr) -> int:
    """Floating-point operations of all matrix products, those of a scan once per iteration, branches all together."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            left: Any = equation.invars[0].aval
            result: Any = equation.outvars[0].aval
            total += 2 * result.size * math.prod(left.shape[axis] for axis in contracted)
        times = equation.params["length"] if equation.primitive.name == "scan" else 1
        inner = jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: isinstance(x, Jaxpr | ClosedJaxpr))
        for part in inner:
            if isinstance(part, Jaxpr | ClosedJaxpr):
                total += times * matmul_flops(part.jaxpr if isinstance(part, ClosedJaxpr) else part)
    return total


def program(function: Callable[..., Any], *arguments: Any) -> Program:
    """A function compiled for these arguments."""
    began = time.perf_counter()
    traced = jax.jit(function).trace(*arguments)
    compiled = traced.lower().compile()
    taken = time.perf_counter() - began
    memory = compiled.memory_analysis()
    temp_gb = round(memory.temp_size_in_bytes / 2**30, 3) if memory else None
    return Program(lambda: compiled(*arguments), matmul_flops(traced.jaxpr.jaxpr), round(taken, 2), temp_gb)


def update(learner: Learner, config: RunConfig, params: EnvParams, priors: jax.Array) -> Program:
    """One update of a fresh seed: rollout and learning."""
    state = jax.jit(learner.init)(jax.random.key(config.seed), params, priors)
    return program(learner.update, state, config.ppo.scalars(config.total_updates), params, priors)


def acting(learner: Learner, config: RunConfig, params: EnvParams, priors: jax.Array) -> Program:
    """The rollout of the same update."""
    state = jax.jit(learner.init)(jax.random.key(config.seed), params, priors)

    def act(state: Any, params: EnvParams, priors: jax.Array) -> Any:
        policy, coin = bind(learner.spec, state.params), learner.counterfactual == "coin"
        return rollout(learner.acting, policy, state.agent, state.key, config.ppo.rollout, coin, params, priors)

    return program(act, state, params, priors)


def phases(arms: Arms, config: RunConfig, params: EnvParams, priors: jax.Array) -> dict[str, Program]:
    """`ARM update` and `ARM rollout` of every arm."""
    return {
        f"{name} {what}": make(learner, config, params, priors)
        for name, learner in arms.learners.items()
        for what, make in (("update", update), ("rollout", acting))
    }
