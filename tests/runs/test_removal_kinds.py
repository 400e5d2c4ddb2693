"""Evaluations with both kinds of removal, and with both counterfactual memories."""

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
    """A run with experience dropout and a counterfactual memory of its own, with drawn policies."""
    config = tiny_config(tmp_path_factory.mktemp("dropping"), counterfactual_memory="own")
    return draw_run(dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, experience=0.8)))


@pytest.fixture(scope="module")
def results(run):
    return jaxnav.evaluate(run, epsilon=THRESHOLDS, episodes=NUM_EPISODES, removal=("tde", "cde"))


def outcome_of(results, variant, epsilon=None, decoding="argmax"):
    """Outcome of a row, leaves [S, E]."""
    for index, row in enumerate(results.rows):
        if (row.variant, row.epsilon, row.decoding) == (variant, epsilon, decoding):
            return jax.tree.map(lambda leaf, index=index: leaf[index], results.outcome)
    raise LookupError(variant)


@pytest.mark.exhaustive
def test_controlled_direct_effect_adds_rows_and_changes_no_other(run, results):
    plain = jaxnav.evaluate(run, epsilon=THRESHOLDS, episodes=NUM_EPISODES)
    assert [row for row in results.rows if row.variant not in ("cde", "scde")] == plain.rows
    for row in plain.rows:
        expected = outcome_of(plain, row.variant, row.epsilon, row.decoding)
        chex.assert_trees_all_equal(outcome_of(results, row.variant, row.epsilon, row.decoding), expected)
    assert (results.report["compilations"], plain.report["compilations"]) == (2, 1)


@pytest.mark.slow
def test_soft_controlled_direct_effect_removes_nothing_from_epsilon_one_on(results):
    # Soft removal interpolates linearly by default.
    assert {row.form for row in results.rows if row.variant == "scde"} == {"paper"}
    for decoding in ("argmax", "sample"):
        unchanged = outcome_of(results, "scde", 1.0, decoding)
        np.testing.assert_array_equal(unchanged.mean_weight, 0.0)
        # Logits are rounded to a grid, so that now and then another of two nearly equal actions is best.
        same_length = unchanged.length == outcome_of(results, "layout", None, decoding).length
        assert np.mean(same_length) > 0.9
        np.testing.assert_array_equal(outcome_of(results, "cde", None, decoding).mean_weight, 1.0)
    assert (outcome_of(results, "cde").length != outcome_of(results, "layout").length).any()


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
def test_cde_leaves_the_policy_without_experience_in_a_replay(run, results):
    compiled_world = compile_evaluation_world(run.config, "val", None, None, Console(quiet=True))
    policies = run.policies()
    row = next(row for row in results.rows if row.variant == "cde" and row.decoding == "argmax")
    episodes = results.episodes.take(np.arange(4))
    traces = replay_episodes(policies, compiled_world, episodes, row)
    expected_length = outcome_of(results, "cde").length[0, :4]
    np.testing.assert_array_equal([len(trace.action) for trace in traces], expected_length)


@pytest.mark.exhaustive
def test_counterfactual_memory_changes_only_rows_with_counterfactual_logits(run, results):
    factual = jaxnav.evaluate(run, epsilon=THRESHOLDS, episodes=NUM_EPISODES, counterfactual_memory="factual")
    own = jaxnav.evaluate(run, epsilon=THRESHOLDS, episodes=NUM_EPISODES, counterfactual_memory="own")
    assert factual.report["run"]["evaluation_counterfactual_memory"] == "factual"
    assert own.report["run"]["evaluation_counterfactual_memory"] == "own"
    for variant in ("baseline", "layout", "tde"):
        chex.assert_trees_all_equal(outcome_of(own, variant), outcome_of(results, variant))
    chex.assert_trees_all_equal(outcome_of(factual, "layout"), outcome_of(own, "layout"))
    assert (outcome_of(factual, "tde").length != outcome_of(own, "tde").length).any()


@pytest.mark.slow
def test_loaded_policy_carries_both_memories(run):
    policy = jaxnav.load_policy(run.config.run_dir / "policies" / "layout-0")
    compiled_world = compile_evaluation_world(run.config, "val", None, None, Console(quiet=True))
    env_params = compiled_world.make_env_params(0)
    _, state = compiled_world.env.reset(jax.random.key(0), env_params)
    observation = compiled_world.env.observe(state, env_params)
    decide = jax.jit(policy.decide)

    # The first counterfactual decision follows from two empty memories, the next one from two different ones.
    memory = policy.init()
    np.testing.assert_array_equal(memory.policy_state.use_experience, 1.0)
    output = decide(observation, memory, heading=0, moved=False)
    _, memory = policy.apply_choice(output, jnp.int32(0), memory.room)
    own_hidden = memory.policy_state.counterfactual_hidden
    assert own_hidden is not None
    assert np.abs(memory.policy_state.hidden - own_hidden).max() > 0.01
    own = decide(observation, memory, heading=0, moved=False)
    other_policy = policy.replace(spec=dataclasses.replace(policy.spec, counterfactual_memory="factual"))
    factual_state = memory.policy_state._replace(counterfactual_hidden=None)
    other = jax.jit(other_policy.decide)(
        observation, memory._replace(policy_state=factual_state), heading=0, moved=False
    )
    chex.assert_trees_all_equal(own.factual, other.factual)
    assert own.counterfactual is not None
    assert other.counterfactual is not None
    assert np.abs(own.counterfactual - other.counterfactual).max() > 1e-3


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--removal", "cde"), "cde: these policies had experience in every episode of training"),
        (
            ("--counterfactual-memory", "own"),
            "the counterfactual branch of these policies was trained",
        ),
    ],
)
def test_eval_refuses_removals_that_training_did_not_prepare(drawn_run, capsys, option, words):
    assert evaluate_command(drawn_run.config.run_dir, *option) == 2
    message = refusal(capsys)
    assert message.startswith("error: ")
    assert words in message
    assert "train a run with --" in message
    assert len(message.splitlines()) == 1


def test_evaluate_refuses_no_kind_of_removal(drawn_run):
    with pytest.raises(InputError, match="--removal: give tde, cde or both"):
        jaxnav.evaluate(drawn_run, removal=())
