"""Two policies of which one acts: a hand-over leaves the layout-blind one, as if it had acted all along."""

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
KNOWLEDGE = Knowledge(0.05 * tiny.knowledge().layout)
ANONYMOUS = dataclasses.replace(tiny.SPEC, method=find_method("anonymous"), method_sizes=())
PAIR = AgentLoop(ENV, tiny.SPEC, tiny.ESTIMATOR, fallback_spec=ANONYMOUS)
ALONE = AgentLoop(ENV, ANONYMOUS)
AGENT, WITHOUT = tiny.random_params(6), tiny.random_params(9, ANONYMOUS)
BOTH = {"agent": AGENT, "without": WITHOUT}
EPISODES, KEY = draw_episodes(tiny.BANK, 24, seed=1), jax.random.key(3)


def make_cells(row, **changes):
    """The cell of a row, with something changed."""
    cells = inference_grid([row], ("layout",), 1)
    return cells.replace(**{name: jnp.full_like(getattr(cells, name), value) for name, value in changes.items()})


def play(acting, weights, *cells):
    """How the episodes of each cell go, all compiled as one program."""
    grid = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *cells)
    stacked = jax.tree.map(lambda leaf: leaf[None], weights)
    outcome = Evaluator(acting)(grid, stacked, [(EPISODES, PARAMS)], KNOWLEDGE, KEY)
    return [tiny.leaves_at(outcome, index) for index in range(len(cells))]


def alike(one, other):
    """Check that episodes went alike, whatever was removed in them."""
    chex.assert_trees_all_equal(one._replace(mean_weight=0), other._replace(mean_weight=0))


LAYOUT_ROW = table_row("layout", None, None, "argmax")


@pytest.fixture(scope="module")
def layout_blind():
    """Episodes of the layout-blind policy, which wears the name of the one arm that is there."""
    return play(ALONE, WITHOUT, make_cells(LAYOUT_ROW))[0]


@pytest.fixture(scope="module")
def handed_over():
    """Episodes of the pair: never handed over, under TDE, handed over at the first step, and two steps later."""
    switch = table_row("stde", 0.5, "switch", "argmax")
    given = {"gap_source": GapSource.GIVEN, "given_gap": 1.0, "gap_end": 2**30}
    cells = {
        "never": make_cells(LAYOUT_ROW),
        "TDE": make_cells(table_row("tde", None, None, "argmax")),
        "at once": make_cells(switch, gap_begin=0, **given),
        "later": make_cells(switch, gap_begin=2, **given),
    }
    return dict(zip(cells, play(PAIR, BOTH, *cells.values()), strict=True))


@pytest.mark.slow
def test_what_removal_leaves_is_the_layout_blind_policy_to_the_bit():
    decider = PAIR.bind_decider(BOTH)
    batch = jnp.arange(8)
    agent = PAIR.start(KEY, len(batch), decider.initial_memory(batch.shape), KNOWLEDGE, PARAMS)
    memory = agent.memory
    assert memory is not None
    view = PAIR.policy_inputs(agent, KNOWLEDGE, PARAMS)
    pathways = decider.pathways(view, memory)
    factual = decider.decide(pathways, memory)
    removed = decider.decide(do(pathways, scene=0.0, goal=0.0), memory)
    own, other = PAIR.bind(AGENT), ALONE.bind(WITHOUT)
    knowing = own.decide(own.pathways(view), own.initial_memory(batch.shape))
    unknowing = other.decide(
        other.pathways(view._replace(layout_weights=jnp.ones_like(view.layout_weights), reading=None)),
        other.initial_memory(batch.shape),
    )
    chex.assert_trees_all_equal(factual.logits - removed.logits, round_to_grid(unknowing.logits))
    chex.assert_trees_all_equal(factual.logits, round_to_grid(knowing.logits))
    chex.assert_trees_all_equal(factual.hidden, jnp.concatenate([knowing.hidden, unknowing.hidden], axis=-1))
    assert np.abs(knowing.logits - unknowing.logits).max() > 0.1


@pytest.mark.slow
def test_without_removal_the_policy_with_experience_acts(handed_over):
    (alone,) = play(AgentLoop(ENV, tiny.SPEC, tiny.ESTIMATOR), AGENT, make_cells(LAYOUT_ROW))
    alike(handed_over["never"], alone)


