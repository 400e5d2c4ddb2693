"""Replays: episodes of an evaluation, played by several agents, as data for the page's player.

`make_replays` chooses the episodes in which most agents differ, plays them with every `ReplayAgent`, and returns
`Replays`: a `ScenePlan` for each scene with the views that are replayed, and a `ReplayTrace` for each episode and
agent. The page embeds these dataclasses as JSON, so that their fields are the names that its script reads.

Lengths are whole centimetres. Rectangles are [x, z, width, depth], from their lowest corner. Arrays of shares are
packed, see `pack_shares`.
"""

import base64
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import softmax

from jaxnav.choices import Variant
from jaxnav.env.render import (
    FULL_SHADE_HEIGHT,
    view_cone,
)
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.playback import EpisodeTrace
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.report.beliefs import SQUARE_SIZE, BeliefTracer, find_squares
from jaxnav.runs.evaluate import replay_episodes
from jaxnav.runs.policies import Policies
from jaxnav.runs.worlds import CompiledWorld, find_scenes
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene, scene_extent
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import MAX_RANGE, RowFormat, detected_positions
from jaxnav.scenes.tables.visibility import cell_centres, wall_boxes
from jaxnav.scenes.task import NUM_ACTIONS

#: Pairs of roles to show side by side, by the difference between them.
ROLE_PAIRS = {
    "Removal": ("layout", "stde"),
    "Experience": ("layout", "reference"),
    "Layout weights": ("layout", "baseline"),
}
#: Pair of one agent in two layouts of the same home.
LAYOUT_PAIR = "Layout"
#: Episodes that are played in both layouts for each episode that is shown.
_LAYOUT_CANDIDATES = 4

Rectangle = tuple[int, int, int, int]


class ReplayAgent(NamedTuple):
    """Agent of the replays, with its results in E episodes of the evaluation.

    Attributes:
      role: the variant of its row, or `reference` for layout-blind agents.
      name: name of the row in tables.
      policies: policies of its run.
      compiled_world: compiled scenes, equal for all agents.
      row: row of the evaluation, with best actions.
      success: bool [E], success of the first seed.
      length: int [E], actions of the first seed.
    """

    role: Variant | Literal["reference"]
    name: str
    policies: Policies
    compiled_world: CompiledWorld
    row: EvaluationRow
    success: np.ndarray
    length: np.ndarray

    def differs(self, other: "ReplayAgent") -> np.ndarray:
        """Return in which episodes the other agent has another result or length, bool [E]."""
        return (self.success != other.success) | (self.length != other.length)


class TrainedLayout(NamedTuple):
    """Scenes in the layout of training, in which episodes of shifted scenes are played once more.

    Attributes:
      shift: layout shift of training.
      compiled_world: compiled scenes.
    """

    shift: float
    compiled_world: CompiledWorld


@dataclasses.dataclass(frozen=True)
class Floor:
    """Standable floor of a type of room; without a name, outside of rooms."""

    name: str
    cells: list[Rectangle]


@dataclasses.dataclass(frozen=True)
class PlanView:
    """View from one pose.

    Attributes:
      x: world x of the agent.
      z: world z of the agent.
      yaw: degrees clockwise from +z.
      cone: packed, the depths of every other ray of the view cone from left to right, as shares of `MAX_RANGE`.
      seen: index of the category, x, z and confidence in percent of each detection, the surest first.
    """

    x: int
    z: int
    yaw: float
    cone: str
    seen: list[tuple[int, int, int, int]]


@dataclasses.dataclass(frozen=True)
class ScenePlan:
    """Plan of a scene from above, with views.

    Attributes:
      name: name of the scene.
      room: type of room of the scene.
      box: area of the plan.
      floors: floor of each type of room.
      walls: walls, which end the sight.
      furniture: rectangle and height from 0 to 100 of every object, the highest last.
      objects: index of the category, x and z of each object of a category.
      views: views that are replayed.
    """

    name: str
    room: str
    box: Rectangle
    floors: list[Floor]
    walls: list[Rectangle]
    furniture: list[tuple[int, ...]]
    objects: list[tuple[int, int, int]]
    views: list[PlanView]


