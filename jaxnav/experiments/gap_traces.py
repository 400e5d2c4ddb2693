"""Layout gap D along episodes, as seen by several layout estimators.

`measure_gaps` evaluates a run of an experiment at every layout shift. `trace_gaps` walks episodes with the policies of
a run while several estimators observe. `mean_by_step` and `auc_by_step` summarize the traces: the mean gap, and how
well the gap separates shifted from unshifted episodes. `calibration_at_steps` compares the gap with the share of
shifted episodes.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import EnvParams, State
from jaxnav.evaluation.episodes import EpisodeList, joint_clusters
from jaxnav.evaluation.grid import start_states
from jaxnav.evaluation.statistics import Interval, divide_or_nan, jackknife_interval, run_clusters, weight_below
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import AgentRun
from jaxnav.experiments.table import Curve, ResultRow
from jaxnav.experiments.trials import require_estimator_config
from jaxnav.gaps import CooccurrenceEvidence
from jaxnav.layout import ESTIMATORS, EstimatorConfig, LayoutEstimator, LayoutState, ViewGeometry
from jaxnav.policies.agent_loop import Agent, AgentLoop, Perception, embed_and_decide, policy_memory
from jaxnav.policies.method import Knowledge
from jaxnav.policies.network import Params, Policy
from jaxnav.runs.policies import Policies, adapt_counts, estimators_by_gap, load_policies
from jaxnav.training.calibration import layout_priors

#: A belief is updated by observations (eq. 4), or stays at the prior.
Belief = Literal["updated", "frozen"]
#: Indices of the two beliefs behind a gap: updated by each view (eq. 4), or fixed at the prior.
UPDATED = 0
FROZEN = 1
BELIEFS: dict[Belief, int] = {"updated": UPDATED, "frozen": FROZEN}
#: Steps at which the gap is compared with the share of shifted episodes.
CALIBRATION_STEPS = (10, 20, 40, 80)
#: Number of bins of equal width from 0 to 1, in which gaps are compared with the share of shifted episodes.
NUM_CALIBRATION_BINS = 10


class GapTraces(NamedTuple):
    """Gaps along E episodes walked by N policies.

    Step t is the state after t actions, including the view there.

    Attributes:
      gap: float32 [estimators, 2, N, E, T + 1], layout gap D by estimator and belief (`UPDATED`, `FROZEN`);
        meaningless after the end of an episode.
      running: bool [N, E, T + 1], True if the episode has not ended before step t.
      episodes: the episodes.
    """

    gap: np.ndarray
    running: np.ndarray
    episodes: EpisodeList


def measure_gaps(bench: Bench, run: AgentRun) -> Iterator[ResultRow]:
    """Measure the mean gap by step at every shift, and the AUC and the calibration of each shift against the first.

    The rows' variant is the name of the layout estimator, their control the belief: `updated` or `frozen`.

    Raises:
      InputError: the run is without the layout, or its scenes fill more than one shard.
    """
    # Walk the same number of episodes at every shift, and compare the steps that all shifts reach.
    bench.train(run)
    shifts = bench.config.shifts
    policies = load_policies(run.config)
    estimators = _compared_estimators(policies)
    shift_traces = [_trace_shift(bench, run, shift, policies, estimators) for shift in shifts]
    shift_traces = truncate_to_shortest(shift_traces)
    steps = np.arange(shift_traces[0].running.shape[-1], dtype=np.float64)

    # Mean gap of every estimator and belief, and the share of the episodes behind each point of these curves.
    for shift, traces in zip(shifts, shift_traces, strict=True):
        fields = {"world": run.world, "run": run.agent, "shift": shift, "scenes": traces.episodes.num_drawn_scenes}
        bounds = mean_by_step(traces)
        for (index, name), (belief, belief_index) in itertools.product(enumerate(estimators), BELIEFS.items()):
            curve = Curve(steps, *bounds[:, index, belief_index])
            yield ResultRow(**fields, variant=name, control=belief, metric="gap", value=curve)
        running_share = 100.0 * traces.running.mean(axis=(0, 1))
        undefined = np.full(len(steps), np.nan)
        yield ResultRow(**fields, metric="running", value=Curve(steps, running_share, undefined, undefined))

        # AUC against the first shift.
        if shift != shifts[0]:
            auc_bounds = auc_by_step(traces, shift_traces[0])
            for index, name in enumerate(estimators):
                curve = Curve(steps, *auc_bounds[:, index, UPDATED])
                yield ResultRow(**fields, variant=name, control="updated", metric="gap auc", value=curve)

            # Share of shifted episodes among those with an equal gap.
            calibration_steps = [step for step in CALIBRATION_STEPS if step < len(steps)]
            for step, calibrations in calibration_at_steps(traces, shift_traces[0], calibration_steps).items():
                for name, calibration in zip(estimators, calibrations, strict=True):
                    gap_fields = {**fields, "variant": name, "control": "updated"}
                    yield ResultRow(**gap_fields, metric=f"shifted share@{step}", value=calibration.shifted_share)
                    yield ResultRow(**gap_fields, metric=f"calibration error@{step}", value=calibration.error)


def _compared_estimators(policies: Policies) -> dict[str, EstimatorConfig]:
    """Configurations of the compared estimators, by name.

    Gaps that need evidence are left out if the run learned none.
    """
    # The two published estimators come first, then those of this package.
    by_gap = estimators_by_gap(require_estimator_config(policies))
    estimators = {
        "paper": adapt_counts(ESTIMATORS["paper"], policies.task),
        "released": ESTIMATORS["released"],
        "calibrated": by_gap["novelty"],
    }
    for gap in ("evidence", "learned", "surprise", "overdue"):
        if policies.supports_gap(gap):
            estimators[gap] = by_gap[gap]
    return estimators


def _trace_shift(
    bench: Bench, run: AgentRun, shift: float, policies: Policies, estimators: dict[str, EstimatorConfig]
) -> GapTraces:
    """Walk the episodes of one shift with the layout arm."""
    # Each estimator starts from a prior of its own, [rooms, K, K], made from the same counts.
    compiled_world = bench.compile_world(run, shift)
    estimator_priors = []
    for estimator in estimators.values():
        estimator_priors.append(layout_priors(policies.prior_counts, estimator))

    # The key depends on the experiment's seed alone, so walks at different shifts share their random numbers.
    return trace_gaps(
        policies.arm_params("layout"),
        bench.draw_episodes(compiled_world),
        compiled_world.make_env_params(0),
        policies.make_agent_loop(compiled_world),
        policies.knowledge,
        estimators=list(estimators.values()),
        priors=jnp.stack(estimator_priors),
        num_steps=bench.config.steps,
        key=jax.random.key(bench.config.seed),
    )


def truncate_to_shortest(traces: list[GapTraces]) -> list[GapTraces]:
    """Keep the steps at which some episode still runs at every shift."""
    num_steps = min(int(trace.running.any(axis=(0, 1)).sum()) for trace in traces)
    truncated = []
    for trace in traces:
        truncated.append(trace._replace(gap=trace.gap[..., :num_steps], running=trace.running[..., :num_steps]))
    return truncated


# Walks


def trace_gaps(
    params: Params,
    episodes: EpisodeList,
    env_params: EnvParams,
    agent_loop: AgentLoop,
    knowledge: Knowledge,
    *,
    estimators: Sequence[str | EstimatorConfig],
    priors: jax.Array,
    num_steps: int,
    key: jax.Array,
) -> GapTraces:
    """Walk episodes with layout policies while several estimators observe.

    Actions are sampled, without sTDE. All estimators observe the same walks; only the estimator of `agent_loop`
    influences the policies.

    Args:
      params: parameters of the policies, leaves [N, ...].
      episodes: E episodes of one bank.
      env_params: parameters of the environment with that bank.
      agent_loop: environment, policy and its layout estimator.
      knowledge: learned before training.
      estimators: configurations of the observing estimators.
      priors: float32 [estimators, rooms, K, K], priors of each estimator.
      num_steps: T.
      key: policy n in episode e uses it folded with n, e and the time.
    """
    # [N, T + 1, estimators, 2, E] and [N, T + 1, E] become the shapes of `GapTraces`, with the time last.
    gap, running = _walk_episodes(
        params, start_states(episodes), env_params, agent_loop, knowledge, tuple(estimators), priors, num_steps, key
    )
    return GapTraces(
        gap=np.asarray(gap).transpose(2, 3, 0, 4, 1),
        running=np.asarray(running).transpose(0, 2, 1),
        episodes=episodes,
    )


@functools.partial(jax.jit, static_argnames=("agent_loop", "estimators", "num_steps"))
def _walk_episodes(
    params: Params,
    start: State,
    env_params: EnvParams,
    agent_loop: AgentLoop,
    knowledge: Knowledge,
    estimators: tuple[str | EstimatorConfig, ...],
    priors: jax.Array,
    num_steps: int,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Walk with every policy in turn.

    Returns:
      The gaps, float32 [N, T + 1, estimators, 2, E], and which episodes run, bool [N, T + 1, E].
    """
    num_episodes = len(start.pose)
    # Estimators that count presence take instance counts, too.
    row_format = agent_loop.env.row_format
    read_presence = row_format.counts if row_format.has_counts else row_format.presence
    rules = agent_loop.env.task.rules
    perception = Perception(row_format, rules=rules)

    # Every estimator observes with the prior and the evidence of the episode's room type.
    room = env_params.room[start.scene]
    evidence = jax.tree.map(lambda leaf: leaf[room], knowledge.cooccurrence)
    observers = []
    for estimator, estimator_priors in zip(estimators, priors, strict=True):
        observers.append(_Observer(estimator, estimator_priors[room], evidence))

    # One policy after the other walks all episodes, so that working memory does not grow with their number.
    def walk(indexed_policy: tuple[jax.Array, Params]) -> tuple[jax.Array, jax.Array]:
        policy_index, policy_params = indexed_policy
        policy = agent_loop.bind(policy_params)
        policy_key = jax.random.fold_in(key, policy_index)
        episode_keys = jax.vmap(jax.random.fold_in, (None, 0))(policy_key, jnp.arange(num_episodes))

        def step(carry: tuple, _: None) -> tuple[tuple, tuple[jax.Array, jax.Array]]:
            agent, running, beliefs, previous_cell = carry

            # Observe the present view, [E, K], with both beliefs of every estimator.
            rows = env_params.tables.rows[agent.state.pose]
            presence = read_presence(rows)
            cell = agent_loop.env.cell_of_pose(agent.state.pose)
            _, heading, _ = rules.split_pose(agent.state.pose)
            geometry = jax.vmap(perception.view_geometry)(rows, heading, cell != previous_cell)
            next_beliefs = []
            for observer, belief_pair in zip(observers, beliefs, strict=True):
                next_beliefs.append(observer.update(belief_pair, presence, start.goal, geometry))
            gap_pairs = []
            for updated, frozen in next_beliefs:
                gap_pairs.append(jnp.stack([updated.gap, frozen.gap]))
            gaps = jnp.stack(gap_pairs)  # [estimators, 2, E]

            # Act, and record whether the episode was still running at this view.
            next_agent, ended = _sample_step(agent_loop, policy, agent, knowledge, env_params, episode_keys)
            return (next_agent, running & ~ended, next_beliefs, cell), (gaps, running)

        # Before the first view, both beliefs equal the prior.
        beliefs = [observer.init() for observer in observers]
        agent = agent_loop.start_from(start, policy.initial_memory((num_episodes,)), knowledge, env_params)
        first_cell = agent_loop.env.cell_of_pose(agent.state.pose)
        carry = (agent, jnp.ones(num_episodes, bool), beliefs, first_cell)
        _, (gaps, running) = jax.lax.scan(step, carry, length=num_steps + 1)
        return gaps, running

    num_policies = jax.tree.leaves(params)[0].shape[0]
    return jax.lax.map(walk, (jnp.arange(num_policies), params))


