"""A loaded policy acts as the evaluation's, step by step and in batches."""

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
from jaxnav.env.objectnav import OTHER_ROOM, ObjectNav, State
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import start_states
from jaxnav.evaluation.playback import play_episodes
from jaxnav.evaluation.report import Decoding, Variant
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.adaptation import WINDOW
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Experience, Method
from jaxnav.policies.methods import METHODS
from jaxnav.runs.policies import POLICIES_DIR
from jaxnav.runs.policy import LoadedPolicy
from jaxnav.runs.worlds import compile_evaluation_world
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.observation_row import Detector
from jaxnav.scenes.task import APARTMENTS

_compiled = jax.jit(LoadedPolicy.act)
LONG = 15  # actions, of an episode in which a policy adapts twice


def act(policy, observation, memory, epsilon=0.1, *, key=None, heading=0, moved=False, horizon=0):
    """One step, by as few compilations as there are kinds of policies."""
    use_pose = {"heading": jnp.int32(heading), "moved": jnp.bool_(moved), "horizon": jnp.int32(horizon)}
    return _compiled(policy, observation, memory, jnp.float32(epsilon), key=key, **use_pose)


@pytest.fixture(scope="module")
def world(drawn_run):
    return compile_evaluation_world(drawn_run.config, "val", None, None, Console(quiet=True))


def cell_of(variant: Variant, epsilon: float | None, decoding: Decoding = "argmax"):
    """How the evaluation infers with one set of parameters."""
    row = table_row(variant, epsilon, "residual", decoding)
    return tiny.leaves_at(inference_grid([row], [row.arm or ""], 1), 0)


def follow(policy, env, params, start, room_type, steps, *, key=None, epsilon=0.5, use_pose=True):
    """The actions of a policy from a start on, in a loop over observations, with heading and moves unless not told."""
    memory, state, before, actions = policy.init(room_type), start, start, []
    headings, horizons = env.task.rules.headings, len(env.task.rules.horizons)
    for time in range(steps):
        action, memory = act(
            policy,
            env.observe(state, params),
            memory,
            epsilon,
            key=None if key is None else jax.random.fold_in(key, time),
            heading=state.pose // horizons % headings if use_pose else 0,
            moved=env.cell_of_pose(state.pose) != env.cell_of_pose(before.pose) if use_pose else False,
            horizon=state.pose % horizons if use_pose else 0,
        )
        actions.append(int(action))
        before, (state, *_) = state, env.advance(state, action, params)
    return actions


