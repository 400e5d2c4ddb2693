"""Loaded policies act as in the evaluation, step by step and in batches."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from support import tiny_world as tiny

import jaxnav
from jaxnav.choices import Decoding, Variant
from jaxnav.env.objectnav import OTHER_ROOM, ObjectNav, State
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import start_states
from jaxnav.evaluation.playback import play_episodes
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.adaptation import WINDOW
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Experience, Method
from jaxnav.policies.methods import METHODS
from jaxnav.runs.loaded_policy import LoadedPolicy
from jaxnav.runs.policies import POLICIES_DIR
from jaxnav.runs.worlds import compile_evaluation_world
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.observation_row import Detector
from jaxnav.scenes.task import APARTMENTS

_compiled_act = jax.jit(LoadedPolicy.act)
#: Step limit of an episode in which a policy adapts twice.
LONG_EPISODE = 15


def act(policy, observation, memory, epsilon=0.1, *, key=None, heading=0, moved=False, horizon=0):
    """Return the action and the memory after one step; policies of equal structure share a compilation."""
    odometry = {"heading": jnp.int32(heading), "moved": jnp.bool_(moved), "horizon": jnp.int32(horizon)}
    return _compiled_act(policy, observation, memory, jnp.float32(epsilon), key=key, **odometry)


@pytest.fixture(scope="module")
def world(drawn_run):
    return compile_evaluation_world(drawn_run.config, "val", None, None, Console(quiet=True))


def select_cell(variant: Variant, epsilon: float | None, decoding: Decoding = "argmax"):
    """Return the inference settings that the evaluation uses for one set of parameters."""
    row = table_row(variant, epsilon, "residual", decoding)
    return tiny.leaves_at(inference_grid([row], [row.arm or ""], 1), 0)


def measure_odometry(env, state, previous_state):
    """Return compass, odometry and horizon of a state, as keyword arguments of a step."""
    rules = env.task.rules
    num_horizons = len(rules.horizons)
    return {
        "heading": state.pose // num_horizons % rules.headings,
        "moved": env.cell_of_pose(state.pose) != env.cell_of_pose(previous_state.pose),
        "horizon": state.pose % num_horizons,
    }


def roll_out(policy, env, params, start, room_type, num_steps, *, key=None, epsilon=0.5, use_pose=True):
    """Return the actions of a policy in a loop over observations, with odometry if `use_pose`."""
    memory = policy.init(room_type)
    state = start
    previous_state = start
    actions = []
    for time in range(num_steps):
        odometry = measure_odometry(env, state, previous_state) if use_pose else {}
        step_key = None if key is None else jax.random.fold_in(key, time)
        action, memory = act(policy, env.observe(state, params), memory, epsilon, key=step_key, **odometry)
        actions.append(int(action))
        previous_state = state
        state, *_ = env.advance(state, action, params)
    return actions


def add_batch_axis(state):
    """Return one state as a batch of one."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], state)


# One policy, step by step


@pytest.mark.parametrize(
    ("variant", "epsilon", "decoding"),
    [
        ("stde", 0.0, "argmax"),
        pytest.param("stde", 0.2, "argmax", marks=pytest.mark.slow),
        pytest.param("stde", 1.0, "argmax", marks=pytest.mark.slow),
        pytest.param("stde", 0.0, "sample", marks=pytest.mark.slow),
        ("baseline", None, "argmax"),
    ],
)
def test_loaded_policy_acts_as_in_the_evaluation(drawn_run, world, variant, epsilon, decoding):
    arm = "baseline" if variant == "baseline" else "layout"
    seed = 1
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / f"{arm}-{seed}")

    # The policies of the run, as the evaluation plays them.
    policies = drawn_run.policies()
    agent_loop = policies.make_agent_loop(world)
    weights = tiny.leaves_at(policies.arm_params(arm), seed)
    cell = select_cell(variant, epsilon, decoding)
    first_episode_key = jax.random.fold_in(jax.random.key(0), 0)
    key = first_episode_key if decoding == "sample" else None
    env_params = world.make_env_params(0)
    bank = world.banks[0]
    episodes = draw_episodes(bank, 8)

    # One episode of each room type.
    for episode in range(0, 8, 2):
        start = tiny.leaves_at(start_states(episodes), episode)
        room_type = bank.room_types[episodes.scene[episode]]
        (trace,) = play_episodes(cell, weights, add_batch_axis(start), agent_loop, env_params, policies.knowledge)
        num_steps = len(trace.action)
        actions = roll_out(policy, world.env, env_params, start, room_type, num_steps, key=key, epsilon=epsilon or 0.0)
        assert actions == trace.action.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["overdue", "learned"])
