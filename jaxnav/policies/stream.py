"""A stream: what enters a recurrent core, and the heads on it."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.numerics.product import Linear, biased, product
from jaxnav.policies.pathways import Decision, Pathways
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.task import DONE, NUM_ACTIONS

#: First logit of Done: chosen once in 60 steps, for an agent that gives up at once never learns what it might find.
SELDOM = -2.5

#: What an adaptation adds to the outputs [..., N] of some of the layers `fuse`, `drive`, `core` and `actor`, given the
#: inputs [..., M] of each. Where the layer has a bias the last input is 1.
Changes = Mapping[str, Callable[[jax.Array], jax.Array]]
NO_CHANGES: Changes = MappingProxyType({})


class Stream(nnx.Module):
    """Make logits and a value by a recurrent core."""

    def __init__(
        self, widths: tuple[int, ...], num_choices: int, spec: PolicySpec, rngs: nnx.Rngs, done: float = SELDOM
    ) -> None:
        """Prepare.

        Args:
          widths: of all that enters; the last are those of experience and previous action.
          num_choices: A.
          spec: of the policy.
          rngs: of the parameters.
          done: first logit of Done, where actions are chosen.
        """
        self.widths, self.hidden, self.done_gate = widths, spec.sizes.hidden, spec.done_gate
        self.fuse = Linear(sum(widths), self.hidden, rngs=rngs)
        self.core = nnx.GRUCell(self.hidden, self.hidden, rngs=rngs)
        # Small first logits: the first policy is close to uniform but for Done.
        small = nnx.initializers.variance_scaling(1e-4, "fan_in", "normal")
        first = np.zeros(num_choices, np.float32)
        if num_choices == NUM_ACTIONS:
            first[DONE] = done
        self.actor = Linear(
            self.hidden, num_choices, kernel_init=small, bias_init=lambda *_: jnp.asarray(first), rngs=rngs
        )
        self.critic = Linear(self.hidden, 1, rngs=rngs)

    def mediated_input(self, pathways: Pathways, action: jax.Array, changes: Changes = NO_CHANGES) -> jax.Array:
        """Return what enters by experience and previous action.

        Float32 [..., H]; the action is int32 [...]. A change of the layer `fuse`, which takes in all pathways, is part.
        """
        *_, experience, previous = self.fuse_kernels
        one_hot = jax.nn.one_hot(action, NUM_ACTIONS, dtype=jnp.float32)
        entering = biased(product(pathways.experience, experience) + product(one_hot, previous), self.fuse)
        if "fuse" not in changes:
            return entering
        parts = pathways.scene, pathways.goal, pathways.experience, one_hot
        return entering + changes["fuse"](with_one(jnp.concatenate(parts, axis=-1)))

    def drive(self, entering: jax.Array, changes: Changes = NO_CHANGES) -> jax.Array:
        """Return the core's input, float32 [..., 3 H].

        It is made of all that enters, float32 [..., H].
        """
        inputs = nnx.relu(entering)
        drive = biased(product(inputs, self.core.dense_i.kernel[...]), self.core.dense_i)
        return drive + changes["drive"](with_one(inputs)) if "drive" in changes else drive

    def project(self, hidden: jax.Array, changes: Changes = NO_CHANGES) -> jax.Array:
        """Return what the hidden state [..., H] does, float32 [..., 3 H]."""
        projected = hidden @ self.core.dense_h.kernel[...]
        return projected + changes["core"](hidden) if "core" in changes else projected

    def act(self, hidden: jax.Array, pathways: Pathways, changes: Changes = NO_CHANGES) -> Decision:
        """Decide by a hidden state float32 [..., H]."""
        logits = self.actor(hidden)
        if "actor" in changes:
            logits = logits + changes["actor"](with_one(hidden))
        return Decision(logits=self.gated(logits, pathways), value=self.critic(hidden)[..., 0], hidden=hidden)

    def gated(self, logits: jax.Array, pathways: Pathways) -> jax.Array:
        """Multiply the logit of Done by the gate, if there is one."""
        if not self.done_gate:
            return logits
        return jnp.concatenate([logits[..., :DONE], pathways.gate * logits[..., DONE:]], axis=-1)

    @property
    def layer_widths(self) -> dict[str, tuple[int, int]]:
        """Return the widths of inputs and outputs of the layers that may change."""
        hidden, gates = self.hidden, 3 * self.hidden
        return {
            "fuse": (sum(self.widths) + 1, hidden),
            "drive": (hidden + 1, gates),
            "core": (hidden, gates),
            "actor": (hidden + 1, self.actor.out_features),
        }

    @property
    def recurrent_kernel(self) -> jax.Array:
        """Return the hidden state's kernel, float32 [H, 3 H]."""
        return self.core.dense_h.kernel[...]

    @property
    def fuse_kernels(self) -> list[jax.Array]:
        """Return the kernels of all that enters."""
        return jnp.split(self.fuse.kernel[...], np.cumsum(self.widths)[:-1])


def with_one(values: jax.Array) -> jax.Array:
    """Append a 1 to values [..., N]."""
    return jnp.concatenate([values, jnp.ones_like(values[..., :1])], axis=-1)
