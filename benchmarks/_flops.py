"""Floating-point operations of a program's matrix products."""

import math
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr


def matmul_flops(jaxpr: Jaxpr) -> int:
    """Count the operations of all matrix products.

    Those of a scan count once per iteration, branches all together.
    """
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