@pytest.mark.slow
def test_under_tde_the_layout_blind_policy_acts(handed_over, layout_blind):
    alike(handed_over["TDE"], layout_blind)


@pytest.mark.slow
def test_handed_over_at_the_first_step_it_is_the_same(handed_over, layout_blind):
    at_once, later = handed_over["at once"], handed_over["later"]
    alike(at_once, layout_blind)
    # Two steps later it is neither of the two, but begins as the one with experience.
    assert (np.asarray(later.length) != np.asarray(at_once.length)).any()
    assert (np.asarray(later.mean_weight) > 0).any()
    assert (np.asarray(later.mean_weight) < 1).all()


# The same network without experience


DROPPING = dataclasses.replace(tiny.SPEC, experience_dropout=True)
OWN_PAIR = AgentLoop(ENV, DROPPING, tiny.ESTIMATOR, use_own_fallback=True)


def follow_alone(policy, inputs_by_step, actions, use_experience):
    """Logits of each step of a policy that has experience in all steps or in none."""
    batch_size = len(actions[0])
    memory = policy.initial_memory((batch_size,))._replace(use_experience=jnp.full(batch_size, use_experience))
    logits = []
    for inputs, action in zip(inputs_by_step, actions, strict=True):
        decision = policy.decide(policy.pathways(inputs, memory), memory)
        logits.append(decision.logits)
        memory = decision.next_state(action)
    return logits


@pytest.mark.slow
@pytest.mark.parametrize(
    "method_name",
    [
        "org",
        *(pytest.param(f"support.methods:{name}", marks=pytest.mark.exhaustive) for name in ("ATTENTIVE", "ADAPTIVE")),
    ],
)
def test_reference_removal_leaves_the_network_without_experience_to_the_bit(method_name):
    """At s = 1, at every step of an episode: eq. 1 leaves a0, whose memory has never held experience."""
    spec = dataclasses.replace(DROPPING, method=find_method(method_name), method_sizes=())
    loop = dataclasses.replace(OWN_PAIR, spec=spec)
    params = tiny.random_params(6, spec)
    decider = loop.bind_decider(params)
    agent = loop.start(KEY, 8, decider.initial_memory((8,)), KNOWLEDGE, PARAMS)
    inputs_by_step, actions, factual_by_step, removed_by_step = [], [], [], []
    for step in range(4):
        memory = agent.memory
        assert memory is not None
        inputs = loop.policy_inputs(agent, KNOWLEDGE, PARAMS)
        pathways = decider.pathways(inputs, memory)
        decision = decider.decide(pathways, memory)
        counterfactual = decider.decide(do(pathways, scene=0.0, goal=0.0), memory.counterfactual_state())
        inputs_by_step.append(inputs)
        factual_by_step.append(decision.logits)
        removed_by_step.append(tde(decision.logits, counterfactual.logits))
        # Moves and turns alone, so that no episode ends.
        action = (jnp.arange(8) + step) % 3
        actions.append(action)
        agent, _ = loop.step(agent, action, KNOWLEDGE, PARAMS, policy=decider, decision=decision)

    policy = loop.bind(params)
    chex.assert_trees_all_equal(
        removed_by_step, [round_to_grid(logits) for logits in follow_alone(policy, inputs_by_step, actions, 0.0)]
    )
    chex.assert_trees_all_equal(
        factual_by_step, [round_to_grid(logits) for logits in follow_alone(policy, inputs_by_step, actions, 1.0)]
    )
    assert np.abs(removed_by_step[-1] - factual_by_step[-1]).max() > 0.05


@pytest.mark.slow
def test_half_of_the_reference_removal_lies_midway():
    """The form `paper` is a - s (a - a0): at s = 1/2 the mean of both logits."""
    decider = OWN_PAIR.bind_decider(AGENT)
    agent = OWN_PAIR.start(KEY, 8, decider.initial_memory((8,)), KNOWLEDGE, PARAMS)
    memory = agent.memory
    assert memory is not None
    pathways = decider.pathways(OWN_PAIR.policy_inputs(agent, KNOWLEDGE, PARAMS), memory)
    factual = decider.decide(pathways, memory).logits
    removed = decider.decide(do(pathways, scene=0.0, goal=0.0), memory).logits
    without_experience = tde(factual, removed)
    result = stde(factual, removed, jnp.full(8, 0.5), 0.0, "paper")
    np.testing.assert_allclose(result, (factual + without_experience) / 2, atol=1e-6)


