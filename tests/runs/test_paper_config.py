"""Claims in the header of `paper.yaml`: equations 3 to 7 to the letter, and networks as large as the released code."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.tiny_run import draw_run, tiny_config
from twins.perception import TwinPaperBelief

import jaxnav
from jaxnav.env.objectnav import EnvParams, ObjectNav, Observation
from jaxnav.errors import InputError
from jaxnav.layout import ESTIMATORS, EstimatorConfig, LayoutEstimator
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.agent_loop import Perception
from jaxnav.policies.features import unpack_features
from jaxnav.policies.method import Knowledge, Percept
from jaxnav.policies.network import bind, init_params
from jaxnav.policies.pathways import PolicyInputs
from jaxnav.runs import train as training
from jaxnav.runs.config import LayoutConfig, RunConfig, WorldConfig, check_config, fill_world_defaults
from jaxnav.runs.config_files import CONFIGS, apply_yaml
from jaxnav.runs.loaded_policy import input_shapes
from jaxnav.runs.policies import POLICIES_DIR, config_for_policy
from jaxnav.runs.run import Run
from jaxnav.runs.worlds import compile_training_world
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import DONE, Task

NUM_CATEGORIES = 22
#: Parameters of the released code by part, from the widths of its layers.
RELEASED_PARAMETERS = {
    # A 1 x 1 convolution of 64 + 22 + 22 + 10 to 64 channels, and an LSTM with four gates and two biases per gate: the
    # first layer reads 64 x 7 x 7 numbers, the second one the 512 of the first.
    "core": 118 * 64 + 64 + 4 * 512 * (3136 + 512 + 2) + 4 * 512 * (512 + 512 + 2),
    "view": 512 * 64 + 64,
    # Rows of 512 + 5 + 1 numbers to 128 to 49, and relations: 6 to 22, then two layers (direct) or four of 22 to 22.
    "detections": 518 * 128 + 128 + 128 * 49 + 49 + 6 * 22 + 22 + 2 * (22 * 22 + 22),
    "method": 518 * 128 + 128 + 128 * 49 + 49 + 6 * 22 + 22 + 4 * (22 * 22 + 22),
    "heads": 512 * 6 + 6 + 512 * 64 + 64 + 64 + 1,
    "action": 6 * 10 + 10,
}
#: Modules of the network in each part.
PARTS = {
    "core": ("fuse", "core"),
    "view": ("view",),
    "detections": ("detections",),
    "method": ("method",),
    "categories": ("appearance", "sought"),
    "heads": ("actor", "critic"),
}


def load_config(name: str, **changes: Any) -> RunConfig:
    """Return a packaged configuration with changes, completed as in training."""
    return check_config(dataclasses.replace(apply_yaml(RunConfig(), name), **changes))


# Equations 3 to 7


@dataclasses.dataclass(frozen=True)
class PaperWorld:
    """Few training scenes, and the knowledge that a run of `--config paper` learns in them before training."""

    config: RunConfig
    bank: Bank
    env_params: EnvParams
    perception: Perception
    estimator: EstimatorConfig
    knowledge: Knowledge
    start_poses: np.ndarray
    actions: np.ndarray


@functools.cache
def paper_world() -> PaperWorld:
    # Four scenes, and 24 walks of 40 steps.
    config = apply_yaml(RunConfig(), "paper")
    layout = dataclasses.replace(config.layout, walks=24, steps=40)
    worlds = dataclasses.replace(config.worlds, num_train=4)
    config = check_config(dataclasses.replace(config, layout=layout, worlds=worlds))

    # Compile, explore and learn as `train` does.
    console = PlainConsole(quiet=True)
    compiled_world = compile_training_world(config, console)
    exploration = training.explore_world(config, compiled_world)
    estimator = training.calibrate_estimator(config, compiled_world, exploration, console)
    knowledge = training.learn_knowledge(config, compiled_world, exploration, estimator)

    # Repeat the random walks: starts and actions are drawn by the keys of the run.
    explore_key = jax.random.fold_in(jax.random.key(config.seed), training._EXPLORE)
    bank_key = jax.random.fold_in(explore_key, 0)
    start_key = jax.random.fold_in(bank_key, 0)
    action_key = jax.random.fold_in(bank_key, 1)
    env_params = compiled_world.make_env_params(0)
    _, state = jax.vmap(compiled_world.env.reset, (0, None))(jax.random.split(start_key, 24), env_params)
    actions = np.asarray(jax.random.randint(action_key, (40, 24), 0, DONE))

    perception = Perception(compiled_world.env.row_format, config.policy_spec(NUM_CATEGORIES), estimator)
    start_poses = np.asarray(state.pose)
    return PaperWorld(
        config, compiled_world.banks[0], env_params, perception, estimator, knowledge, start_poses, actions
    )


def instance_counts(row: np.ndarray) -> np.ndarray:
    """Return the counts of a row, which follow four bytes per category and a view of 31 bytes."""
    return row[4 * NUM_CATEGORIES + 31 :][:NUM_CATEGORIES].astype(np.int64)


@pytest.mark.slow
def test_all_rooms_share_a_prior_of_ones_plus_the_counts_of_every_view():
    world = paper_world()

    # Ones, plus the instance counts of every view to the row of each category that it shows.
    alpha = np.ones((NUM_CATEGORIES, NUM_CATEGORIES))
    pose = world.start_poses
    for step_actions in (None, *world.actions):
        if step_actions is not None:
            pose = world.bank.successor[pose, step_actions]
        for row in world.bank.rows[pose]:
            counts = instance_counts(row)
            alpha[counts > 0] += counts
    np.fill_diagonal(alpha, 0)

    priors = np.asarray(world.knowledge.priors)
    assert len(priors) > 1
    for prior in priors:
        np.testing.assert_array_equal(prior, alpha)
    assert world.bank.rows[:, 4 * NUM_CATEGORIES + 31 :].max() > 1  # several instances are in sight


@pytest.mark.slow
@pytest.mark.parametrize("prior_kind", ["of the run", "ones"])
def test_belief_gap_and_weights_follow_equations_3_to_7(prior_kind):
    """The belief follows a twin in float64 along random views; after few sightings (`ones`) the gaps are large."""
    world = paper_world()
    rng = np.random.default_rng(0)
    prior = world.knowledge.priors[0]
    if prior_kind == "ones":
        prior = jnp.ones_like(prior) - jnp.eye(NUM_CATEGORIES)
    knowledge = world.knowledge._replace(priors=jnp.broadcast_to(prior, world.knowledge.priors.shape))
    twin = TwinPaperBelief(np.asarray(prior))

    update = jax.jit(world.perception.update)
    read_inputs = jax.jit(world.perception.policy_inputs)
    room = jnp.int32(1)
    zero = jnp.int32(0)
    state = world.perception.init(knowledge, room)
    gaps = []
    # Each view occurs twice in a row, because a repetition counts again.
    for pose in np.repeat(rng.integers(0, len(world.bank.rows), 20), 2):
        row = jnp.asarray(world.bank.rows[pose])
        goal = jnp.int32(rng.integers(NUM_CATEGORIES))
        percept = Percept(row, heading=zero, action=zero, moved=jnp.bool_(False), horizon=zero, goal=goal)
        state = update(state, percept, knowledge, room)
        inputs = read_inputs(state, Observation(row, goal), knowledge)

        # Equations 3 and 4, 5, 6, and the goal's column of w (equation 7).
        twin.update(instance_counts(world.bank.rows[pose]))
        assert state.layout is not None
        np.testing.assert_array_equal(state.layout.alpha, twin.alpha)
        np.testing.assert_allclose(state.layout.gap, twin.gap, rtol=1e-4, atol=1e-7)
        expectation = twin.alpha / twin.alpha.sum(axis=1, keepdims=True)
        np.fill_diagonal(expectation, 1)
        np.testing.assert_allclose(LayoutEstimator.expectation(state.layout), expectation, rtol=1e-5)
        np.testing.assert_allclose(inputs.layout_weights, expectation[:, int(goal)], rtol=1e-5)
        gaps.append(twin.gap)
    assert max(gaps) > (0.3 if prior_kind == "ones" else 1e-4)


@pytest.mark.slow
def test_weights_multiply_the_rows_of_experience_unscaled():
    """Equation 7: the policy encodes its experience by its method, with raw weights."""
    world = paper_world()
    spec = load_config("paper_small").policy_spec(NUM_CATEGORIES)
    policy = bind(spec, init_params(spec, jax.random.key(0)))

    # The row with most detections, and random weights of at most 0.2 except for the goal.
    num_detections = (world.bank.rows[:, : 4 * NUM_CATEGORIES : 4] > 0).sum(1)
    row = jnp.asarray(world.bank.rows[int(np.argmax(num_detections))])
    goal = jnp.int32(3)
    weights = jax.random.uniform(jax.random.key(1), (NUM_CATEGORIES,), maxval=0.2).at[goal].set(1.0)

    pathways = policy.encode(PolicyInputs(Observation(row, goal), weights))
    features = unpack_features(row, goal, world.perception.row_format)
    expected = policy.experience.encode(features, policy.experience_appearance, weights, None)
    np.testing.assert_array_equal(pathways.experience, expected)

    # Other weights give another experience.
    doubled_experience = policy.experience.encode(features, policy.experience_appearance, 2 * weights, None)
    assert np.abs(doubled_experience - expected).max() > 1e-3


# Networks


def count_parameters(config: RunConfig) -> dict[str, int]:
    """Return the number of parameters by part of the network."""
    params = jax.eval_shape(functools.partial(init_params, config.policy_spec(NUM_CATEGORIES)), jax.random.key(0))
    totals = {}
    for part, names in PARTS.items():
        leaves = jax.tree.leaves([params.pop(name) for name in names])
        totals[part] = sum(int(np.prod(leaf.shape)) for leaf in leaves)
    assert not params
    return totals


def test_network_is_of_the_released_size_by_part():
    assert sum(RELEASED_PARAMETERS.values()) == 9_801_791
    counts = count_parameters(load_config("paper"))
    assert sum(counts.values()) == pytest.approx(9_801_791, rel=1e-3)

    # Rows of detections and of the experience: relations differ by biases, and rows by three columns.
    for part in ("detections", "method"):
        assert counts[part] == pytest.approx(RELEASED_PARAMETERS[part], rel=0.02)

    # The core with its input layer and the layer of the view; in the release each of these layers is a convolution.
    released_core = RELEASED_PARAMETERS["core"] + RELEASED_PARAMETERS["view"]
    assert counts["core"] + counts["view"] == pytest.approx(released_core, rel=0.01)
    assert counts["categories"] < 0.003 * 9_801_791
    assert counts["heads"] < RELEASED_PARAMETERS["heads"]


def test_header_of_the_configuration_states_the_counts():
    header = CONFIGS["paper"].read_text()
    counts = count_parameters(load_config("paper"))
    for number in (*counts.values(), sum(counts.values())):
        assert f"{number:,}" in header
    for number in (*RELEASED_PARAMETERS.values(), 9_801_791):
        assert f"{number:,}" in header or number == RELEASED_PARAMETERS["action"]
    small_total = sum(count_parameters(load_config("paper_small")).values())
    assert f"{small_total:,}" in CONFIGS["paper_small"].read_text()


# The other settings


@pytest.mark.parametrize("world", ["rooms", "apartments", "houses"])
def test_every_world_has_the_papers_reward(world):
    paper_config = dataclasses.replace(apply_yaml(RunConfig(), "paper"), world=world)
    config = check_config(fill_world_defaults(paper_config))
    assert (config.worlds.shaping, config.near_starts, config.ppo.guidance) == (0, 0, 0)
    assert not config.ppo.has_guidance
    assert config.ppo.experience == 1.0  # no episodes without experience
    assert config.task.instance_counts


def test_rewards_are_those_of_the_paper():
    env_params = paper_world().env_params
    assert (float(env_params.success_reward), float(env_params.step_reward)) == (5.0, np.float32(-0.01))


def test_estimator_is_paper():
    assert paper_world().estimator == ESTIMATORS["paper"]


@pytest.mark.parametrize("name", ["paper_small", "paper_vtnet"])
def test_other_paper_configurations_differ_only_in_sizes_and_learning_rate(name):
    paper_config = load_config("paper")
    config = load_config(name)
    ppo = dataclasses.replace(config.ppo, learning_rate=paper_config.ppo.learning_rate)
    paper_sizes = {"method": "org", "sizes": paper_config.sizes, "method_sizes": {"relation_layers": 4}}
    assert dataclasses.replace(config, ppo=ppo, **paper_sizes) == paper_config
    assert config.worlds == WorldConfig(shaping=0, near_starts=0, front_cell="nearest")


# Policies that count instances


@pytest.fixture(scope="module")
def counting_run(tmp_path_factory) -> Run:
    """Run of tiny policies whose estimator is `paper`, with weak rows of the prior."""
    layout = LayoutConfig(setting="paper", prior="pooled", walks=64, steps=20)
    config = check_config(tiny_config(tmp_path_factory.mktemp("counting"), layout=layout))
    return draw_run(config, dataclasses.replace(ESTIMATORS["paper"], strength=5.0))


def test_exported_policy_follows_the_belief_with_counts(counting_run):
    folder = counting_run.config.run_dir / POLICIES_DIR / "layout-0"
    policy = jaxnav.load_policy(folder)
    assert policy.task.instance_counts

    # The belief follows its twin along four views, of which the second occurs twice.
    twin = TwinPaperBelief(np.asarray(policy.knowledge.priors[0]))
    memory = policy.init("kitchen")
    rows = paper_world().bank.rows
    decide = jax.jit(type(policy).decide)
    for pose in (5, 700, 700, 4000):
        observation = Observation(jnp.asarray(rows[pose]), jnp.int32(2))
        odometry = {"heading": jnp.int32(0), "moved": jnp.bool_(False)}
        output = decide(policy, observation, memory, jnp.float32(0.0), **odometry)
        _, memory = policy.apply_choice(output, jnp.int32(1), memory.room)
        twin.update(instance_counts(rows[pose]))
        np.testing.assert_allclose(output.gap, twin.gap, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(output.weights, twin.weights(2), rtol=1e-5)

    # A program gets the counts as a separate array, and the task of the configuration counts instances.
    assert input_shapes(policy, 1)["counts"].shape == (1, NUM_CATEGORIES)
    assert config_for_policy(folder).task == policy.task


def test_policy_that_counts_instances_refuses_rows_without_counts(counting_run):
    folder = counting_run.config.run_dir / POLICIES_DIR / "layout-0"
    plain_env = ObjectNav(Task())
    with pytest.raises(InputError, match=r"instance_counts.*make an environment with the task of the policy"):
        jaxnav.load_policy(folder, env=plain_env)
    assert jaxnav.load_policy(folder, env=ObjectNav(Task(instance_counts=True))).task.instance_counts

    # The baseline has no belief and reads rows of both kinds.
    baseline = jaxnav.load_policy(counting_run.config.run_dir / POLICIES_DIR / "baseline-0", env=plain_env)
    assert baseline.estimator_config is None


@pytest.mark.slow
def test_paper_estimator_counts_instances_where_rows_hold_them_and_else_presence(counting_run, drawn_run):
    assert counting_run.policies().with_estimator("paper").estimator_config == ESTIMATORS["paper"]
    presence = dataclasses.replace(ESTIMATORS["paper"], counts="presence")
    assert drawn_run.policies().with_estimator("paper").estimator_config == presence
    results = jaxnav.evaluate(counting_run, epsilon=(0.0,), episodes=4)
    assert {row.variant for row in results.rows} >= {"layout", "stde"}
