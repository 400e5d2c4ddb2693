"""Fit of a belief to searches in training homes.

1. `locate_objects` finds where the detector reports objects from several poses of a training home.
2. `explore_homes` searches for goals with a belief that is flat, and keeps snapshots of the agent's map together with
   the squares of the objects; on the way it counts how often a look at an object detects it.
3. `fit_weights` fits places and predictor by conditional likelihood: among the squares of a map that does not show the
   goal, those with the goal should be likeliest, given the looks in vain. The places are fitted by their own
   likelihood, and the predictor to what they leave unexplained.
"""

import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxnav.env.objectnav import OTHER_ROOM, EnvParams
from jaxnav.layout import LayoutEstimator
from jaxnav.policies.agent_loop import AgentLoop, policy_memory
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods.belief_map import MapSquares, read_squares
from jaxnav.policies.methods.local_policy import wrapped_offset
from jaxnav.policies.methods.map_tracker import (
    NUM_LOOK_DISTANCES,
    SQUARE_CELLS,
    SearchState,
    detection_cells,
    make_view_table,
    nearest_looks,
)
from jaxnav.policies.methods.semexp import cell_positions
from jaxnav.policies.network import Params, init_params
from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import RowFormat, relative_position, turn_offsets

if TYPE_CHECKING:
    from jaxnav.policies.methods.belief import TargetPolicy

#: Smallest number of actions between two snapshots of a map, and largest number of snapshots, which bounds the memory.
MIN_SNAPSHOT_INTERVAL = 10
MAX_SNAPSHOTS = 10_000
#: Poses that must report an object at one cell; false alarms are scattered.
MIN_REPORTS = 5
#: Steps, maps in each, and learning rate of Adam.
NUM_FIT_STEPS = 1200
FIT_BATCH = 32
FIT_LEARNING_RATE = 0.02
#: Factor of the squared weights in the loss.
WEIGHT_PENALTY = 1e-4
#: Number of looks at the mean rate that are added to those at each category.
PRIOR_LOOKS = 2.0
#: Largest rate of detection, so that no look excludes a square for ever.
MAX_RATE = 0.98

# Constants folded into the key of a fit.
_INIT = 0
_START = 1
_EXPLORE = 2
_BATCHES = 3


class HomeObjects(NamedTuple):
    """Objects of the S homes of a bank, at most M in each, on the lattice of their home.

    Attributes:
      positions: int32 [S, M, 2], (z, x) in cells from the home's first cell.
      categories: int32 [S, M]; K for unused entries.
      cell_positions: int32 [C, 2], position of each cell of the bank.
    """

    positions: jax.Array
    categories: jax.Array
    cell_positions: jax.Array


class Snapshots(NamedTuple):
    """Maps of searches, B of them.

    Attributes:
      categories: uint32 [B, n, n], see `MapSquares`.
      floor: uint8 [B, 3, n, n], number of a square's cells that are explored, free, and walls.
      looks: uint8 [B, D, n, n].
      object_squares: int32 [B, M, 2], squares of the home's objects.
      object_categories: int32 [B, M]; K for unused entries.
    """

    categories: jax.Array
    floor: jax.Array
    looks: jax.Array
    object_squares: jax.Array
    object_categories: jax.Array


class LookCounts(NamedTuple):
    """Looks at the nearest object of each category, by distance.

    Attributes:
      looks: float32 [K, D], number of looks.
      hits: float32 [K, D], number of looks that detect the object.
    """

    looks: jax.Array
    hits: jax.Array


def fit_belief(
    agent_loop: AgentLoop,
    bank: Bank,
    env_params: EnvParams,
    knowledge: Knowledge,
    key: jax.Array,
    num_searches: int,
    num_steps: int,
) -> Params:
    """Fit places, predictor and detection rates; see `jaxnav.policies.method.Fit`."""
    assert agent_loop.spec is not None
    params = init_params(agent_loop.spec, jax.random.fold_in(key, _INIT))
    home_objects = locate_objects(bank)

    # Searches with the initial belief, which is flat.
    explore = jax.jit(explore_homes, static_argnums=(0, 6, 7))
    snapshots, look_counts = explore(
        agent_loop, params, home_objects, env_params, knowledge, key, num_searches, num_steps
    )
    params = params | {"detection_rates": detection_rates(look_counts)}

    # Goals of the task, and the layout's weights before the first view, by the prior of homes with rooms of all types.
    goals = jnp.asarray(np.flatnonzero(agent_loop.env.task.is_goal()))
    estimator = LayoutEstimator(knowledge.priors[OTHER_ROOM])
    goal_weights = jax.vmap(estimator.goal_weights, (None, 0))(estimator.init(), goals)
    return fit_weights(agent_loop, params, snapshots, goals, goal_weights, key)


