"""The examples run, and show what they say."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def output(name, tmp_path):
    """What an example prints, as a user runs it: elsewhere, with warnings as errors of its own code alone."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    result = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=250,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.slow
def test_the_packaged_policy_finds_what_it_looks_for(tmp_path):
    """Random actions find 8 %; the policy was measured at 90 % in other rooms, with up to 200 actions."""
    rates = [float(rate) for rate in re.findall(r": ([\d.]+) % of 256 episodes", output("packaged_policy", tmp_path))]
    assert len(rates) == 4
    assert min(rates) > 70


def test_the_estimator_takes_detections_of_ones_own(tmp_path):
    """What was never seen together moves the belief more than what was."""
    gaps = [float(gap) for gap in re.findall(r"gap ([\d.]+)", output("own_detections", tmp_path))]
    assert len(gaps) == 4
    assert gaps[3] > max(gaps[:2])


@pytest.mark.slow
def test_stable_baselines3_learns(tmp_path):
    pytest.importorskip("stable_baselines3")
    learned, random = (float(rate) for rate in re.findall(r": ([\d.]+) %", output("stable_baselines3_ppo", tmp_path)))
    assert learned > 3 * random
