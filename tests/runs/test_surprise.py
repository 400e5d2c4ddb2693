"""The gap `surprise` of played episodes, against a count in world coordinates, and its export."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.variants import table_row
from jaxnav.gaps import (
    NEAR_DISTANCES,
    NEAR_VIEW_COUNTS,
    NUM_NEAR_FEATURES,
    NUM_SIGHTING_RELATIONS,
    learned_gap,
    surprise_gap,
)
from jaxnav.runs.evaluate import replay_episodes
from jaxnav.runs.policies import export_policy, load_policy_as_run
from jaxnav.runs.worlds import compile_evaluation_world
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.observation_row import detected_positions
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.training.calibration import Exploration


@pytest.fixture(scope="module")
def policies(drawn_run):
    """Policies whose evidence of sightings is drawn at random, above the diagonal."""
    policies = drawn_run.policies()
    num_categories = policies.spec.num_categories
    shape = (NUM_PRIORS, NUM_NEAR_FEATURES, num_categories, num_categories)
    near_log_odds = np.triu(np.random.default_rng(0).normal(0.0, 0.3, shape), 1).astype(np.float32)
    evidence = policies.knowledge.cooccurrence._replace(near_log_odds=near_log_odds)
    return policies._replace(knowledge=policies.knowledge._replace(cooccurrence=evidence))


def test_permuted_evidence_reads_renamed_categories_as_before(policies):
    """Views of a layout whose categories are renamed by the permutation have the former gaps."""
    permuted = policies.with_permuted_evidence(3)
    permutation = np.random.default_rng(3).permutation(policies.spec.num_categories)
    assert (permutation != np.arange(len(permutation))).any()
    # Views of few pairs, so that no gap is 0 or 1.
    rng = np.random.default_rng(4)
    shape = (NUM_SIGHTING_RELATIONS, len(permutation), len(permutation))
    counts = rng.integers(1, 25, shape) * (rng.random(shape) < 0.01)
    counts = jnp.asarray(counts + counts.swapaxes(1, 2), jnp.uint8)
    renamed_counts = counts[:, permutation][:, :, permutation]

    for room in range(NUM_PRIORS):
        evidence, permuted_evidence = (p.knowledge.cooccurrence for p in (policies, permuted))
        gap = surprise_gap(counts, evidence.near_log_odds[room])
        permuted_gap = surprise_gap(renamed_counts, permuted_evidence.near_log_odds[room])
        np.testing.assert_allclose(permuted_gap, gap, rtol=1e-4)
        assert abs(surprise_gap(counts, permuted_evidence.near_log_odds[room]) - gap) > 1e-3

        learned = learned_gap(counts[0] > 0, evidence.log_odds[room])
        renamed = learned_gap(renamed_counts[0] > 0, permuted_evidence.log_odds[room])
        np.testing.assert_allclose(renamed, learned, rtol=1e-4)
    np.testing.assert_array_equal(permuted.knowledge.layout, policies.knowledge.layout)


def count_in_the_world(poses, bank, centres, task, near_log_odds):
    """Return the gap after each pose, with the places of all detections in world coordinates.

    Pairs are counted view by view: both known, one of the two in view, and at most so far apart; or both in view.
    """
    rules = task.rules
    num_categories = len(task.categories)
    last_place = {}
    counts = np.zeros((NUM_SIGHTING_RELATIONS, num_categories, num_categories), int)
    gaps = []
    for pose in poses:
        cell, heading, _ = rules.split_pose(pose)
        visible = np.flatnonzero(task.row_format.presence(bank.rows[pose]))
        detections = task.row_format.detections(bank.rows[pose])[visible]
        places = detected_positions(detections, centres[cell], rules.heading_directions()[heading])
        last_place.update(zip(visible.tolist(), places, strict=True))
        for first in visible.tolist():
            for second in last_place:
                if second in visible and second < first:
                    continue  # counted with the roles exchanged
                pair = min(first, second), max(first, second)
                distance = np.linalg.norm(last_place[first] - last_place[second])
                for index, limit in enumerate(NEAR_DISTANCES):
                    if distance <= limit:
                        counts[index, *pair] += 1
                if second in visible:
                    counts[-1, *pair] += 1

        log_odds = 0.0
        for index in range(NUM_SIGHTING_RELATIONS):
            for threshold_index, threshold in enumerate(NEAR_VIEW_COUNTS):
                feature = index * len(NEAR_VIEW_COUNTS) + threshold_index
                log_odds += near_log_odds[feature][np.triu(counts[index] >= threshold, 1)].sum()
        gaps.append(1 / (1 + np.exp(-log_odds)))
    return np.array(gaps)


@pytest.mark.slow
def test_surprise_of_played_episodes_is_that_of_the_world(drawn_run, policies):
    compiled_world = compile_evaluation_world(drawn_run.config, "val", None, None, Console(quiet=True))
    bank = compiled_world.banks[0]
    scenes = {
        compiled_world.scenes[index].name: compiled_world.scenes[index] for index in range(len(compiled_world.scenes))
    }
    all_centres = [cell_centres(scenes[name], standable_cells(scenes[name].reach)) for name in bank.names]
    centres = np.concatenate(all_centres)

    surprised = policies.with_estimator("surprise")
    episodes = draw_episodes(bank, 8)
    traces = replay_episodes(surprised, compiled_world, episodes, table_row("stde", 0.5, "residual", "sample"))
    num_views = 0
    for trace, scene in zip(traces, episodes.scene, strict=True):
        room = compiled_world.make_env_params(0).room[scene]
        near_log_odds = policies.knowledge.cooccurrence.near_log_odds[room]
        expected = count_in_the_world(trace.pose.tolist(), bank, centres, compiled_world.env.task, near_log_odds)
        # A pair at exactly 1, 2 or 4 m may be rounded to either side.
        np.testing.assert_allclose(trace.gap, expected, atol=2e-4)
        num_views += len(trace.pose)
    assert num_views > 20
    assert np.std(np.concatenate([trace.gap for trace in traces])) > 0.02


def test_evidence_of_sightings_is_exported(drawn_run, policies, tmp_path):
    config = drawn_run.config
    explored = Exploration(policies.prior_counts, policies.prior_counts, jnp.int32(1), jnp.int32(1))
    export_policy(
        tmp_path / "policy",
        config,
        jax.tree.map(lambda leaf: leaf[0], policies.arm_params("layout")),
        policies.knowledge,
        policies.estimator_config,
        explored,
    )
    _, loaded = load_policy_as_run(tmp_path / "policy")
    assert loaded.knowledge.cooccurrence is not None
    np.testing.assert_array_equal(
        loaded.knowledge.cooccurrence.near_log_odds, policies.knowledge.cooccurrence.near_log_odds
    )
    expected = dataclasses.replace(policies.estimator_config, gap="surprise")
    assert loaded.with_estimator("surprise").estimator_config == expected


def test_surprise_is_refused_without_evidence_of_sightings(drawn_run):
    with pytest.raises(InputError, match=r"--setting surprise: .*no evidence for this gap; train the run again"):
        drawn_run.policies().with_estimator("surprise")
