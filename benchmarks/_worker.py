"""A trainer as a process that trains when asked."""

import json
import sys
from collections.abc import Callable
from typing import Any

import jax
from _common import peak_resident_gb
from _flops import matmul_flops
from jax.interpreters.partial_eval import dce_jaxpr

#: One call of training: from a state to the state after some updates and the episodes and successes that ended in it.
Train = Callable[[Any], tuple[Any, tuple[jax.Array, jax.Array]]]


def serve(train: Train, state: Any, steps: int, weights: Any) -> None:
    """Print what the trainer is, then train once per line.

    Each answer is one line of JSON; those after a line of stdin hold the success of one more call.

    Args:
      train: the call.
      state: to begin with; donated.
      steps: environment steps of one call.
      weights: of the policy, to count.
    """
    traced = jax.make_jaxpr(train)(state).jaxpr
    needed, _ = dce_jaxpr(traced, [True] * len(traced.outvars))  # as XLA drops what no result depends on
    flops = matmul_flops(needed) / steps
    sizes = [leaf.size for leaf in jax.tree.leaves(weights)]
    compiled = jax.jit(train, donate_argnums=0).lower(state).compile()
    answer({"parameters": sum(sizes), "matmul_flops_per_step": round(flops)})
    for _ in sys.stdin:
        state, (episodes, successes) = jax.block_until_ready(compiled(state))
        answer({"success": round(float(successes) / max(float(episodes), 1.0), 4), "resident_gb": peak_resident_gb()})


def answer(words: dict[str, Any]) -> None:
    print(json.dumps(words), flush=True)
