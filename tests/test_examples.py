"""Tests of the examples and of the notebook: their code runs, and their output shows what their text claims."""

import copy
import itertools
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
    """Output of an example, run as a user runs it: in another folder and without a PYTHONPATH."""
    return run_script(EXAMPLES / f"{name}.py", tmp_path, *options)


def run_script(script, tmp_path, *options):
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, script, *options]
    completed = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=250)
    assert completed.returncode == 0, completed.stderr
    return completed.stdout


@pytest.mark.exhaustive
def test_packaged_policy_example_finds_most_goals(tmp_path):
    """Random actions find 7 %; in the 1,000 episodes of `jaxnav episode` the policy finds 91 %, and 88 % at shift 1."""
    # Four thresholds at each of two shifts.
    printed = run_example("packaged_policy", tmp_path)
    lines = re.findall(r"shift (\d), epsilon ([\d.]+): ([\d.]+) % of 256 episodes", printed)
    expected_settings = list(itertools.product("01", ("0.00", "0.25", "0.50", "1.00")))
    assert [(shift, epsilon) for shift, epsilon, _ in lines] == expected_settings

    # The shift costs some success, about 2 points.
    rates = [float(rate) for *_, rate in lines]
    assert min(rates[:4]) > 70
    assert min(rates) > 60
    assert statistics.mean(rates[4:]) < statistics.mean(rates[:4])


@pytest.mark.slow
def test_drawn_room_example_reaches_the_goal(tmp_path):
    """The drawn path leads from the start to within 1.5 m, six marks, of the toaster; no path is shorter than L*."""
    printed = run_example("drawn_room", tmp_path)
    *picture_lines, outcome_line, actions_line = printed.splitlines()

    # The numbers of actions by kind add up to the length of the path.
    (lengths,) = re.findall(r"found after (\d+) actions; a shortest path takes (\d+)", outcome_line)
    num_actions, best_length = map(int, lengths)
    assert num_actions >= best_length > 1
    assert sum(map(int, re.findall(r"(\d+) x", actions_line))) == num_actions

    # Places of the start (@), the path (*) and the goal (o) in the picture.
    places = {mark: [] for mark in "@*o"}
    for row, line in enumerate(picture_lines):
        for column, mark in enumerate(line):
            if mark in places:
                places[mark].append((row, column))
    (goal,) = places["o"]
    assert len(places["@"]) == 1
    assert min(math.dist(goal, place) for place in places["*"] + places["@"]) <= 6


NUMBER = re.compile(r"\d+(?:\.\d+)?")


def printed_text(notebook):
    """Text that each code cell of a notebook prints, and the number of figures that it shows."""
    cell_outputs = []
    for cell in notebook.cells:
        if cell.cell_type == "code":
            text = "".join(output.text for output in cell.outputs if output.output_type == "stream")
            num_figures = sum("image/png" in output.get("data", {}) for output in cell.outputs)
            cell_outputs.append((text, num_figures))
    return cell_outputs


@pytest.mark.exhaustive
def test_notebook_prints_its_stored_outputs():
    """The words are equal, and the numbers are close, since the last digits depend on the CPU."""
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    stored_notebook = nbformat.read(NOTEBOOK, as_version=4)
    notebook = copy.deepcopy(stored_notebook)
    nbclient.NotebookClient(notebook, timeout=250, kernel_name="python3").execute()

    outputs = printed_text(notebook)
    stored_outputs = printed_text(stored_notebook)
    assert sum(num_figures for _, num_figures in stored_outputs) == 4
    for (text, num_figures), (stored_text, num_stored_figures) in zip(outputs, stored_outputs, strict=True):
        assert num_figures == num_stored_figures
        assert NUMBER.sub("#", text) == NUMBER.sub("#", stored_text)
        numbers = [float(number) for number in NUMBER.findall(text)]
        stored_numbers = [float(number) for number in NUMBER.findall(stored_text)]
        assert numbers == pytest.approx(stored_numbers, rel=0.05, abs=0.03)


def test_notebook_finds_the_kettle_only_in_the_training_layout():
    """The stored outputs show what the text says."""
    nbformat = pytest.importorskip("nbformat")
    printed = "".join(text for text, _ in printed_text(nbformat.read(NOTEBOOK, as_version=4)))

    # The last pair, a bed next to the fridge, has by far the largest gap.
    gaps = [float(gap) for gap in re.findall(r"^\w+ and \w+ +gap ([\d.]+)", printed, re.MULTILINE)]
    assert gaps[-1] > 10 * max(gaps[:-1])

    # The policy finds the kettle only in the training layout, and the shift costs success at every threshold.
    assert "training layout: found in" in printed
    assert "layout shifted: not found in" in printed
    rates = [float(rate) for rate in re.findall(r"epsilon [\d.]+: ([\d.]+) %", printed)]
    assert len(rates) == 8
    assert max(rates[4:]) < min(rates[:4])


@pytest.mark.slow
def test_own_detections_example_raises_the_gap_for_new_pairs(tmp_path):
    """A pair of categories that was never seen together moves the belief more than a known pair."""
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
    printed = run_example("stable_baselines3_ppo", tmp_path)
    learned_rate, random_rate = map(float, re.findall(r": ([\d.]+) %", printed))
    assert learned_rate > 3 * random_rate