def _sample_step(
    agent_loop: AgentLoop,
    policy: Policy,
    agent: Agent,
    knowledge: Knowledge,
    env_params: EnvParams,
    episode_keys: jax.Array,
) -> tuple[Agent, jax.Array]:
    """Act once with sampled actions.

    Returns:
      The agents after the step, and which of their episodes ended, bool [E].
    """
    # Logits from the present view, without any removal.
    inputs = agent_loop.policy_inputs(agent, knowledge, env_params)
    decision = embed_and_decide(policy, inputs, policy_memory(agent))

    # The key of a step depends on the episode's own time only.
    step_keys = jax.vmap(jax.random.fold_in)(episode_keys, agent.state.time)
    sampled_choice = jax.vmap(jax.random.categorical)(step_keys, decision.logits).astype(jnp.int32)
    next_agent, step_result = agent_loop.step(
        agent, sampled_choice, knowledge, env_params, policy=policy, decision=decision
    )
    return next_agent, step_result.ended


class _Observer(NamedTuple):
    """A layout estimator that observes E episodes.

    Two beliefs are kept of each episode: one is updated by every view, the alpha of the other stays at the prior.

    Attributes:
      estimator: its configuration.
      priors: float32 [E, K, K].
      evidence: leaves [E, K, K]; None if no gap needs it.
    """

    estimator: str | EstimatorConfig
    priors: jax.Array
    evidence: CooccurrenceEvidence | None

    def init(self) -> tuple[LayoutState, LayoutState]:
        """Return both beliefs before the first view, leaves [E, ...]."""

        def init_one(prior: jax.Array, evidence: CooccurrenceEvidence | None) -> LayoutState:
            return LayoutEstimator(prior, self.estimator, evidence).init()

        initial_belief = jax.vmap(init_one)(self.priors, self.evidence)
        return initial_belief, initial_belief

    def update(
        self,
        beliefs: tuple[LayoutState, LayoutState],
        presence: jax.Array,
        goal: jax.Array,
        geometry: ViewGeometry,
    ) -> tuple[LayoutState, LayoutState]:
        """Return both beliefs after one view of each episode.

        Args:
          beliefs: both beliefs before the view, leaves [E, ...].
          presence: bool [E, K], or instance counts uint8 [E, K].
          goal: int32 [E].
          geometry: where the views show the categories, leaves [E, ...].
        """

        def update_one(
            prior: jax.Array,
            evidence: CooccurrenceEvidence | None,
            updated: LayoutState,
            frozen: LayoutState,
            presence: jax.Array,
            goal: jax.Array,
            geometry: ViewGeometry,
        ) -> tuple[LayoutState, LayoutState]:
            # The frozen belief takes the view into its gap, but its alpha returns to the prior.
            estimator = LayoutEstimator(prior, self.estimator, evidence)
            next_updated = estimator.update(updated, presence, goal, geometry)
            next_frozen = estimator.update(frozen, presence, goal, geometry).replace(alpha=prior)
            return next_updated, next_frozen

        return jax.vmap(update_one)(self.priors, self.evidence, *beliefs, presence, goal, geometry)


