"""The seam for methods."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import jax
import numpy as np
from flax import nnx

from jaxnav.gaps import Signs
from jaxnav.policies.features import Features
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import NUM_ACTIONS

if TYPE_CHECKING:
    from jaxnav.policies.pathways import Decision, Memory, Pathways
    from jaxnav.policies.policy import Policy
    from jaxnav.policies.spec import PolicySpec

#: A nested dict of arrays, or a pytree of a method's own.
Tree = Any


class Knowledge(NamedTuple):
    """Hold what is learned before training: traced, exported, fixed.

    Attributes:
      layout: float32 [rooms, K, K], the layout prior alpha* of each room type.
      method: nested dict of arrays, what the method's `learn` returned; empty if it learns nothing.
      signs: what sightings tell of the layout, leaves [rooms, K, K]; None where no gap goes by them.
    """

    layout: jax.Array
    method: Tree = {}  # noqa: RUF012  (never written to)
    signs: Signs | None = None


class Percept(NamedTuple):
    """Describe what a tracker is told at one step.

    Attributes:
      row: uint8 [R], the observation row after the action.
      heading: int32 [], compass heading, 0 to H - 1, clockwise.
      action: int32 [], the action that led here; `NO_ACTION` at the start.
      moved: bool [], whether it changed the cell.
      horizon: int32 [], index of the camera's horizon.
      goal: int32 [], what is sought.
    """

    row: jax.Array
    heading: jax.Array
    action: jax.Array
    moved: jax.Array
    horizon: jax.Array
    goal: jax.Array


class Tracker(Protocol):
    """Remember an episode without parameters; hashable.

    A note lives in the agent and is updated once per environment step, the first view of an episode included. All
    functions take one episode; callers `vmap`.
    """

    def init(self, knowledge: Knowledge) -> Tree:
        """Return the note before anything is seen."""
        ...

    def update(self, note: Tree, knowledge: Knowledge, percept: Percept) -> Tree:
        """Take in one step."""
        ...

    def read(self, note: Tree, knowledge: Knowledge, goal: jax.Array) -> Tree:
        """Return what the network reads; rollouts store it."""
        ...


class Experience(nnx.Module):
    """Make the mediator Z of what is seen and sought.

    Subclasses take `(spec, rngs)` and set `width`.

    Attributes:
      sizes: the method's own whole-number sizes and their defaults, beside those that all methods share.
      width: Z, the size of the experience.
      recurrent: whether `attend` reads the memory; training then unrolls the policy step by step.
      geometry: so many numbers of the reading belong to the direct pathway of the scene, see `geometry_inputs`.
    """

    sizes: ClassVar[Mapping[str, int]] = {}
    geometry: ClassVar[int] = 0
    width: int
    recurrent = False

    def __init__(self, spec: "PolicySpec", rngs: nnx.Rngs) -> None:
        raise NotImplementedError

    def size(self, spec: "PolicySpec", name: str) -> int:
        """Return one of the method's own sizes."""
        return dict(spec.method_sizes).get(name, self.sizes[name])

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: Tree) -> Tree:
        """Encode without memory, in parallel over time.

        Args:
          features: what is seen and sought, leaves [..., K, ...].
          appearance: float32 [K, d], an embedding per category.
          weights: float32 [..., K], w x g of eq. 7; ones leave the layout out.
          reading: what the method's tracker read, leaves [...]; None without a tracker.

        Returns:
          float32 [..., Z], or any pytree with leaves [...] that `attend` turns into that.
        """
        raise NotImplementedError

    @staticmethod
    def geometry_inputs(reading: Tree) -> jax.Array:
        """Return what the reading tells of the scene without objects.

        It is float32 [..., geometry], and no part of Z.
        """
        raise NotImplementedError

    def attend(self, encoded: Tree, memory: "Memory") -> jax.Array:
        """Return the experience float32 [..., Z], given the memory."""
        del memory
        return encoded