def test_handover_policy_switches_as_in_the_evaluation(drawn_run, world, setting):
    """With `hold`, a policy that has switched to decisions without experience keeps them to the end of the episode."""
    epsilon = 0.6
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-1", setting, hold=True, form="switch")

    # The policies of the run, as the evaluation plays them.
    policies = drawn_run.policies().with_estimator(setting, hold=True)
    agent_loop = policies.make_agent_loop(world)
    weights = tiny.leaves_at(policies.arm_params("layout"), 1)
    cell = tiny.leaves_at(inference_grid([table_row("stde", epsilon, "switch", "argmax")], ["layout"], 1), 0)
    env_params = world.make_env_params(0)
    bank = world.banks[0]
    episodes = draw_episodes(bank, 8)

    # One episode of each room type.
    has_switched = []
    for episode in range(0, 8, 2):
        start = tiny.leaves_at(start_states(episodes), episode)
        room_type = bank.room_types[episodes.scene[episode]]
        (trace,) = play_episodes(cell, weights, add_batch_axis(start), agent_loop, env_params, policies.knowledge)
        actions = roll_out(policy, world.env, env_params, start, room_type, len(trace.action), epsilon=epsilon)
        assert actions == trace.action.tolist()
        assert (np.diff(trace.gap) >= 0).all()
        has_switched += (trace.gap > epsilon).tolist()

    # Both sides of the switch occur.
    assert 0 < np.mean(has_switched) < 1


@pytest.mark.slow
def test_loaded_policy_actions_depend_on_epsilon_and_key(drawn_run, world):
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-1")
    bank = world.banks[0]
    starts = start_states(draw_episodes(bank, 8))
    room_type = bank.room_types[int(starts.scene[0])]
    start = tiny.leaves_at(starts, 0)
    act_twelve_times = functools.partial(roll_out, policy, world.env, world.make_env_params(0), start, room_type, 12)

    # Actions are repeatable.
    assert act_twelve_times(epsilon=0.0) == act_twelve_times(epsilon=0.0)
    first_key = jax.random.key(0)
    second_key = jax.random.key(1)
    assert act_twelve_times(key=first_key) == act_twelve_times(key=first_key)

    # Best actions at another epsilon and sampled actions of two keys all differ.
    action_lists = [
        act_twelve_times(epsilon=1.0),
        act_twelve_times(key=first_key),
        act_twelve_times(key=second_key),
    ]
    assert len(set(map(tuple, action_lists))) == 3


# Batches


def sample_mid_episode(policy, env, params, num_samples=6):
    """Return lists of observations and memories after one step from random poses, with the room types in turn."""
    observations = []
    memories = []
    room_types = [*ROOM_TYPES, None]
    for index, key in enumerate(jax.random.split(jax.random.key(2), num_samples)):
        _, state = env.reset(key, params)
        _, memory = act(policy, env.observe(state, params), policy.init(room_types[index % 5]))
        next_state, *_ = env.advance(state, memory.policy_state.action, params)
        observations.append(env.observe(next_state, params))
        memories.append(memory)
    return observations, memories