# Statistics by step


def mean_by_step(traces: GapTraces) -> np.ndarray:
    """Compute the mean gap over the episodes that still run, at each step.

    Returns:
      Mean and bounds, float64 [3, estimators, 2, T + 1]; NaN after the last episode has ended.
    """
    return _statistic_by_step(_weighted_mean, [traces])


def auc_by_step(shifted: GapTraces, unshifted: GapTraces) -> np.ndarray:
    """Compute the AUC of the gap, shifted against unshifted episodes that still run, at each step.

    Args:
      shifted: traces at the greater shift.
      unshifted: traces of the same policies, estimators and number of steps at the smaller shift.

    Returns:
      Mean and bounds, float64 [3, estimators, 2, T + 1]; NaN after the last episode of either side has ended.
    """
    return _statistic_by_step(weighted_auc, [shifted, unshifted])


class GapCalibration(NamedTuple):
    """How well a gap states the probability that its episode is shifted.

    Attributes:
      shifted_share: share of shifted episodes in each bin of the gap, over the mean gap in the bin, both from 0 to 1;
        bins without episodes are left out.
      error: mean absolute difference between the mean gap and the share of shifted episodes over the bins, weighted by
        their episodes, from 0 to 1.
    """

    shifted_share: Curve
    error: Interval


