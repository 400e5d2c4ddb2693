"""What a game needs before its first step."""

from pathlib import Path
from typing import Literal

from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.game.episode import Game, choose_episode
from jaxnav.layout import Setting
from jaxnav.policies.methods import Knowledge, find_method
from jaxnav.policies.methods.base import Primitive
from jaxnav.runs.config import RunConfig, WorldConfig
from jaxnav.runs.packaged import world_of
from jaxnav.runs.policy import LoadedPolicy, load_policy
from jaxnav.runs.prepare import calibrate_setting, explore_world
from jaxnav.runs.worlds import evaluation_world, training_world
from jaxnav.training.calibration import layout_priors


def prepare(
    world: Literal["rooms", "apartments", "houses"] = "rooms",
    scenes: Path | None = None,
    split: str = "val",
    goal: str | None = None,
    seed: int = 0,
    shift: float = 0.0,
    policy: str | None = None,
    epsilon: float = 0.5,
    console: Console | None = None,
) -> Game:
    """Prepare a game.

    Args:
      world: generated scenes and rules.
      scenes: scene file to read instead.
      split: scenes to play in.
      goal: category to look for; None for any.
      seed: of the scenes and of the episode, at least 0.
      shift: layout shift, from 0 to 1.
      policy: folder or name of a policy that gives advice; its belief is shown if it has one.
      epsilon: threshold of sTDE in its advice.
      console: gets messages; None for silence.

    Raises:
      InputError: no such scenes, goal or policy, or a policy of another world or without actions to advise.
    """
    console, config = console or Console(quiet=True), RunConfig(world=world, worlds=WorldConfig(seed=seed))
    adviser = None if policy is None else _adviser(policy, world)
    compiled = evaluation_world(config, split, scenes, shift, console)
    episode = choose_episode(compiled.banks[0], goal, seed)
    if adviser is not None and adviser.setting is not None:
        return Game(compiled, episode, adviser.knowledge, adviser.setting, adviser, epsilon)
    knowledge, setting = _walked(config, console)
    return Game(compiled, episode, knowledge, setting, adviser, epsilon)


def _adviser(policy: str, world: str) -> LoadedPolicy:
    """Load a policy that can advise in a world.

    Raises:
      InputError: no such policy, or one of another world or without actions to advise.
    """
    made_for, loaded = world_of(policy).world, load_policy(policy)
    if made_for != world:
        raise InputError(f"--policy {policy}: was trained for {made_for}; play with --world {made_for}")
    if not isinstance(find_method(loaded.spec.method).control, Primitive):
        raise InputError(f"--policy {policy}: method {loaded.spec.method!r} chooses no single actions; take another")
    return loaded


def _walked(config: RunConfig, console: Console) -> tuple[Knowledge, Setting]:
    """Return the layout priors of random walks, and the setting that training would choose."""
    world = training_world(config, console)
    explored = explore_world(config, world)
    setting = calibrate_setting(config, world, explored, console)
    return Knowledge(layout_priors(explored.counts, setting)), setting
