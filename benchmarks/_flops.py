"""Floating-point operations of a program's matrix products."""

import math
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.interpreters import partial_eval


def matmul_flops(jaxpr: Jaxpr) -> int:
    """Count the operations of all matrix products.

    Those that no result depends on, which the compiler leaves out, do not count. Those of a scan count once per
    iteration, branches all together.
    """
    live, _ = partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return _count(live)


def _count(jaxpr: Jaxpr) -> int:
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
                total += times * _count(part.jaxpr if isinstance(part, ClosedJaxpr) else part)
    return total
