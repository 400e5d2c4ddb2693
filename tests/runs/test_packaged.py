"""Exported and packaged policies: the configuration of their task, and episodes that they play at layout shifts."""

import dataclasses
import io
import shutil

import numpy as np
import pytest
from rich.console import Console
from support.mutations import resigned

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.runs.config import WorldConfig
from jaxnav.runs.policies import (
    PACKAGED_POLICIES,
    POLICIES_DIR,
    config_for_policy,
    config_for_task,
    find_policy_folder,
    is_policy,
    list_packaged_policies,
    load_policy_as_run,
)
from jaxnav.runs.worlds import compile_evaluation_world
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.task import Detector, Rules
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes
from jaxnav.viz.episode import play_episode


def test_config_for_policy_names_the_world_of_its_task(drawn_run, tmp_path):
    assert config_for_policy("rooms-org").world == "rooms"
    baseline_config = config_for_policy(drawn_run.config.run_dir / POLICIES_DIR / "baseline-0")
    assert (baseline_config.world, baseline_config.arms) == ("rooms", ("baseline",))

    # No generated world has 12 headings.
    export_folder = shutil.copytree(PACKAGED_POLICIES / "rooms-org", tmp_path / "mine")
    with resigned(export_folder / "policy.json") as policy:
        policy["spec"]["task"]["rules"]["headings"] = 12
    with pytest.raises(InputError, match=r"no generated world has; give the run that it comes from$"):
        config_for_policy(export_folder)


@pytest.mark.slow
@pytest.mark.parametrize("name", list_packaged_policies())
def test_packaged_policies_act_in_the_world_of_their_name(name):
    world, _, method = name.partition("-")
    config, policies = load_policy_as_run(name)
    assert (config.world, config.method, policies.num_seeds) == (world, method, 1)
    assert config.task == policies.task == jaxnav.load_policy(name).task


def test_packaged_policies_are_small():
    num_bytes = sum(path.stat().st_size for path in PACKAGED_POLICIES.rglob("*") if path.is_file())
    assert num_bytes <= 4_000_000


def test_config_for_task_keeps_goals_and_detector():
    houses_task = WORLDS["houses"].task
    usual_config = config_for_task(houses_task, "org", "layout")
    assert usual_config is not None
    assert usual_config.worlds.goals is None

    # Goals and detector become settings of the world.
    task = dataclasses.replace(houses_task, goals=("Cup", "Book"), detector=Detector(false_alarm=0.25, seed=3))
    config = config_for_task(task, "org", "layout")
    assert config is not None
    assert (config.world, config.worlds.goals, config.detector) == ("houses", ("Cup", "Book"), task.detector)

    # No world has other rules.
    assert config_for_task(dataclasses.replace(task, rules=Rules(headings=6)), "org", "layout") is None


def test_packaged_policy_as_a_run_has_one_seed():
    config, policies = load_policy_as_run("rooms-org")
    assert (config.arms, policies.arms, policies.num_seeds) == (("layout",), ("layout",), 1)
    policy = jaxnav.load_policy("rooms-org")
    np.testing.assert_array_equal(policies.arm_params("layout")["actor"]["bias"][0], policy.params["actor"]["bias"])


def test_local_folder_precedes_a_packaged_policy_of_equal_name(tmp_path, monkeypatch):
    assert find_policy_folder("rooms-org") == PACKAGED_POLICIES / "rooms-org"
    assert is_policy("rooms-org")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rooms-org").mkdir()
    assert find_policy_folder("rooms-org").resolve() == (tmp_path / "rooms-org").resolve()
    assert not is_policy("rooms-org")


def list_whole_numbers(line):
    """Whole numbers among the words of a line, without its colons."""
    return [int(word) for word in line.replace(":", "").split() if word.isdigit()]


@pytest.mark.exhaustive
def test_shifted_episode_differs_only_in_its_layout(drawn_run):
    """Room, goal and start are equal at both shifts; L* and the observations are those of the shifted scene."""
    console = Console(record=True, width=120, file=io.StringIO())
    index = 5
    original, shifted = play_episode(drawn_run.config.run_dir, index=index, shifts=(0.0, 1.0), console=console)
    assert (original.shift, shifted.shift) == (0.0, 1.0)
    assert original.scene.name == shifted.scene.name
    assert original.scene.types != shifted.scene.types
    assert original.goal == shifted.goal
    assert original.trace.pose[0] == shifted.trace.pose[0]

    # Shortest paths and rows are those of the compiled scenes of each shift.
    banks = []
    for shift in (0.0, 1.0):
        compiled_world = compile_evaluation_world(drawn_run.config, "val", None, shift, Console(quiet=True))
        banks.append(compiled_world.banks[0])
    episodes = draw_episodes(banks[0])
    for played_episode, bank in zip((original, shifted), banks, strict=True):
        assert played_episode.best_length == bank.best_length[episodes.pose[index], episodes.goal[index]]
        np.testing.assert_array_equal(played_episode.rows, bank.rows[played_episode.trace.pose])

    # A line of the console holds shift, successes, number of episodes, and episodes that succeed only at this shift.
    # Successes at both shifts are equally many in the two lines.
    lines = [line for line in console.export_text().splitlines() if line.startswith("shift")]
    original_counts, shifted_counts = (list_whole_numbers(line) for line in lines)
    _, original_successes, num_episodes, original_only = original_counts
    _, shifted_successes, _, shifted_only = shifted_counts
    assert num_episodes <= len(episodes.goal)
    assert original_successes - original_only == shifted_successes - shifted_only

    # The shifted episode does not depend on the comparison.
    (single_episode,) = play_episode(drawn_run.config.run_dir, index=index, shifts=(1.0,))
    np.testing.assert_array_equal(single_episode.trace.action, shifted.trace.action)


def test_play_episode_refuses_unknown_variants_and_indexes(drawn_run):
    with pytest.raises(InputError, match="is a policy of the arm 'layout'; choose another --variant"):
        play_episode("rooms-org", variants=("baseline",))
    with pytest.raises(InputError, match="--index 1000: give a number from 0 to 999"):
        play_episode(drawn_run.config.run_dir, index=1000)


def test_policies_refuse_scenes_of_other_rules(tmp_path):
    scene_file = tmp_path / "scenes.jsonl.gz"
    write_scenes(scene_file, [make_generated_scenes("houses", "val", 1)[0]])
    _, policies = load_policy_as_run("houses-org")
    config = jaxnav.RunConfig(world="houses", worlds=WorldConfig(front_cell="nearest"))
    compiled_world = compile_evaluation_world(config, "val", scene_file, 0.0, Console(quiet=True))
    with pytest.raises(InputError, match=r"other rules .* front_cell: 'move' != 'nearest'; .* --worlds.front-cell"):
        policies.make_agent_loop(compiled_world)
