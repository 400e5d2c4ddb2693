"""Tests of the public names, the command line, the README's example and the shortest method of the documentation."""

import ast
import dataclasses
import importlib
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
from support.tiny_run import write_config

import jaxnav
from jaxnav.__main__ import main
from jaxnav.env.objectnav import Observation
from jaxnav.policies.methods import find_method
from jaxnav.policies.network import bind, init_params
from jaxnav.policies.pathways import PolicyInputs
from jaxnav.scenes.task import NUM_ACTIONS

ROOT = Path(__file__).parent.parent
PACKAGE_SOURCE = (ROOT / "jaxnav" / "__init__.py").read_text()
README = (ROOT / "README.md").read_text()
README_EXAMPLE, *_ = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
METHOD_SECTION = (ROOT / "docs" / "add_a_method.md").read_text().partition("\n## ")[0]
(SHORTEST_METHOD,) = re.findall(r"```python\n(.*?)```", METHOD_SECTION, re.DOTALL)


def test_package_shows_only_its_public_names():
    assert dir(jaxnav) == sorted(set(jaxnav.__all__))
    for name in jaxnav.__all__:
        assert getattr(jaxnav, name) is not None
    with pytest.raises(AttributeError, match="trian"):
        jaxnav.trian  # noqa: B018


def test_type_checkers_see_the_public_names():
    # The only `if` of the module is the block of imports for type checkers.
    (type_block,) = (node for node in ast.parse(PACKAGE_SOURCE).body if isinstance(node, ast.If))
    typed_names = {}
    for node in type_block.body:
        assert isinstance(node, ast.ImportFrom)
        assert node.module is not None
        module = importlib.import_module(node.module)
        typed_names |= {alias.name: getattr(module, alias.name) for alias in node.names}

    # These imports give every public name, and each name has the value that the package gives at run time.
    assert typed_names.keys() | {"__version__"} == set(jaxnav.__all__)
    for name, value in typed_names.items():
        assert getattr(jaxnav, name) is value


def test_importing_jaxnav_loads_no_heavy_package():
    heavy_packages = ("orbax", "tyro", "matplotlib", "PIL", "optax", "flax.nnx", "jaxnav.cli", "jaxnav.training")
    script = f"import sys, jaxnav; print([name for name in {heavy_packages} if name in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", script], cwd=ROOT, text=True) == "[]\n"


def test_version_equals_the_project_version():
    assert jaxnav.__version__ == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"version: {jaxnav.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_version_option_prints_the_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"jaxnav {jaxnav.__version__}\n"


@pytest.mark.parametrize(
    ("command", "hint"),
    [("epsiode", "episode"), ("zzz", "train")],
)
def test_unknown_command_is_refused_with_a_hint(command, hint, capsys):
    assert main([command]) == 2
    assert hint in capsys.readouterr().err


def test_main_passes_arguments_to_commands(tmp_path, capsys):
    assert main([]) == 0
    assert "episode" in capsys.readouterr().out
    for command in ("eval", "episode", "report"):
        assert main([command, str(tmp_path / "nowhere")]) == 2
        assert "nowhere" in capsys.readouterr().err


def test_readme_example_runs(capsys):
    namespace = {}
    exec(README_EXAMPLE, namespace)
    assert namespace["weights"].shape == (8, 22)
    assert capsys.readouterr().out


# The shortest method


@pytest.fixture
def method_folder(tmp_path):
    """A folder that holds only the module of the page."""
    (tmp_path / "module").mkdir()
    (tmp_path / "module" / "shortest.py").write_text(SHORTEST_METHOD)
    return tmp_path / "module"


