"""`jaxnav.evaluate` and `jaxnav eval` for agents that are functions or objects of other code."""

import csv
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from support.commands import evaluate, refusal

import jaxnav
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.runs.subjects import PolicySubject, find_subject
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.worlds import make_generated_scenes

NUM_EPISODES = 16

AGENT_MODULE = """
import numpy as np

def always_done(observations):
    return np.full(len(observations["goal"]), 5)

def returns_logits(observations):
    return np.zeros((len(observations["goal"]), 6))
"""


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    """File of four rooms, one of each type."""
    path = tmp_path_factory.mktemp("agents") / "rooms.jsonl.gz"
    scenes = make_generated_scenes("rooms", "val", 4)
    write_scenes(path, [scenes[index] for index in range(4)])
    return path


@pytest.fixture(autouse=True)
def agent_module(tmp_path, monkeypatch):
    """Working directory with a module of agents, and with a module that exits when imported."""
    monkeypatch.chdir(tmp_path)
    Path("always.py").write_text(AGENT_MODULE)
    Path("ending.py").write_text("import sys\nsys.exit(0)\n")  # a script without a main guard


@pytest.fixture(scope="module")
def results(scene_file):
    """Results of an agent that chooses Done at every step."""

    def always_done(observations):
        return np.full(len(observations["goal"]), jaxnav.DONE)

    return jaxnav.evaluate(always_done, scenes=scene_file, episodes=NUM_EPISODES)


def test_agent_and_references_are_evaluated_on_equal_episodes(results, scene_file):
    assert [row.variant for row in results.rows] == ["agent", "random", "frontier", "oracle"]
    metrics = results.metrics()
    agent_success, random_success, frontier_success, oracle_success = metrics["sr"][:, 0]

    # Done at the start succeeds exactly where the shortest path has one action.
    scenes = make_generated_scenes("rooms", "val", 4)
    bank = compile_bank((scenes[index] for index in range(4)), jaxnav.Task())
    episodes = draw_episodes(bank, NUM_EPISODES)
    np.testing.assert_array_equal(results.episodes.best_length, episodes.best_length)
    np.testing.assert_array_equal(agent_success, episodes.best_length == 1)
    np.testing.assert_array_equal(metrics["wrong_done"][0, 0], 1 - agent_success)
    assert oracle_success.all()
    assert random_success.sum() < frontier_success.sum() <= oracle_success.sum()

    # Rows and differences of the report; one agent is no sample of training runs, so seeds have no deviation.
    report = results.report
    assert [row["method"] for row in report["rows"]] == ["always_done"] * 4
    assert report["rows"][0]["sr"]["mean"] == pytest.approx(100 * agent_success.mean())
    assert report["rows"][0]["sr"]["std"] is None
    compared_variants = {(difference["from"], difference["to"]) for difference in report["differences"]}
    assert compared_variants == {("random", "agent"), ("frontier", "agent")}


def test_list_of_agents_is_evaluated_as_training_seeds(scene_file):
    class ConstantAgent:
        def __init__(self, action):
            self.action = action

        def predict(self, observations):
            return np.full(len(observations["goal"]), self.action)

    agents = [ConstantAgent(jaxnav.DONE), ConstantAgent(jaxnav.ROTATE_LEFT)]
    results = jaxnav.evaluate(agents, scenes=scene_file, episodes=NUM_EPISODES)
    success = results.metrics()["sr"][0]
    assert success.shape == (2, NUM_EPISODES)
    assert success[1].sum() == 0
    assert results.report["rows"][0]["sr"]["seeds"] == pytest.approx(100 * success.mean(axis=1))
    assert results.report["rows"][0]["method"] == "ConstantAgent"


def test_eval_command_evaluates_an_agent_of_a_module(scene_file, capsys):
    options = ("--scenes", scene_file, "--episodes", NUM_EPISODES)
    assert evaluate("always:always_done", *options) == 0

    # The table names the agent, the references and their difference.
    printed = capsys.readouterr()
    row_labels = ("always_done", "Random", "Frontier search", "Shortest path (oracle)")
    for label in (*row_labels, "always_done vs. Frontier search"):
        assert label in printed.out
    assert "actions in" in printed.err

    # A report and a row for each episode, in the working directory.
    (report_file,) = Path().glob("eval-always-always_done-*.json")
    assert json.loads(report_file.read_text())["rows"][0]["variant"] == "agent"
    with Path(f"{report_file.name.removesuffix('.json')}.episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["length"] for row in rows if row["variant"] == "agent"] == ["1"] * NUM_EPISODES
    assert Path("latest-eval.txt").read_text().strip() == report_file.name


@pytest.mark.parametrize(
    ("subject", "message"),
    [
        ("always:alway_done", "always has no alway_done; did you mean always_done?"),
        ("ending:AGENT", "cannot be imported (SystemExit: 0); give package.module"),
        ("nowhere:AGENT", "cannot be imported (ModuleNotFoundError: No module named 'nowhere'); give package.module"),
        ("rooms-orgg", "did you mean 'rooms-org' or 'houses-org'?"),
        ("always:returns_logits", "returns_logits: it returned actions float64 [16, 6]; expected int [16], an index"),
    ],
)
def test_eval_command_refuses_unknown_subjects_and_wrong_agents(subject, message, scene_file, capsys):
    assert evaluate(subject, "--scenes", scene_file, "--episodes", NUM_EPISODES) == 2
    assert message in refusal(capsys)
    assert not list(Path().glob("eval*"))


def test_options_about_experience_are_refused_for_agents(capsys):
    assert evaluate("always:always_done", "--epsilon", 0.1) == 2
    assert "--epsilon: always_done is an agent whose experience jaxnav cannot remove" in refusal(capsys)
    with pytest.raises(jaxnav.InputError, match=r"^--inner-steps: "):
        jaxnav.evaluate(lambda observations: observations["goal"], inner_steps=1)


def test_policy_is_found_by_name_and_as_an_object():
    """One policy is evaluated as a run of one seed in the world of its training."""
    policy = jaxnav.load_policy("rooms-org")
    layouts = []
    for source in ("rooms-org", policy):
        subject = find_subject(source)
        assert isinstance(subject, PolicySubject)
        layouts.append(subject.policies.knowledge.priors)
        assert subject.config.world == "rooms"
        assert (subject.policies.arms, subject.policies.num_seeds) == (("layout",), 1)
    assert jnp.array_equal(*layouts)


@pytest.mark.exhaustive
def test_packaged_policy_is_evaluated_with_removal_of_experience(scene_file):
    results = jaxnav.evaluate("rooms-org", scenes=scene_file, episodes=NUM_EPISODES, costs="none")
    variants = [row.variant for row in results.rows]
    assert variants == [*["layout", "tde", "stde"] * 2, "random", "oracle"]
    # Intervals are over scenes, because one policy shows no spread between trainings.
    assert results.report["rows"][0]["sr"]["ci95"] is not None
    assert all(entry["share"]["ci95"] is not None for entry in results.report["decision_shares"])
    assert results.report["run"]["subject"] == "rooms-org"
    assert not any("training seed" in note for note in results.report["notes"])


def test_printed_results_show_the_table(results):
    printed = str(results)
    for name in ("SR", "SPL", "Random", "Frontier"):
        assert name in printed
    assert max(len(line) for line in printed.splitlines()) < 400
