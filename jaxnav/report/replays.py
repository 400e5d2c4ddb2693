"""Replays: the same episodes by several agents, as JSON."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.special import softmax

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.playback import Trace
from jaxnav.report.plans import Plan, make_plan, pack
from jaxnav.report.players import Player, choose, compare
from jaxnav.runs.replay import replay, scene_named
from jaxnav.scenes.tables.detector import MAX_RANGE
from jaxnav.scenes.task import NUM_ACTIONS


@dataclasses.dataclass(frozen=True)
class Course:
    """Hold an episode as one agent plays it, T steps.

    Attributes:
      views: [T], indices into the plan's views.
      actions: [T].
      success: whether it ended with Done where that succeeds.
      gap, weight: packed [T], layout gap, and weight of the logits that are removed.
      layout: packed [T, K], weights towards the goal (eq. 7), at most 1; empty without the layout.
      chances: packed [T, 3, A], of each action: of the factual, the counterfactual and the corrected logits; empty
        where the policy chooses no actions.
    """

    views: list[int]
    actions: list[int]
    success: bool
    gap: str
    weight: str
    layout: str
    chances: str


@dataclasses.dataclass(frozen=True)
class Episode:
    """Hold an episode of the replays.

    Attributes:
      plan: index of its scene's plan.
      goal: index of the category to search for.
      best: L*, actions.
      courses: of each player.
    """

    plan: int
    goal: int
    best: int
    courses: list[Course]


@dataclasses.dataclass(frozen=True)
class Replays:
    """Hold the replays at one layout shift.

    Attributes:
      shift: of the layout.
      split: of the scenes.
      categories: names.
      players: names; what tables call the rows.
      comparisons: pairs of players by name, what is with and what is without; the first is shown first.
      thresholds: of sTDE, by player; None where nothing is removed.
      differ: [P, P], in how many of the evaluation's episodes two players end otherwise or at another step.
      evaluated: number of these.
      field_of_view: degrees, horizontal.
      reach: centimetres, of the view cone.
      plans: of the scenes.
      episodes: those in which players differ first.
    """

    shift: float
    split: str
    categories: list[str]
    players: list[str]
    comparisons: dict[str, tuple[int, int]]
    thresholds: list[float | None]
    differ: list[list[int]]
    evaluated: int
    field_of_view: float
    reach: int
    plans: list[Plan]
    episodes: list[Episode]


def make_replays(players: Sequence[Player], episodes: EpisodeList, count: int, shift: float, split: str) -> Replays:
    """Play chosen episodes by every player.

    Args:
      players: at least one; their results are those of `episodes`.
      episodes: of an evaluation, of the first bank.
      count: of episodes to replay.
      shift, split: of the scenes.
    """
    world = players[0].world
    bank, rules = world.banks[0], world.banks[0].task.rules
    chosen = episodes.take(choose(players, count))
    played = [replay(player.policies, player.world, chosen, player.row) for player in players]
    scenes = np.unique(chosen.scene)
    poses = [
        np.unique(np.concatenate([traces[e].pose for traces in played for e in np.flatnonzero(chosen.scene == scene)]))
        for scene in scenes
    ]
    of = np.searchsorted(scenes, chosen.scene)
    return Replays(
        shift=shift,
        split=split,
        categories=list(bank.task.categories),
        players=[player.name for player in players],
        comparisons=compare(players),
        thresholds=[player.row.epsilon for player in players],
        differ=[[int(a.differs(b).sum()) for b in players] for a in players],
        evaluated=len(episodes.goal),
        field_of_view=rules.field_of_view[0],
        reach=round(100 * MAX_RANGE),
        plans=[
            make_plan(scene_named(world, bank.names[scene]), bank, scene, seen)
            for scene, seen in zip(scenes, poses, strict=True)
        ],
        episodes=[
            Episode(
                int(of[e]),
                int(chosen.goal[e]),
                int(chosen.best_length[e]),
                [
                    _course(traces[e], poses[of[e]], player.row.arm == "layout")
                    for traces, player in zip(played, players, strict=True)
                ],
            )
            for e in range(len(chosen.goal))
        ],
    )


def _course(trace: Trace, poses: np.ndarray, layout: bool) -> Course:
    how = trace.inferred
    logits = np.stack([how.factual, how.counterfactual, how.corrected], axis=1)
    return Course(
        views=np.searchsorted(poses, trace.pose).tolist(),
        actions=trace.action.tolist(),
        success=trace.success,
        gap=pack(trace.gap),
        weight=pack(np.asarray(how.weight)),
        layout=pack(np.asarray(how.layout)) if layout else "",
        chances=pack(softmax(logits, axis=-1)) if logits.shape[-1] == NUM_ACTIONS else "",
    )