def alone(start):
    """One state as a batch of one."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], start)


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
    arm, seed = "baseline" if variant == "baseline" else "layout", 1
    key = jax.random.fold_in(jax.random.key(0), 0)  # that of the first episode played
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / f"{arm}-{seed}")
    policies, params, bank = drawn_run.policies(), world.make_env_params(0), world.banks[0]
    episodes = draw_episodes(bank, 8)
    for episode in range(0, 8, 2):  # one of each room type
        start = tiny.leaves_at(start_states(episodes), episode)
        weights = tiny.leaves_at(policies.arm_params(arm), seed)
        cell = cell_of(variant, epsilon, decoding)
        (trace,) = play_episodes(
            cell, weights, alone(start), policies.make_agent_loop(world), params, policies.knowledge
        )
        room = bank.room_types[episodes.scene[episode]]
        steps, sampled = len(trace.action), key if decoding == "sample" else None
        actions = follow(policy, world.env, params, start, room, steps, key=sampled, epsilon=epsilon or 0.0)
        assert actions == trace.action.tolist()


@pytest.mark.parametrize("setting", ["overdue", pytest.param("learned", marks=pytest.mark.slow)])
def test_handover_policy_switches_as_in_the_evaluation(drawn_run, world, setting):
    """It switches, and holds: once without experience, always without."""
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-1", setting, hold=True, form="switch")
    policies, params, bank = (
        drawn_run.policies().with_estimator(setting, hold=True),
        world.make_env_params(0),
        world.banks[0],
    )
    episodes, weights = draw_episodes(bank, 8), tiny.leaves_at(policies.arm_params("layout"), 1)
    cell = tiny.leaves_at(inference_grid([table_row("stde", 0.6, "switch", "argmax")], ["layout"], 1), 0)
    switched = []
    for episode in range(0, 8, 2):
        start, room = tiny.leaves_at(start_states(episodes), episode), bank.room_types[episodes.scene[episode]]
        (trace,) = play_episodes(
            cell, weights, alone(start), policies.make_agent_loop(world), params, policies.knowledge
        )
        steps = len(trace.action)
        assert follow(policy, world.env, params, start, room, steps, epsilon=0.6) == trace.action.tolist()
        assert (np.diff(trace.gap) >= 0).all()
        switched += (trace.gap > 0.6).tolist()
    assert 0 < np.mean(switched) < 1


def test_loaded_policy_actions_depend_on_epsilon_and_key(drawn_run, world):
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-1")
    starts, bank = start_states(draw_episodes(world.banks[0], 8)), world.banks[0]
    room = bank.room_types[int(starts.scene[0])]
    walk = functools.partial(follow, policy, world.env, world.make_env_params(0), tiny.leaves_at(starts, 0), room, 12)
    assert walk(epsilon=0.0) == walk(epsilon=0.0)
    key = jax.random.key(0)
    assert len({tuple(actions) for actions in (walk(epsilon=1.0), walk(key=key), walk(key=jax.random.key(1)))}) == 3
    assert walk(key=key) == walk(key=key)


def batch_of(policy, env, params, size=6):
    """Observations of random poses and memories in the middle of episodes, one by one."""
    keys = jax.random.split(jax.random.key(2), size)
    states = [env.reset(key, params)[1] for key in keys]
    observations, memories = [], []
    for number, state in enumerate(states):
        _, memory = act(policy, env.observe(state, params), policy.init([*ROOM_TYPES, None][number % 5]))
        moved = env.advance(state, memory.policy_state.action, params)[0]
        observations.append(env.observe(moved, params))
        memories.append(memory)
    return observations, memories


def stack(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


@pytest.mark.parametrize("name", ["layout-0", "baseline-0"])
def test_vmapped_observations_equal_single_steps(drawn_run, world, name):
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / name)
    observations, memories = batch_of(policy, world.env, world.make_env_params(0))
    standing = functools.partial(policy.act, heading=0, moved=False)
    batched = jax.jit(jax.vmap(standing, (0, 0, None)))(stack(observations), stack(memories), 0.1)
    singles = stack([act(policy, *pair) for pair in zip(observations, memories, strict=True)])
    np.testing.assert_array_equal(batched[0], singles[0])
    chex.assert_trees_all_close(batched, singles, rtol=1e-5, atol=1e-6)


def test_vmapped_policies_equal_single_policies(drawn_run, world):
    folders = [drawn_run.config.run_dir / POLICIES_DIR / f"layout-{seed}" for seed in range(2)]
    policies = [jaxnav.load_policy(folder) for folder in folders]
    (observation, *_), (memory, *_) = batch_of(policies[0], world.env, world.make_env_params(0), 1)
    standing = functools.partial(LoadedPolicy.act, heading=0, moved=False)
    together = jax.jit(jax.vmap(standing, (0, None, None, None)))(stack(policies), observation, memory, 0.1)
    singles = stack([act(policy, observation, memory) for policy in policies])
    chex.assert_trees_all_close(together, singles, rtol=1e-5, atol=1e-6)


def test_policy_init_selects_the_prior_of_the_room_type(drawn_run):
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-0")
    for number, room in enumerate([*ROOM_TYPES, None]):
        layout = policy.init(room).perception_state.layout
        assert layout is not None
        np.testing.assert_array_equal(layout.alpha, policy.knowledge.layout[number])
        assert int(policy.init(room).room) == number
    assert len(ROOM_TYPES) == OTHER_ROOM
    with pytest.raises(InputError, match=r"^room_type 'cellar': choose one of kitchen, .*, or None$"):
        policy.init("cellar")


def test_spatial_memory_policy_refuses_steps_without_compass_and_odometry(drawn_run, world):
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-0")
    start = tiny.leaves_at(start_states(draw_episodes(world.banks[0], 8)), 0)
    with pytest.raises(InputError, match="goes by compass and odometry; give `heading` and `moved`"):
        policy.act(world.env.observe(start, world.make_env_params(0)), policy.init())


def test_load_policy_refuses_an_environment_of_another_task(drawn_run, world):
    folder = drawn_run.config.run_dir / POLICIES_DIR / "layout-0"
    policy = jaxnav.load_policy(folder, env=world.env)
    assert policy.task == world.env.task
    rules, detector = dataclasses.replace(policy.task.rules, success_distance=1.0), Detector(miss_near=0.5)
    blind = dataclasses.replace(policy.task, detector=detector, goals=policy.task.categories[:2])
    jaxnav.load_policy(folder, env=ObjectNav(blind))  # worse eyes and fewer goals are no other task
    with pytest.raises(InputError, match=r"another task than that of env .*: rules.success_distance: 1.5 != 1.0; make"):
        jaxnav.load_policy(folder, env=ObjectNav(dataclasses.replace(policy.task, rules=rules)))
    with pytest.raises(InputError, match=r"layout-0: was trained .*categories: .*rules.headings: 8 != 12"):
        jaxnav.load_policy(folder, env=ObjectNav(APARTMENTS))


# Methods with a tracker


@dataclasses.dataclass(frozen=True)
class Compass:
    """Remembers headings, moves and actions, the older the less."""

    def init(self, knowledge):
        return jnp.zeros(3)

    def update(self, note, knowledge, percept):
        heard = [jnp.float32(value) for value in (percept.heading, percept.moved, percept.action)]
        return 0.5 * note + jnp.stack(heard)

    def read(self, note, knowledge, goal):
        return note


class Steered(Experience):
    width = 3

    def __init__(self, spec, rngs):
        pass

    def encode(self, features, appearance, weights, reading):
        return reading


@pytest.mark.slow
@pytest.mark.parametrize("name", ["semexp", "savn", "tpn"])
def test_loaded_adaptive_or_controlled_policy_acts_as_in_the_evaluation(name):
    """Over a whole episode of more than a window of six actions: what is adapted changes the logits of both."""
    setting = tiny.ESTIMATOR if METHODS[name].hosts_layout else None
    spec = dataclasses.replace(tiny.SPEC, method=METHODS[name], method_sizes=())
    env, params = tiny.world()
    params = params.replace(step_limit=jnp.full(2, LONG, jnp.int32))
    learn = METHODS[name].learn
    learned = {} if learn is None else learn([tiny.BANK], np.ones(tiny.knowledge().layout.shape))
    knowledge = tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, learned))
    weights = tiny.random_params(2, spec)
    if METHODS[name].control.num_choices == env.num_actions:
        weights["actor"]["bias"] = weights["actor"]["bias"].at[-1].set(-9.0)  # to the step limit
    state = before = State(pose=jnp.int32(8), scene=jnp.int32(0), goal=jnp.int32(2), time=jnp.int32(0))
    cell = cell_of("baseline" if setting is None else "stde", None if setting is None else 0.1)
    played = functools.partial(play_episodes, cell, weights, alone(state), env_params=params, knowledge=knowledge)
    (trace,) = played(agent_loop=AgentLoop(env, spec, setting))
    assert len(trace.action) > WINDOW
    policy, decide = LoadedPolicy(weights, knowledge, spec, setting, env.task), jax.jit(LoadedPolicy.decide)
    memory, horizons = policy.init("kitchen"), len(env.task.rules.horizons)
    for action, logits in zip(trace.action, trace.inferred.action_logits, strict=True):
        use_pose = {"heading": state.pose // horizons % env.task.rules.headings, "horizon": state.pose % horizons}
        use_pose["moved"] = env.cell_of_pose(state.pose) != env.cell_of_pose(before.pose)
        made = decide(policy, env.observe(state, params), memory, jnp.float32(0.1), **use_pose)
        np.testing.assert_allclose(made.logits, logits, rtol=1e-4, atol=1e-4)
        applied_action, memory = policy.apply_choice(made, jnp.argmax(made.logits).astype(jnp.int32), memory.room)
        assert int(applied_action) == action
        before, (state, *_) = state, env.advance(state, applied_action, params)
    if METHODS[name].adaptation is not None:
        (plain,) = played(agent_loop=AgentLoop(env, spec, setting, inner_steps=0))
        assert np.abs(plain.inferred.factual_logits[:LONG] - trace.inferred.factual_logits[:LONG]).max() > 1e-3


@pytest.mark.slow
def test_loaded_tracker_is_updated_at_every_step():
    steered = Method(Steered, tracker=Compass(), name="steered")
    spec = dataclasses.replace(tiny.SPEC, method=steered, method_sizes=())
    env, params = tiny.world()
    weights, knowledge = tiny.random_params(2, spec), tiny.knowledge()
    weights["actor"]["bias"] = weights["actor"]["bias"].at[-1].set(-9.0)  # to the step limit
    policy = LoadedPolicy(weights, knowledge, spec, tiny.ESTIMATOR, env.task)
    start = State(pose=jnp.int32(8), scene=jnp.int32(0), goal=jnp.int32(1), time=jnp.int32(0))
    (trace,) = play_episodes(
        cell_of("stde", 0.1), weights, alone(start), AgentLoop(env, spec, tiny.ESTIMATOR), params, knowledge
    )
    assert len(trace.action) == tiny.STEP_LIMITS[0]
    walk = functools.partial(follow, policy, env, params, start, "kitchen", len(trace.action), epsilon=0.1)
    assert walk() == trace.action.tolist()
    assert walk(use_pose=False) != trace.action.tolist()
