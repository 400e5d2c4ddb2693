"""The study's trials: their cells, their episodes against each other bit for bit, and the rows that tell of them."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxnav.evaluation.episodes import episode_list
from jaxnav.evaluation.grid import Outcome, evaluate_grid
from jaxnav.evaluation.inference import Branch
from jaxnav.evaluation.trials import CONTROLS, Results, Trial, mean_weight, trial_grid
from jaxnav.policies.acting import Acting

SEEDS, EPISODES = 2, 32
FORMS, DECODINGS = ("residual", "paper"), ("argmax", "sample")
OTHERS = tuple(control for control in CONTROLS if control != "constant")
#: For both decodings: + w, hard TDE, sTDE and its controls where everything and where nothing is taken out.
PLAIN = [Trial(variant, decoding) for decoding in DECODINGS for variant in ("baseline", "layout", "tde")]
SWEEP = [
    Trial("stde", decoding, epsilon, form, control)
    for decoding in DECODINGS
    for epsilon, form in ((0.0, "paper"), (0.0, "residual"), (1.0, "residual"))
    for control in (None, *OTHERS)
]
WEIGHTS = (0.3, 1.0)
CONSTANT = [Trial("stde", "argmax", 0.0, "paper", "constant", weight) for weight in WEIGHTS]
TRIALS = [*PLAIN, *SWEEP, *CONSTANT]


@pytest.fixture(scope="module")
def outcome():
    """All trials [T, S, E]."""
    env, params = tiny.world()
    params = params.replace(step_limit=jnp.array((12, 16), jnp.int32))
    weights = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(tiny.lively(seed) for seed in (5, 9, 6, 11)))
    parts = [(episode_list(tiny.BANK, EPISODES, seed=1), params)]
    priors = 0.05 * tiny.priors()  # a belief that gives way at once: large gaps
    acting, key = Acting(env, tiny.SETTING), jax.random.key(3)
    found, _ = evaluate_grid(trial_grid(TRIALS, SEEDS), weights, parts, acting, tiny.SPEC, priors, key)
    return jax.tree.map(lambda leaf: leaf.reshape(len(TRIALS), SEEDS, -1), found)


def pick(outcome, *trial):
    return tiny.at(outcome, TRIALS.index(Trial(*trial)))


# Cells


def test_cells_are_those_of_stde_but_for_what_the_control_changes():
    plain = Trial("stde", "sample", 0.5, "residual").cells(SEEDS)
    changed = {
        "constant": {"always": np.float32(0.3), "epsilon": np.float32(np.inf)},
        "shuffled": {"shuffled": True},
        "zeros": {"branch": Branch.ZEROS},
        "noise": {"branch": Branch.NOISE},
        "random": {"noise": 1.0},
    }
    assert set(changed) == set(CONTROLS)
    for control, expected in changed.items():
        cells = Trial("stde", "sample", 0.5, "residual", control, 0.3).cells(SEEDS)
        chex.assert_trees_all_equal_shapes_and_dtypes(cells, plain)
        for name in vars(plain):
            wanted = np.broadcast_to(expected.get(name, getattr(plain, name)), (SEEDS,))
            np.testing.assert_array_equal(getattr(cells, name), wanted, err_msg=f"{control}: {name}")


def test_the_grid_holds_the_seeds_of_one_trial_after_the_other():
    grid = trial_grid(TRIALS, SEEDS)
    assert {leaf.shape for leaf in jax.tree.leaves(grid)} == {(len(TRIALS) * SEEDS,)}
    for i in (0, 1, 10, len(TRIALS) - 1):
        own = jax.tree.map(lambda leaf, i=i: leaf[SEEDS * i : SEEDS * (i + 1)], grid)
        chex.assert_trees_all_equal(own, TRIALS[i].cells(SEEDS))


# Episodes


@pytest.mark.parametrize("control", [None, *OTHERS])
@pytest.mark.parametrize("decoding", DECODINGS)
def test_at_epsilon_one_every_control_is_plus_w_bit_for_bit(outcome, decoding, control):
    layout = pick(outcome, "layout", decoding)
    chex.assert_trees_all_equal(pick(outcome, "stde", decoding, 1.0, "residual", control), layout)
    # At epsilon 0 each takes something out.
    assert (pick(outcome, "stde", decoding, 0.0, "residual", control).weight > 0.1).any()


def changes(outcome, *trial):
    """Whether a trial's episodes, but for their weights, differ from those of + w."""
    own, layout = (found._replace(weight=0) for found in (pick(outcome, *trial), pick(outcome, "layout", trial[1])))
    return any(not np.array_equal(a, b) for a, b in zip(own, layout, strict=True))


