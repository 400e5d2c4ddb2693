"""The parts of a method: the seam between jaxnav and the methods of the paper's tables, or your own.

A `Method` brings an `Experience`, the network module that makes the mediator Z. Everything else is optional: a
`Tracker` that remembers an episode without parameters, a `Control` that turns choices into actions, an `Adaptation`
that changes the policy within an episode, `Stage`s of training, and `learn`, which computes `Knowledge` before
training. Methods are found by name with `jaxnav.policies.methods.find_method`; see docs/add_a_method.md.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.gaps import CooccurrenceEvidence
from jaxnav.policies.features import Features
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import NUM_ACTIONS

if TYPE_CHECKING:
    from jaxnav.env.objectnav import EnvParams
    from jaxnav.policies.agent_loop import AgentLoop
    from jaxnav.policies.network import Params, Policy
    from jaxnav.policies.pathways import Decision, Pathways, PolicyState
    from jaxnav.policies.spec import PolicySpec

#: A nested dict of arrays, or a pytree of a method's own.
Tree = Any


class Knowledge(NamedTuple):
    """Statistics that are computed before training: traced, exported, never changed by training.

    Attributes:
      priors: float32 [rooms, K, K], the layout prior alpha* of each room type.
      method: nested dict of arrays, the result of the method's `learn`; empty if it learns nothing.
      cooccurrence: evidence about the layout, leaves [rooms, K, K]; None for runs without the arm `layout`.
    """

    priors: jax.Array
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
        """Return the state before the first view, leaves without a batch axis."""
        ...

    def update(self, state: Tree, knowledge: Knowledge, percept: Percept, /) -> Tree:
        """Return the state after one step.

        Args:
          state: state before the step.
          knowledge: statistics from before training.
          percept: the next view of one episode, and the action that led to it.
        """
        ...

    def read(self, state: Tree, knowledge: Knowledge, goal: jax.Array, /) -> Tree:
        """Return the reading, the input of the network from the tracker; rollouts store it.

        Args:
          state: state of one episode.
          knowledge: statistics from before training.
          goal: int32 [], the category that is sought.

        Returns:
          A pytree with leaves without a batch axis.
        """
        ...


class Experience(nnx.Module):
    """Network module that computes the mediator Z from detections and goal.

    Subclasses take `(spec, rngs)` and set `width`.

    Attributes:
      sizes: the method's own integer sizes with their defaults, in addition to `Sizes`.
      width: Z, the size of the experience.
      is_empty: whether Z has no entries, so that layout weights have nothing to multiply.
      reads_memory: whether `attend` reads the memory; training then computes the experience step by step.
      num_scene_inputs: number of inputs that the reading adds to the direct pathway of the scene, see `scene_inputs`.
    """

    sizes: ClassVar[Mapping[str, int]] = {}
    num_scene_inputs: ClassVar[int] = 0
    is_empty: ClassVar[bool] = False
    width: int
    reads_memory = False

    def __init__(self, spec: "PolicySpec", rngs: nnx.Rngs) -> None:
        raise NotImplementedError

    def size(self, spec: "PolicySpec", name: str) -> int:
        """One of the method's own sizes."""
        return dict(spec.method_sizes).get(name, self.sizes[name])

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: Tree) -> Tree:
        """Encode without memory, in parallel over time. The method applies eq. 7 here.

        Args:
          features: detections and goal, leaves [..., K, ...].
          appearance: float32 [K, d], an embedding per category.
          weights: float32 [..., K], the goal's column of w (eq. 7); ones disable the layout.
          reading: output of the method's tracker, leaves [...]; None without a tracker.

        Returns:
          float32 [..., Z], or a pytree with leaves [...] that `attend` maps to float32 [..., Z].
        """
        raise NotImplementedError

    def replace_other_categories(
        self, features: Features, reading: Tree, other_features: Features, other_reading: Tree
    ) -> tuple[Features, Tree]:
        """Replace all categories but the goal by those of another episode, for `jaxnav.evaluation.replacements`.

        A method whose reading holds categories overrides this function, so that the reading is replaced too.

        Args:
          features, reading: inputs of `encode`.
          other_features, other_reading: the same of another episode, read for the goal of this one.

        Returns:
          Features and reading. The view and the goal's detection stay, and here the reading too.
        """
        is_goal = features.goal > 0
        mixed_features = features._replace(
            visible=jnp.where(is_goal, features.visible, other_features.visible),
            table=jnp.where(is_goal[..., None], features.table, other_features.table),
        )
        return mixed_features, reading

    @staticmethod
    def scene_inputs(reading: Tree) -> jax.Array:
        """Return the part of the reading that describes the scene without objects, float32 [..., num_scene_inputs].

        This part enters the direct pathway S -> A and is no part of Z.
        """
        raise NotImplementedError

    def attend(self, encoded: Tree, memory: "PolicyState") -> jax.Array:
        """Experience float32 [..., Z], given the memory."""
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
        """True where the next choice takes effect, bool [...]; None if every choice does.

        At other steps the choice is ignored and excluded from the loss. The tracker state has leaves [..., ...].
        """
        ...

    def act(self, choice: jax.Array, state: Tree, knowledge: Any, /) -> tuple[jax.Array, Tree]:
        """Turn a choice of one episode into an action; callers `vmap`.

        Args:
          choice: int32 [], index into the logits.
          state: tracker state.
          knowledge: statistics from before training.

        Returns:
          The action int32 [], and the next tracker state.
        """
        ...


