"""Notes beside a table: what limits it, and when nothing does."""

import numpy as np
import pytest
from support.study_results import episodes_in

from jaxnav.evaluation.notes import convergence_note, evaluation_notes
from jaxnav.evaluation.variants import EvaluationRow

BASELINE, LAYOUT = (EvaluationRow(variant, None, None, "argmax") for variant in ("baseline", "layout"))
RANDOM, ORACLE = EvaluationRow("random", None, None, "sample"), EvaluationRow("oracle", None, None, "argmax")
FEW_PLANS = "an interval needs at least 3"
ONE_SEED = "No interval for a single training seed"
PRIVILEGE = "are told the type of the room by their prior"
NO_BETTER = "is no better than Random"


def notes_of(rows=(BASELINE,), success=None, episodes=None, seeds=2, room_prior=False) -> list[str]:
    """Return the notes on rows, all alike unless `success` [R, S, E] is given."""
    episodes = episodes_in([0, 1, 2, 3]) if episodes is None else episodes
    success = np.ones((len(rows), seeds, len(episodes.scene))) if success is None else np.array(success, float)
    return evaluation_notes(rows, success, episodes, has_room_prior=room_prior)


def test_there_is_nothing_to_tell_of_a_good_table():
    assert notes_of() == []


@pytest.mark.parametrize(
    ("episodes", "plans"),
    [
        (episodes_in([0, 0, 0]), "1 floor plan;"),
        (episodes_in([0, 1, 1]), "2 floor plans;"),
        # Three scenes of two floor plans; three of three are enough.
        (episodes_in([0, 1, 2], names=("FloorPlan1", "FloorPlan2", "FloorPlan2-replaced-1")), "2 floor plans;"),
        (episodes_in([0, 1, 2], names=("FloorPlan1", "FloorPlan2", "FloorPlan3-replaced-1")), None),
        # Room types of one floor plan each are one stratum.
        (episodes_in([0, 1, 2], room=[0, 1, 1]), None),
    ],
)
def test_too_few_floor_plans(episodes, plans):
    assert notes_of(episodes=episodes) == ([] if plans is None else [f"No intervals: {plans} {FEW_PLANS}."])


@pytest.mark.parametrize("seeds", [1, 2, 3])
def test_a_single_training_seed(seeds):
    notes = notes_of(seeds=seeds)
    assert len(notes) == (seeds == 1)
    assert all(note.startswith(ONE_SEED) for note in notes)


@pytest.mark.parametrize(
    "row", [LAYOUT, EvaluationRow("tde", None, "paper", "argmax"), EvaluationRow("stde", 0.5, "paper", "sample")]
)
def test_the_privilege_of_the_prior(row):
    (note,) = notes_of((BASELINE, row), room_prior=True)
    assert PRIVILEGE in note
    # A pooled prior tells no room type; without rows of the layout there is no prior.
    assert notes_of((BASELINE, row)) == []
    assert notes_of((BASELINE, ORACLE), room_prior=True) == []


def test_policies_that_are_no_better_than_random_are_named():
    # Random succeeds in 1 of 4 scenes; so does the baseline, in another. The layout's weights succeed in all.
    random, baseline, layout = ([row] * 2 for row in ([1, 0, 0, 0], [0, 1, 0, 0], [1, 1, 1, 1]))
    notes = notes_of((BASELINE, LAYOUT, RANDOM), [baseline, layout, random])
    # The gain of the layout's weights: 0, 1, 1 and 1, a mean of 0.75 +- 3.18 x 0.25, which reaches 0 as well.
    assert notes == [f"{name} (argmax) {NO_BETTER}." for name in ("baseline", "layout")]
    # 0, 1, 1, 1, 1 and 1: 0.83 +- 2.57 x 0.17 does not.
    more = episodes_in(range(6))
    random, layout = ([row] * 2 for row in ([1, 0, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1]))
    (note,) = notes_of((BASELINE, LAYOUT, RANDOM), [random, layout, random], more)
    assert note.startswith(f"baseline (argmax) {NO_BETTER}")
    # Nothing is said where Random was not run, nor of the others.
    assert notes_of((BASELINE, LAYOUT), [random, layout], more) == []
    assert notes_of((ORACLE, EvaluationRow("tde", None, "paper", "argmax"), RANDOM), [random] * 3, more) == []


def test_where_there_is_no_interval_the_means_are_compared():
    few, rows = episodes_in([0, 0, 1]), (BASELINE, RANDOM)
    for success, expected in (([1, 0, 1], []), ([1, 0, 0], [NO_BETTER]), ([0, 0, 0], [NO_BETTER])):
        notes = notes_of(rows, [[success] * 2, [[0, 1, 0]] * 2], few)[1:]  # the first is that of too few floor plans
        assert len(notes) == len(expected)
        assert all(NO_BETTER in note for note in notes)


def test_a_gain_in_other_scenes_counts_even_if_training_runs_differ():
    # The interval is of these policies: runs at 40 and 100 % against 0 are both better in every scene.
    success = [[[0.4] * 4, [1.0] * 4], [[0.0] * 4] * 2]
    assert notes_of((BASELINE, RANDOM), success) == []


def test_the_last_quarter_of_training_is_told():
    rows = [{"env_steps": steps, "val_success": success} for steps, success in ((4, 0.2), (6, 0.5), (7, 0.6), (8, 0.7))]
    rows += [{"env_steps": 6, "val_success": 0.6}, {"env_steps": 8, "val_success": 0.8}, {"env_steps": 8}]
    expected = ["In the last quarter of training val success (best actions) went from 55.0 to 75.0 %."]
    assert convergence_note(rows) == expected  # 0.5 and 0.6 at three quarters, 0.7 and 0.8 at the end
    assert convergence_note(rows[:1]) == convergence_note([]) == []
