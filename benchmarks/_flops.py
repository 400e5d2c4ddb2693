"""Floating-point operations of a program's matrix products."""

import math
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.interpreters import partial_eval


def matmul_flops(jaxpr: Jaxpr) -> int:
    """Return the number of operations of all matrix products.

    Products that no result depends on are not counted, as the compiler drops them. The body of a scan counts once per
    iteration; all branches of a condition count.
    """
    live_jaxpr, _ = partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return _count_flops(live_jaxpr)


def _count_flops(jaxpr: Jaxpr) -> int:
    total = 0
    for equation in jaxpr.eqns:
        # A product of [m, n] and [n, p] takes 2 m n p operations.
        if equation.primitive.name == "dot_general":
            (contracted_axes, _), _ = equation.params["dimension_numbers"]
            lhs: Any = equation.invars[0].aval
            output: Any = equation.outvars[0].aval
            total += 2 * output.size * math.prod(lhs.shape[axis] for axis in contracted_axes)

        # Programs inside of this operation are among its parameters.
        repeats = equation.params["length"] if equation.primitive.name == "scan" else 1
        for leaf in jax.tree.leaves(list(equation.params.values()), is_leaf=_is_jaxpr):
            if _is_jaxpr(leaf):
                inner_jaxpr = leaf.jaxpr if isinstance(leaf, ClosedJaxpr) else leaf
                total += repeats * _count_flops(inner_jaxpr)
    return total


def _is_jaxpr(value: Any) -> bool:
    return isinstance(value, Jaxpr | ClosedJaxpr)
