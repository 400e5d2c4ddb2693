"""Knowledge of the layout that is collected before training, on random walks in the training scenes.

1. `explore` counts how often two categories are detected together.
2. `calibrate` chooses strength and reduction of the layout estimator, and `layout_priors` turns the counts into its
   priors.
3. `fit_shift_classifier` learns how strongly pairs of categories seen together indicate another layout than that of
   training, by a logistic regression against walks under a simulated layout shift. `fit_sighting_classifier` learns the
   same of the distances at which pairs were seen.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxnav.choices import Reduction
from jaxnav.env.objectnav import NUM_PRIORS, EnvParams, ObjectNav
from jaxnav.errors import InputError
from jaxnav.gaps import CooccurrenceEvidence, PairSightings, near_features, seen_together
from jaxnav.layout import EstimatorConfig, prior_from_counts, resolve_estimator
from jaxnav.policies.agent_loop import Agent, AgentLoop, Perception
from jaxnav.policies.method import Knowledge
from jaxnav.scenes.task import DONE

#: Candidates of the calibration: sums of the prior's rows, and reductions over rows in the gap.
STRENGTHS = (5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0, 56.0, 80.0)
REDUCTIONS: tuple[Reduction, ...] = ("mean_visible", "sum")

#: Target of the calibration, after Fig. 6b of the paper: in the training layouts the gap is large in the first views
#: that the belief accepts, and well under the paper's threshold of 0.5 after `LATE_STEP` steps.
EARLY_GAP_TARGET = 0.75
LATE_GAP_TARGET = 0.25
NUM_EARLY_VIEWS = 3
LATE_STEP = 20

#: Lengths of the walks that the shift classifier learns from; each walk is cut at one of them.
_WALK_LENGTHS = (1, 2, 5, 10, 20, 40, 60)
#: The same for the sightings of a walk, whose evidence grows for longer.
_SIGHTING_LENGTHS = (5, 10, 20, 40, 80, 120)
#: Number of walks whose pairs are computed at once: those of all views of a walk take much memory with many categories.
_WALK_BATCH = 64
#: Standard deviation of the noise on the frequency ranks by which categories are paired for an exchange, in ranks.
_RANK_NOISE = 3.0
#: Weight of the squared log odds in the loss of the regression.
_L2_WEIGHT = 1e-3
#: Share of the scenes that is held out of the regression to calibrate its scale.
_CALIBRATION_SHARE = 0.25
#: Bytes of the examples of a regression, above which it learns from fewer walks (`limit_walks`).
_MAX_EXAMPLE_BYTES = 2**31
#: Steps and learning rate of Adam in the fits.
_NUM_FIT_STEPS = 100
_FIT_LEARNING_RATE = 0.1


# 1. Exploration


class Exploration(NamedTuple):
    """Co-occurrence counts from random walks.

    Attributes:
      counts: float32 [rooms, K, K], number of poses at which two categories were detected together, by room type; on
        the diagonal, at which a category was detected.
      prior_counts: float32 [rooms, K, K], counts behind the layout priors, as the layout estimator counts; `counts` for
        estimators with a gate and presence counts.
      steps: int32 [], number of steps.
      poses: int32 [], number of distinct poses visited.
    """

    counts: jax.Array
    prior_counts: jax.Array
    steps: jax.Array
    poses: jax.Array


def explore(
    env: ObjectNav,
    env_params: EnvParams,
    key: jax.Array,
    num_walks: int = 2048,
    num_steps: int = 100,
    estimator_config: str | EstimatorConfig = "calibrated",
) -> Exploration:
    """Count which categories are detected together on random walks (paper, section 3.3, stage i).

    The walks never choose Done. In `counts` each pose counts once, however often it is visited. In `prior_counts` a
    view that shows category i adds its counts n_j (eq. 3) to row i. Estimators with a gate take each pose once;
    without a gate every view of the walks counts, as in eq. 4.

    Args:
      env: the environment.
      env_params: parameters of the training environment.
      key: consumed.
      num_walks: parallel walks.
      num_steps: steps of each walk.
      estimator_config: layout estimator, or its name; `counts` and `gate` are read.
    """
    # Walk, and mark the poses visited in any walk.
    tables = env_params.tables
    poses, _ = _walk(env, env_params, key, num_walks, num_steps)
    is_visited = jnp.zeros(tables.rows.shape[0], bool).at[poses].set(True)

    # Detections at visited poses [P, K], and the room type of each pose [P].
    config = resolve_estimator(estimator_config)
    presence = (env.row_format.presence(tables.rows) & is_visited[:, None]).astype(jnp.float32)
    pose_scenes = jnp.repeat(
        jnp.arange(len(env_params.room)),
        tables.num_cells * env.task.rules.poses_per_cell,
        total_repeat_length=len(is_visited),
    )
    pose_rooms = env_params.room[pose_scenes]

    def count_pairs(view_counts: jax.Array) -> jax.Array:
        def count_in_room(room: jax.Array) -> jax.Array:
            is_in_room = (pose_rooms == room)[:, None].astype(jnp.float32)
            return jnp.matmul((presence * is_in_room).T, view_counts, precision="highest")

        return jax.lax.map(count_in_room, jnp.arange(NUM_PRIORS))  # one room type at a time, to save memory

    # Counts of the prior: instances instead of presence, and every view instead of every pose.
    counts = count_pairs(presence)
    prior_counts = counts
    if config.counts == "instances" or not config.gate:
        view_counts = presence
        if config.counts == "instances":
            view_counts = env.row_format.counts(tables.rows).astype(jnp.float32) * presence
        if not config.gate:
            num_visits = jnp.zeros(len(is_visited), jnp.float32).at[poses].add(1.0)
            view_counts = view_counts * num_visits[:, None]
        prior_counts = count_pairs(view_counts)

    return Exploration(
        counts=counts,
        prior_counts=prior_counts,
        steps=jnp.int32(num_walks * num_steps),
        poses=is_visited.sum(dtype=jnp.int32),
    )


def _start_walks(
    agent_loop: AgentLoop,
    env_params: EnvParams,
    knowledge: Knowledge | None,
    key: jax.Array,
    num_walks: int,
    num_steps: int,
) -> tuple[Agent, jax.Array]:
    """Start random walks: agents [W] at random poses, and their actions without Done, int32 [T, W]."""
    start_key = jax.random.fold_in(key, 0)
    walk_key = jax.random.fold_in(key, 1)
    agent = agent_loop.start(start_key, num_walks, None, knowledge, env_params)
    actions = jax.random.randint(walk_key, (num_steps, num_walks), 0, DONE)
    return agent, actions


def _walk(
    env: ObjectNav, env_params: EnvParams, key: jax.Array, num_walks: int, num_steps: int
) -> tuple[jax.Array, jax.Array]:
    """Walk at random: the poses of each walk, int32 [W, T + 1], and its scene, int32 [W]."""
    agent_loop = AgentLoop(env)
    agent, actions = _start_walks(agent_loop, env_params, None, key, num_walks, num_steps)

    def step(agent: Agent, action: jax.Array) -> tuple[Agent, jax.Array]:
        next_agent, _ = agent_loop.step(agent, action, None, env_params)
        return next_agent, next_agent.state.pose

    _, next_poses = jax.lax.scan(step, agent, actions)
    return jnp.concatenate([agent.state.pose[None], next_poses]).T, agent.state.scene


# 2. Layout priors, and calibration of the estimator


@partial(jax.jit, static_argnames="estimator_config")
def layout_priors(counts: jax.Array, estimator_config: str | EstimatorConfig) -> jax.Array:
    """Layout priors of all room types.

    Each pair starts with one sighting (the all-ones Dirichlet). A room type without training scenes gets the prior of
    all scenes together.

    Args:
      counts: float32 [rooms, K, K], see `Exploration.prior_counts`.
      estimator_config: configuration of the layout estimator, or its name.

    Returns:
      float32 [rooms, K, K].
    """
    make_prior = partial(prior_from_counts, config=estimator_config)
    return jax.vmap(make_prior)(_fill_unseen_rooms(counts) + 1.0)


def _fill_unseen_rooms(counts: jax.Array) -> jax.Array:
    """Give room types without training scenes the counts of all scenes together, float32 [rooms, K, K]."""
    has_scenes = counts.any(axis=(1, 2), keepdims=True)
    return jnp.where(has_scenes, counts, counts.sum(axis=0, keepdims=True))


class Calibration(NamedTuple):
    """A calibrated layout estimator.

    Attributes:
      estimator_config: estimator with the best strength and reduction.
      early: median over walks of the mean gap in the first three accepted views; NaN without any.
      late: median over walks of the gap at step 20.
    """

    estimator_config: EstimatorConfig
    early: float
    late: float


def calibrate(
    env: ObjectNav,
    env_params: EnvParams,
    counts: jax.Array,
    estimator_config: EstimatorConfig,
    key: jax.Array,
    strengths: Sequence[float] = STRENGTHS,
    reductions: Sequence[Reduction] = REDUCTIONS,
    num_walks: int = 256,
) -> Calibration:
    """Choose strength and reduction of the estimator so that the gap behaves as in the paper's Fig. 6b.

    Among all pairs, the one with the smallest |early - 0.75| + |late - 0.25| is best. Early and late gaps are medians
    over random walks without Done in the training scenes, the same walks for all pairs.

    Args:
      env: the environment.
      env_params: parameters of the training environment.
      counts: float32 [rooms, K, K], `Exploration.prior_counts`.
      estimator_config: all other settings of the estimator.
      key: consumed.
      strengths, reductions: candidates.
      num_walks: parallel walks.

    Raises:
      InputError: no walk shows two categories together.
    """

    # The strength enters by the priors alone, so all strengths are measured in one call, [strengths, rooms, K, K].
    def make_priors(counts: jax.Array) -> jax.Array:
        strength_configs = [dataclasses.replace(estimator_config, strength=strength) for strength in strengths]
        return jnp.stack([layout_priors(counts, strength_config) for strength_config in strength_configs])

    priors = jax.jit(make_priors)(counts)

    # Measure the gaps of all pairs.
    calibrations = []
    for reduction in reductions:
        reduction_config = dataclasses.replace(estimator_config, reduction=reduction)
        measure_gaps = partial(_measure_gaps, reduction_config, env=env, key=key, num_walks=num_walks)
        early_gaps, late_gaps = jax.device_get(jax.jit(jax.vmap(measure_gaps, (0, None)))(priors, env_params))
        for strength, early_gap, late_gap in zip(strengths, early_gaps, late_gaps, strict=True):
            candidate = dataclasses.replace(reduction_config, strength=strength)
            calibrations.append(Calibration(candidate, _median_of_finite(early_gap), float(np.median(late_gap))))

    # Take the pair nearest to the targets.
    if all(np.isnan(calibration.early) for calibration in calibrations):
        raise InputError(
            "layout: no random walk shows two categories together, so the estimator cannot be calibrated; give scenes "
            "with objects of more categories, or more layout.steps"
        )
    return min(calibrations, key=_distance_to_targets)


def _distance_to_targets(calibration: Calibration) -> float:
    return abs(calibration.early - EARLY_GAP_TARGET) + abs(calibration.late - LATE_GAP_TARGET)


def _median_of_finite(values: np.ndarray) -> float:
    """Median of the finite values, NaN without any."""
    finite_values = values[np.isfinite(values)]
    return float(np.median(finite_values)) if len(finite_values) else float("nan")


def _measure_gaps(
    estimator_config: EstimatorConfig,
    priors: jax.Array,
    env_params: EnvParams,
    env: ObjectNav,
    key: jax.Array,
    num_walks: int,
) -> tuple[jax.Array, jax.Array]:
    """Early and late gap of each walk, float32 [W]; the early gap is infinite where no view was accepted.

    Args:
      estimator_config: estimator with a reduction; its strength has no effect.
      priors: float32 [rooms, K, K], of one strength.
      env_params, env, key, num_walks: as in `calibrate`.
    """
    agent_loop = AgentLoop(env, estimator_config=estimator_config)
    knowledge = Knowledge(priors)
    agent, actions = _start_walks(agent_loop, env_params, knowledge, key, num_walks, LATE_STEP)

    def belief(agent: Agent) -> jax.Array:
        assert agent.perception.layout is not None
        return agent.perception.layout.alpha

    # A view is accepted where it changes the belief; the first view is compared with the prior.
    def step(agent: Agent, action: jax.Array) -> tuple[Agent, tuple[jax.Array, jax.Array]]:
        next_agent, _ = agent_loop.step(agent, action, knowledge, env_params)
        is_accepted = (belief(next_agent) != belief(agent)).any(axis=(1, 2))
        return next_agent, (agent_loop.layout_gap(next_agent), is_accepted)

    prior = priors[env_params.room[agent.state.scene]]
    first_gap = agent_loop.layout_gap(agent)
    first_accepted = (belief(agent) != prior).any(axis=(1, 2))
    _, (later_gaps, later_accepted) = jax.lax.scan(step, agent, actions)
    gaps = jnp.concatenate([first_gap[None], later_gaps])  # [T + 1, W]
    is_accepted = jnp.concatenate([first_accepted[None], later_accepted])

    # Mean over the first accepted views, and the gap after the last step.
    is_early = is_accepted & (jnp.cumsum(is_accepted, axis=0) <= NUM_EARLY_VIEWS)
    num_early = is_early.astype(jnp.float32).sum(axis=0)
    early_sum = jnp.where(is_early, gaps, 0.0).sum(axis=0)
    early_gap = jnp.where(num_early > 0, early_sum / jnp.maximum(num_early, 1.0), jnp.inf)
    return early_gap, gaps[-1]


# 3. Shift classifier


def limit_walks(num_walks: int, num_features: int, num_categories: int) -> int:
    """Number of walks whose examples fit into 2 GiB.

    The examples are float32, two for each walk: features of all pairs in both layouts. The usual numbers of walks fit
    up to 81 categories with the features of `surprise`, and up to 256 with that of `learned`.

    Args:
      num_walks: number of walks that is wanted.
      num_features: F, features of a pair.
      num_categories: K.

    Returns:
      At most `num_walks`, and at least 1 even where one does not fit.
    """
    num_pairs = num_categories * (num_categories - 1) // 2
    bytes_per_walk = 2 * 4 * num_features * num_pairs
    return max(1, min(num_walks, _MAX_EXAMPLE_BYTES // bytes_per_walk))


def fit_shift_classifier(
    env: ObjectNav,
    env_params: EnvParams,
    counts: jax.Array,
    key: jax.Array,
    num_walks: int = 8192,
    pooled: bool = False,
) -> CooccurrenceEvidence:
    """Learn which pairs of categories seen together indicate another layout than that of training.

    A logistic regression on the pairs that a random walk has seen together distinguishes walks in the training scenes
    from the same walks with categories exchanged at random (`draw_category_exchange`). The scale of its log odds is
    calibrated in a quarter of the scenes, on log odds learned in the rest. A room type without scenes gets log odds of
    0, unless all room types share theirs.

    Args:
      env: the environment.
      env_params: parameters of the training environment.
      counts: float32 [rooms, K, K], from `explore`.
      key: consumed.
      num_walks: W, parallel walks.
      pooled: learn the same log odds for all room types.
    """
    walk_key = jax.random.fold_in(key, 0)
    length_key = jax.random.fold_in(key, 2)

    # Pairs that each walk has seen together when it is cut at a random length, bool [W, K, K].
    poses, scene = _walk(env, env_params, walk_key, num_walks, _WALK_LENGTHS[-1])
    presence = env.row_format.presence(env_params.tables.rows[poses])  # [W, T + 1, K]
    lengths = jax.random.choice(length_key, jnp.array(_WALK_LENGTHS), (num_walks,))
    is_before_cut = jnp.arange(presence.shape[1])[None] <= lengths[:, None]
    co_seen = jax.lax.map(seen_together, presence & is_before_cut[..., None], batch_size=_WALK_BATCH)

    log_odds = _fit_against_exchanges(co_seen[:, None], scene, env, env_params, counts, key, pooled)[:, 0]
    return CooccurrenceEvidence(log_odds=log_odds, co_visibility=co_visibility_from_counts(counts))


def fit_sighting_classifier(
    env: ObjectNav,
    env_params: EnvParams,
    counts: jax.Array,
    key: jax.Array,
    num_walks: int = 4096,
    pooled: bool = False,
) -> jax.Array:
    """Learn which distances between categories indicate another layout than that of training.

    As `fit_shift_classifier`, with the features `near_features` of the sightings of each walk.

    Args:
      env: the environment.
      env_params: parameters of the training environment.
      counts: float32 [rooms, K, K], from `explore`.
      key: consumed.
      num_walks: W, parallel walks.
      pooled: learn the same log odds for all room types.

    Returns:
      float32 [rooms, F, K, K], log odds of each feature; 0 on and below the diagonal.
    """
    walk_key = jax.random.fold_in(key, 0)
    length_key = jax.random.fold_in(key, 2)

    # Sightings of each walk when it is cut at a random length, uint8 [W, R, K, K].
    poses, scene = _walk(env, env_params, walk_key, num_walks, _SIGHTING_LENGTHS[-1])
    lengths = jax.random.choice(length_key, jnp.array(_SIGHTING_LENGTHS), (num_walks,))
    count_sightings = partial(_count_sightings, env, env_params)
    sightings = jax.lax.map(lambda walk: count_sightings(*walk), (poses, lengths), batch_size=_WALK_BATCH)

    return _fit_against_exchanges(near_features(sightings), scene, env, env_params, counts, key, pooled)


def _fit_against_exchanges(
    features: jax.Array,
    scene: jax.Array,
    env: ObjectNav,
    env_params: EnvParams,
    counts: jax.Array,
    key: jax.Array,
    pooled: bool,
) -> jax.Array:
    """Learn which features of pairs tell walks from the same walks with categories exchanged.

    Args:
      features: bool [W, F, K, K], features of the pairs of each walk.
      scene: int32 [W].
      env, env_params, counts, key, pooled: as in `fit_shift_classifier`.

    Returns:
      float32 [rooms, F, K, K], calibrated log odds; 0 on and below the diagonal.
    """
    exchange_key = jax.random.fold_in(key, 1)
    scene_key = jax.random.fold_in(key, 3)

    # The same features in another layout: a new exchange of categories for each walk.
    room = env_params.room[scene]
    is_present = _find_present_categories(env, env_params)[scene]  # [W, K]
    frequency = jnp.diagonal(counts, axis1=1, axis2=2)[room]
    exchange_keys = jax.random.split(exchange_key, len(features))
    exchanges = jax.vmap(draw_category_exchange)(exchange_keys, is_present, frequency)
    shifted_features = jax.vmap(lambda matrix, exchange: matrix[:, exchange][:, :, exchange])(features, exchanges)

    # Examples of both layouts, bool [2 W, F pairs], and the scenes that only calibrate.
    num_categories = counts.shape[-1]
    rows, columns = jnp.triu_indices(num_categories, 1)
    pair_features = jnp.concatenate([features, shifted_features])[..., rows, columns]  # [2 W, F, pairs]
    examples = pair_features.reshape(len(pair_features), -1)
    is_held_out = jax.random.bernoulli(scene_key, _CALIBRATION_SHARE, env_params.room.shape)[scene]

    # Log odds of each room type, or of all as if they were the first one.
    fit_rooms = jnp.zeros_like(room) if pooled else room
    example_log_odds = _fit_log_odds(examples, jnp.tile(fit_rooms, 2), jnp.tile(is_held_out, 2), len(counts))
    if pooled:
        example_log_odds = jnp.broadcast_to(example_log_odds[0], example_log_odds.shape)
    log_odds = jnp.zeros((len(counts), features.shape[1], num_categories, num_categories))
    return log_odds.at[:, :, rows, columns].set(example_log_odds.reshape(len(counts), features.shape[1], -1))


def _count_sightings(env: ObjectNav, env_params: EnvParams, poses: jax.Array, length: jax.Array) -> jax.Array:
    """Count the sightings of a walk of poses int32 [T + 1] in its first `length` steps, uint8 [R, K, K]."""
    perception = Perception(env.row_format, rules=env.task.rules)
    rows = env_params.tables.rows[poses]
    _, heading, _ = env.task.rules.split_pose(poses)
    cell = env.cell_of_pose(poses)
    has_moved = jnp.concatenate([jnp.zeros(1, bool), cell[1:] != cell[:-1]])

    def add_view(sightings: PairSightings, view: tuple) -> tuple[PairSightings, None]:
        row, view_heading, moved, is_counted = view
        geometry = perception.view_geometry(row, view_heading, moved)
        # After the end of the walk nothing is seen.
        is_visible = env.row_format.presence(row) & is_counted
        return sightings.update(is_visible, geometry.offsets, geometry.motion), None

    is_counted = jnp.arange(len(poses)) <= length
    views = (rows, heading, has_moved, is_counted)
    return jax.lax.scan(add_view, PairSightings.init(env.row_format.num_categories), views)[0].counts


def co_visibility_from_counts(counts: jax.Array) -> jax.Array:
    """Probability that a pose showing one category shows another one too.

    Args:
      counts: float32 [rooms, K, K], see `Exploration`.

    Returns:
      float32 [rooms, K, K] in [0, 1], the share of the poses showing i that show j too; 0 on the diagonal and where i
      was never seen. A room type without training scenes gets the shares of all scenes together.
    """
    counts = _fill_unseen_rooms(counts)
    category_counts = jnp.diagonal(counts, axis1=1, axis2=2)[..., None]
    off_diagonal = 1 - jnp.eye(counts.shape[-1], dtype=counts.dtype)
    return counts / jnp.maximum(category_counts, 1) * off_diagonal[None]


def _find_present_categories(env: ObjectNav, env_params: EnvParams) -> jax.Array:
    """Find the categories in each scene, bool [S, K]: those detected more often than false alarms explain."""
    tables = env_params.tables
    poses_per_cell = env.task.rules.poses_per_cell

    # Detections of each scene as differences of cumulative sums over all poses.
    detections = env.row_format.presence(tables.rows).astype(jnp.int32)
    cumulative = jnp.concatenate([jnp.zeros_like(detections[:1]), jnp.cumsum(detections, axis=0)])
    first_pose = tables.first_cell * poses_per_cell
    num_poses = tables.num_cells * poses_per_cell
    num_detections = cumulative[first_pose + num_poses] - cumulative[first_pose]

    detection_share = num_detections.astype(jnp.float32) / num_poses[:, None].astype(jnp.float32)
    return detection_share > 2 * env.task.detector.false_alarm


def draw_category_exchange(key: jax.Array, present: jax.Array, frequency: jax.Array) -> jax.Array:
    """Draw a random exchange of categories that are seen about equally often.

    The categories present are ordered by frequency, with noise on their ranks. Each two neighbours exchange; the last
    of an odd number stays.

    Args:
      key: consumed.
      present: bool [K], categories in the scene.
      frequency: float32 [K], how often each category is seen.

    Returns:
      int32 [K], a permutation that is its own inverse: each category is seen where the one it maps to was seen.
    """
    # Order by noisy ranks; absent categories come last.
    ranks = jnp.argsort(jnp.argsort(jnp.where(present, frequency, jnp.inf))).astype(jnp.float32)
    noisy_ranks = ranks + _RANK_NOISE * jax.random.normal(key, ranks.shape)
    order = jnp.argsort(jnp.where(present, noisy_ranks, jnp.inf)).astype(jnp.int32)

    # Positions 0 and 1, 2 and 3, ... are partners, as far as both categories are present.
    position = jnp.arange(len(order))
    num_present = present.sum()
    partner = jnp.where((position ^ 1) < num_present, position ^ 1, position)
    partner = jnp.where(position < num_present, partner, position)
    return jnp.zeros_like(order).at[order].set(order[partner])


def _fit_log_odds(features: jax.Array, rooms: jax.Array, is_held_out: jax.Array, num_rooms: int) -> jax.Array:
    """Calibrated log odds that each feature indicates the shifted layout, float32 [rooms, features].

    The log odds are fitted to all examples, and multiplied by the scale that calibrates, in the held-out examples, a
    fit without them.

    Args:
      features: bool [2 W, features], signs of each example, such as the pairs seen together; the second W examples are
        those of the shifted layout.
      rooms: int32 [2 W], room type whose log odds hold for an example.
      is_held_out: bool [2 W], examples that only calibrate.
      num_rooms: number of room types.
    """
    examples = features.astype(jnp.float32)
    is_shifted = (jnp.arange(len(features)) >= len(features) // 2).astype(jnp.float32)

    def predict(log_odds: jax.Array) -> jax.Array:
        logits_by_room = examples @ log_odds.T  # [2 W, rooms]
        return jnp.take_along_axis(logits_by_room, rooms[:, None], axis=-1)[:, 0]

    def cross_entropy(logits: jax.Array, mask: jax.Array) -> jax.Array:
        losses = optax.sigmoid_binary_cross_entropy(logits, is_shifted)
        return (losses * mask.astype(jnp.float32)).sum() / jnp.maximum(mask.sum(), 1).astype(jnp.float32)

    def fit(mask: jax.Array) -> jax.Array:
        def regularized_loss(log_odds: jax.Array) -> jax.Array:
            return cross_entropy(predict(log_odds), mask) + _L2_WEIGHT * (log_odds**2).sum()

        return _minimize(regularized_loss, jnp.zeros((num_rooms, features.shape[-1])))

    # Fit without the held-out examples, calibrate on them, then fit to all.
    held_out_logits = predict(fit(~is_held_out))

    def calibration_loss(log_scale: jax.Array) -> jax.Array:
        return cross_entropy(jnp.exp(log_scale) * held_out_logits, is_held_out)

    log_scale = _minimize(calibration_loss, jnp.zeros(()))
    return jnp.exp(log_scale) * fit(jnp.ones_like(is_held_out))


def _minimize(loss: Callable[[jax.Array], jax.Array], start: jax.Array) -> jax.Array:
    """Minimise a loss by gradient descent with Adam, and return the minimiser."""
    optimizer = optax.adam(_FIT_LEARNING_RATE)

    def descend(carry: tuple[Any, optax.OptState], _: None) -> tuple[tuple[Any, optax.OptState], None]:
        weights, optimizer_state = carry
        gradient = jax.grad(loss)(weights)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes int32 counts with float32
            updates, optimizer_state = optimizer.update(gradient, optimizer_state)
        return (optax.apply_updates(weights, updates), optimizer_state), None

    (weights, _), _ = jax.lax.scan(descend, (start, optimizer.init(start)), length=_NUM_FIT_STEPS)
    return weights