def locate_objects(bank: Bank) -> HomeObjects:
    """Find the cells at which the detector reports objects from at least `MIN_REPORTS` poses."""
    rules = bank.task.rules
    num_categories = len(bank.task.categories)
    row_format = RowFormat(num_categories)
    lattice = cell_positions(bank.ahead, rules.move_steps())
    forward = rules.heading_directions()

    positions_by_home = []
    categories_by_home = []
    for first_cell, num_cells in zip(bank.first_cell, bank.num_cells, strict=True):
        # All detections of the home, and the cells at which they are reported.
        first_pose = first_cell * rules.poses_per_cell
        poses = np.arange(first_pose, first_pose + num_cells * rules.poses_per_cell)
        detections = row_format.detections(bank.rows[poses])
        pose_index, category = np.nonzero(detections[..., 0])
        ahead, right = relative_position(detections[pose_index, category])
        cell, heading, _ = rules.split_pose(poses[pose_index])
        offsets = turn_offsets(ahead, right, forward[heading])[:, ::-1]  # (z, x)
        reported_cells = lattice[cell] + np.rint(offsets / CELL_SIZE).astype(int)

        # Cells with enough reports of a category.
        reports = np.column_stack([category, reported_cells])
        places, num_reports = np.unique(reports, axis=0, return_counts=True)
        places = places[num_reports >= MIN_REPORTS]
        categories_by_home.append(places[:, 0])
        positions_by_home.append(places[:, 1:])

    # Pad to the largest number of objects.
    max_objects = max(map(len, categories_by_home))
    shape = (len(categories_by_home), max_objects)
    positions = np.zeros((*shape, 2), np.int32)
    categories = np.full(shape, num_categories, np.int32)
    for home, (home_positions, home_categories) in enumerate(zip(positions_by_home, categories_by_home, strict=True)):
        positions[home, : len(home_positions)] = home_positions
        categories[home, : len(home_categories)] = home_categories
    return HomeObjects(jnp.asarray(positions), jnp.asarray(categories), jnp.asarray(lattice, dtype=jnp.int32))


def explore_homes(
    agent_loop: AgentLoop,
    params: Params,
    home_objects: HomeObjects,
    env_params: EnvParams,
    knowledge: Knowledge,
    key: jax.Array,
    num_searches: int,
    num_steps: int,
) -> tuple[Snapshots, LookCounts]:
    """Search for goals, and collect snapshots and looks.

    Args:
      agent_loop: runs policy and environment.
      params: parameters of the searching policy.
      home_objects: objects of the homes.
      env_params, knowledge, key, num_searches, num_steps: see `jaxnav.policies.method.Fit`.
    """
    policy = agent_loop.bind(params)
    memory = policy.initial_memory((num_searches,))
    agent = agent_loop.start(jax.random.fold_in(key, _START), num_searches, memory, knowledge, env_params)
    num_categories = len(agent_loop.env.categories)
    no_looks = LookCounts(*(jnp.zeros((num_categories, NUM_LOOK_DISTANCES)) for _ in LookCounts._fields))

    def count_looks_once(search: SearchState, cell: jax.Array, scene: jax.Array, row: jax.Array) -> LookCounts:
        squares = object_squares(search, cell, scene, home_objects)
        return count_looks(search, row, squares, home_objects.categories[scene], agent_loop)

    def step(carry: Any, time: jax.Array) -> tuple[Any, None]:
        agent, look_counts = carry
        inputs = agent_loop.policy_inputs(agent, knowledge, env_params)
        memory = policy_memory(agent)
        decision = policy.decide(policy.pathways(inputs, memory), memory)

        # Count the looks of the current view.
        cell = agent_loop.env.cell_of_pose(agent.state.pose)
        new_counts = jax.vmap(count_looks_once)(
            agent.perception.tracker_state, cell, agent.state.scene, inputs.observation.row
        )
        look_counts = jax.tree.map(lambda total, counts: total + counts.sum(axis=0), look_counts, new_counts)

        # Walk to the best target. Ended episodes are followed by new ones.
        choice = decision.logits.argmax(axis=-1).astype(jnp.int32)
        reset_keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, _EXPLORE), time), num_searches)
        agent, _ = agent_loop.step(
            agent, choice, knowledge, env_params, policy=policy, decision=decision, reset_keys=reset_keys
        )
        return (agent, look_counts), None

    def take_snapshot(carry: Any, times: jax.Array) -> tuple[Any, Snapshots]:
        carry, _ = jax.lax.scan(step, carry, times)
        agent, _ = carry
        cell = agent_loop.env.cell_of_pose(agent.state.pose)
        search = agent.perception.tracker_state
        squares = jax.vmap(read_squares)(search.cells, search.looks)
        squares_of_objects = jax.vmap(object_squares, (0, 0, 0, None))(search, cell, agent.state.scene, home_objects)
        snapshots = Snapshots(
            categories=squares.categories,
            floor=(SQUARE_CELLS**2 * squares.floor).astype(jnp.uint8),
            looks=squares.looks.astype(jnp.uint8),
            object_squares=squares_of_objects,
            object_categories=home_objects.categories[agent.state.scene],
        )
        return carry, snapshots

    # At least one snapshot of each search.
    interval = max(MIN_SNAPSHOT_INTERVAL, -(-num_searches * num_steps // MAX_SNAPSHOTS))
    interval = min(interval, num_steps)
    num_snapshots = num_steps // interval
    times = jnp.arange(num_snapshots * interval).reshape(num_snapshots, interval)
    (_, look_counts), snapshots = jax.lax.scan(take_snapshot, (agent, no_looks), times)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), snapshots), look_counts


