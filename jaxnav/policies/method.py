"""The parts of a method: the seam between jaxnav and the methods of the paper's tables, or your own.

A `Method` brings an `Experience`, the network module that makes the mediator Z. Everything else is optional: a
`Tracker` that remembers an episode without parameters, a `Control` that turns choices into actions, an `Adaptation`
that changes the policy within an episode, `Stage`s of training, and `learn`, which computes `Knowledge` before
training. Methods are found by name with `jaxnav.policies.methods.find_method`; see docs/add_a_method.md.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import jax
import numpy as np
from flax import nnx

from jaxnav.gaps import CooccurrenceEvidence
from jaxnav.policies.features import Features
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import NUM_ACTIONS

if TYPE_CHECKING:
    from jaxnav.policies.network import Policy
    from jaxnav.policies.pathways import Decision, Pathways, PolicyState
    from jaxnav.policies.spec import PolicySpec

#: A nested dict of arrays, or a pytree of a method's own.
Tree = Any


class Knowledge(NamedTuple):
    """Statistics that are computed before training: traced, exported, never changed by training.

    Attributes:
      layout: float32 [rooms, K, K], the layout prior alpha* of each room type.
      method: nested dict of arrays, the result of the method's `learn`; empty if it learns nothing.
      cooccurrence: evidence about the layout, leaves [rooms, K, K]; None where no gap needs it.
    """

    layout: jax.Array
    method: Tree = {}  # noqa: RUF012  (never written to)
    cooccurrence: CooccurrenceEvidence | None = None


class Percept(NamedTuple):
    """Inputs of a tracker at one step.

    Attributes:
      row: uint8 [R], the observation row after the action.
      heading: int32 [], compass heading, 0 to H - 1, clockwise.
      action: int32 [], the action that led here; `NO_ACTION` at the start.
      moved: bool [], whether that action changed the cell.
      horizon: int32 [], index of the camera's horizon.
      goal: int32 [], the category that is sought.
    """

    row: jax.Array
    heading: jax.Array
    action: jax.Array
    moved: jax.Array
    horizon: jax.Array
    goal: jax.Array


class Tracker(Protocol):
    """Memory of an episode without parameters; hashable.

    Its state lives in the agent and is updated once per environment step, the first view of an episode included. All
    functions handle one episode; callers `vmap`.
    """

    def init(self, knowledge: Knowledge, /) -> Tree:
        """Return the state before the first view."""
        ...

    def update(self, state: Tree, knowledge: Knowledge, percept: Percept, /) -> Tree:
        """Take in one step."""
        ...

    def read(self, state: Tree, knowledge: Knowledge, goal: jax.Array, /) -> Tree:
        """Return what the network reads; rollouts store it."""
        ...


class Experience(nnx.Module):
    """Module that makes the mediator Z of what is seen and sought.

    Subclasses take `(spec, rngs)` and set `width`.

    Attributes:
      sizes: the method's own whole-number sizes and their defaults, beside those that all methods share.
      width: Z, the size of the experience.
      recurrent: whether `attend` reads the memory; training then unrolls the policy step by step.
      num_scene_inputs: number of inputs that the reading adds to the direct pathway of the scene, see `scene_inputs`.
    """

    sizes: ClassVar[Mapping[str, int]] = {}
    num_scene_inputs: ClassVar[int] = 0
    width: int
    reads_memory = False

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
    def scene_inputs(reading: Tree) -> jax.Array:
        """Return the part of the reading that describes the scene without objects, float32 [..., num_scene_inputs].

        This part enters the direct pathway S -> A and is no part of Z.
        """
        raise NotImplementedError

    def attend(self, encoded: Tree, memory: "PolicyState") -> jax.Array:
        """Return the experience float32 [..., Z], given the memory."""
        del memory
        return encoded


class Control(Protocol):
    """Map from the policy's choices to actions; hashable."""

    @property
    def num_choices(self) -> int:
        """Size of the policy's output."""
        ...

    @property
    def interval(self) -> int:
        """Largest number of actions that a choice lasts."""
        ...

    def is_decision_step(self, state: Tree, /) -> jax.Array | None:
        """True where the choice has an effect now, bool [...]; None where every choice has.

        At other times the choice is ignored, and not learned from. The tracker state has leaves [..., ...].
        """
        ...

    def act(self, choice: jax.Array, state: Tree, knowledge: Any, /) -> tuple[jax.Array, Tree]:
        """Return the action int32 [] of a choice int32 [], and the tracker state; one episode, callers `vmap`."""
        ...