@pytest.mark.parametrize("form", FORMS)
def test_zeros_change_no_best_action_and_every_other_control_does(outcome, form):
    assert not changes(outcome, "stde", "argmax", 0.0, form, "zeros")
    for control in (None, "shuffled", "noise", "random"):
        assert changes(outcome, "stde", "argmax", 0.0, form, control), control
    # Sampled, they act as a temperature in the residual form alone.
    assert changes(outcome, "stde", "sample", 0.0, form, "zeros") == (form == "residual")


def test_a_shuffled_weight_is_another(outcome):
    own, shuffled = (pick(outcome, "stde", "argmax", 0.0, "paper", control) for control in (None, "shuffled"))
    assert not np.array_equal(own.weight, shuffled.weight)


def test_a_constant_weight_is_the_weight_of_every_step(outcome):
    for weight in WEIGHTS:
        found = pick(outcome, "stde", "argmax", 0.0, "paper", "constant", weight)
        np.testing.assert_allclose(found.weight, weight, rtol=1e-6)
    # Of 1, in the paper's form: hard TDE.
    chex.assert_trees_all_equal(found, pick(outcome, "tde", "argmax"))


# Rows

#: Four episodes of two seeds; L* = 2, so that success after 4 actions has SPL 0.5.
FEW = [
    Trial("baseline", "sample"),
    Trial("layout", "sample"),
    Trial("stde", "sample", 0.5, "residual"),
    Trial("layout", "argmax"),
]
SUCCESS = [
    [[0, 0, 1, 1], [0, 1, 0, 1]],  # 50 %
    [[1, 0, 1, 1], [1, 1, 1, 1]],  # 75 % and 100 %
    [[1, 1, 1, 1], [1, 1, 1, 0]],  # 100 % and 75 %
    [[0, 0, 0, 0], [0, 0, 0, 1]],  # 0 % and 25 %
]
LENGTH = np.array([[2, 4, 4, 10], [2, 4, 4, 10]])
WEIGHT = np.array([[0.5, 0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 0.0]], np.float32)


def few(success):
    """An outcome [S, E]."""
    return Outcome(np.array(success, bool), LENGTH, np.ones((2, 4), int), np.full((2, 4), 2.5), WEIGHT)


@pytest.fixture(scope="module")
def small():
    outcomes = {trial: few(success) for trial, success in zip(FEW, SUCCESS, strict=True)}
    return Results(outcomes, np.full(4, 2), np.array([0, 0, 1, 1]))


def test_the_mean_weight_is_over_steps():
    # 0.5 in 2 steps and 0.1 in 10, of 2 x 20 steps: (1 + 1) / 40. Over episodes it would be 0.6 / 8.
    assert mean_weight(few(SUCCESS[2])) == pytest.approx(0.05)


def test_success_of_a_trial(small):
    np.testing.assert_array_equal(small.success(FEW[1]), SUCCESS[1])


def test_rows_tell_metrics_and_differences(small):
    baseline, layout, stde, other = small.rows(seed=0)
    about = {"variant": "stde", "decoding": "sample", "epsilon": 0.5, "form": "residual", "control": None}
    assert stde.items() >= about.items()
    assert stde["mean_weight"] == pytest.approx(0.05)
    assert layout["sr"]["mean"] == 87.5
    assert layout["sr"]["seeds"] == [75.0, 100.0]
    # Each of 2 / length where found: (1 + 1/2 + 1/5) / 4 and (1 + 1/2 + 1/2 + 1/5) / 4.
    assert layout["spl"]["seeds"] == pytest.approx([42.5, 55.0])
    assert layout["dts"]["mean"] == 1.5  # 2.5 m less the radius
    # + w is compared with the baseline, trained apart; sTDE with + w, seed by seed.
    assert "difference" not in baseline
    assert layout["difference"]["to"] == "baseline"
    assert layout["difference"]["sr"]["mean"] == 37.5
    assert stde["difference"]["to"] == "layout"
    assert stde["difference"]["sr"]["mean"] == 0.0
    # Differences of seeds: +25 and -25.
    assert stde["difference"]["sr"]["std"] == pytest.approx(25 * 2**0.5)
    # Apart: the baseline's seeds do not differ, the layout's by 25.
    assert layout["difference"]["sr"]["std"] == pytest.approx(25 / 2**0.5)
    # Best actions have no baseline to be compared with here.
    assert "difference" not in other


def test_equal_results_have_equal_intervals(small):
    assert small.rows(seed=0) == small.rows(seed=0)
    same = Results({trial: few(SUCCESS[1]) for trial in FEW[1:3]}, np.full(4, 2), np.array([0, 0, 1, 1]))
    layout, stde = same.rows(seed=0)
    assert stde["sr"] == layout["sr"]
    assert stde["difference"]["sr"] == {"mean": 0.0, "std": 0.0, "ci95": (0.0, 0.0)}
