"""What the documentation shows is what happens."""

import doctest
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from support.commands import write_config

import jaxnav

DOCS = Path(__file__).parents[1] / "docs"


def test_the_numbers_of_the_concepts_are_computed():
    failed, tried = doctest.testfile(str(DOCS / "concepts.md"), module_relative=False)
    assert (failed, tried > 10) == (0, True)


def test_the_worked_divergences_are_those_of_the_text():
    """psi(n) = -gamma + 1 + 1/2 + ... + 1/(n - 1), so psi(3) - psi(9) = -(1/3 + ... + 1/8)."""
    mug = np.log(4) - sum(1 / n for n in range(3, 9))
    bed = np.log(2) - (1 / 3 + 1 / 4)
    text = (DOCS / "concepts.md").read_text()
    for value in (mug, bed, (mug + bed) / 2, np.tanh((mug + bed) / 2)):
        assert f"{value:.4f}" in text


@pytest.mark.slow
def test_the_code_of_use_runs(tmp_path, monkeypatch, capsys):
    """In a folder of its own, in the order of the page, with a run of a few updates."""
    monkeypatch.chdir(tmp_path)
    small = "jaxnav.runs.overlay.apply_yaml(jaxnav.RunConfig(run_dir=Path('runs/org')), Path('tiny.yaml'))"
    write_config(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "use.md").read_text(), re.DOTALL)
    assert len(blocks) == 3
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for block in blocks:
            code = re.sub(r"jaxnav\.RunConfig\(.*?\)(?=\))", small.replace("\\", "\\\\"), block, flags=re.DOTALL)
            exec(code.replace("import jaxnav\n", "import jaxnav\nimport jaxnav.runs.overlay\n"), {"__name__": "use"})
    assert "['detections', 'goal', 'heading', 'horizon', 'moved', 'view']" in capsys.readouterr().out
    assert jaxnav.Run.open("runs/org").config.seeds == 2
