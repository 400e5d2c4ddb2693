"""Evaluation episodes of a run, step by step."""

import jax

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import first_states
from jaxnav.evaluation.playback import Trace, play
from jaxnav.evaluation.variants import Row, inference_grid
from jaxnav.runs.policies import Policies
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.scene import Scene


def replay(policies: Policies, world: CompiledWorld, episodes: EpisodeList, row: Row) -> list[Trace]:
    """Play episodes of the first bank by the first seed.

    Args:
      policies: of the run.
      world: the scenes.
      episodes: of the first bank.
      row: of a table, with its arm among those of the policies.

    Raises:
      InputError: the method cannot act in the scenes.
    """
    inference = jax.tree.map(lambda leaf: leaf[0], inference_grid([row], policies.arms, policies.seeds))
    return play(
        inference,
        jax.tree.map(lambda leaf: leaf[inference.params], policies.params),
        first_states(episodes),
        policies.acting(world),
        world.params(0),
        policies.knowledge,
    )


def scene_named(world: CompiledWorld, name: str) -> Scene:
    """Return the scene of a world with a name."""
    scenes = (world.scenes[i] for i in range(len(world.scenes)))
    return next(scene for scene in scenes if scene.name == name)
