"""Evaluations with TDE and CDE, the two kinds of removal, and with both counterfactual memories."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from support.commands import evaluate as evaluate_command
from support.commands import refusal
from support.tiny_run import draw_run, tiny_config

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.report import difference_label, row_label
from jaxnav.runs.evaluate import replay_episodes
from jaxnav.runs.worlds import compile_evaluation_world

NUM_EPISODES = 24
THRESHOLDS = (0.0, 1.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run of drawn policies with experience dropout and a separate counterfactual memory (`own`)."""
    config = tiny_config(tmp_path_factory.mktemp("dropout"), counterfactual_memory="own")
    return draw_run(dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, experience=0.8)))


@pytest.fixture(scope="module")
def results(run):
    return jaxnav.evaluate(run, epsilon=THRESHOLDS, episodes=NUM_EPISODES, removal=("tde", "cde"))


def select_outcome(results, variant, epsilon=None, decoding="argmax"):
    """Outcome of a row, leaves [S, E]."""
    row_keys = [(row.variant, row.epsilon, row.decoding) for row in results.rows]
    row_index = row_keys.index((variant, epsilon, decoding))
    return jax.tree.map(lambda leaf: leaf[row_index], results.outcome)


@pytest.mark.exhaustive
def test_controlled_direct_effect_adds_rows_and_changes_no_other_row(run, results):
    tde_results = jaxnav.evaluate(run, epsilon=THRESHOLDS, episodes=NUM_EPISODES)
    assert [row for row in results.rows if row.variant not in ("cde", "scde")] == tde_results.rows
    for row in tde_results.rows:
        expected = select_outcome(tde_results, row.variant, row.epsilon, row.decoding)
        chex.assert_trees_all_equal(select_outcome(results, row.variant, row.epsilon, row.decoding), expected)

    # Each kind of removal is compiled once.
    assert (results.report["compilations"], tde_results.report["compilations"]) == (2, 1)


@pytest.mark.slow
def test_soft_controlled_direct_effect_removes_nothing_from_epsilon_1_on(results):
    # Soft removal interpolates linearly by default.
    assert {row.form for row in results.rows if row.variant == "scde"} == {"paper"}
    for decoding in ("argmax", "sample"):
        no_removal = select_outcome(results, "scde", 1.0, decoding)
        np.testing.assert_array_equal(no_removal.mean_weight, 0.0)
        # Logits are rounded to a grid, so that now and then another of two nearly equal actions is best.
        has_equal_length = no_removal.length == select_outcome(results, "layout", None, decoding).length
        assert np.mean(has_equal_length) > 0.9
        np.testing.assert_array_equal(select_outcome(results, "cde", None, decoding).mean_weight, 1.0)
    assert (select_outcome(results, "cde").length != select_outcome(results, "layout").length).any()


@pytest.mark.slow
def test_rows_are_named_after_their_causal_quantity(results):
    labels = [row_label(row) for row in results.report["rows"] if row["decoding"] == "argmax"]
    assert labels[1:] == [
        "+ w (layout)",
        "+ w + TDE",
        "+ w + sTDE (eps=0)",
        "+ w + sTDE (eps=1)",
        "+ w + CDE",
        "+ w + sCDE (eps=0)",
        "+ w + sCDE (eps=1)",
        "Shortest path (oracle)",
    ]
    difference_labels = {difference_label(difference) for difference in results.report["differences"]}
    assert {"+ w + CDE vs. + w", "+ w + sCDE (eps=0) vs. + w", "+ w + TDE vs. + w"} <= difference_labels


@pytest.mark.slow
def test_replay_of_cde_acts_as_in_the_evaluation(run, results):
    compiled_world = compile_evaluation_world(run.config, "val", None, None, Console(quiet=True))
    policies = run.policies()
    cde_row = next(row for row in results.rows if row.variant == "cde" and row.decoding == "argmax")
    episodes = results.episodes.take(np.arange(4))
    traces = replay_episodes(policies, compiled_world, episodes, cde_row)
    expected_length = select_outcome(results, "cde").length[0, :4]
    np.testing.assert_array_equal([len(trace.action) for trace in traces], expected_length)


