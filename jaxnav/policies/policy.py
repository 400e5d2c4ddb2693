"""The policy: pathways from an observation, and the recurrent decision on them.

A policy is built once; only its parameters, a nested dict of arrays, are kept in states and on disk:

    params = init_params(spec, key)
    policy = bind(spec, params)
    pathways = policy.pathways(observation, weights)
    decision = policy.decide(pathways, memory)
    counterfactual = policy.decide(do(pathways, scene=0, goal=0), memory)
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.env.types import Observation
from jaxnav.policies.features import CONFIDENCE, NUM_FEATURES, features
from jaxnav.policies.methods import METHODS, CategoryMaps
from jaxnav.policies.pathways import NO_ACTION, Decision, Memory, Pathways
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.rows import RowLayout
from jaxnav.scenes.task import DONE, NUM_ACTIONS

Params = dict[str, Any]

#: First logit of Done: chosen once in 60 steps, for an agent that gives up at once never learns what it might find.
SELDOM = -2.5
DONE_GATE = 0.58  # times the confidence of the goal's detection


class Policy(nnx.Module):
    """Three pathways and a recurrent decision; works on single observations and on batches."""

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        layout = RowLayout(spec.num_categories)
        self.layout = layout
        self.hidden, self.direct, self.done_gate = spec.sizes.hidden, spec.direct, spec.done_gate
        self.appearance = nnx.Embed(spec.num_categories, spec.sizes.appearance, rngs=rngs)
        self.view = nnx.Linear(2 * layout.view**2, spec.sizes.view_outputs, rngs=rngs)
        self.detections = CategoryMaps(spec.sizes.appearance + NUM_FEATURES, spec, rngs)
        self.sought = nnx.Embed(spec.num_categories, spec.sizes.appearance, rngs=rngs)
        self.method = METHODS[spec.method](spec, rngs)
        fused = (
            spec.sizes.view_outputs + self.detections.width + spec.sizes.appearance + self.method.width + NUM_ACTIONS
        )
        self.fuse = nnx.Linear(fused, spec.sizes.hidden, rngs=rngs)
        self.core = nnx.GRUCell(spec.sizes.hidden, spec.sizes.hidden, rngs=rngs)
        # Small first logits: the first policy is close to uniform but for Done.
        small = nnx.initializers.variance_scaling(1e-4, "fan_in", "normal")
        self.actor = nnx.Linear(spec.sizes.hidden, NUM_ACTIONS, kernel_init=small, bias_init=_seldom_done, rngs=rngs)
        self.critic = nnx.Linear(spec.sizes.hidden, 1, rngs=rngs)

    def pathways(self, observation: Observation, weights: jax.Array) -> Pathways:
        """Embeddings of what is seen, what is sought and what experience says.

        Args:
          observation: a batch [...] of observations.
          weights: float32 [..., K], the layout's weights for the goal (eq. 7); ones leave the layout out.
        """
        seen = features(observation.row, observation.goal, self.layout)
        appearance = self.appearance.embedding[...]
        looks = seen.visible[..., None] * jnp.broadcast_to(appearance, (*seen.visible.shape, appearance.shape[-1]))
        rows = jnp.concatenate([looks, seen.table], axis=-1)
        if self.direct != "all":
            rows = rows * (seen.goal if self.direct == "goal" else jnp.zeros_like(seen.goal))[..., None]
        goal = jnp.concatenate([self.detections(rows), seen.goal @ self.sought.embedding[...]], axis=-1)
        confidence = (seen.table[..., CONFIDENCE] * seen.goal).sum(axis=-1, keepdims=True)
        return Pathways(
            scene=nnx.relu(self.view(seen.view)),
            goal=goal,
            experience=self.method(seen, appearance, jax.lax.stop_gradient(weights)),
            gate=DONE_GATE * confidence if self.done_gate else jnp.ones_like(confidence),
        )

    def decide(self, pathways: Pathways, memory: Memory) -> Decision:
        """Action logits and value from the pathways and the memory."""
        previous = jax.nn.one_hot(memory.action, NUM_ACTIONS, dtype=jnp.float32)
        scene, goal, experience, gate = pathways
        fused = nnx.relu(self.fuse(jnp.concatenate([scene, goal, experience, previous], axis=-1)))
        hidden, _ = self.core(memory.hidden, fused)
        logits = self.actor(hidden)
        if self.done_gate:
            logits = jnp.concatenate([logits[..., :DONE], gate * logits[..., DONE:]], axis=-1)
        return Decision(logits=logits, value=self.critic(hidden)[..., 0], hidden=hidden)

    def initial_memory(self, batch: tuple[int, ...] = ()) -> Memory:
        """Memory at the start of an episode."""
        return Memory(hidden=jnp.zeros((*batch, self.hidden)), action=jnp.full(batch, NO_ACTION, jnp.int32))


def _seldom_done(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
    del key
    return jnp.zeros(shape, dtype).at[DONE].set(SELDOM)


def init_params(spec: PolicySpec, key: jax.Array) -> Params:
    """Fresh parameters: a nested dict of float32 arrays."""
    return nnx.to_pure_dict(nnx.state(Policy(spec, nnx.Rngs(params=key)), nnx.Param))


def bind(spec: PolicySpec, params: Params) -> Policy:
    """The policy with these parameters; call it inside a jitted function."""
    return nnx.merge(_graph(spec), params)


@functools.lru_cache(maxsize=16)
def _graph(spec: PolicySpec) -> nnx.GraphDef[Policy]:
    abstract = nnx.eval_shape(lambda: Policy(spec, nnx.Rngs(0)))
    return nnx.split(abstract)[0]