def calibration_at_steps(
    shifted: GapTraces, unshifted: GapTraces, steps: Sequence[int]
) -> dict[int, list[GapCalibration]]:
    """Compare the gap with the share of shifted episodes among those that still run.

    Args:
      shifted: traces at the greater shift.
      unshifted: traces of equal policies and estimators, with equally many episodes, at the smaller shift.
      steps: steps of the traces.

    Returns:
      The calibration of every estimator with the updated belief, by step.
    """
    # Keep only the requested steps and the updated belief, because every statistic has many jackknife replicates.
    sides = []
    for traces in (shifted, unshifted):
        updated_gap = traces.gap[:, UPDATED : UPDATED + 1, ..., list(steps)]
        sides.append(traces._replace(gap=updated_gap, running=traces.running[..., list(steps)]))

    # Shares by bin, mean and bounds.
    shifted_shares = []
    for bin_index in range(NUM_CALIBRATION_BINS):
        share_in_bin = functools.partial(_shifted_share, bin_index=bin_index)
        shifted_shares.append(_statistic_by_step(share_in_bin, sides)[:, :, 0])
    bin_shares = np.stack(shifted_shares)  # [bins, 3, estimators, steps]
    errors = _statistic_by_step(_calibration_error, sides)[:, :, 0]  # [3, estimators, steps]

    # One curve over the bins with episodes, and one error, for each step and estimator.
    calibrations: dict[int, list[GapCalibration]] = {step: [] for step in steps}
    num_estimators = shifted.gap.shape[0]
    for (step_index, step), estimator in itertools.product(enumerate(steps), range(num_estimators)):
        side_gaps = [side.gap[estimator, 0, ..., step_index][side.running[..., step_index]] for side in sides]
        gaps = np.concatenate(side_gaps).astype(np.float64)
        bin_sizes = np.bincount(_bin_indices(gaps), minlength=NUM_CALIBRATION_BINS)
        bin_sums = np.bincount(_bin_indices(gaps), gaps, NUM_CALIBRATION_BINS)
        has_episodes = bin_sizes > 0
        mean_gaps = bin_sums[has_episodes] / bin_sizes[has_episodes]
        curve = Curve(mean_gaps, *bin_shares[has_episodes, :, estimator, step_index].T)
        interval = Interval(*errors[:, estimator, step_index].tolist())
        calibrations[step].append(GapCalibration(curve, interval))
    return calibrations