def stack(trees):
    """Return trees as one tree, whose leaves have a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["layout-0", "baseline-0"])
def test_vmapped_observations_equal_single_steps(drawn_run, world, name):
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / name)
    observations, memories = sample_mid_episode(policy, world.env, world.make_env_params(0))
    act_in_place = functools.partial(policy.act, heading=0, moved=False)
    batched_act = jax.jit(jax.vmap(act_in_place, (0, 0, None)))
    batched = batched_act(stack(observations), stack(memories), 0.1)
    singles = stack([act(policy, *pair) for pair in zip(observations, memories, strict=True)])
    np.testing.assert_array_equal(batched[0], singles[0])
    chex.assert_trees_all_close(batched, singles, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_vmapped_policies_equal_single_policies(drawn_run, world):
    policy_dirs = [drawn_run.config.run_dir / POLICIES_DIR / f"layout-{seed}" for seed in range(2)]
    policies = [jaxnav.load_policy(policy_dir) for policy_dir in policy_dirs]
    observations, memories = sample_mid_episode(policies[0], world.env, world.make_env_params(0), num_samples=1)
    act_in_place = functools.partial(LoadedPolicy.act, heading=0, moved=False)
    batched_act = jax.jit(jax.vmap(act_in_place, (0, None, None, None)))
    batched = batched_act(stack(policies), observations[0], memories[0], 0.1)
    singles = stack([act(policy, observations[0], memories[0]) for policy in policies])
    chex.assert_trees_all_close(batched, singles, rtol=1e-5, atol=1e-6)


# Priors, inputs and task


def test_policy_init_selects_the_prior_of_the_room_type(drawn_run):
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-0")
    for prior_index, room_type in enumerate([*ROOM_TYPES, None]):
        memory = policy.init(room_type)
        layout_state = memory.perception_state.layout
        assert layout_state is not None
        np.testing.assert_array_equal(layout_state.alpha, policy.knowledge.priors[prior_index])
        assert int(memory.room) == prior_index
    assert len(ROOM_TYPES) == OTHER_ROOM
    with pytest.raises(InputError, match=r"^room_type 'cellar': choose one of kitchen, .*, or None$"):
        policy.init("cellar")


def test_spatial_memory_policy_refuses_steps_without_compass_and_odometry(drawn_run, world):
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-0")
    start = tiny.leaves_at(start_states(draw_episodes(world.banks[0], 8)), 0)
    with pytest.raises(InputError, match="give `heading` and `moved`"):
        policy.act(world.env.observe(start, world.make_env_params(0)), policy.init())


def test_load_policy_refuses_an_environment_of_another_task(drawn_run, world):
    policy_dir = drawn_run.config.run_dir / POLICIES_DIR / "layout-0"
    task = jaxnav.load_policy(policy_dir, env=world.env).task
    assert task == world.env.task

    # A worse detector and fewer goals do not make another task.
    harder_task = dataclasses.replace(task, detector=Detector(miss_near=0.5), goals=task.categories[:2])
    jaxnav.load_policy(policy_dir, env=ObjectNav(harder_task))

    # Other rules or other categories do.
    stricter_rules = dataclasses.replace(task.rules, success_distance=1.0)
    with pytest.raises(InputError, match=r"rules.success_distance: 1.5 != 1.0; make"):
        jaxnav.load_policy(policy_dir, env=ObjectNav(dataclasses.replace(task, rules=stricter_rules)))
    with pytest.raises(InputError, match=r"layout-0: .*categories: .*rules.headings: 8 != 12"):
        jaxnav.load_policy(policy_dir, env=ObjectNav(APARTMENTS))


# Methods with a tracker


@dataclasses.dataclass(frozen=True)
class OdometryTracker:
    """Tracker of headings, moves and actions, in which each step weighs half as much as the next."""

    def init(self, knowledge):
        return jnp.zeros(3)

    def update(self, tracker_state, knowledge, percept):
        odometry = [jnp.float32(value) for value in (percept.heading, percept.moved, percept.action)]
        return 0.5 * tracker_state + jnp.stack(odometry)

    def read(self, tracker_state, knowledge, goal):
        return tracker_state


class TrackerExperience(Experience):
    """Experience that is the tracker's reading."""

    width = 3

    def __init__(self, spec, rngs):
        pass

    def encode(self, features, appearance, weights, reading):
        return reading


