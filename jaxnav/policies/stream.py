"""A stream: what enters a recurrent core, and the heads on it."""

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

    def mediated_input(self, pathways: Pathways, action: jax.Array) -> jax.Array:
        """Return what enters by experience and previous action.

        Float32 [..., H]; the action is int32 [...].
        """
        *_, experience, previous = self.fuse_kernels
        one_hot = jax.nn.one_hot(action, NUM_ACTIONS, dtype=jnp.float32)
        return biased(product(pathways.experience, experience) + product(one_hot, previous), self.fuse)

    def drive(self, entering: jax.Array) -> jax.Array:
        """Return the core's input, float32 [..., 3 H].

        It is made of all that enters, float32 [..., H].
        """
        return biased(product(nnx.relu(entering), self.core.dense_i.kernel[...]), self.core.dense_i)

    def act(self, hidden: jax.Array, pathways: Pathways, change: jax.Array | None = None) -> Decision:
        """Decide by a hidden state float32 [..., H].

        A change float32 [..., H + 1, A] is added to the actor's kernel and bias; None adds nothing.
        """
        logits = self.actor(hidden)
        if change is not None:
            logits = logits + (with_one(hidden)[..., None] * change).sum(axis=-2)
        return Decision(logits=self.gated(logits, pathways), value=self.critic(hidden)[..., 0], hidden=hidden)

    def gated(self, logits: jax.Array, pathways: Pathways) -> jax.Array:
        """Multiply the logit of Done by the gate, if there is one."""
        if not self.done_gate:
            return logits
        return jnp.concatenate([logits[..., :DONE], pathways.gate * logits[..., DONE:]], axis=-1)

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
