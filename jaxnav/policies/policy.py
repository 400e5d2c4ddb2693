"""The policy: pathways from an observation, and the recurrent decision on them.

A policy is built once; only its parameters, a nested dict of arrays, are kept in states and on disk:

    params = init_params(spec, key)
    policy = bind(spec, params)
    pathways = policy.pathways(observation, weights, reading, surroundings, memory)
    decision = policy.decide(pathways, memory)
    counterfactual = policy.decide(do(pathways, scene=0, goal=0), memory)
"""

import functools
from typing import Any

import jax
from flax import nnx

from jaxnav.policies.fused import Policy
from jaxnav.policies.spec import PolicySpec
from jaxnav.policies.streams import Streams

Params = dict[str, Any]

_DECISIONS: dict[str, type[Policy]] = {"fused": Policy, "streams": Streams}


def init_params(spec: PolicySpec, key: jax.Array) -> Params:
    """Draw fresh parameters, a nested dict of float32 arrays."""
    return nnx.to_pure_dict(nnx.state(_DECISIONS[spec.decision](spec, nnx.Rngs(params=key)), nnx.Param))


def bind(spec: PolicySpec, params: Params) -> Policy:
    """Bind parameters to a policy, inside a jitted function."""
    return nnx.merge(_graph(spec), params)


@functools.lru_cache(maxsize=16)
def _graph(spec: PolicySpec) -> nnx.GraphDef[Policy]:
    abstract = nnx.eval_shape(lambda: _DECISIONS[spec.decision](spec, nnx.Rngs(0)))
    return nnx.split(abstract)[0]
