"""The decision in two streams: what is seen and sought, and experience, each a policy."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.env.types import Observation
from jaxnav.numerics.rounding import rounded
from jaxnav.policies.fused import Policy
from jaxnav.policies.pathways import Decision, Memory, Pathways
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.policies.stream import NO_CHANGES, Changes, Stream, with_one
from jaxnav.scenes.task import NUM_ACTIONS


class Streams(Policy):
    """Decide by the sum of two streams.

    The direct stream gets scene and goal, the stream of experience all that is in `Pathways.experience`, a view of its
    own included. Scene and experience end with a 1, a factor on the stream: 0 removes it. The direct stream learns
    where it acts alone, the stream of experience what to add to it.
    """

    num_views = 2

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        widths = self.method.width + spec.sizes.view_outputs + 1, NUM_ACTIONS
        self.experience_stream = Stream(widths, self.actor.out_features, spec, rngs, done=0.0)
        self.known_appearance = nnx.Embed(self.appearance.num_embeddings, spec.sizes.appearance, rngs=rngs)

    def encode(
        self,
        observation: Observation,
        weights: jax.Array,
        reading: Any = None,
        surroundings: jax.Array | None = None,
    ) -> Pathways:
        """Embed without memory; the experience may still have to `attend`."""
        encoded = super().encode(observation, weights, reading, surroundings)
        views = [with_one(view) for view in jnp.split(encoded.scene, 2, axis=-1)]
        encoded = encoded._replace(scene=views[0], experience=(encoded.experience, views[1]))
        return encoded if self.method.recurrent else _joined(encoded)

    def attend(self, encoded: Pathways, memory: Memory) -> Pathways:
        """Let the experience of `encode` attend with its stream's memory."""
        if not self.method.recurrent:
            return encoded
        experience, view = encoded.experience
        memory = memory._replace(hidden=memory.hidden[..., self.hidden :])
        return _joined(encoded._replace(experience=(self.method.attend(experience, memory), view)))

    def direct_input(self, pathways: Pathways) -> jax.Array:
        """Return what enters by the direct pathways, float32 [..., 2 H]."""
        direct = super().direct_input(pathways)
        return jnp.concatenate([direct, jnp.zeros_like(direct)], axis=-1)

    def mediated_input(self, pathways: Pathways, action: jax.Array, changes: Changes = NO_CHANGES) -> jax.Array:
        """Return what enters by experience and previous action.

        Float32 [..., 2 H]; the direct stream gets the previous action alone.
        """
        without = pathways._replace(experience=pathways.experience[..., :0])
        direct = super().mediated_input(without, action, changes)
        return jnp.concatenate([direct, self.experience_stream.mediated_input(pathways, action)], axis=-1)

    def drive(self, entering: jax.Array, changes: Changes = NO_CHANGES) -> jax.Array:
        """Return the cores' input, float32 [..., 6 H]."""
        direct, experience = jnp.split(entering, 2, axis=-1)
        return _interleaved(super().drive(direct, changes), self.experience_stream.drive(experience))

    def project(self, hidden: jax.Array, changes: Changes = NO_CHANGES) -> jax.Array:
        """Return what both hidden states [..., 2 H] do, float32 [..., 6 H]."""
        direct, experience = jnp.split(hidden, 2, axis=-1)
        return _interleaved(super().project(direct, changes), self.experience_stream.project(experience))

    def act(self, hidden: jax.Array, pathways: Pathways, changes: Changes = NO_CHANGES) -> Decision:
        """Decide by both hidden states, float32 [..., 2 H]."""
        halves = jnp.split(hidden, 2, axis=-1)
        direct, experience = super().act(halves[0], pathways, changes), self.experience_stream.act(halves[1], pathways)
        seen, known = pathways.scene[..., -1:], pathways.experience[..., -1:]
        direct = _fixed(direct, known != 0)
        # Rounded, so that the sum is exact and removing one stream (eq. 1) leaves the other to the bit.
        logits = rounded(seen * direct.logits) + rounded(known * experience.logits)
        return Decision(logits, seen[..., 0] * direct.value + known[..., 0] * experience.value, hidden)

    def initial_memory(self, batch: tuple[int, ...] = ()) -> Memory:
        """Return the memory at the start of an episode."""
        hidden, experienced = jnp.zeros((*batch, 2 * self.hidden)), jnp.ones(batch)
        return super().initial_memory(batch)._replace(hidden=hidden, experienced=experienced)

    @property
    def experience_appearance(self) -> jax.Array:
        """Return the embeddings of categories that experience gets."""
        return self.known_appearance.embedding[...]

    @property
    def recurrent_kernel(self) -> jax.Array:
        """Return the kernel of both hidden states, float32 [2 H, 6 H]."""
        kernels = super().recurrent_kernel, self.experience_stream.recurrent_kernel
        gates = zip(*(_gates(kernel) for kernel in kernels), strict=True)
        return jnp.concatenate([jax.scipy.linalg.block_diag(*gate) for gate in gates], axis=-1)

    @property
    def pathway_widths(self) -> tuple[int, ...]:
        """Return the widths of scene, goal, experience and gate."""
        return *self.widths[:2], self.experience_stream.widths[0], 1

    def _widths(self, sizes: Sizes) -> tuple[int, ...]:
        """Return the widths of what enters the direct stream."""
        scene, goal, _, action = super()._widths(sizes)
        return scene + 1, goal, 0, action


def _fixed(decision: Decision, where: jax.Array) -> Decision:
    """Let no gradient reach logits and value somewhere, bool [..., 1]."""
    fixed = jax.lax.stop_gradient(decision)
    return decision._replace(
        logits=jnp.where(where, fixed.logits, decision.logits),
        value=jnp.where(where[..., 0], fixed.value, decision.value),
    )


def _joined(encoded: Pathways) -> Pathways:
    """Join the method's experience and the view beside it."""
    return encoded._replace(experience=jnp.concatenate(encoded.experience, axis=-1))


def _interleaved(direct: jax.Array, experience: jax.Array) -> jax.Array:
    """Join the streams gate by gate, [..., 6 H]."""
    return jnp.concatenate(
        [part for gate in zip(_gates(direct), _gates(experience), strict=True) for part in gate], axis=-1
    )


def _gates(values: jax.Array) -> list[jax.Array]:
    """Return the parts of reset gate, update gate and candidate."""
    return jnp.split(values, 3, axis=-1)
