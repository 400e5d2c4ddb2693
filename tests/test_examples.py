"""The examples run, and show what they say."""

import copy
import math
import os
import re
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
NOTEBOOK = Path(__file__).parents[1] / "docs" / "tutorials" / "story.ipynb"


def run_example(name, tmp_path, *options):
    """What an example prints, as a user runs it: elsewhere, with warnings as errors of its own code alone."""
    return run_script(EXAMPLES / f"{name}.py", tmp_path, *options)


def run_script(script, tmp_path, *options):
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    result = subprocess.run(
        [sys.executable, script, *options], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=250
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.exhaustive
def test_packaged_policy_example_finds_most_goals(tmp_path):
    """Random actions find 7 %; in the 1,000 episodes of `jaxnav episode` the policy finds 91 %, and 88 % at shift 1."""
    matches = re.findall(
        r"shift (\d), epsilon ([\d.]+): ([\d.]+) % of 256 episodes", run_example("packaged_policy", tmp_path)
    )
    assert [row[:2] for row in matches] == [(shift, f"{e:.2f}") for shift in "01" for e in (0, 0.25, 0.5, 1)]
    rates = [float(rate) for *_, rate in matches]
    assert min(rates[:4]) > 70
    assert min(rates) > 60
    assert statistics.mean(rates[4:]) < statistics.mean(rates[:4])  # by 2 points where this was written


@pytest.mark.slow
def test_drawn_room_example_reaches_the_goal(tmp_path):
    """The way on the page goes from the start to within 1.5 m, six marks, of the toaster; no way is shorter than L*."""
    printed = run_example("drawn_room", tmp_path)
    *page, outcome, actions = printed.splitlines()
    (lengths,) = re.findall(r"found after (\d+) actions; a shortest path takes (\d+)", outcome)
    num_actions, best_length = map(int, lengths)
    assert num_actions >= best_length > 1
    assert sum(map(int, re.findall(r"(\d+) x", actions))) == num_actions
    places = {mark: [] for mark in "@*o"}
    for row_index, line in enumerate(page):
        for column, mark in enumerate(line):
            if mark in places:
                places[mark].append((row_index, column))
    (goal,) = places["o"]
    assert len(places["@"]) == 1
    assert min(math.dist(goal, place) for place in places["*"] + places["@"]) <= 6


NUMBER = re.compile(r"\d+(?:\.\d+)?")


def printed_text(notebook):
    """What each code cell of a notebook prints, and how many figures it shows."""
    cell_outputs = []
    for cell in notebook.cells:
        if cell.cell_type == "code":
            text = "".join(output.text for output in cell.outputs if output.output_type == "stream")
            num_figures = sum("image/png" in output.get("data", {}) for output in cell.outputs)
            cell_outputs.append((text, num_figures))
    return cell_outputs


@pytest.mark.exhaustive
def test_notebook_prints_its_stored_outputs():
    """The words are equal, and the numbers up to what another CPU may change."""
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    stored = nbformat.read(NOTEBOOK, as_version=4)
    notebook = copy.deepcopy(stored)
    nbclient.NotebookClient(notebook, timeout=250, kernel_name="python3").execute()

    outputs = printed_text(notebook)
    stored_outputs = printed_text(stored)
    assert sum(num_figures for _, num_figures in stored_outputs) == 4
    for (text, num_figures), (stored_text, num_stored_figures) in zip(outputs, stored_outputs, strict=True):
        assert num_figures == num_stored_figures
        assert NUMBER.sub("#", text) == NUMBER.sub("#", stored_text)
        numbers = [float(number) for number in NUMBER.findall(text)]
        stored_numbers = [float(number) for number in NUMBER.findall(stored_text)]
        assert numbers == pytest.approx(stored_numbers, rel=0.05, abs=0.03)


def test_notebook_finds_the_kettle_only_in_the_training_layout():
    """The stored outputs show what the text says."""
    printed = "".join(text for text, _ in printed_text(pytest.importorskip("nbformat").read(NOTEBOOK, as_version=4)))
    gaps = [float(gap) for gap in re.findall(r"^\w+ and \w+ +gap ([\d.]+)", printed, re.MULTILINE)]
    assert gaps[-1] > 10 * max(gaps[:-1])  # a bed next to the fridge
    assert "training layout: found in" in printed
    assert "layout shifted: not found in" in printed
    rates = [float(rate) for rate in re.findall(r"epsilon [\d.]+: ([\d.]+) %", printed)]
    assert len(rates) == 8
    assert max(rates[4:]) < min(rates[:4])


@pytest.mark.slow
def test_own_detections_example_raises_the_gap_for_new_pairs(tmp_path):
    """What was never seen together moves the belief more than what was."""
    gaps = [float(gap) for gap in re.findall(r"gap ([\d.]+)", run_example("own_detections", tmp_path))]
    assert len(gaps) == 4
    assert gaps[3] > max(gaps[:2])


@pytest.mark.slow
def test_ppo_loop_example_learns(tmp_path):
    """After 200,000 steps the agent finds the goal several times as often as random actions, which find 7 %."""
    printed = run_example("ppo_loop", tmp_path, "--steps", "200000")
    shares = [float(share) for share in re.findall(r": (\d+) % of the episodes", printed)]
    assert shares[-1] > 3 * 7
    assert shares[-1] > shares[0]


@pytest.mark.exhaustive
def test_stable_baselines3_example_learns(tmp_path):
    pytest.importorskip("stable_baselines3")
    learned, random = (
        float(rate) for rate in re.findall(r": ([\d.]+) %", run_example("stable_baselines3_ppo", tmp_path))
    )
    assert learned > 3 * random