def _statistic_by_step(statistic: Callable[..., np.ndarray], sides: list[GapTraces]) -> np.ndarray:
    """Compute a statistic of the gaps of all sides, with intervals over shared scenes and policies.

    Args:
      statistic: takes the gaps [P] of each side, then the weights [P, R] of each side; returns [R].
      sides: traces of equal policies, estimators and number of steps.
    """
    # A floor plan that occurs on both sides is left out of both at once.
    runs = run_clusters(len(sides[0].running))
    scene_clusters_by_side = joint_clusters([side.episodes for side in sides])
    replicate_shape = (runs.weights.shape[1], scene_clusters_by_side[0].weights.shape[1])

    # The weight of an episode walked by a policy is the product of both weights, [N, E, replicates].
    weights_by_side = []
    for side, scenes in zip(sides, scene_clusters_by_side, strict=True):
        pair_weights = np.einsum("nr,ec->nerc", runs.weights, scenes.weights)
        weights_by_side.append(pair_weights.reshape(*side.running.shape[:2], -1))

    # Mean and bounds, step by step. Ended episodes drop out of gaps [P] and weights [P, replicates] alike.
    num_estimators, num_beliefs, _, _, num_steps = sides[0].gap.shape
    curves = np.empty((3, num_estimators, num_beliefs, num_steps))
    for step in range(num_steps):
        running_by_side = [side.running[..., step] for side in sides]
        running_weights = []
        for pair_weights, running in zip(weights_by_side, running_by_side, strict=True):
            running_weights.append(pair_weights[running])
        for estimator, belief in np.ndindex(num_estimators, num_beliefs):
            running_gaps = []
            for side, running in zip(sides, running_by_side, strict=True):
                running_gaps.append(side.gap[estimator, belief, ..., step][running])

            # One replicate for each pair of a run and a scene that are left out.
            replicates = statistic(*running_gaps, *running_weights).reshape(replicate_shape)
            step_interval = jackknife_interval(replicates, scene_clusters_by_side[0], runs)
            curves[:, estimator, belief, step] = (step_interval.mean, step_interval.low, step_interval.high)
    return curves


