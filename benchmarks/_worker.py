"""A trainer in a process of its own, which trains once per line of its input."""

import json
import sys
from collections.abc import Callable
from typing import Any

import jax
from _common import peak_resident_gb
from _flops import matmul_flops
from jax.interpreters.partial_eval import dce_jaxpr

#: One training call: from a state to the state after some updates, and the episodes and successes that ended in them.
Train = Callable[[Any], tuple[Any, tuple[jax.Array, jax.Array]]]


def serve(train: Train, state: Any, num_steps: int, weights: Any) -> None:
    """Print a description of the trainer, then train once per line of stdin.

    Each answer is one line of JSON; those to a line of stdin hold the success rate of one more call.

    Args:
      train: the training call.
      state: to begin with; donated.
      num_steps: environment steps of one call.
      weights: parameters of the policy, to be counted.
    """
    # Count operations as XLA runs them, without those that no result depends on.
    jaxpr = jax.make_jaxpr(train)(state).jaxpr
    live_jaxpr, _ = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    flops = matmul_flops(live_jaxpr) / num_steps
    num_parameters = sum(leaf.size for leaf in jax.tree.leaves(weights))

    compiled = jax.jit(train, donate_argnums=0).lower(state).compile()
    print_json({"parameters": num_parameters, "matmul_flops_per_step": round(flops)})

    for _ in sys.stdin:
        state, (episodes, successes) = jax.block_until_ready(compiled(state))
        success = round(float(successes) / max(float(episodes), 1.0), 4)
        print_json({"success": success, "resident_gb": peak_resident_gb()})


def print_json(answer: dict[str, Any]) -> None:
    print(json.dumps(answer), flush=True)
