"""What a newcomer meets first: the package's names, the commands, and the examples of the README."""

import dataclasses
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from support import tiny_world as tiny

import jaxnav
from jaxnav.__main__ import main
from jaxnav.env.types import Observation
from jaxnav.policies import methods
from jaxnav.policies.policy import bind, init_params

ROOT = Path(__file__).parent.parent
EXAMPLE, METHOD = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)


def test_importing_jaxnav_is_light():
    heavy = ("orbax", "tyro", "matplotlib", "PIL", "optax", "flax.nnx", "jaxnav.cli", "jaxnav.training")
    script = f"import sys, jaxnav; print([name for name in {heavy} if name in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", script], cwd=ROOT, text=True) == "[]\n"


def test_the_version_is_that_of_the_project():
    assert jaxnav.__version__ == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"version: {jaxnav.__version__}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.parametrize(("wrong", "mend"), [("epsiode", "did you mean 'episode'?"), ("zzz", "train, eval, episode")])
def test_unknown_commands_are_refused_with_a_hint(wrong, mend, capsys):
    assert main([wrong]) == 2
    assert mend in capsys.readouterr().err


def test_commands_get_the_other_arguments(tmp_path, capsys):
    assert main([]) == 0
    assert "episode" in capsys.readouterr().out
    for command in ("eval", "episode"):
        assert main([command, str(tmp_path / "nowhere")]) == 2
        assert "nowhere: holds no run" in re.sub(r"\s+", " ", capsys.readouterr().err)


def test_the_example_of_the_readme_runs(capsys):
    names = {}
    exec(EXAMPLE, names)
    assert names["weights"].shape == (8, 22)
    assert capsys.readouterr().out


def test_the_method_of_the_readme_makes_a_policy(monkeypatch):
    names = vars(methods).copy()
    exec(METHOD, names)
    assert names["METHODS"].keys() - methods.METHODS.keys() == {"mine"}
    monkeypatch.setitem(methods.METHODS, "mine", names["Mine"])
    spec = dataclasses.replace(tiny.SPEC, method="mine")
    policy = bind(spec, init_params(spec, jax.random.key(0)))
    observation = Observation(row=jnp.asarray(tiny.BANK.rows[:4]), goal=jnp.zeros(4, jnp.int32))
    experience = policy.pathways(observation, jnp.ones((4, len(tiny.CATEGORIES)))).experience
    assert experience.shape == (4, policy.method.width)