def object_squares(search: SearchState, cell: jax.Array, scene: jax.Array, home_objects: HomeObjects) -> jax.Array:
    """Squares of a home's objects on the map of one episode, int32 [M, 2].

    Args:
      search: state of the search.
      cell: int32 [], the agent's cell in the bank.
      scene: int32 [], the home.
      home_objects: objects of all homes.
    """
    offset = search.position - home_objects.cell_positions[cell]
    return (home_objects.positions[scene] + offset[None]) % len(search.cells) // SQUARE_CELLS


def count_looks(
    search: SearchState, row: jax.Array, squares: jax.Array, categories: jax.Array, agent_loop: AgentLoop
) -> LookCounts:
    """Count the looks of one view at the nearest object of each category, 0 or 1 each.

    Args:
      search: state of the search after the view.
      row: uint8 [R], the observation row.
      squares, categories: int32 [M, 2] and int32 [M], the home's objects.
      agent_loop: has the format of the rows and the rules.
    """
    row_format = agent_loop.env.row_format
    num_categories = row_format.num_categories
    rules = agent_loop.env.task.rules
    size = len(search.cells)
    view = (row, search.position, search.heading, row_format)

    # Distance bin of the nearest object of each category in view, [K].
    view_table = make_view_table(rules, row_format.view)
    distance_bins = nearest_looks(*view, view_table, size)[squares[:, 0], squares[:, 1]]
    unseen = jnp.full(num_categories + 1, NUM_LOOK_DISTANCES, jnp.int32)
    nearest_bin = unseen.at[categories].min(distance_bins)[:num_categories]

    # A hit is a detection in the object's square or in a neighbouring one.
    detected_squares = detection_cells(*view, rules.headings, size) // SQUARE_CELLS
    num_squares = size // SQUARE_CELLS
    own_detection = detected_squares[jnp.minimum(categories, num_categories - 1)]
    separation = jnp.abs(wrapped_offset(own_detection, squares, num_squares)).max(axis=-1)
    is_close = jnp.zeros(num_categories + 1, bool).at[categories].max(separation <= 1)[:num_categories]
    is_hit = row_format.presence(row) & is_close

    view_looks = jax.nn.one_hot(nearest_bin, NUM_LOOK_DISTANCES)  # zeros for categories out of view
    return LookCounts(view_looks, view_looks * is_hit[:, None].astype(jnp.float32))


def detection_rates(look_counts: LookCounts) -> jax.Array:
    """Probability that a look from each distance detects an object, float32 [K, D]; at most `MAX_RATE`.

    Categories that were rarely in view have nearly the mean rate.
    """
    mean_rate = (look_counts.hits.sum(axis=0) + 0.5) / (look_counts.looks.sum(axis=0) + 1.0)
    rates = (look_counts.hits + PRIOR_LOOKS * mean_rate[None]) / (look_counts.looks + PRIOR_LOOKS)
    return jnp.minimum(rates, MAX_RATE)