@pytest.mark.exhaustive
def test_counterfactual_memory_changes_only_rows_with_counterfactual_logits(run, results):
    factual_results = jaxnav.evaluate(run, epsilon=THRESHOLDS, episodes=NUM_EPISODES, counterfactual_memory="factual")
    own_results = jaxnav.evaluate(run, epsilon=THRESHOLDS, episodes=NUM_EPISODES, counterfactual_memory="own")
    assert factual_results.report["run"]["evaluation_counterfactual_memory"] == "factual"
    assert own_results.report["run"]["evaluation_counterfactual_memory"] == "own"

    # The run's own memory is the default.
    for variant in ("baseline", "layout", "tde"):
        chex.assert_trees_all_equal(select_outcome(own_results, variant), select_outcome(results, variant))

    # Rows of the layout have no counterfactual logits.
    chex.assert_trees_all_equal(select_outcome(factual_results, "layout"), select_outcome(own_results, "layout"))
    assert (select_outcome(factual_results, "tde").length != select_outcome(own_results, "tde").length).any()


@pytest.mark.slow
def test_loaded_policy_keeps_factual_and_counterfactual_memory(run):
    policy = jaxnav.load_policy(run.config.run_dir / "policies" / "layout-0")
    compiled_world = compile_evaluation_world(run.config, "val", None, None, Console(quiet=True))
    env_params = compiled_world.make_env_params(0)
    _, state = compiled_world.env.reset(jax.random.key(0), env_params)
    observation = compiled_world.env.observe(state, env_params)
    decide = jax.jit(policy.decide)

    # The first counterfactual decision follows from two empty memories, the next decision from two different ones.
    memory = policy.init()
    np.testing.assert_array_equal(memory.policy_state.use_experience, 1.0)
    first_output = decide(observation, memory, heading=0, moved=False)
    _, memory = policy.apply_choice(first_output, jnp.int32(0), memory.room)
    own_hidden = memory.policy_state.counterfactual_hidden
    assert own_hidden is not None
    assert np.abs(memory.policy_state.hidden - own_hidden).max() > 0.01
    own_output = decide(observation, memory, heading=0, moved=False)

    # The next decision of a policy whose counterfactual branch reads the factual memory.
    factual_policy = policy.replace(spec=dataclasses.replace(policy.spec, counterfactual_memory="factual"))
    factual_state = memory.policy_state._replace(counterfactual_hidden=None)
    factual_memory = memory._replace(policy_state=factual_state)
    factual_output = jax.jit(factual_policy.decide)(observation, factual_memory, heading=0, moved=False)

    # Only the counterfactual logits depend on the counterfactual memory.
    chex.assert_trees_all_equal(own_output.factual, factual_output.factual)
    assert own_output.counterfactual is not None
    assert factual_output.counterfactual is not None
    assert np.abs(own_output.counterfactual - factual_output.counterfactual).max() > 1e-3


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("--removal", "cde"), "cde: these policies had experience in every episode of training"),
        (("--counterfactual-memory", "own"), "the counterfactual branch of these policies was trained"),
    ],
)
def test_eval_refuses_removals_that_training_did_not_prepare(drawn_run, capsys, options, problem):
    assert evaluate_command(drawn_run.config.run_dir, *options) == 2
    message = refusal(capsys)
    assert message.startswith("error: ")
    assert problem in message
    assert "train a run with --" in message
    assert len(message.splitlines()) == 1


def test_evaluate_requires_a_kind_and_a_form_of_removal(drawn_run):
    with pytest.raises(InputError, match="--removal: give tde, cde or both"):
        jaxnav.evaluate(drawn_run, removal=())
    with pytest.raises(InputError, match="--form: give at least one form"):
        jaxnav.evaluate(drawn_run, form=())
