"""Picture of a search with a map: the agent's map at one step, its target block and its planned path.

`take_snapshot` recomputes the map and the plan of a step from a played episode, and `draw_search` draws both over the
plan of the home, with a row for each episode, such as those with and without a layout shift. `MapProjection` converts
cells of the toroidal map to places in the world. For a search by belief, each row has two panels with the belief as a
heat map: with all experience, and after its removal.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from jaxnav.env.render import (
    AGENT_COLOR,
    BACKGROUND_COLOR,
    GOAL_COLOR,
    SEEN_COLOR,
)
from jaxnav.errors import InputError
from jaxnav.evaluation.playback import make_percepts
from jaxnav.policies.method import Knowledge, Percept
from jaxnav.policies.methods.belief import TargetPolicy
from jaxnav.policies.methods.belief_map import read_squares
from jaxnav.policies.methods.local_policy import LocalPolicy
from jaxnav.policies.methods.map_tracker import (
    EXPLORED_BIT,
    FREE_BIT,
    WALL_BIT,
    SearchState,
    goal_on_map,
)
from jaxnav.policies.network import Params, bind
from jaxnav.scenes.scene import CELL_SIZE, scene_extent
from jaxnav.scenes.task import LOOK_DOWN, LOOK_UP, MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT
from jaxnav.viz.episode import PlayedEpisode, describe_step
from jaxnav.viz.scene import (
    LabelPlacer,
    draw_agent,
    draw_plan_background,
    is_any_near,
)
from jaxnav.viz.style import (
    MUTED_COLOR,
    default_style,
    save_figure,
)

MAX_PREDICTED_ACTIONS = 80

NEAR_COLOR = "#bcd9ea"
FAR_COLOR = "#e6f0f6"
OBSTACLE_COLOR = "#55524d"
BLOCK_COLOR = "#CC79A7"
BELIEF_COLOR = "#D55E00"
#: Opacity of the likeliest square.
_MAX_OPACITY = 0.85


class SearchSnapshot(NamedTuple):
    """Map and plan of an agent at one step.

    Attributes:
      search_state: state of the search after the choice of the step, with the map; leaves are NumPy arrays.
      predicted_cells: int32 [L, 2], cells (z, x) after each of the next actions, if nothing new is seen.
      block_size: cells along each side of the target block.
      beliefs: by the title of a panel, the probability float32 [n, n] that the goal is in each square of the map; empty
        for other methods than a search by belief.
    """

    search_state: SearchState
    predicted_cells: np.ndarray
    block_size: int
    beliefs: Mapping[str, np.ndarray] = {}

    @property
    def is_searching(self) -> bool:
        """True while the goal is not on the map."""
        return not goal_on_map(jax.tree.map(jnp.asarray, self.search_state))


def take_snapshot(episode: PlayedEpisode, step: int) -> SearchSnapshot:
    """Return the map and the plan at a step.

    Args:
      episode: played episode of a method that searches with a map.
      step: step of the episode, from 0.

    Raises:
      InputError: the method keeps no map, or the episode has no such step.
    """
    method = episode.policies.spec.method
    knowledge = episode.policies.knowledge
    control = method.control
    tracker = method.tracker
    num_steps = len(episode.trace.pose)
    if not isinstance(control, LocalPolicy) or tracker is None:
        raise InputError(f"--map: method {method.name!r} has no map; give a run of method semexp or belief")
    if not 0 <= step < num_steps:
        raise InputError(f"--step {step + 1}: give a number from 1 to {num_steps}")

    # Repeat the updates of the map up to the step, with the choices of the episode.
    def update_map(state: SearchState, inputs: tuple[Percept, jax.Array]) -> tuple[SearchState, None]:
        percept, choice = inputs
        _, next_state = control.act(choice, tracker.update(state, knowledge, percept), knowledge)
        return next_state, None

    percepts = make_percepts(episode.trace, episode.rows, episode.task.rules, episode.goal)
    choices = jnp.asarray(episode.trace.inferred.action_logits.argmax(axis=-1))
    inputs = jax.tree.map(lambda leaf: leaf[: step + 1], (percepts, choices))
    search_state, _ = jax.jit(lambda inputs: jax.lax.scan(update_map, tracker.init(knowledge), inputs))(inputs)

    # Predict the next actions with the choice of this step.
    predict = jax.jit(lambda state: predict_path(control, state, choices[step], knowledge))
    predicted_cells = predict(search_state)
    return SearchSnapshot(
        search_state=jax.tree.map(np.asarray, search_state),
        predicted_cells=np.asarray(predicted_cells),
        block_size=control.block_size(len(search_state.cells)),
        beliefs=compute_beliefs(episode, search_state, step),
    )


def compute_beliefs(episode: PlayedEpisode, search_state: SearchState, step: int) -> dict[str, np.ndarray]:
    """Return the belief of a search by belief with all experience, and after its removal by equations 1 or 2.

    Args:
      episode: played episode; its first policy has acted.
      search_state: state of the search at the step.
      step: step of the episode, from 0.

    Returns:
      By the title of a panel, float32 [n, n], as in `SearchSnapshot.beliefs`.
    """
    policies = episode.policies
    if policies.spec.method.policy_class is not TargetPolicy:
        return {}
    inferred = episode.trace.inferred
    removal_weight = float(inferred.removal_weight[step])
    layout_weights = jnp.asarray(inferred.layout_weights[step])

    @jax.jit
    def predict_goal(params: Params, search_state: SearchState) -> tuple[jax.Array, jax.Array]:
        policy = bind(policies.spec, params)
        assert isinstance(policy, TargetPolicy)
        assert search_state.looks is not None
        squares = read_squares(search_state.cells, search_state.looks)
        goal = jnp.int32(episode.goal)
        before_removal = policy.goal_probabilities(squares, goal, layout_weights)
        return before_removal, policy.goal_probabilities(squares, goal, layout_weights, removal_weight)

    params = jax.tree.map(lambda leaf: leaf[0], policies.params)
    before_removal, after_removal = predict_goal(params, search_state)
    return {
        "belief with all experience": np.asarray(before_removal),
        f"after removal, s = {removal_weight:.2f}": np.asarray(after_removal),
    }


def predict_path(control: LocalPolicy, search_state: SearchState, choice: jax.Array, knowledge: Knowledge) -> jax.Array:
    """Return the cells that the next actions lead to, if nothing new is seen.

    Returns:
      int32 [MAX_PREDICTED_ACTIONS, 2], cells (z, x).
    """
    strides = knowledge.method["steps"]
    size = len(search_state.cells)

    def move(pose: tuple[jax.Array, ...], _: None) -> tuple[tuple[jax.Array, ...], jax.Array]:
        position, heading, horizon = pose
        state = search_state._replace(position=position, heading=heading, horizon=horizon)
        action = control.act(choice, state, knowledge)[0]

        # Move on the toroidal map.
        cell_ahead = (position + strides[heading]) % size
        heading_change = (action == ROTATE_RIGHT).astype(jnp.int32) - (action == ROTATE_LEFT).astype(jnp.int32)
        horizon_change = (action == LOOK_DOWN).astype(jnp.int32) - (action == LOOK_UP).astype(jnp.int32)
        next_position = jnp.where(action == MOVE_AHEAD, cell_ahead, position)
        return (next_position, (heading + heading_change) % len(strides), horizon + horizon_change), next_position

    first_pose = (search_state.position, search_state.heading, search_state.horizon)
    _, cells = jax.lax.scan(move, first_pose, length=MAX_PREDICTED_ACTIONS)
    return cells


class MapProjection:
    """Projection of the toroidal map of an agent onto the home.

    Attributes:
      size: cells along a side of the map.
    """

    def __init__(self, episode: PlayedEpisode, snapshot: SearchSnapshot) -> None:
        """Place the start of the episode in the middle of the map, and the map around the middle of the home."""
        self.size = len(snapshot.search_state.cells)
        self._start = episode.places[0]
        home_centre = np.mean(scene_extent(episode.scene), axis=0)
        # Cell (z, x) of the map, not wrapped, in the middle of the home.
        self._centre_cell = np.rint((home_centre - self._start) / CELL_SIZE).astype(int)[::-1] + self.size // 2

    def unroll(self, cells: np.ndarray) -> np.ndarray:
        """Return the map with the home in its middle."""
        return np.roll(cells, tuple(self.size // 2 - self._centre_cell), axis=(0, 1))

    def to_world(self, cells: np.ndarray) -> np.ndarray:
        """Return the world (x, z) of map cells (z, x), float64 [..., 2]."""
        from_centre = self._wrap(cells - self._centre_cell)
        from_start = from_centre + self._centre_cell - self.size // 2
        return self._start + CELL_SIZE * from_start[..., ::-1]

    def path_to_world(self, cells: np.ndarray) -> np.ndarray:
        """Return the world (x, z) of consecutive cells [L, 2], with the shorter way around the map between neighbours.

        A path may lead beyond the edge of the map.
        """
        steps = self._wrap(np.diff(cells, axis=0))
        from_first = np.concatenate([np.zeros((1, 2), int), np.cumsum(steps, axis=0)])
        return self.to_world(cells[0]) + CELL_SIZE * from_first[:, ::-1]

    @property
    def borders(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top of the unrolled map, metres."""
        x_low, z_low = self._start + CELL_SIZE * (self._centre_cell[::-1] - self.size) - CELL_SIZE / 2
        return x_low, x_low + CELL_SIZE * self.size, z_low, z_low + CELL_SIZE * self.size

    def _wrap(self, offsets: np.ndarray) -> np.ndarray:
        """Return offsets between cells by the shorter way around the map."""
        return (offsets + self.size // 2) % self.size - self.size // 2


@default_style
def draw_search(episodes: Sequence[PlayedEpisode], snapshots: Sequence[SearchSnapshot], step: int, path: Path) -> None:
    """Write the picture of the search at a step as a PNG, with a row for each episode.

    Args:
      episodes: one or more episodes with the same goal.
      snapshots: the snapshot of each.
      step: step of the snapshots, from 0; episodes that ended earlier show their end.
      path: file to write.
    """
    num_rows = len(episodes)
    figure = Figure(figsize=(9.6, 5.4 * num_rows), dpi=100)
    FigureCanvasAgg(figure)
    for row, (episode, snapshot) in enumerate(zip(episodes, snapshots, strict=True)):
        bottom = 1.0 - (row + 1) / num_rows
        _draw_row(figure, bottom, 1.0 / num_rows, episode, snapshot, min(step, len(episode.trace.pose) - 1))

    # The legend stands to the right of the plans.
    goal_name = episodes[0].task.categories[episodes[0].goal]
    legend_handles = _legend_handles(goal_name, any(snapshot.is_searching for snapshot in snapshots))
    if any(snapshot.beliefs for snapshot in snapshots):
        legend_handles.append(Patch(color=BELIEF_COLOR, alpha=_MAX_OPACITY, label=f"{goal_name} is likely here"))
    figure.legend(handles=legend_handles, loc="center left", bbox_to_anchor=(0.73, 0.5), fontsize=9, frameon=False)
    save_figure(figure, path)


def _draw_row(
    figure: Figure, bottom: float, height: float, episode: PlayedEpisode, snapshot: SearchSnapshot, step: int
) -> None:
    """Draw the panels of one episode in a part of the figure, with texts above them."""
    # Title, goal and outcome, at fixed heights of the row.
    goal_name = episode.task.categories[episode.goal]
    status_text, status_color = describe_step(episode, step)
    figure.text(0.02, bottom + 0.945 * height, episode.title, color=MUTED_COLOR, fontsize=9.5)
    search_text = f"Looking for {goal_name}"
    figure.text(0.02, bottom + 0.9 * height, search_text, color=GOAL_COLOR, fontsize=14, weight="bold")
    figure.text(0.98, bottom + 0.935 * height, status_text, color=status_color, fontsize=10.5, ha="right")

    # A panel for each belief; one panel without a belief.
    projection = MapProjection(episode, snapshot)
    panel_titles = list(snapshot.beliefs) or [""]
    panel_width = 0.7 / len(panel_titles)
    panel_height = (0.82 if snapshot.beliefs else 0.85) * height
    for index, panel_title in enumerate(panel_titles):
        axes = figure.add_axes((0.015 + index * panel_width, bottom + 0.03 * height, panel_width, panel_height))
        axes.set_title(panel_title, fontsize=9.5, color=MUTED_COLOR)
        # The plan of the home, faint, under the agent's map.
        draw_plan_background(axes, episode.scene)
        _draw_map(axes, snapshot, projection)
        if panel_title:
            _draw_belief(axes, snapshot.beliefs[panel_title], projection)
        _draw_paths(axes, episode, snapshot, step, projection)
        _draw_marks(axes, episode, snapshot, projection)


def _draw_map(axes: Axes, snapshot: SearchSnapshot, projection: MapProjection) -> None:
    """Draw the floor and walls on the map."""
    cells = projection.unroll(np.asarray(snapshot.search_state.cells))
    map_image = np.zeros((*cells.shape, 4))
    # Explored floor and walls cover floor that was only seen from afar.
    for bits, color in ((FREE_BIT, FAR_COLOR), (FREE_BIT | EXPLORED_BIT, NEAR_COLOR), (WALL_BIT, OBSTACLE_COLOR)):
        map_image[cells & bits == bits] = to_rgba(color)
    axes.imshow(map_image, origin="lower", extent=projection.borders, interpolation="nearest", zorder=2.5)


def _draw_belief(axes: Axes, belief: np.ndarray, projection: MapProjection) -> None:
    """Draw the probability of each square of the map, as opacity over the likeliest square."""
    square_cells = projection.size // len(belief)
    by_cell = np.repeat(np.repeat(belief, square_cells, axis=0), square_cells, axis=1)
    heat_image = np.zeros((*by_cell.shape, 4))
    heat_image[..., :3] = to_rgb(BELIEF_COLOR)
    heat_image[..., 3] = _MAX_OPACITY * projection.unroll(by_cell) / belief.max()
    axes.imshow(heat_image, origin="lower", extent=projection.borders, interpolation="nearest", zorder=3)


def _draw_paths(
    axes: Axes, episode: PlayedEpisode, snapshot: SearchSnapshot, step: int, projection: MapProjection
) -> None:
    """Draw the path so far, the planned path, the agent and, during the search, the target block."""
    # The path so far, from a ring at the start.
    search_state = snapshot.search_state
    rules = episode.task.rules
    axes.plot(*episode.places[: step + 1].T, color=AGENT_COLOR, lw=2, solid_joinstyle="round", zorder=4)
    axes.plot(*episode.places[0], "o", color="white", markeredgecolor=AGENT_COLOR, markersize=6, zorder=4)

    # The planned path begins at the agent.
    planned_path = projection.path_to_world(np.stack([search_state.position, *snapshot.predicted_cells]))
    axes.plot(*planned_path.T, ":", color=AGENT_COLOR, lw=2, zorder=4)
    draw_agent(axes, episode.scene, rules, episode.places[step], 360.0 / rules.headings * float(search_state.heading))
    if snapshot.is_searching:
        _draw_block(axes, search_state, snapshot.block_size, projection)
    axes.apply_aspect()


def _draw_block(axes: Axes, search_state: SearchState, block_size: int, projection: MapProjection) -> None:
    """Draw the target block, which may lie beyond the home."""
    block_side = CELL_SIZE * block_size  # metres
    middle_cell = search_state.block_start + block_size // 2
    _, block_middle = projection.path_to_world(np.stack([search_state.position, middle_cell]))
    block_corner = block_middle - CELL_SIZE * (block_size // 2) - CELL_SIZE / 2
    axes.add_patch(Rectangle(block_corner, block_side, block_side, fill=False, edgecolor=BLOCK_COLOR, lw=2.2, zorder=5))

    # Widen the plan, so that it shows the whole block.
    x_low, x_high = axes.get_xlim()
    z_low, z_high = axes.get_ylim()
    axes.set_xlim(min(x_low, block_corner[0] - CELL_SIZE), max(x_high, block_corner[0] + block_side + CELL_SIZE))
    axes.set_ylim(min(z_low, block_corner[1] - CELL_SIZE), max(z_high, block_corner[1] + block_side + CELL_SIZE))


def _draw_marks(axes: Axes, episode: PlayedEpisode, snapshot: SearchSnapshot, projection: MapProjection) -> None:
    """Draw and name the cells that hold categories on the map."""
    # Places of each category on the map.
    categories = episode.task.categories
    places_by_category = []
    for category in range(len(categories)):
        marked_cells = np.argwhere(snapshot.search_state.cells & np.uint32(1 << category))
        places_by_category.append(projection.to_world(marked_cells))

    # Mark the goal first, so that its label gets the best place.
    goal_first = sorted(range(len(categories)), key=lambda category: category != episode.goal)
    no_walls = np.zeros((0, 2, 2))
    label_placer = LabelPlacer(axes, np.concatenate(places_by_category), no_walls, halo=BACKGROUND_COLOR)
    style = {"markeredgecolor": "white", "markeredgewidth": 0.5, "zorder": 6}
    for category in goal_first:
        marker, size, color = ("*", 13, GOAL_COLOR) if category == episode.goal else ("s", 4, SEEN_COLOR)
        earlier_places: list[np.ndarray] = []
        for place in places_by_category[category]:
            axes.plot(*place, marker, color=color, markersize=size, **style)
            # Marks of one category that are near each other share a label.
            if not is_any_near(place, earlier_places):
                label_placer.label_point(categories[category], place, color)
            earlier_places.append(place)


def _legend_handles(goal_name: str, is_searching: bool) -> list[Patch | Line2D]:
    """Return the entries of the legend."""
    # The target block is drawn during the search only.
    block_handles = [Patch(fill=False, edgecolor=BLOCK_COLOR, lw=2, label="block chosen to search in")]
    return [
        Patch(color=NEAR_COLOR, label="floor seen from nearby"),
        Patch(color=FAR_COLOR, label="floor seen from afar"),
        Patch(color=OBSTACLE_COLOR, label="walls and furniture as known"),
        Line2D([], [], marker="s", ls="", color=SEEN_COLOR, label="a category was seen here"),
        Line2D([], [], marker="*", ls="", color=GOAL_COLOR, markersize=12, label=f"{goal_name}, as known"),
        *(block_handles if is_searching else []),
        Line2D([], [], color=AGENT_COLOR, lw=2, label="way so far"),
        Line2D([], [], color=AGENT_COLOR, lw=2, ls=":", label="way planned"),
        Patch(facecolor=BACKGROUND_COLOR, edgecolor=MUTED_COLOR, label="faint: the true home"),
    ]