def fit_weights(
    agent_loop: AgentLoop,
    params: Params,
    snapshots: Snapshots,
    goals: jax.Array,
    goal_weights: jax.Array,
    key: jax.Array,
) -> Params:
    """Fit places and predictor by conditional likelihood.

    Args:
      agent_loop: has the policy.
      params: initial parameters; the detection rates stay as they are.
      snapshots: maps of searches.
      goals: int32 [G], the goals that are fitted.
      goal_weights: float32 [G, K], the layout's weights for each goal.
      key: typed PRNG key [].
    """
    optimizer = optax.adam(optax.cosine_decay_schedule(FIT_LEARNING_RATE, NUM_FIT_STEPS))
    num_maps = len(snapshots.categories)
    batches = jax.random.randint(jax.random.fold_in(key, _BATCHES), (NUM_FIT_STEPS, FIT_BATCH), 0, num_maps)
    fit = jax.jit(_optimize, static_argnums=(0, 1))
    return fit(agent_loop, optimizer, params, snapshots, goals, goal_weights, batches)


def _optimize(
    agent_loop: AgentLoop,
    optimizer: optax.GradientTransformation,
    params: Params,
    snapshots: Snapshots,
    goals: jax.Array,
    goal_weights: jax.Array,
    batches: jax.Array,
) -> Params:
    """Parameters after Adam's steps, one for each row of `batches`, int32 [steps, B]."""
    fixed_params = {"detection_rates": params["detection_rates"]}

    def loss_fn(params: Params, batch: Snapshots) -> jax.Array:
        policy: Any = agent_loop.bind(params | fixed_params)
        losses = jax.vmap(functools.partial(goal_losses, policy), (0, None, None))
        places_loss, layout_loss, num_goals = losses(batch, goals, goal_weights)
        squared_weights = sum(jnp.square(leaf).sum() for leaf in jax.tree.leaves(params))
        mean_loss = (places_loss + layout_loss).sum() / jnp.maximum(num_goals.sum(), 1.0)
        return mean_loss + WEIGHT_PENALTY * squared_weights

    def train_step(carry: Any, indices: jax.Array) -> tuple[Any, None]:
        params, opt_state = carry
        batch = jax.tree.map(lambda leaf: leaf[indices], snapshots)
        gradient = jax.grad(loss_fn)(params, batch)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes int32 counts with float32
            updates, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(params, updates), opt_state), None

    (fitted_params, _), _ = jax.lax.scan(train_step, (params, optimizer.init(params)), batches)
    return fitted_params | fixed_params


def goal_losses(
    policy: "TargetPolicy", snapshot: Snapshots, goals: jax.Array, goal_weights: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Negative log likelihoods of the goals' squares on one map, added over the goals that the map does not show.

    Args:
      policy: policy with the parameters that are fitted.
      snapshot: one map.
      goals: int32 [G].
      goal_weights: float32 [G, K].

    Returns:
      float32 [] each: of the places, of the layout, and the number of goals.
    """
    squares = MapSquares(
        snapshot.categories,
        snapshot.floor.astype(jnp.float32) / SQUARE_CELLS**2,
        snapshot.looks.astype(jnp.float32),
    )

    def goal_loss(goal: jax.Array, weights: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        # Squares with the goal; goals on the map or missing in the home do not count.
        rows, columns = snapshot.object_squares.T
        is_goal_square = jnp.zeros(squares.categories.shape, bool)
        is_goal_square = is_goal_square.at[rows, columns].max(snapshot.object_categories == goal)
        is_on_map = (squares.categories >> goal.astype(jnp.uint32) & np.uint32(1) > 0).any()
        is_counted = (is_goal_square.any() & ~is_on_map).astype(jnp.float32)

        # The predictor explains what the places leave unexplained, so no gradient of its loss reaches them.
        beliefs = policy.log_beliefs(squares, goal, weights)
        added_score = beliefs.layout - beliefs.places
        layout = jax.lax.stop_gradient(beliefs.places) + added_score
        places_loss = _negative_log_likelihood(beliefs.places, is_goal_square)
        layout_loss = _negative_log_likelihood(layout, is_goal_square)
        return is_counted * places_loss, is_counted * layout_loss, is_counted

    losses = jax.vmap(goal_loss)(goals, goal_weights)
    places_loss, layout_loss, num_goals = (loss.sum() for loss in losses)
    return places_loss, layout_loss, num_goals


def _negative_log_likelihood(log_belief: jax.Array, is_goal_square: jax.Array) -> jax.Array:
    """Negative log of the belief's share in the squares with the goal; 0 without such a square."""
    # Without a square the sum would be empty, and its gradient not finite.
    counted_squares = is_goal_square | ~is_goal_square.any()
    goal_mass = jax.nn.logsumexp(log_belief, where=counted_squares)
    return jax.nn.logsumexp(log_belief) - goal_mass
