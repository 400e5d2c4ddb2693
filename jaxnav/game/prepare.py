"""Preparation of a game: scenes, an episode, layout priors and, if asked for, a policy that gives advice."""

from pathlib import Path
from typing import Literal

from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.game.episode import Game, choose_episode
from jaxnav.layout import EstimatorConfig
from jaxnav.policies.method import ActionControl, Knowledge
from jaxnav.runs.config import RunConfig, WorldConfig
from jaxnav.runs.policies import config_for_policy
from jaxnav.runs.policy import LoadedPolicy, load_policy
from jaxnav.runs.train import calibrate_estimator, explore_world
from jaxnav.runs.worlds import compile_evaluation_world, compile_training_world
from jaxnav.training.calibration import layout_priors


def prepare_game(
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
      scenes: scene file to read instead of the world's scenes.
      split: scenes to play in.
      goal: category to search for; None for any.
      seed: seed of the scenes and of the episode, at least 0.
      shift: layout shift, from 0 to 1.
      policy: folder or name of a policy that gives advice; its belief is displayed if it has one.
      epsilon: threshold of sTDE in the advice.
      console: receives messages; None for silence.

    Raises:
      InputError: no such scenes, goal or policy, or a policy of another world or without actions to advise.
    """
    # Check the policy first, since compiling scenes takes longer.
    console = console or Console(quiet=True)
    config = RunConfig(world=world, worlds=WorldConfig(seed=seed))
    adviser = None if policy is None else _load_adviser(policy, world)

    # The game takes one episode of the list that an evaluation with this seed would play.
    compiled_world = compile_evaluation_world(config, split, scenes, shift, console)
    episode = choose_episode(compiled_world.banks[0], goal, seed)

    # Without a policy that estimates the layout, the belief starts from random walks in training scenes.
    if adviser is not None and adviser.estimator_config is not None:
        knowledge = adviser.knowledge
        estimator_config = adviser.estimator_config
    else:
        knowledge, estimator_config = _explore(config, console)
    return Game(compiled_world, episode, knowledge, estimator_config, adviser, epsilon)


def _load_adviser(policy: str, world: str) -> LoadedPolicy:
    """Load a policy that can give advice in a world.

    Raises:
      InputError: no such policy, or one of another world or without actions to advise.
    """
    policy_world = config_for_policy(policy).world
    adviser = load_policy(policy)
    if policy_world != world:
        raise InputError(f"--policy {policy}: was trained for {policy_world}; play with --world {policy_world}")
    if not isinstance(adviser.spec.method.control, ActionControl):
        raise InputError(
            f"--policy {policy}: method {adviser.spec.method.name!r} chooses no single actions; take another"
        )
    return adviser


def _explore(config: RunConfig, console: Console) -> tuple[Knowledge, EstimatorConfig]:
    """Return the layout priors of random walks, and the estimator configuration that training would choose."""
    # As in training, except that no policy is trained.
    world = compile_training_world(config, console)
    exploration = explore_world(config, world)
    estimator_config = calibrate_estimator(config, world, exploration, console)
    return Knowledge(layout_priors(exploration.counts, estimator_config)), estimator_config