@pytest.mark.slow
def test_shortest_method_passes_ruff_and_pyright(method_folder):
    assert SHORTEST_METHOD.count("\n") <= 25
    # Checks of the linter, the formatter and the type checker.
    method_file = method_folder / "shortest.py"
    pyright_config = method_folder / "pyrightconfig.json"
    pyright_config.write_text(json.dumps({"include": ["."], "extraPaths": [str(ROOT)], "typeCheckingMode": "standard"}))
    commands = [
        ["ruff", "check", "--no-cache", "--config", ROOT / "pyproject.toml", method_file],
        ["ruff", "format", "--no-cache", "--check", "--config", ROOT / "pyproject.toml", method_file],
        ["pyright", "-p", pyright_config, "--pythonpath", sys.executable],
    ]

    def is_clean(command):
        return subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True).returncode == 0

    assert [is_clean(command) for command in commands] == [True] * 3

    # Negative control: an undefined name of the wrong type after a stray space fails every check.
    faulty_method = SHORTEST_METHOD.replace(
        "SHORTEST = Method(Detections)", "SHORTEST = Method( 'Detections', undefined)"
    )
    method_file.write_text(faulty_method)
    assert [is_clean(command) for command in commands] == [False] * 3


@pytest.mark.slow
def test_shortest_method_makes_experience(method_folder, monkeypatch):
    # An untrained policy of the method, and the first four views of the kitchen.
    monkeypatch.syspath_prepend(method_folder)
    spec = dataclasses.replace(tiny.SPEC, method=find_method("shortest:SHORTEST"), method_sizes=())
    params = jax.jit(init_params, static_argnums=0)(spec, jax.random.key(0))
    observation = Observation(row=jnp.asarray(tiny.BANK.rows[:4]), goal=jnp.zeros(4, jnp.int32))

    @jax.jit
    def compute_pathways(params, layout_weights):
        return bind(spec, params).pathways(PolicyInputs(observation, layout_weights))

    # The experience depends on the layout weights.
    layout_weights = jnp.ones((4, len(tiny.CATEGORIES)))
    experience = compute_pathways(params, layout_weights).experience
    other_experience = compute_pathways(params, 2 * layout_weights).experience
    assert experience.shape == (4, bind(spec, params).method.width)
    assert (experience != other_experience).any()


ACT_SCRIPT = """
import jax, jaxnav
policy = jaxnav.load_policy("runs/shortest/policies/layout-0")
env, params = jaxnav.make("rooms", "val")
observation, state = env.reset(jax.random.key(0), params)
print(policy.act(observation, policy.init(), heading=0, moved=False)[0])
"""


@pytest.mark.exhaustive
def test_commands_of_the_page_train_and_evaluate_the_method(method_folder, tmp_path):
    run_dir = tmp_path / "run"

    def run_command(command, cwd=method_folder):
        """Run a command as a user does, without a PYTHONPATH, with a run directory of this test."""
        arguments = [str(argument).replace("runs/shortest", str(run_dir)) for argument in command]
        environment = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}
        environment.pop("PYTHONPATH", None)
        return subprocess.run(arguments, cwd=cwd, env=environment, capture_output=True, text=True)

    # The page shows one command that trains and one that evaluates.
    jaxnav_program = Path(sys.executable).with_name("jaxnav")
    train_line, evaluate_line = re.findall(r"^    jaxnav (.*?)(?: +#.*)?$", METHOD_SECTION, re.MULTILINE)
    train_command = [jaxnav_program, *train_line.split()]
    evaluate_command = [jaxnav_program, *evaluate_line.split()]

    # Train with a tiny configuration, evaluate four episodes, and let a stored policy act in its environment.
    small_options = ["--config", write_config(tmp_path), "--method-sizes", "--seeds", 1, "--total-steps", 256]
    outputs = []
    for command in (
        [*train_command, *small_options],
        [*evaluate_command, "--episodes", 4],
        [sys.executable, "-c", ACT_SCRIPT],
    ):
        completed = run_command(command)
        assert completed.returncode == 0, completed.stderr
        outputs.append(completed.stdout)
    assert int(outputs[-1]) in range(NUM_ACTIONS)
    rows = json.loads((run_dir / "eval-val-episodes4.json").read_text())["rows"]
    assert {row["variant"] for row in rows} == {"baseline", "layout", "tde", "stde", "random", "oracle"}

    # Outside the folder of the module, the command ends with one line that names the missing module.
    completed = run_command(evaluate_command, cwd=ROOT)
    assert completed.returncode == 2
    assert completed.stderr.count("\n") == 1
    assert "shortest:SHORTEST" in completed.stderr
    assert "ModuleNotFoundError" in completed.stderr