def weighted_auc(
    positive: np.ndarray, negative: np.ndarray, positive_weights: np.ndarray, negative_weights: np.ndarray
) -> np.ndarray:
    """Compute the area under the ROC curve.

    The area is the probability that a positive value exceeds a negative one, counting ties half.

    Args:
      positive, negative: real [P] and [Q].
      positive_weights, negative_weights: float [P, R] and [Q, R].

    Returns:
      float64 [R]; NaN if the weights of one side are 0.
    """
    # Weight of the negatives below each positive, as a share of the weight of all pairs.
    negative_below = weight_below(positive, negative, negative_weights)  # [P, R]
    wins = np.einsum("pr,pr->r", positive_weights, negative_below, dtype=np.float64)
    positive_total = positive_weights.sum(axis=0, dtype=np.float64)
    negative_total = negative_weights.sum(axis=0, dtype=np.float64)
    return divide_or_nan(wins, positive_total * negative_total)


def _bin_indices(gaps: np.ndarray) -> np.ndarray:
    """Bin of each gap, int, from 0 to `NUM_CALIBRATION_BINS` - 1; a gap of 1 is in the last one."""
    # In the precision of the gaps, so that 0.9 is in the bin from 0.9.
    return np.minimum((NUM_CALIBRATION_BINS * gaps.astype(np.float32)).astype(int), NUM_CALIBRATION_BINS - 1)


def _shifted_share(
    shifted: np.ndarray,
    unshifted: np.ndarray,
    shifted_weights: np.ndarray,
    unshifted_weights: np.ndarray,
    bin_index: int,
) -> np.ndarray:
    """Share of shifted episodes in a bin, float64 [R]; NaN without episodes."""
    shifted_total = shifted_weights[_bin_indices(shifted) == bin_index].sum(axis=0, dtype=np.float64)
    unshifted_total = unshifted_weights[_bin_indices(unshifted) == bin_index].sum(axis=0, dtype=np.float64)
    return divide_or_nan(shifted_total, shifted_total + unshifted_total)


def _calibration_error(
    shifted: np.ndarray, unshifted: np.ndarray, shifted_weights: np.ndarray, unshifted_weights: np.ndarray
) -> np.ndarray:
    """Mean absolute difference between mean gap and share of shifted episodes over the bins, float64 [R]."""
    # A shifted episode adds its gap less 1 to the difference of its bin, an unshifted one its gap.
    gaps = np.concatenate([shifted, unshifted]).astype(np.float64)
    is_shifted = np.arange(len(gaps)) < len(shifted)
    weights = np.concatenate([shifted_weights, unshifted_weights])
    bins = _bin_indices(gaps)
    differences = np.zeros(weights.shape[1])
    for bin_index in range(NUM_CALIBRATION_BINS):
        in_bin = bins == bin_index
        differences += np.abs((gaps - is_shifted)[in_bin] @ weights[in_bin])
    return divide_or_nan(differences, weights.sum(axis=0, dtype=np.float64))


def _weighted_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute means [R] of values [P] weighted by [P, R]."""
    return divide_or_nan((values @ weights).astype(np.float64), weights.sum(axis=0, dtype=np.float64))