@pytest.mark.exhaustive
def test_under_cde_episodes_are_those_of_the_network_without_experience():
    """Whole episodes: a policy whose experience columns are zero takes the same actions."""
    kernel = AGENT["fuse"]["kernel"]
    policy = AgentLoop(ENV, DROPPING).bind(AGENT)
    first_row = sum(policy.widths[:2])
    mute_kernel = kernel.at[first_row : first_row + policy.widths[2]].set(0.0)
    mute = AGENT | {"fuse": AGENT["fuse"] | {"kernel": mute_kernel}}
    cde_row = table_row("cde", None, None, "argmax")
    removed, plain = play(OWN_PAIR, AGENT, make_cells(cde_row), make_cells(LAYOUT_ROW))
    (muted,) = play(AgentLoop(ENV, DROPPING, tiny.ESTIMATOR), mute, make_cells(LAYOUT_ROW))
    alike(removed, muted)
    # Negative control: with experience the episodes differ.
    assert (np.asarray(plain.length) != np.asarray(removed.length)).any()


def test_own_fallback_replaces_the_counterfactual_memory():
    loop = dataclasses.replace(OWN_PAIR, spec=dataclasses.replace(DROPPING, counterfactual_memory="own"))
    memory = loop.bind_decider(AGENT).initial_memory((2,))
    assert memory.counterfactual_hidden is None
    assert memory.hidden.shape == (2, 2 * tiny.SIZES.hidden)


def test_policies_that_always_had_experience_have_no_own_fallback():
    with pytest.raises(InputError, match=r"cde: these policies had experience in every .* --ppo.experience below 1"):
        policies(tiny.SPEC, AGENT).with_own_fallback()
    for spec in (DROPPING, tiny.STREAMS):
        assert policies(spec, AGENT).with_own_fallback().use_own_fallback


def test_own_counterfactual_memory_needs_one_from_training():
    own = dataclasses.replace(tiny.SPEC, counterfactual_memory="own")
    with pytest.raises(InputError, match=r"--counterfactual-memory own: .* trained without a memory of its own; train"):
        policies(tiny.SPEC, AGENT).with_counterfactual_memory("own")
    assert policies(own, AGENT).with_counterfactual_memory("own").spec == own
    assert policies(own, AGENT).with_counterfactual_memory("factual").spec == tiny.SPEC
    assert policies(own, AGENT).with_counterfactual_memory(None).spec == own


def policies(spec, params):
    knowledge = Knowledge(KNOWLEDGE.layout)
    return Policies(params, ("layout",), knowledge, knowledge.layout, spec, None, 0, tiny.BANK.task)


def test_parameters_stand_side_by_side():
    one, other = (jax.tree.map(lambda leaf: leaf[None], tree) for tree in (AGENT, WITHOUT))
    pair = policies(tiny.SPEC, one).with_handover_to(policies(ANONYMOUS, other))
    assert pair.fallback_spec == ANONYMOUS
    assert pair.num_seeds == 1
    chex.assert_trees_all_equal(pair.params, {"agent": one, "without": other})


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
def test_what_cannot_be_handed_over_to_is_refused(changes, remedy):
    own = dataclasses.replace(tiny.SPEC, spatial_memory=SpatialMemory(8))
    other = dataclasses.replace(ANONYMOUS, **{"spatial_memory": own.spatial_memory} | changes)
    with pytest.raises(InputError, match=remedy):
        policies(own, AGENT).with_handover_to(policies(other, WITHOUT))


def test_a_hand_over_needs_equally_many_policies():
    one = jax.tree.map(lambda leaf: leaf[None], AGENT)
    two = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), WITHOUT)
    with pytest.raises(InputError, match="1 policies cannot hand over to 2; train both runs with equal arms and seeds"):
        policies(tiny.SPEC, one).with_handover_to(policies(ANONYMOUS, two))