@dataclasses.dataclass(frozen=True)
class BeliefFrames:
    """Beliefs of a search at U choices of a target, as heat maps of squares.

    Attributes:
      steps: [U], steps of the choices.
      corner: x and z of the lowest corner of the first square.
      side: length of a side of a square.
      columns: number of squares along x.
      shares: packed [U, rows, columns], probability of the goal in each square, as shares of the likeliest square.
    """

    steps: list[int]
    corner: tuple[int, int]
    side: int
    columns: int
    shares: str


@dataclasses.dataclass(frozen=True)
class ReplayTrace:
    """Episode of T steps as one agent plays it, with K categories and A actions.

    Attributes:
      plan: index of the plan in which the agent acts.
      views: [T], indices into the plan's views.
      actions: [T], actions.
      success: True if the episode ended with Done where Done succeeds.
      gap: packed [T], layout gap.
      weight: packed [T], weight of the logits that are removed.
      layout: packed [T, K], weights towards the goal (eq. 7), at most 1; empty without the layout.
      chances: packed [T, 3, A], probabilities by the factual, the counterfactual and the corrected logits; empty
        where the policy chooses no actions.
      belief: belief over places; None for methods other than a search by belief.
    """

    plan: int
    views: list[int]
    actions: list[int]
    success: bool
    gap: str
    weight: str
    layout: str
    chances: str
    belief: BeliefFrames | None = None


@dataclasses.dataclass(frozen=True)
class ReplayEpisode:
    """Episode of the replays.

    Attributes:
      plan: index of the plan of its scene, at the layout shift of the replays.
      goal: index of the category to search for.
      best: length L* of a shortest path, actions.
      courses: trace of each agent.
    """

    plan: int
    goal: int
    best: int
    courses: list[ReplayTrace]


@dataclasses.dataclass(frozen=True)
class Replays:
    """Replays of P agents at one layout shift.

    Attributes:
      shift: layout shift.
      split: split of the scenes.
      categories: names of the categories.
      players: names of the agents, as in tables.
      layouts: layout shift of the scenes of each agent.
      comparisons: pairs of agents by the difference between them; the page shows the first pair.
      thresholds: threshold of sTDE of each agent; None where nothing is removed.
      differ: [P, P], number of evaluated episodes in which two agents differ in result or length; None for an agent in
        the layout of training, which plays fewer episodes.
      evaluated: number of evaluated episodes.
      field_of_view: horizontal field of view, degrees.
      reach: length of the view cone, centimetres.
      plans: plans of the scenes.
      episodes: episodes, those in which most agents differ first.
    """

    shift: float
    split: str
    categories: list[str]
    players: list[str]
    layouts: list[float]
    comparisons: dict[str, tuple[int, int]]
    thresholds: list[float | None]
    differ: list[list[int | None]]
    evaluated: int
    field_of_view: float
    reach: int
    plans: list[ScenePlan]
    episodes: list[ReplayEpisode]