@dataclasses.dataclass(frozen=True)
class ActionControl:
    """Control of methods that choose the actions themselves."""

    num_choices: int = NUM_ACTIONS
    interval: int = 1

    def is_decision_step(self, state: Tree) -> None:
        """Return None: every step is a decision step."""
        return None

    def act(self, choice: jax.Array, state: Tree, knowledge: Any) -> tuple[jax.Array, Tree]:
        """Return the choice."""
        return choice, state


class Adaptation(Protocol):
    """Change of a policy within an episode; hashable. The fast weights are part of the policy's memory."""

    def init(self, policy: "Policy", batch: tuple[int, ...], /) -> Tree:
        """Return the fast weights at the start of an episode, leaves [*batch, ...]."""
        ...

    def decide(self, policy: "Policy", pathways: "Pathways", memory: "PolicyState", /) -> "Decision":
        """Decide with the fast weights `memory.fast`; the returned decision carries the updated ones.

        `policy.decide_with_changes` decides with given changes of the layers, or with none.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Stage:
    """One part of a method's training.

    Attributes:
      share: share of all updates, above 0; the shares of a method add up to 1.
      loss: loss in place of PPO's, with the arguments and results of `jaxnav.training.ppo.ppo_loss`.
      lr_scale_by_path: learning-rate factor by parameter path; 0 freezes a parameter. None for 1 everywhere.
      uses_expert: whether the loss reads the actions of shortest paths, `SceneTables.expert`. Guidance reads them in
        every stage.
      direct_stream_only: whether only the direct stream acts and learns, for policies with streams.
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


class Fit(Protocol):
    """Fit of the parameters of a policy to searches in training scenes, in place of training by PPO."""

    def __call__(
        self,
        agent_loop: "AgentLoop",
        bank: Bank,
        env_params: "EnvParams",
        knowledge: Knowledge,
        key: jax.Array,
        num_searches: int,
        num_steps: int,
        /,
    ) -> "Params":
        """Return the parameters of one seed.

        Args:
          agent_loop: runs the policy and the environment.
          bank: compiled training scenes.
          env_params: parameters of the environment with these scenes.
          knowledge: statistics from before training.
          key: typed PRNG key [] of the seed; consumed.
          num_searches: number of parallel searches.
          num_steps: number of environment steps of each; ended episodes are followed by new ones.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Method:
    """A method of object navigation; the defaults of all fields but the first do nothing.

    Attributes:
      experience: module that makes Z, built with `(spec, rngs)`.
      perceive: map from all features to the features that the networks read; None for all. It may change the number of
        categories if the method does not host the layout.
      tracker: memory of an episode without parameters.
      learn: function that computes `Knowledge.method`, a nested dict of arrays, from the banks of training scenes and
        co-occurrence counts float32 [rooms, K, K] (number of exploration poses that detect both categories).
      stages: stages of training, in order; the best policy of the last stage is kept.
      auxiliary: further term of the loss, from a `jaxnav.training.ppo.Replay` to a loss float32 [] and named parts.
      adaptation: change of the policy within an episode.
      control: map from choices to actions.
      check: function of knowledge and a bank that raises an `InputError` if the method cannot act in these scenes.
      hosts_layout: whether the layout's weights can enter; if not, only the agent without the layout is trained.
      policy_class: class of the policy, built with `(spec, rngs)`, in place of the networks of
        `jaxnav.policies.network`. A policy whose scores are a sum holds its own agent without experience, so only the
        agent with the layout is trained.
      fit: function that fits the parameters of one seed in place of training by PPO; None trains by PPO.
      name: name by which `find_method` finds the method again.
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
    policy_class: "type[Policy] | None" = None
    fit: "Fit | None" = None
    name: str = ""

    @property
    def chooses_actions(self) -> bool:
        """True if the choices of the policies are the actions themselves, Done among them."""
        return isinstance(self.control, ActionControl)

    @property
    def has_additive_scores(self) -> bool:
        """True if the scores of the policies are a sum of direct scores and experience."""
        return self.policy_class is not None and self.policy_class.has_additive_scores

    def __post_init__(self) -> None:
        shares = [stage.share for stage in self.stages]
        if not shares or min(shares) <= 0.0 or abs(sum(shares) - 1.0) > 1e-6:
            raise ValueError(f"the shares of the stages are {shares}; give shares above 0 that add up to 1")

        # Episodes that begin in a stage without adaptation would inherit the fast weights of ended ones.
        phases = [
            adapts_online for adapts_online, _ in itertools.groupby(self.stages, lambda stage: stage.adapts_online)
        ]
        if self.adaptation is not None and phases.count(True) > 1:
            raise ValueError("a stage without adaptation lies between stages with it; put this stage first or last")
