"""Handover: a removal of experience leaves the fallback policy, bit-identical to one that acted from the start."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny

from jaxnav.causal import do, stde, tde
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import Evaluator
from jaxnav.evaluation.removal import GapSource
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.numerics.rounding import round_to_grid
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods import find_method
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.runs.policies import Policies

ENV, PARAMS = tiny.world()
KNOWLEDGE = Knowledge(0.05 * tiny.knowledge().priors)
ANONYMOUS_SPEC = dataclasses.replace(tiny.SPEC, method=find_method("anonymous"), method_sizes=())
#: Agents with experience, layout-blind agents, and pairs of an agent with experience and a layout-blind fallback.
EXPERIENCED_LOOP = AgentLoop(ENV, tiny.SPEC, tiny.ESTIMATOR)
BLIND_LOOP = AgentLoop(ENV, ANONYMOUS_SPEC)
PAIR_LOOP = AgentLoop(ENV, tiny.SPEC, tiny.ESTIMATOR, fallback_spec=ANONYMOUS_SPEC)
EXPERIENCED_PARAMS = tiny.random_params(6)
BLIND_PARAMS = tiny.random_params(9, ANONYMOUS_SPEC)
PAIR_PARAMS = {"primary": EXPERIENCED_PARAMS, "fallback": BLIND_PARAMS}
EPISODES = draw_episodes(tiny.BANK, 24, seed=1)
KEY = jax.random.key(3)
BATCH_SIZE = 8

LAYOUT_ROW = table_row("layout", None, None, "argmax")


def make_grid_cell(row, **changes):
    """Grid with the single cell of a table row, some of its fields set to other values."""
    grid = inference_grid([row], ("layout",), 1)
    changed_fields = {}
    for name, value in changes.items():
        changed_fields[name] = jnp.full_like(getattr(grid, name), value)
    return grid.replace(**changed_fields)


def run_episodes(agent_loop, params, *grid_cells):
    """Outcomes of the episodes of each grid cell, all compiled as one program."""
    grid = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *grid_cells)
    stacked_params = jax.tree.map(lambda leaf: leaf[None], params)
    outcomes = Evaluator(agent_loop)(grid, stacked_params, [(EPISODES, PARAMS)], KNOWLEDGE, KEY)
    return [tiny.leaves_at(outcomes, index) for index in range(len(grid_cells))]


def assert_equal_episodes(outcome, expected):
    """Check that episodes are bit-identical, whatever was removed in them."""
    chex.assert_trees_all_equal(outcome._replace(total_weight=0), expected._replace(total_weight=0))


# A layout-blind fallback


@pytest.fixture(scope="module")
def blind_outcome():
    """Episodes of the layout-blind policy; its row has the name of the only arm in the grid."""
    (outcome,) = run_episodes(BLIND_LOOP, BLIND_PARAMS, make_grid_cell(LAYOUT_ROW))
    return outcome


@pytest.fixture(scope="module")
def pair_outcomes():
    """Episodes of the pair: no handover, TDE, handover at the first step, and handover two steps later."""
    tde_row = table_row("tde", None, None, "argmax")
    switch_row = table_row("stde", 0.5, "switch", "argmax")
    full_gap = {"gap_source": GapSource.GIVEN, "given_gap": 1.0, "gap_end": 2**30}
    grid_cells = {
        "no handover": make_grid_cell(LAYOUT_ROW),
        "TDE": make_grid_cell(tde_row),
        "first step": make_grid_cell(switch_row, gap_begin=0, **full_gap),
        "third step": make_grid_cell(switch_row, gap_begin=2, **full_gap),
    }
    outcomes = run_episodes(PAIR_LOOP, PAIR_PARAMS, *grid_cells.values())
    return dict(zip(grid_cells, outcomes, strict=True))


@pytest.mark.slow
def test_removal_leaves_the_layout_blind_policy_bit_for_bit():
    # Factual and counterfactual decision of the pair at the start of episodes.
    decider = PAIR_LOOP.bind_decider(PAIR_PARAMS)
    batch_shape = (BATCH_SIZE,)
    agent = PAIR_LOOP.start(KEY, BATCH_SIZE, decider.initial_memory(batch_shape), KNOWLEDGE, PARAMS)
    memory = agent.memory
    assert memory is not None
    inputs = PAIR_LOOP.policy_inputs(agent, KNOWLEDGE, PARAMS)
    pathways = decider.pathways(inputs, memory)
    factual = decider.decide(pathways, memory)
    counterfactual = decider.decide(do(pathways, scene=0.0, goal=0.0), memory)

    # Decisions of the two policies on their own; the layout-blind one knows no layout and has no tracker.
    experienced_policy = PAIR_LOOP.bind(EXPERIENCED_PARAMS)
    experienced = experienced_policy.decide(
        experienced_policy.pathways(inputs), experienced_policy.initial_memory(batch_shape)
    )
    blind_policy = BLIND_LOOP.bind(BLIND_PARAMS)
    blind_inputs = inputs._replace(layout_weights=jnp.ones_like(inputs.layout_weights), reading=None)
    blind = blind_policy.decide(blind_policy.pathways(blind_inputs), blind_policy.initial_memory(batch_shape))

    # The pair decides like its policy with experience, and eq. 1 leaves the layout-blind policy.
    chex.assert_trees_all_equal(factual.logits - counterfactual.logits, round_to_grid(blind.logits))
    chex.assert_trees_all_equal(factual.logits, round_to_grid(experienced.logits))
    chex.assert_trees_all_equal(factual.hidden, jnp.concatenate([experienced.hidden, blind.hidden], axis=-1))
    assert np.abs(experienced.logits - blind.logits).max() > 0.1


@pytest.mark.slow
def test_without_removal_the_policy_with_experience_acts(pair_outcomes):
    (experienced_outcome,) = run_episodes(EXPERIENCED_LOOP, EXPERIENCED_PARAMS, make_grid_cell(LAYOUT_ROW))
    assert_equal_episodes(pair_outcomes["no handover"], experienced_outcome)


@pytest.mark.slow
def test_under_tde_the_layout_blind_policy_acts(pair_outcomes, blind_outcome):
    assert_equal_episodes(pair_outcomes["TDE"], blind_outcome)


@pytest.mark.slow
def test_handover_at_the_first_step_gives_episodes_of_the_layout_blind_policy(pair_outcomes, blind_outcome):
    first_step = pair_outcomes["first step"]
    third_step = pair_outcomes["third step"]
    assert_equal_episodes(first_step, blind_outcome)

    # Two steps later the pair acts like neither policy, but begins like the policy with experience.
    assert (np.asarray(third_step.length) != np.asarray(first_step.length)).any()
    assert (np.asarray(third_step.mean_weight) > 0).any()
    assert (np.asarray(third_step.mean_weight) < 1).all()


# The same network without experience as the fallback


DROPOUT_SPEC = dataclasses.replace(tiny.SPEC, experience_dropout=True)
OWN_FALLBACK_LOOP = AgentLoop(ENV, DROPOUT_SPEC, tiny.ESTIMATOR, use_own_fallback=True)


def replay_logits(policy, inputs_by_step, actions, use_experience):
    """Logits of each step of a policy that has experience in all steps or in none."""
    batch_size = len(actions[0])
    memory = policy.initial_memory((batch_size,))._replace(use_experience=jnp.full(batch_size, use_experience))
    logits_by_step = []
    for inputs, action in zip(inputs_by_step, actions, strict=True):
        decision = policy.decide(policy.pathways(inputs, memory), memory)
        logits_by_step.append(decision.logits)
        memory = decision.next_state(action)
    return logits_by_step


@pytest.mark.slow
@pytest.mark.parametrize(
    "method_name",
    [
        "org",
        pytest.param("support.methods:ATTENTIVE", marks=pytest.mark.exhaustive),
        pytest.param("support.methods:ADAPTIVE", marks=pytest.mark.exhaustive),
    ],
)
def test_reference_removal_leaves_the_network_without_experience_bit_for_bit(method_name):
    """At s = 1, at every step of an episode: eq. 1 leaves a0, whose memory has never held experience."""
    spec = dataclasses.replace(DROPOUT_SPEC, method=find_method(method_name), method_sizes=())
    agent_loop = dataclasses.replace(OWN_FALLBACK_LOOP, spec=spec)
    params = tiny.random_params(6, spec)
    decider = agent_loop.bind_decider(params)
    agent = agent_loop.start(KEY, BATCH_SIZE, decider.initial_memory((BATCH_SIZE,)), KNOWLEDGE, PARAMS)

    # Follow the episodes for four steps with and without removal.
    inputs_by_step = []
    actions = []
    factual_by_step = []
    removed_by_step = []
    for step in range(4):
        memory = agent.memory
        assert memory is not None
        inputs = agent_loop.policy_inputs(agent, KNOWLEDGE, PARAMS)
        pathways = decider.pathways(inputs, memory)
        decision = decider.decide(pathways, memory)
        counterfactual = decider.decide(do(pathways, scene=0.0, goal=0.0), memory.counterfactual_state())
        inputs_by_step.append(inputs)
        factual_by_step.append(decision.logits)
        removed_by_step.append(tde(decision.logits, counterfactual.logits))

        # Moves and turns alone, so that no episode ends.
        action = (jnp.arange(BATCH_SIZE) + step) % 3
        actions.append(action)
        agent, _ = agent_loop.step(agent, action, KNOWLEDGE, PARAMS, policy=decider, decision=decision)

    # Replay the same inputs and actions by the plain network.
    policy = agent_loop.bind(params)
    logits_without_experience = replay_logits(policy, inputs_by_step, actions, 0.0)
    logits_with_experience = replay_logits(policy, inputs_by_step, actions, 1.0)
    chex.assert_trees_all_equal(removed_by_step, [round_to_grid(logits) for logits in logits_without_experience])
    chex.assert_trees_all_equal(factual_by_step, [round_to_grid(logits) for logits in logits_with_experience])
    assert np.abs(removed_by_step[-1] - factual_by_step[-1]).max() > 0.05


@pytest.mark.slow
def test_half_of_the_reference_removal_lies_midway():
    """The form `paper` is a - s (a - a0): at s = 1/2 the mean of the logits a and a0."""
    decider = OWN_FALLBACK_LOOP.bind_decider(EXPERIENCED_PARAMS)
    agent = OWN_FALLBACK_LOOP.start(KEY, BATCH_SIZE, decider.initial_memory((BATCH_SIZE,)), KNOWLEDGE, PARAMS)
    memory = agent.memory
    assert memory is not None
    inputs = OWN_FALLBACK_LOOP.policy_inputs(agent, KNOWLEDGE, PARAMS)
    pathways = decider.pathways(inputs, memory)
    factual_logits = decider.decide(pathways, memory).logits
    counterfactual_logits = decider.decide(do(pathways, scene=0.0, goal=0.0), memory).logits
    half_removed = stde(factual_logits, counterfactual_logits, jnp.full(BATCH_SIZE, 0.5), 0.0, "paper")

    # The logits a0 of the plain network, whose memory has never held experience.
    network = OWN_FALLBACK_LOOP.bind(EXPERIENCED_PARAMS)
    any_action = jnp.zeros(BATCH_SIZE, jnp.int32)
    (logits_without_experience,) = replay_logits(network, [inputs], [any_action], 0.0)
    expected = (factual_logits + round_to_grid(logits_without_experience)) / 2
    np.testing.assert_allclose(half_removed, expected, atol=1e-6)
    assert np.abs(factual_logits - logits_without_experience).max() > 0.05


@pytest.mark.exhaustive
def test_episodes_under_cde_equal_those_of_the_network_without_experience():
    """Whole episodes: a policy whose experience columns are zero takes the same actions."""
    # Zero the rows of the kernel that read the experience, which follows the first two pathways.
    kernel = EXPERIENCED_PARAMS["fuse"]["kernel"]
    policy = AgentLoop(ENV, DROPOUT_SPEC).bind(EXPERIENCED_PARAMS)
    first_row = sum(policy.widths[:2])
    muted_kernel = kernel.at[first_row : first_row + policy.widths[2]].set(0.0)
    muted_params = EXPERIENCED_PARAMS | {"fuse": EXPERIENCED_PARAMS["fuse"] | {"kernel": muted_kernel}}

    # Compare whole episodes.
    cde_row = table_row("cde", None, None, "argmax")
    cde_outcome, factual_outcome = run_episodes(
        OWN_FALLBACK_LOOP, EXPERIENCED_PARAMS, make_grid_cell(cde_row), make_grid_cell(LAYOUT_ROW)
    )
    dropout_loop = AgentLoop(ENV, DROPOUT_SPEC, tiny.ESTIMATOR)
    (muted_outcome,) = run_episodes(dropout_loop, muted_params, make_grid_cell(LAYOUT_ROW))
    assert_equal_episodes(cde_outcome, muted_outcome)

    # Negative control: with experience the episodes differ.
    assert (np.asarray(factual_outcome.length) != np.asarray(cde_outcome.length)).any()


def test_own_fallback_replaces_the_counterfactual_memory():
    spec = dataclasses.replace(DROPOUT_SPEC, counterfactual_memory="own")
    agent_loop = dataclasses.replace(OWN_FALLBACK_LOOP, spec=spec)
    memory = agent_loop.bind_decider(EXPERIENCED_PARAMS).initial_memory((2,))
    assert memory.counterfactual_hidden is None
    assert memory.hidden.shape == (2, 2 * tiny.SIZES.hidden)


# Policies of runs


def make_policies(spec, params):
    knowledge = Knowledge(KNOWLEDGE.priors)
    return Policies(params, ("layout",), knowledge, knowledge.priors, spec, None, 0, tiny.BANK.task)


def test_policies_that_always_had_experience_have_no_own_fallback():
    with pytest.raises(InputError, match=r"cde: these policies had experience in every .* --ppo.experience below 1"):
        make_policies(tiny.SPEC, EXPERIENCED_PARAMS).with_own_fallback()
    for spec in (DROPOUT_SPEC, tiny.STREAMS):
        assert make_policies(spec, EXPERIENCED_PARAMS).with_own_fallback().use_own_fallback


def test_own_counterfactual_memory_needs_one_from_training():
    with pytest.raises(InputError, match=r"--counterfactual-memory own: .* trained without a memory of its own; train"):
        make_policies(tiny.SPEC, EXPERIENCED_PARAMS).with_counterfactual_memory("own")

    # Policies with a memory from training can use either memory.
    own_memory_spec = dataclasses.replace(tiny.SPEC, counterfactual_memory="own")
    policies = make_policies(own_memory_spec, EXPERIENCED_PARAMS)
    assert policies.with_counterfactual_memory("own").spec == own_memory_spec
    assert policies.with_counterfactual_memory("factual").spec == tiny.SPEC
    assert policies.with_counterfactual_memory(None).spec == own_memory_spec


def test_handover_joins_the_parameters_of_the_two_policies():
    experienced_params = jax.tree.map(lambda leaf: leaf[None], EXPERIENCED_PARAMS)
    blind_params = jax.tree.map(lambda leaf: leaf[None], BLIND_PARAMS)
    blind_policies = make_policies(ANONYMOUS_SPEC, blind_params)
    pair = make_policies(tiny.SPEC, experienced_params).with_handover_to(blind_policies)
    assert pair.fallback_spec == ANONYMOUS_SPEC
    assert pair.num_seeds == 1
    chex.assert_trees_all_equal(pair.params, {"primary": experienced_params, "fallback": blind_params})


@pytest.mark.parametrize(
    ("changes", "remedy"),
    [
        (
            {"method": find_method("hoz")},
            "method 'org' cannot hand over to 'hoz'; train the reference run with --method anonymous",
        ),
        ({"method": find_method("semexp")}, "'org' cannot hand over to 'semexp'"),
        ({"spatial_memory": None}, "the runs have different spatial memories; train both"),
    ],
)
def test_handover_to_unsuitable_policies_is_refused(changes, remedy):
    memory = SpatialMemory(8)
    spec = dataclasses.replace(tiny.SPEC, spatial_memory=memory)
    fallback_spec = dataclasses.replace(ANONYMOUS_SPEC, **{"spatial_memory": memory} | changes)
    with pytest.raises(InputError, match=remedy):
        make_policies(spec, EXPERIENCED_PARAMS).with_handover_to(make_policies(fallback_spec, BLIND_PARAMS))


def test_handover_needs_equally_many_policies():
    single_params = jax.tree.map(lambda leaf: leaf[None], EXPERIENCED_PARAMS)
    double_params = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), BLIND_PARAMS)
    blind_policies = make_policies(ANONYMOUS_SPEC, double_params)
    with pytest.raises(InputError, match="1 policies cannot hand over to 2; train both runs with equal arms and seeds"):
        make_policies(tiny.SPEC, single_params).with_handover_to(blind_policies)