def make_replays(
    agents: Sequence[ReplayAgent],
    episodes: EpisodeList,
    count: int,
    shift: float,
    split: str,
    trained_layout: TrainedLayout | None = None,
) -> Replays:
    """Choose episodes of an evaluation and play them with every agent.

    Args:
      agents: at least one, with their results in `episodes`.
      episodes: evaluated episodes of the first bank.
      count: number of episodes to replay.
      shift: layout shift of the scenes.
      split: split of the scenes.
      trained_layout: layout in which the agent that keeps its experience plays the episodes, too; None for none.
    """
    comparisons = pair_agents(agents)
    differ: list[list[int | None]] = [_count_differing_episodes(agent, agents) for agent in agents]

    # Play the selected episodes again, because the evaluation stores results, not traces.
    main_index = _find_main_agent(agents)
    main_agent = agents[main_index]
    selected_indices = select_episodes(agents, count)
    trained_traces = None
    if trained_layout is not None:
        selected_indices, trained_traces = _play_in_layout(agents, main_agent, trained_layout, episodes, count)
    selected_episodes = episodes.take(selected_indices)
    players = []
    for agent, tracer in zip(agents, _make_tracers(agents), strict=True):
        traces = replay_episodes(agent.policies, agent.compiled_world, selected_episodes, agent.row)
        players.append(_Player(agent.name, agent.row, shift, agent.compiled_world.banks[0], tracer, traces))

    # The agent in the layout of training is one more player, and the only one in other scenes.
    worlds_by_shift = {shift: agents[0].compiled_world}
    if trained_layout is not None and trained_traces is not None:
        comparisons[LAYOUT_PAIR] = (len(players), main_index)
        player_name = f"{main_agent.name}, shift {trained_layout.shift:g}"
        trained_bank = trained_layout.compiled_world.banks[0]
        tracer = players[main_index].tracer
        players.append(_Player(player_name, main_agent.row, trained_layout.shift, trained_bank, tracer, trained_traces))
        worlds_by_shift[trained_layout.shift] = trained_layout.compiled_world
        for counts in differ:
            counts.append(None)
        differ.append([None] * len(players))

    # Plans of the scenes in each layout, then one trace for each episode and player.
    plans = _make_plans(players, selected_episodes, worlds_by_shift)
    replay_episode_list = []
    for episode_index in range(len(selected_episodes.goal)):
        scene = int(selected_episodes.scene[episode_index])
        goal = int(selected_episodes.goal[episode_index])
        courses = []
        for player in players:
            courses.append(_trace_player(player, plans[player.shift, scene], episode_index, scene, goal))
        best_length = int(selected_episodes.best_length[episode_index])
        replay_episode_list.append(ReplayEpisode(plans[shift, scene].plan_index, goal, best_length, courses))

    # Names, thresholds and differences stand in the order of the players.
    task = agents[0].compiled_world.banks[0].task
    return Replays(
        shift=shift,
        split=split,
        categories=list(task.categories),
        players=[player.name for player in players],
        layouts=[player.shift for player in players],
        comparisons=comparisons,
        thresholds=[player.row.epsilon for player in players],
        differ=differ,
        evaluated=len(episodes.goal),
        field_of_view=task.rules.field_of_view[0],
        reach=round(100 * MAX_RANGE),
        plans=[plan.drawing for plan in plans.values()],
        episodes=replay_episode_list,
    )


class _Player(NamedTuple):
    """An agent that plays the selected episodes in one layout.

    Attributes:
      name: name on the page.
      row: use of its policies.
      shift: layout shift of its scenes.
      bank: tables of its scenes.
      tracer: tracer of its belief; None without one.
      traces: the episodes as it played them.
    """

    name: str
    row: EvaluationRow
    shift: float
    bank: Bank
    tracer: BeliefTracer | None
    traces: Sequence[EpisodeTrace]


class _VisitedScene(NamedTuple):
    """Scene in which episodes were played.

    Attributes:
      plan_index: index of its plan on the page.
      scene: the scene.
      poses: int [V], poses that any player visited, rising.
      drawing: its plan, with a view from each of these poses.
    """

    plan_index: int
    scene: Scene
    poses: np.ndarray
    drawing: ScenePlan


def _make_plans(
    players: Sequence[_Player], episodes: EpisodeList, worlds_by_shift: Mapping[float, CompiledWorld]
) -> dict[tuple[float, int], _VisitedScene]:
    """Draw a plan for each layout shift and scene, with a view from every pose that any player visits there."""
    plans: dict[tuple[float, int], _VisitedScene] = {}
    scene_indices = np.unique(episodes.scene).tolist()
    for shift, world in worlds_by_shift.items():
        bank = world.banks[0]
        scene_by_name = find_scenes(world, [bank.names[scene_index] for scene_index in scene_indices])
        for scene_index in scene_indices:
            visited_poses = []
            for player in players:
                if player.shift == shift:
                    for episode_index in np.flatnonzero(episodes.scene == scene_index).tolist():
                        visited_poses.append(player.traces[episode_index].pose)
            poses = np.unique(np.concatenate(visited_poses))
            scene = scene_by_name[bank.names[scene_index]]
            drawing = make_plan(scene, bank, scene_index, poses)
            plans[shift, scene_index] = _VisitedScene(len(plans), scene, poses, drawing)
    return plans


