"""Notes below a table describe the limits of its results, and a table without limits has no notes."""

import numpy as np
import pytest
from support.episodes import episodes_in

from jaxnav.evaluation.notes import convergence_note, decision_share_notes, evaluation_notes
from jaxnav.evaluation.variants import EvaluationRow

BASELINE = EvaluationRow("baseline", None, None, "argmax")
LAYOUT = EvaluationRow("layout", None, None, "argmax")
TDE = EvaluationRow("tde", None, "paper", "argmax")
RANDOM = EvaluationRow("random", None, None, "sample")
ORACLE = EvaluationRow("oracle", None, None, "argmax")


def make_notes(
    rows=(BASELINE,), success=None, episodes=None, seeds=2, room_prior=False, has_experience=True
) -> list[str]:
    """Return the notes on rows, which always succeed unless `success` [R, S, E] is given."""
    if episodes is None:
        episodes = episodes_in([0, 1, 2, 3])
    if success is None:
        success = np.ones((len(rows), seeds, len(episodes.scene)))
    success = np.array(success, float)
    return evaluation_notes(rows, success, episodes, has_room_prior=room_prior, has_experience=has_experience)


def test_good_table_has_no_notes():
    assert make_notes() == []


@pytest.mark.parametrize(
    ("episodes", "floor_plans"),
    [
        (episodes_in([0, 0, 0]), "1 floor plan"),
        (episodes_in([0, 1, 1]), "2 floor plans"),
        # Three scenes of two floor plans are noted; three scenes of three floor plans suffice.
        (episodes_in([0, 1, 2], names=("FloorPlan1", "FloorPlan2", "FloorPlan2-replaced-1")), "2 floor plans"),
        (episodes_in([0, 1, 2], names=("FloorPlan1", "FloorPlan2", "FloorPlan3-replaced-1")), None),
        # Room types with one floor plan each form one stratum.
        (episodes_in([0, 1, 2], room=[0, 1, 1]), None),
    ],
)
def test_too_few_floor_plans_are_noted(episodes, floor_plans):
    notes = make_notes(episodes=episodes)
    assert len(notes) == (floor_plans is not None)
    assert all(floor_plans in note for note in notes)


@pytest.mark.parametrize("seeds", [1, 2, 3])
def test_single_training_seed_is_noted(seeds):
    notes = make_notes(seeds=seeds)
    assert len(notes) == (seeds == 1)
    assert all("seed" in note for note in notes)


@pytest.mark.parametrize("row", [LAYOUT, TDE, EvaluationRow("stde", 0.5, "paper", "sample")])
def test_prior_by_room_type_is_noted(row):
    (note,) = make_notes((BASELINE, row), room_prior=True)
    assert "prior" in note
    # With one prior for all room types, or without rows with layout weights, no row receives the room type.
    assert make_notes((BASELINE, row)) == []
    assert make_notes((BASELINE, ORACLE), room_prior=True) == []


def test_rows_whose_layout_weights_have_no_effect_are_named_a_a_rows():
    (note,) = make_notes((BASELINE, LAYOUT), has_experience=False)
    assert note.startswith("A/A row")
    assert "noise between trainings" in note
    assert make_notes((BASELINE, LAYOUT)) == []
    assert make_notes((BASELINE, ORACLE), has_experience=False) == []


def test_policies_no_better_than_random_are_named():
    # Random succeeds in 1 of 4 scenes, the baseline in 1 other scene, and the layout row in all scenes; two seeds each.
    baseline_success = [[0, 1, 0, 0]] * 2
    layout_success = [[1, 1, 1, 1]] * 2
    random_success = [[1, 0, 0, 0]] * 2
    notes = make_notes((BASELINE, LAYOUT, RANDOM), [baseline_success, layout_success, random_success])
    # The gains of the layout row are 0, 1, 1 and 1, with a mean of 0.75 +- 3.18 x 0.25, so the interval contains 0.
    for name, note in zip(("baseline", "layout"), notes, strict=True):
        assert name in note
        assert "Random" in note

    # With six scenes the gains 0, 1, 1, 1, 1 and 1 have a mean of 0.83 +- 2.57 x 0.17, which excludes 0.
    six_episodes = episodes_in(range(6))
    layout_success = [[1, 1, 1, 1, 1, 1]] * 2
    random_success = [[1, 0, 0, 0, 0, 0]] * 2
    (note,) = make_notes((BASELINE, LAYOUT, RANDOM), [random_success, layout_success, random_success], six_episodes)
    assert "baseline" in note

    # Without Random there is no note, and oracle and TDE are not compared with Random.
    assert make_notes((BASELINE, LAYOUT), [random_success, layout_success], six_episodes) == []
    assert make_notes((ORACLE, TDE, RANDOM), [random_success] * 3, six_episodes) == []


def test_means_are_compared_with_random_without_intervals():
    two_floor_plans = episodes_in([0, 0, 1])
    for success, is_noted in (([1, 0, 1], False), ([1, 0, 0], True), ([0, 0, 0], True)):
        notes = make_notes((BASELINE, RANDOM), [[success] * 2, [[0, 1, 0]] * 2], two_floor_plans)
        chance_notes = notes[1:]  # after the note about too few floor plans
        assert len(chance_notes) == is_noted
        assert all("Random" in note for note in chance_notes)


def test_gain_in_every_scene_counts_even_if_runs_differ():
    # The interval is over scenes for these policies: runs at 40 % and 100 % both exceed 0 % in every scene.
    success = [[[0.4] * 4, [1.0] * 4], [[0.0] * 4] * 2]
    assert make_notes((BASELINE, RANDOM), success) == []


def test_convergence_note_gives_success_of_the_last_quarter():
    log_rows = []
    for env_steps, success in ((4, 0.2), (6, 0.5), (7, 0.6), (8, 0.7), (6, 0.6), (8, 0.8)):
        log_rows.append({"env_steps": env_steps, "val_success": success})
    log_rows.append({"env_steps": 8})
    (note,) = convergence_note(log_rows)
    assert "from 55.0 to 75.0 %" in note  # 0.5 and 0.6 at three quarters, 0.7 and 0.8 at the end
    assert convergence_note(log_rows[:1]) == convergence_note([]) == []


@pytest.mark.parametrize(
    ("share", "bounds", "has_note"),
    [
        (12.0, [0.5, 3.0], False),
        (12.0, [-0.5, 3.0], True),
        (4.9, [0.5, 3.0], True),
        # Without an interval of the cost, only the share decides.
        (12.0, None, False),
        (4.9, None, True),
        (None, None, False),
    ],
)
def test_rows_that_hardly_use_other_categories_are_noted(share, bounds, has_note):
    def make_entry(part, share):
        return {
            "variant": "layout",
            "decoding": "argmax",
            "part": part,
            "share": {"mean": share, "ci95": None},
            "cost": {"spl": {"mean": 1.7, "ci95": bounds}},
        }

    # Shares of other parts have no note.
    notes = decision_share_notes([make_entry("other_categories", share), make_entry("memory", 0.0)])
    assert len(notes) == has_note
    if has_note:
        assert notes[0].startswith(f"layout (argmax): {share} % of the decisions")
        assert ("costs 1.7 [" in notes[0]) == (bounds is not None)
