"""The gap `surprise`: comparison with a count of object pairs in world coordinates, and export of its evidence."""

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
    near_log_odds = np.random.default_rng(0).normal(0.0, 0.3, shape)
    near_log_odds = np.triu(near_log_odds, 1).astype(np.float32)
    evidence = policies.knowledge.cooccurrence._replace(near_log_odds=near_log_odds)
    return policies._replace(knowledge=policies.knowledge._replace(cooccurrence=evidence))


def test_permuted_evidence_gives_equal_gaps_for_renamed_categories(policies):
    """Gaps stay as they are where the permutation renames the categories of the views and of the evidence."""
    permuted_policies = policies.with_permuted_evidence(3)
    permutation = np.random.default_rng(3).permutation(policies.spec.num_categories)
    assert (permutation != np.arange(len(permutation))).any()

    # Draw views of few pairs, so that no gap is 0 or 1.
    rng = np.random.default_rng(4)
    shape = (NUM_SIGHTING_RELATIONS, len(permutation), len(permutation))
    counts = rng.integers(1, 25, shape) * (rng.random(shape) < 0.01)
    counts = jnp.asarray(counts + counts.swapaxes(1, 2), jnp.uint8)
    renamed_counts = counts[:, permutation][:, :, permutation]

    evidence = policies.knowledge.cooccurrence
    permuted_evidence = permuted_policies.knowledge.cooccurrence
    for room in range(NUM_PRIORS):
        # The gap `surprise`; permuted evidence without renamed views gives another gap.
        gap = surprise_gap(counts, evidence.near_log_odds[room])
        permuted_gap = surprise_gap(renamed_counts, permuted_evidence.near_log_odds[room])
        np.testing.assert_allclose(permuted_gap, gap, rtol=1e-4)
        assert abs(surprise_gap(counts, permuted_evidence.near_log_odds[room]) - gap) > 1e-3

        # The gap `learned`, of the pairs that the first relation has counted.
        learned = learned_gap(counts[0] > 0, evidence.log_odds[room])
        renamed_learned = learned_gap(renamed_counts[0] > 0, permuted_evidence.log_odds[room])
        np.testing.assert_allclose(renamed_learned, learned, rtol=1e-4)
    np.testing.assert_array_equal(permuted_policies.knowledge.priors, policies.knowledge.priors)


def gaps_by_world_positions(poses, bank, centres, task, near_log_odds):
    """Return the gap after each pose, from the positions of all detections in world coordinates.

    In every view, a relation counts the pairs that have one category in view, and whose last known positions are within
    its distance. The last relation counts the pairs that have both categories in view.
    """
    rules = task.rules
    num_categories = len(task.categories)
    last_position = {}
    counts = np.zeros((NUM_SIGHTING_RELATIONS, num_categories, num_categories), int)
    gaps = []
    for pose in poses:
        # Positions of the detections of this view replace earlier ones.
        cell, heading, _ = rules.split_pose(pose)
        visible = np.flatnonzero(task.row_format.presence(bank.rows[pose]))
        detections = task.row_format.detections(bank.rows[pose])[visible]
        positions = detected_positions(detections, centres[cell], rules.heading_directions()[heading])
        last_position.update(zip(visible.tolist(), positions, strict=True))

        # Count each pair of a visible and a known category once.
        for first in visible.tolist():
            for second in last_position:
                if second in visible and second < first:
                    continue  # counted with the roles exchanged
                pair = min(first, second), max(first, second)
                distance = np.linalg.norm(last_position[first] - last_position[second])
                for relation, max_distance in enumerate(NEAR_DISTANCES):
                    if distance <= max_distance:
                        counts[relation, *pair] += 1
                if second in visible:
                    counts[-1, *pair] += 1

        # The gap is the sigmoid of the summed log odds of all features that have reached their thresholds.
        log_odds = 0.0
        for relation in range(NUM_SIGHTING_RELATIONS):
            for threshold_index, threshold in enumerate(NEAR_VIEW_COUNTS):
                feature = relation * len(NEAR_VIEW_COUNTS) + threshold_index
                log_odds += near_log_odds[feature][np.triu(counts[relation] >= threshold, 1)].sum()
        gaps.append(1 / (1 + np.exp(-log_odds)))
    return np.array(gaps)


@pytest.mark.slow
def test_surprise_of_played_episodes_matches_world_positions(drawn_run, policies):
    compiled_world = compile_evaluation_world(drawn_run.config, "val", None, None, Console(quiet=True))
    bank = compiled_world.banks[0]

    # Centres of the cells of all scenes, in the order of the bank.
    scenes = {}
    for index in range(len(compiled_world.scenes)):
        scene = compiled_world.scenes[index]
        scenes[scene.name] = scene
    centres_by_scene = [cell_centres(scenes[name], standable_cells(scenes[name].reach)) for name in bank.names]
    centres = np.concatenate(centres_by_scene)

    # The gaps of eight episodes follow from the positions.
    surprise_policies = policies.with_estimator("surprise")
    episodes = draw_episodes(bank, 8)
    row = table_row("stde", 0.5, "residual", "sample")
    traces = replay_episodes(surprise_policies, compiled_world, episodes, row)
    num_views = 0
    for trace, scene_index in zip(traces, episodes.scene, strict=True):
        room = compiled_world.make_env_params(0).room[scene_index]
        near_log_odds = policies.knowledge.cooccurrence.near_log_odds[room]
        expected = gaps_by_world_positions(trace.pose.tolist(), bank, centres, compiled_world.env.task, near_log_odds)
        # A pair at exactly 1, 2 or 4 m may be rounded to either side.
        np.testing.assert_allclose(trace.gap, expected, atol=2e-4)
        num_views += len(trace.pose)

    # The episodes are long enough, and their gaps vary.
    assert num_views > 20
    assert np.std(np.concatenate([trace.gap for trace in traces])) > 0.02


def test_evidence_of_sightings_is_exported(drawn_run, policies, tmp_path):
    policy_dir = tmp_path / "policy"
    params = jax.tree.map(lambda leaf: leaf[0], policies.arm_params("layout"))
    knowledge = policies.knowledge
    estimator_config = policies.estimator_config
    exploration = Exploration(policies.prior_counts, policies.prior_counts, jnp.int32(1), jnp.int32(1))
    export_policy(policy_dir, drawn_run.config, params, knowledge, estimator_config, exploration)

    _, loaded_policies = load_policy_as_run(policy_dir)
    loaded_evidence = loaded_policies.knowledge.cooccurrence
    assert loaded_evidence is not None
    np.testing.assert_array_equal(loaded_evidence.near_log_odds, knowledge.cooccurrence.near_log_odds)
    surprise_config = dataclasses.replace(estimator_config, gap="surprise")
    assert loaded_policies.with_estimator("surprise").estimator_config == surprise_config


def test_surprise_is_refused_without_evidence_of_sightings(drawn_run):
    with pytest.raises(InputError, match=r"--setting surprise: .*no evidence for this gap; train the run again"):
        drawn_run.policies().with_estimator("surprise")