def draw_reluctant_params(spec):
    """Return random parameters of a policy that never chooses Done, so its episodes last to the step limit."""
    params = tiny.random_params(2, spec)
    params["actor"]["bias"] = params["actor"]["bias"].at[-1].set(-9.0)
    return params


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["semexp", "savn", "tpn"])
def test_loaded_adaptive_or_controlled_policy_acts_as_in_the_evaluation(name):
    """Logits agree over an episode that is longer than a window of six actions, so that adaptation changes them."""
    method = METHODS[name]
    estimator = tiny.ESTIMATOR if method.hosts_layout else None
    spec = dataclasses.replace(tiny.SPEC, method=method, method_sizes=())
    env, env_params = tiny.world()
    env_params = env_params.replace(step_limit=jnp.full(2, LONG_EPISODE, jnp.int32))
    if method.control.num_choices == env.num_actions:
        params = draw_reluctant_params(spec)
    else:
        params = tiny.random_params(2, spec)

    # Knowledge that the method learns in the tiny world before training.
    learned = {}
    if method.learn is not None:
        learned = method.learn([tiny.BANK], np.ones(tiny.knowledge().priors.shape))
    knowledge = tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, learned))

    # The episode as the evaluation plays it.
    start = State(pose=jnp.int32(8), scene=jnp.int32(0), goal=jnp.int32(2), time=jnp.int32(0))
    cell = select_cell("baseline", None) if estimator is None else select_cell("stde", 0.1)
    play = functools.partial(
        play_episodes, cell, params, add_batch_axis(start), env_params=env_params, knowledge=knowledge
    )
    (trace,) = play(agent_loop=AgentLoop(env, spec, estimator))
    assert len(trace.action) > WINDOW

    # The loaded policy along these actions.
    policy = LoadedPolicy(params, knowledge, spec, estimator, env.task)
    decide = jax.jit(LoadedPolicy.decide)
    memory = policy.init("kitchen")
    state = start
    previous_state = start
    for action, expected_logits in zip(trace.action, trace.inferred.action_logits, strict=True):
        odometry = measure_odometry(env, state, previous_state)
        choice = decide(policy, env.observe(state, env_params), memory, jnp.float32(0.1), **odometry)
        np.testing.assert_allclose(choice.logits, expected_logits, rtol=1e-4, atol=1e-4)
        best_choice = jnp.argmax(choice.logits).astype(jnp.int32)
        applied_action, memory = policy.apply_choice(choice, best_choice, memory.room)
        assert int(applied_action) == action
        previous_state = state
        state, *_ = env.advance(state, applied_action, env_params)

    # Without adaptation the logits differ.
    if method.adaptation is not None:
        (fixed_trace,) = play(agent_loop=AgentLoop(env, spec, estimator, inner_steps=0))
        fixed_logits = fixed_trace.inferred.factual_logits[:LONG_EPISODE]
        assert np.abs(fixed_logits - trace.inferred.factual_logits[:LONG_EPISODE]).max() > 1e-3


@pytest.mark.slow
def test_loaded_tracker_is_updated_at_every_step():
    method = Method(TrackerExperience, tracker=OdometryTracker(), name="steered")
    spec = dataclasses.replace(tiny.SPEC, method=method, method_sizes=())
    env, env_params = tiny.world()
    params = draw_reluctant_params(spec)
    knowledge = tiny.knowledge()

    # The episode as the evaluation plays it.
    start = State(pose=jnp.int32(8), scene=jnp.int32(0), goal=jnp.int32(1), time=jnp.int32(0))
    agent_loop = AgentLoop(env, spec, tiny.ESTIMATOR)
    (trace,) = play_episodes(select_cell("stde", 0.1), params, add_batch_axis(start), agent_loop, env_params, knowledge)
    num_steps = len(trace.action)
    assert num_steps == tiny.STEP_LIMITS[0]

    # The loaded policy acts like that only with odometry.
    policy = LoadedPolicy(params, knowledge, spec, tiny.ESTIMATOR, env.task)
    walk = functools.partial(roll_out, policy, env, env_params, start, "kitchen", num_steps, epsilon=0.1)
    assert walk() == trace.action.tolist()
    assert walk(use_pose=False) != trace.action.tolist()
