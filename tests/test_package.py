"""What a newcomer meets first: the package's names, the commands, and the examples of the README."""

import dataclasses
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from support import tiny_world as tiny
from support.commands import write_config

import jaxnav
from jaxnav.__main__ import main
from jaxnav.env.objectnav import Observation
from jaxnav.policies.methods import find_method
from jaxnav.policies.network import bind, init_params
from jaxnav.policies.pathways import PolicyInputs
from jaxnav.scenes.task import NUM_ACTIONS

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
EXAMPLE, *_ = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
METHOD_SECTION = re.split(r"^## ", README.partition("\n## A method of your own\n")[2], flags=re.MULTILINE)[0]
(METHOD,) = re.findall(r"```python\n(.*?)```", METHOD_SECTION, re.DOTALL)


def test_importing_jaxnav_is_light():
    heavy = ("orbax", "tyro", "matplotlib", "PIL", "optax", "flax.nnx", "jaxnav.cli", "jaxnav.training")
    script = f"import sys, jaxnav; print([name for name in {heavy} if name in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", script], cwd=ROOT, text=True) == "[]\n"


def test_the_version_is_that_of_the_project():
    assert jaxnav.__version__ == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"version: {jaxnav.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_the_version_is_printed(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"jaxnav {jaxnav.__version__}\n"


@pytest.mark.parametrize(
    ("wrong", "mend"),
    [("epsiode", "did you mean 'episode'?"), ("zzz", "train, eval, account, mixture, report, log, export, ")],
)
def test_unknown_commands_are_refused_with_a_hint(wrong, mend, capsys):
    assert main([wrong]) == 2
    assert mend in capsys.readouterr().err


def test_commands_get_the_other_arguments(tmp_path, capsys):
    assert main([]) == 0
    assert "episode" in capsys.readouterr().out
    for command in ("eval", "episode", "report"):
        assert main([command, str(tmp_path / "nowhere")]) == 2
        assert "nowhere: holds no run" in re.sub(r"\s+", " ", capsys.readouterr().err)


def test_the_example_of_the_readme_runs(capsys):
    names = {}
    exec(EXAMPLE, names)
    assert names["weights"].shape == (8, 22)
    assert capsys.readouterr().out


# The method of the README


@pytest.fixture
def folder(tmp_path):
    """A folder with the README's module, and nothing else."""
    (tmp_path / "module").mkdir()
    (tmp_path / "module" / "my_method.py").write_text(METHOD)
    return tmp_path / "module"


@pytest.mark.slow
def test_the_method_of_the_readme_is_short_and_clean(folder):
    assert METHOD.count("\n") <= 25
    file, types = folder / "my_method.py", folder / "pyrightconfig.json"
    types.write_text(json.dumps({"include": ["."], "extraPaths": [str(ROOT)], "typeCheckingMode": "standard"}))
    checks = [
        ["ruff", "check", "--no-cache", "--config", ROOT / "pyproject.toml", file],
        ["ruff", "format", "--no-cache", "--check", "--config", ROOT / "pyproject.toml", file],
        ["pyright", "-p", types, "--pythonpath", sys.executable],
    ]

    def clean(check):
        return subprocess.run([sys.executable, "-m", *check], cwd=ROOT, capture_output=True).returncode == 0

    assert [clean(check) for check in checks] == [True] * 3
    file.write_text(METHOD.replace("MINE = Method(MyExperience)", "MINE = Method( 'MyExperience', undefined)"))
    assert [clean(check) for check in checks] == [False] * 3


def test_the_method_of_the_readme_makes_experience(folder, monkeypatch):
    monkeypatch.syspath_prepend(folder)
    spec = dataclasses.replace(tiny.SPEC, method=find_method("my_method:MINE"), method_sizes=())
    params = jax.jit(init_params, static_argnums=0)(spec, jax.random.key(0))
    observation = Observation(row=jnp.asarray(tiny.BANK.rows[:4]), goal=jnp.zeros(4, jnp.int32))
    pathways = jax.jit(lambda params, weights: bind(spec, params).pathways(PolicyInputs(observation, weights)))
    weights = jnp.ones((4, len(tiny.CATEGORIES)))
    experience, other = (pathways(params, w).experience for w in (weights, 2 * weights))
    assert experience.shape == (4, bind(spec, params).method.width)
    assert (experience != other).any()  # it hosts the layout


ACT = """
import jax, jaxnav
policy = jaxnav.load_policy("runs/mine/policies/layout-0")
env, params = jaxnav.make("rooms", "val")
observation, state = env.reset(jax.random.key(0), params)
print(policy.act(observation, policy.init(), heading=0, moved=False)[0])
"""


@pytest.mark.slow
def test_the_commands_of_the_readme_train_and_evaluate_the_method(folder, tmp_path):
    run_dir = tmp_path / "run"

    def run(*arguments, cwd=folder):
        arguments = [str(argument).replace("runs/mine", str(run_dir)) for argument in arguments]
        environment = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}
        environment.pop("PYTHONPATH", None)
        return subprocess.run(arguments, cwd=cwd, env=environment, capture_output=True, text=True)

    installed = Path(sys.executable).with_name("jaxnav")
    train, evaluate = (
        [installed, *line.split()] for line in re.findall(r"^    jaxnav (.*?)(?: +#.*)?$", METHOD_SECTION, re.MULTILINE)
    )
    small = ["--config", write_config(tmp_path), "--method-sizes", "--seeds", 1, "--total-steps", 256]
    outputs = []
    for command in ([*train, *small], [*evaluate, "--episodes", 4], [sys.executable, "-c", ACT]):
        done = run(*command)
        assert done.returncode == 0, done.stderr
        outputs.append(done.stdout)
    assert int(outputs[-1]) in range(NUM_ACTIONS)
    rows = json.loads((run_dir / "eval-val.json").read_text())["rows"]
    assert {row["variant"] for row in rows} == {"baseline", "layout", "tde", "stde", "random", "oracle"}

    done = run(*evaluate, cwd=ROOT)  # where the module is not
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: method 'my_method:MINE': cannot be imported (ModuleNotFoundError: ")
    assert done.stderr.endswith("install or mend its package\n")