def _trace_player(player: _Player, plan: _VisitedScene, episode_index: int, scene_index: int, goal: int) -> ReplayTrace:
    """Return an episode of a player as data of the page."""
    trace = player.traces[episode_index]
    replay_trace = _make_trace(trace, plan.plan_index, plan.poses, has_layout=player.row.arm == "layout")
    if player.tracer is None:
        return replay_trace
    frames = _make_belief_frames(player.tracer, trace, player.bank, scene_index, plan.scene, goal)
    return dataclasses.replace(replay_trace, belief=frames)


def _make_tracers(agents: Sequence[ReplayAgent]) -> list[BeliefTracer | None]:
    """Return the tracer of the belief of each agent; None for agents without one."""
    # Agents of one run share a tracer, because a tracer compiles a program.
    tracer_of_policies: dict[int, BeliefTracer] = {}
    tracers: list[BeliefTracer | None] = []
    for agent in agents:
        if agent.row.arm == "layout" and BeliefTracer.supports(agent.policies):
            key = id(agent.policies)
            if key not in tracer_of_policies:
                tracer_of_policies[key] = BeliefTracer(agent.policies)
            tracers.append(tracer_of_policies[key])
        else:
            tracers.append(None)
    return tracers


def _make_belief_frames(
    tracer: BeliefTracer, trace: EpisodeTrace, bank: Bank, scene_index: int, scene: Scene, goal: int
) -> BeliefFrames:
    """Return the beliefs of an episode as data of the page."""
    steps, beliefs = tracer.compute(trace, bank, goal)

    # Squares that cover the home; the map begins at the start of the episode.
    first_cell, _, _ = bank.task.rules.split_pose(int(trace.pose[0]))
    start = cell_centres(scene, standable_cells(scene.reach))[first_cell - bank.first_cell[scene_index]]
    grid = find_squares(scene, start, beliefs.shape[-1])
    shown_beliefs = beliefs[:, grid.rows[:, None], grid.columns]

    largest = shown_beliefs.max(axis=(1, 2), keepdims=True)
    x, z = _to_centimetres(grid.low_corner).tolist()
    return BeliefFrames(
        steps=steps.tolist(),
        corner=(x, z),
        side=round(100 * SQUARE_SIZE),
        columns=len(grid.columns),
        shares=pack_shares(shown_beliefs / np.maximum(largest, np.finfo(np.float32).tiny)),
    )


def _find_main_agent(agents: Sequence[ReplayAgent]) -> int:
    """Return the index of the agent that keeps its experience, or of the first agent."""
    for index, agent in enumerate(agents):
        if agent.role == "layout":
            return index
    return 0