class Control(Protocol):
    """Turn the policy's choices into actions; hashable."""

    @property
    def num_choices(self) -> int:
        """Return the size of the policy's output."""
        ...

    @property
    def interval(self) -> int:
        """Return how many actions a choice lasts at most."""
        ...

    def due(self, note: Tree) -> jax.Array | None:
        """Return whether the choice counts now, bool [...].

        At other times it is ignored, and not learned from. None where every one counts. The note has leaves [..., ...].
        """
        ...

    def act(self, choice: jax.Array, note: Tree, knowledge: Any) -> tuple[jax.Array, Tree]:
        """Return the action int32 [] of a choice int32 [], and the note.

        One episode; callers `vmap`.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Primitive:
    """Choose the actions themselves."""

    num_choices: int = NUM_ACTIONS
    interval: int = 1

    def due(self, note: Tree) -> None:
        """Return that every choice counts."""
        del note

    def act(self, choice: jax.Array, note: Tree, knowledge: Any) -> tuple[jax.Array, Tree]:
        """Return the choice."""
        del knowledge
        return choice, note


class Adaptation(Protocol):
    """Change a policy within an episode; hashable.

    The fast weights are part of the memory.
    """

    def init(self, policy: "Policy", batch: tuple[int, ...]) -> Tree:
        """Return the fast weights at an episode's start.

        Their leaves are [*batch, ...].
        """
        ...

    def decide(self, policy: "Policy", pathways: "Pathways", memory: "Memory") -> "Decision":
        """Decide with fast weights, and return the next ones.

        They are `memory.fast`.

        `policy.decide_plainly` is the decision without them.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Stage:
    """Describe one part of a method's training.

    Attributes:
      share: of all updates, above 0; the shares of a method add up to 1.
      loss: the loss in place of PPO's, with the arguments and results of `jaxnav.training.loss.ppo_loss`.
      rates: factor on the learning rate of the parameter at a path of names, 0 for one that is not trained; None for 1.
      imitates: whether the loss reads what shortest paths do, `Tables.expert`, which only then are there.
      alone: whether the direct stream acts without that of experience, where there are streams.
      rate: factor on the learning rate of all parameters.
      adapts: whether the method's adaptation changes the policy while it acts and learns; if not, fast weights stay as
        they are.
    """

    share: float = 1.0
    loss: Callable[..., tuple[jax.Array, dict[str, jax.Array]]] | None = None
    rates: Callable[[tuple[str, ...]], float] | None = None
    imitates: bool = False
    alone: bool = False
    rate: float = 1.0
    adapts: bool = True


@dataclasses.dataclass(frozen=True)
class Method:
    """Name what a method brings; the defaults do nothing.

    Attributes:
      experience: the module that makes Z, built with `(spec, rngs)`.
      perceive: what of the observation the networks get; None for everything. It may change the number of categories.
      tracker: what an episode remembers without parameters.
      learn: from the banks of training scenes and counts float32 [rooms, K, K] (poses of exploration at which two
        categories were detected together) to what is known before training, a nested dict of arrays.
      stages: of training, in order; of the policies that the last one passes through the best is kept.
      auxiliary: one more term of the loss, from a `jaxnav.training.loss.Replay` to a loss float32 [] and named parts.
      adaptation: how the policy changes within an episode.
      control: how its choices become actions.
      check: from what was learned and a bank to an `InputError` if the method cannot act in its scenes.
      hosts_layout: whether the layout's weights can enter; if not, it is trained without the layout alone.
    """

    experience: type[Experience]
    perceive: Callable[[Features], Features] | None = None
    tracker: Tracker | None = None
    learn: Callable[[Iterable[Bank], np.ndarray], Tree] | None = None
    stages: tuple[Stage, ...] = (Stage(),)
    auxiliary: Callable[..., tuple[jax.Array, dict[str, jax.Array]]] | None = None
    adaptation: Adaptation | None = None
    control: Control = Primitive()
    check: Callable[[Knowledge, Bank], None] | None = None
    hosts_layout: bool = True

    def __post_init__(self) -> None:
        shares = [stage.share for stage in self.stages]
        if not shares or min(shares) <= 0.0 or abs(sum(shares) - 1.0) > 1e-6:
            raise ValueError(f"the shares of its stages are {shares}; give shares above 0 that add up to 1")