@dataclasses.dataclass(frozen=True)
class ActionControl:
    """Control of methods that choose the actions themselves."""

    num_choices: int = NUM_ACTIONS
    interval: int = 1

    def is_decision_step(self, state: Tree) -> None:
        """Every choice has an effect."""
        del state

    def act(self, choice: jax.Array, state: Tree, knowledge: Any) -> tuple[jax.Array, Tree]:
        """Return the choice."""
        del knowledge
        return choice, state


class Adaptation(Protocol):
    """Change of a policy within an episode; hashable. The fast weights are part of the policy's memory."""

    def init(self, policy: "Policy", batch: tuple[int, ...], /) -> Tree:
        """Return the fast weights at the start of an episode, leaves [*batch, ...]."""
        ...

    def decide(self, policy: "Policy", pathways: "Pathways", memory: "PolicyState", /) -> "Decision":
        """Decide with the fast weights `memory.fast`; the decision holds the next ones.

        `policy.decide_with_changes` is the decision without them.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Stage:
    """One part of a method's training.

    Attributes:
      share: of all updates, above 0; the shares of a method add up to 1.
      loss: in place of PPO's, with the arguments and results of `jaxnav.training.ppo.ppo_loss`.
      lr_scale_by_path: factor on the learning rate of the parameter at a path of names, 0 for one that is frozen; None
        for 1.
      uses_expert: whether the loss reads the actions of shortest paths, `SceneTables.expert`, which are compiled only
        then.
      direct_stream_only: whether the direct stream acts without that of experience, where there are streams.
      lr_scale: factor on the learning rate of all parameters.
      adapts_online: whether the method's adaptation changes the policy while it acts and learns; if not, fast weights
        stay as they are.
    """

    share: float = 1.0
    loss: Callable[..., tuple[jax.Array, dict[str, jax.Array]]] | None = None
    lr_scale_by_path: Callable[[tuple[str, ...]], float] | None = None
    uses_expert: bool = False
    direct_stream_only: bool = False
    lr_scale: float = 1.0
    adapts_online: bool = True


@dataclasses.dataclass(frozen=True)
class Method:
    """A method of object navigation; the defaults of all fields but the first do nothing.

    Attributes:
      experience: module that makes Z, built with `(spec, rngs)`.
      perceive: map from the features to those that the networks see; None for all. The number of categories may change.
      tracker: memory of an episode without parameters.
      learn: from the banks of training scenes and counts float32 [rooms, K, K] (poses of exploration at which two
        categories were detected together) to `Knowledge.method`, a nested dict of arrays.
      stages: of training, in order; among the policies of the last stage the best is kept.
      auxiliary: further term of the loss, from a `jaxnav.training.ppo.Replay` to a loss float32 [] and named parts.
      adaptation: change of the policy within an episode.
      control: map from choices to actions.
      check: from knowledge and a bank to an `InputError` if the method cannot act in these scenes.
      hosts_layout: whether the layout's weights can enter; if not, only the arm without the layout is trained.
      name: by which `find_method` finds the method again.
    """

    experience: type[Experience]
    perceive: Callable[[Features], Features] | None = None
    tracker: Tracker | None = None
    learn: Callable[[Iterable[Bank], np.ndarray], Tree] | None = None
    stages: tuple[Stage, ...] = (Stage(),)
    auxiliary: Callable[..., tuple[jax.Array, dict[str, jax.Array]]] | None = None
    adaptation: Adaptation | None = None
    control: Control = ActionControl()
    check: Callable[[Knowledge, Bank], None] | None = None
    hosts_layout: bool = True
    name: str = ""

    def __post_init__(self) -> None:
        shares = [stage.share for stage in self.stages]
        if not shares or min(shares) <= 0.0 or abs(sum(shares) - 1.0) > 1e-6:
            raise ValueError(f"the shares of its stages are {shares}; give shares above 0 that add up to 1")