def _play_in_layout(
    agents: Sequence[ReplayAgent], agent: ReplayAgent, layout: TrainedLayout, episodes: EpisodeList, count: int
) -> tuple[np.ndarray, list[EpisodeTrace] | None]:
    """Select episodes, and play them with one agent in another layout.

    Rooms, goals and starts are equal in both layouts. Up to half of the episodes are those in which only one layout
    lets the agent succeed; the order is that of `select_episodes`.

    Returns:
      Indices of the episodes, and their traces; None if no goal can be reached in the other layout.
    """
    # Objects lie at other places, so that a goal may be out of reach; 0 is no length.
    candidates = select_episodes(agents, len(episodes.goal))
    lengths = layout.compiled_world.banks[0].best_length[episodes.pose[candidates], episodes.goal[candidates]]
    candidates = candidates[lengths > 0][: _LAYOUT_CANDIDATES * count]
    if len(candidates) == 0:
        return select_episodes(agents, count), None

    traces = replay_episodes(agent.policies, layout.compiled_world, episodes.take(candidates), agent.row)
    has_other_result = np.zeros(len(candidates), bool)
    for index, trace in enumerate(traces):
        has_other_result[index] = trace.success != agent.success[candidates[index]]

    # Take the first episodes with another result, fill up with the first of the list, and restore the order.
    first_indices = np.flatnonzero(has_other_result)[: (count + 1) // 2]
    remaining_indices = np.setdiff1d(np.arange(len(candidates)), first_indices)
    selected = np.sort(np.concatenate([first_indices, remaining_indices[: count - len(first_indices)]]))
    return candidates[selected], [traces[index] for index in selected]


def select_episodes(agents: Sequence[ReplayAgent], count: int) -> np.ndarray:
    """Select the episodes to replay.

    Episodes in which more pairs of agents differ come first, then those that come first in the list.

    Args:
      agents: at least one.
      count: number of episodes, or as many as there are.

    Returns:
      Indices in this order.
    """
    # Number of ordered pairs of agents that differ in each episode, [E].
    num_pairs = np.zeros_like(agents[0].length)
    for agent in agents:
        for other in agents:
            num_pairs = num_pairs + agent.differs(other).astype(int)
    return np.argsort(-num_pairs, kind="stable")[:count]


def pair_agents(agents: Sequence[ReplayAgent]) -> dict[str, tuple[int, int]]:
    """Return the indices of pairs of agents by the difference between them, as `ROLE_PAIRS`."""
    # Agents by role; a role can be missing, as without a reference run.
    index_by_role = {}
    for index, agent in enumerate(agents):
        index_by_role[agent.role] = index

    # The page shows the agents of a pair in the order of `ROLE_PAIRS`.
    role_pairs = {}
    for name, (first_role, second_role) in ROLE_PAIRS.items():
        if first_role in index_by_role and second_role in index_by_role:
            role_pairs[name] = (index_by_role[first_role], index_by_role[second_role])
    return role_pairs


def _count_differing_episodes(agent: ReplayAgent, others: Sequence[ReplayAgent]) -> list[int | None]:
    return [int(agent.differs(other).sum()) for other in others]


def _make_trace(trace: EpisodeTrace, plan: int, plan_poses: np.ndarray, has_layout: bool) -> ReplayTrace:
    """Return a trace as data of the page.

    Args:
      trace: trace of an episode.
      plan: index of the plan.
      plan_poses: sorted poses of the views of the plan.
      has_layout: True for agents with layout weights.
    """
    # Logits of the three inferences, [T, 3, A].
    inferred = trace.inferred
    logits = np.stack([inferred.factual_logits, inferred.removed_logits, inferred.action_logits], axis=1)

    # Policies that choose among other things than actions have no probabilities to show.
    chooses_actions = logits.shape[-1] == NUM_ACTIONS
    return ReplayTrace(
        plan=plan,
        views=np.searchsorted(plan_poses, trace.pose).tolist(),
        actions=trace.action.tolist(),
        success=trace.success,
        gap=pack_shares(trace.gap),
        weight=pack_shares(np.asarray(inferred.removal_weight)),
        layout=pack_shares(np.asarray(inferred.layout_weights)) if has_layout else "",
        chances=pack_shares(softmax(logits, axis=-1)) if chooses_actions else "",
    )


def make_plan(scene: Scene, bank: Bank, index: int, poses: np.ndarray) -> ScenePlan:
    """Return the plan of a scene with views from some poses.

    Args:
      scene: scene with at least one standable cell.
      bank: tables of the scene.
      index: index of the scene in the bank.
      poses: int [V], poses of the bank in this scene.
    """
    # Furniture, the highest last, as rectangles with a shade.
    x, y, z, size_x, size_y, size_z = scene.boxes.T
    box_top = y + size_y / 2
    height = np.rint(100 * np.clip(box_top / FULL_SHADE_HEIGHT, 0, 1)).astype(int)
    boxes = _to_centimetres(np.stack([x - size_x / 2, z - size_z / 2, size_x, size_z], axis=-1))
    furniture = []
    for box_index in np.argsort(box_top):
        furniture.append((*boxes[box_index].tolist(), int(height[box_index])))

    # Objects of categories.
    object_places = _to_centimetres(scene.boxes[:, [0, 2]]).tolist()
    object_list = []
    for category, place in zip(category_ids(scene.types, bank.task.categories), object_places, strict=True):
        if category >= 0:
            object_list.append((category, *place))

    # Views from the poses.
    # A pose of the bank holds the cell, counted over all scenes.
    centres = cell_centres(scene, standable_cells(scene.reach))
    views = []
    for pose in poses:
        cell, _, _ = bank.task.rules.split_pose(int(pose))
        views.append(_make_view(scene, bank, int(pose), centres[cell - bank.first_cell[index]]))

    low, high = scene_extent(scene)
    return ScenePlan(
        name=scene.name,
        room=scene.room_type,
        box=tuple(_to_centimetres(np.concatenate([low, high - low])).tolist()),
        floors=_make_floors(scene),
        walls=_to_rectangles(scene, scene.walls),
        furniture=furniture,
        objects=object_list,
        views=views,
    )


def _make_floors(scene: Scene) -> list[Floor]:
    """Return the standable floor outside of rooms, then that of each type of room."""
    # Cells of each type of room, and those in any room: bool [nz, nx].
    cells_by_type: dict[str, np.ndarray] = {}
    cells_in_rooms = np.zeros_like(scene.reach)
    for room in sorted(scene.rooms, key=lambda room: room.type):
        cells_by_type[room.type] = cells_by_type.get(room.type, False) | room.cells
        cells_in_rooms |= room.cells

    # The agent cannot stand everywhere in a room.
    floors = [Floor("", _to_rectangles(scene, scene.reach & ~cells_in_rooms))]
    for room_type, cells in cells_by_type.items():
        floors.append(Floor(room_type, _to_rectangles(scene, cells & scene.reach)))
    return floors


def _make_view(scene: Scene, bank: Bank, pose: int, place: np.ndarray) -> PlanView:
    """Return the view from a pose of the bank at a place [2], world (x, z)."""
    # The view cone as depths, [41]: every other ray is enough for the page.
    rules = bank.task.rules
    _, heading, _ = rules.split_pose(pose)
    yaw = 360.0 / rules.headings * heading
    cone_outline = view_cone(scene, rules, place, yaw)
    cone_depth = np.linalg.norm(cone_outline[1::2] - place, axis=1) / MAX_RANGE

    # Detections, the surest first.
    detections = RowFormat(len(bank.task.categories)).detections(bank.rows[pose])
    detected_categories = np.flatnonzero(detections[:, 0])
    surest_first = sorted(detected_categories, key=lambda category: -int(detections[category, 0]))

    # Bytes of confidence, from 0 to 255, become percent.
    reported_points = detected_positions(detections[surest_first], place, rules.heading_directions()[heading])
    confidence_percent = np.rint(detections[surest_first, 0] / 2.55).astype(int)
    seen_objects = []
    for category, reported_point, confidence in zip(
        surest_first, _to_centimetres(reported_points).tolist(), confidence_percent, strict=True
    ):
        seen_objects.append((int(category), *reported_point, int(confidence)))

    x, z = _to_centimetres(place).tolist()
    return PlanView(x, z, yaw, pack_shares(cone_depth), seen_objects)


def pack_shares(shares: np.ndarray) -> str:
    """Return numbers from 0 to 1 as base64, a byte each; other numbers are clipped."""
    return base64.b64encode(np.rint(255.0 * np.clip(shares, 0.0, 1.0)).astype(np.uint8).tobytes()).decode()


def _to_rectangles(scene: Scene, mask: np.ndarray) -> list[Rectangle]:
    """Return cells bool [nz, nx] as rectangles."""
    low_corners, high_corners = wall_boxes(scene, mask).swapaxes(0, 1)
    boxes = _to_centimetres(np.concatenate([low_corners, high_corners - low_corners], axis=-1))
    return list(map(tuple, boxes.tolist()))


def _to_centimetres(metres: np.ndarray) -> np.ndarray:
    return np.rint(100.0 * metres).astype(int)
