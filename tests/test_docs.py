"""Tests of the documentation: the code on its pages runs, and its tables match the package and the results."""

import ast
import collections
import csv
import dataclasses
import doctest
import gzip
import importlib
import json
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.tiny_run import write_config

import jaxnav
from jaxnav.env.objectnav import Observation
from jaxnav.policies.methods import find_method
from jaxnav.policies.network import bind, init_params
from jaxnav.policies.pathways import PolicyInputs
from jaxnav.scenes.files.scene_file import read_scenes

DOCS = Path(__file__).parents[1] / "docs"
PYTHON_BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


def test_doctests_of_concepts_pass():
    num_failed, num_examples = doctest.testfile(str(DOCS / "concepts.md"), module_relative=False)
    assert num_failed == 0
    assert num_examples > 10


def test_concepts_contain_the_worked_divergences():
    """psi(n) = -gamma + 1 + 1/2 + ... + 1/(n - 1), so psi(3) - psi(9) = -(1/3 + ... + 1/8)."""
    mug_divergence = np.log(4) - sum(1 / count for count in range(3, 9))
    bed_divergence = np.log(2) - (1 / 3 + 1 / 4)
    mean_divergence = (mug_divergence + bed_divergence) / 2
    page = (DOCS / "concepts.md").read_text()
    for value in (mug_divergence, bed_divergence, mean_divergence, np.tanh(mean_divergence)):
        assert f"{value:.4f}" in page


@pytest.mark.exhaustive
def test_python_blocks_of_use_run(tmp_path, monkeypatch, capsys):
    """The blocks run in an empty folder, in the order of the page, and train for a few updates only."""
    blocks = [block for block in PYTHON_BLOCK.findall((DOCS / "use.md").read_text()) if "rejax" not in block]
    assert len(blocks) == 3

    # Replace the configuration of the page by a tiny one.
    monkeypatch.chdir(tmp_path)
    write_config(tmp_path)
    tiny_config = "jaxnav.runs.config_files.apply_yaml(jaxnav.RunConfig(run_dir=Path('runs/org')), Path('tiny.yaml'))"
    code = "\n".join(blocks).replace("import jaxnav\n", "import jaxnav\nimport jaxnav.runs.config_files\n")
    code = re.sub(r"jaxnav\.RunConfig\(.*?\)(?=\))", tiny_config.replace("\\", "\\\\"), code, flags=re.DOTALL)

    # Run it under the rules of promotion of a user.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        exec(code, {})
    assert "['detections', 'goal', 'heading', 'horizon', 'moved', 'view']" in capsys.readouterr().out
    assert jaxnav.Run.open("runs/org").config.seeds == 2


def test_python_block_of_scene_format_writes_a_scene_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (block,) = PYTHON_BLOCK.findall((DOCS / "scene_format.md").read_text())
    exec(block, {"__name__": "scene_format"})
    (scene,) = read_scenes("my_scenes.jsonl.gz")
    assert scene.reach.tolist()[2] == [True, True, False, False, True, True]
    assert scene.types[scene.parents[1]] == "Desk"


def load_script(name):
    """Namespace of a script of the documentation."""
    return runpy.run_path(str(DOCS / f"{name}.py"), run_name=name)


@pytest.mark.parametrize("name", ["commands.md", "commands_train.md"])
def test_pages_of_commands_are_up_to_date(name):
    expected_page = load_script("write_commands")["write_pages"]()[name]
    assert (DOCS / name).read_text() == expected_page, "run: python docs/write_commands.py"


def test_leaderboard_is_up_to_date():
    expected_page = load_script("write_leaderboard")["write_page"]()
    assert (DOCS / "leaderboard.md").read_text() == expected_page, "run: python docs/write_leaderboard.py"


LEADERBOARD_FILES = sorted((DOCS.parent / "results" / "leaderboard").rglob("*.json"))


@pytest.mark.parametrize("path", LEADERBOARD_FILES, ids=lambda path: path.stem)
def test_scores_of_the_leaderboard_follow_from_their_episodes(path):
    scores = json.loads(path.read_text())
    assert scores["benchmark"] == path.parent.name

    # Success, length and shortest length of the episodes of each row; every episode counts at its shift and in the mix.
    episodes_by_row = collections.defaultdict(list)
    with gzip.open(path.with_name(f"{path.stem}.episodes.csv.gz"), "rt") as file:
        for episode in csv.DictReader(file):
            row_key = tuple(episode[name] for name in ("track", "variant", "epsilon", "form", "decoding"))
            values = (int(episode["success"]), int(episode["length"]), int(episode["best_length"]))
            episodes_by_row[*row_key, float(episode["shift"])].append(values)
            episodes_by_row[*row_key, "mixed"].append(values)

    # Every score is the mean of its episodes.
    assert len(scores["rows"]) == len(episodes_by_row)
    for row in scores["rows"]:
        epsilon = "" if row["epsilon"] is None else str(row["epsilon"])
        row_key = (row["track"], row["variant"], epsilon, row["form"] or "", row["decoding"], row["shift"])
        success, length, best_length = np.array(episodes_by_row[row_key]).T
        assert row["sr"]["mean"] == pytest.approx(100.0 * success.mean())
        path_shares = success * best_length / np.maximum(length, best_length)
        assert row["spl"]["mean"] == pytest.approx(100.0 * path_shares.mean())


def public_names_with_links():
    """Link of each name in the tables of the overview."""
    return dict(re.findall(r"^\| \[`(\w+)`\]\(([^)]+)\)", (DOCS / "reference.md").read_text(), re.MULTILINE))


def test_reference_lists_every_public_name():
    assert sorted(public_names_with_links()) == sorted(jaxnav.__all__)


def test_every_public_name_is_on_the_page_it_links_to():
    """Functions and classes stand there as the directive that renders their docstring, and constants by their name."""
    for name, link in public_names_with_links().items():
        page_name, _, anchor = link.partition("#")
        page = (DOCS / page_name).read_text()
        if anchor.startswith("jaxnav."):
            assert f"::: {anchor}\n" in page, name
            module_name, _, attribute = anchor.rpartition(".")
            assert getattr(importlib.import_module(module_name), attribute) is getattr(jaxnav, name)
        else:
            assert re.search(rf"`(jaxnav\.)?{name}`", page), name


def test_constants_of_the_reference_have_their_values():
    rows = re.findall(r"^\| `(\w+)` \| `([^`]+)` \|", (DOCS / "reference_environment.md").read_text(), re.MULTILINE)
    assert len(rows) == 11
    for name, value in rows:
        assert ast.literal_eval(value) == getattr(jaxnav, name)
    assert f"`NUM_FEATURES` is {jaxnav.NUM_FEATURES}" in (DOCS / "reference_networks.md").read_text()
    parts_page = (DOCS / "reference_parts.md").read_text()
    for name in jaxnav.METHODS:
        assert f"`{name}`" in parts_page


def run_python_blocks(path, marker=""):
    """Execute the Python blocks of a page that contain a marker, in order, and return their namespace.

    JAX promotes dtypes and ranks as for a user, not as strictly as in this suite.
    """
    blocks = [block for block in PYTHON_BLOCK.findall(path.read_text()) if marker in block]
    assert blocks
    namespace: dict[str, Any] = {"__name__": "page"}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        exec(compile("\n".join(blocks), str(path), "exec"), namespace)
    return namespace


@pytest.mark.slow
def test_python_blocks_of_own_detections_run():
    run_python_blocks(DOCS / "own_detections.md")


@pytest.mark.slow
def test_python_blocks_of_evaluate_your_agent_run(capsys):
    """The searcher beats Random in the few episodes of the page."""
    namespace = run_python_blocks(DOCS / "evaluate_your_agent.md")
    searcher_success, random_success = namespace["results"].metrics()["sr"].mean(axis=(1, 2))[:2]
    assert searcher_success > random_success
    assert namespace["compiled"].rows[0].variant == "agent"


@pytest.mark.slow
def test_recipe_of_rejax_trains():
    """The returns before and after training are those that the page states."""
    pytest.importorskip("rejax")
    returns = run_python_blocks(DOCS / "use.md", marker="rejax")["returns"]
    np.testing.assert_allclose(returns.mean(axis=1), [0.30, 0.76], atol=0.15)


@pytest.fixture
def page_modules(tmp_path, monkeypatch):
    """Make the modules of the page on methods importable, and return the code of its remaining blocks."""
    # A block whose first line is `# NAME.py` is a module; the remaining blocks use these modules.
    module_blocks = {}
    usage_blocks = []
    for block in PYTHON_BLOCK.findall((DOCS / "add_a_method.md").read_text()):
        title_match = re.match(r"# (\w+)\.py\n", block)
        if title_match is None:
            usage_blocks.append(block)
        else:
            module_blocks[title_match[1]] = block
    assert sorted(module_blocks) == ["judged", "sectors", "shortest"]

    for name, block in module_blocks.items():
        (tmp_path / f"{name}.py").write_text(block)
    monkeypatch.syspath_prepend(tmp_path)
    yield "".join(usage_blocks)

    # Forget the modules and the methods that were found in them.
    for name in module_blocks:
        sys.modules.pop(name, None)
    find_method.cache_clear()


PAGE_METHODS = ("shortest:SHORTEST", "sectors:SECTORED", "judged:JUDGED")


def test_methods_of_add_a_method_are_found(page_modules):
    assert find_method("sectors:SECTORED").control.num_choices == 4
    assert find_method("judged:JUDGED").adaptation is not None
    assert find_method("shortest:SHORTEST").tracker is None
    for name in PAGE_METHODS:
        assert name in page_modules


@pytest.mark.parametrize("decision", ["fused", "streams"])
@pytest.mark.parametrize("name", PAGE_METHODS)
def test_methods_of_add_a_method_decide_fused_and_in_streams(page_modules, name, decision):
    """The test traces shapes only and computes nothing."""
    method = find_method(name)
    spec = dataclasses.replace(tiny.SPEC, method=method, method_sizes=(), decision=decision)

    def decide(params, row, goal):
        policy = bind(spec, params)
        memory = policy.initial_memory(goal.shape)
        tracker_reading = None if method.tracker is None else jnp.zeros((*goal.shape, 2))
        layout_weights = jnp.ones((*goal.shape, 3))
        pathways = policy.pathways(PolicyInputs(Observation(row, goal), layout_weights, tracker_reading), memory)
        return policy.decide(pathways, memory)

    # A batch of five observations.
    params = jax.eval_shape(lambda key: init_params(spec, key), jax.random.key(0))
    row = jax.ShapeDtypeStruct((5, tiny.BANK.rows.shape[-1]), np.uint8)
    goal = jax.ShapeDtypeStruct((5,), np.int32)
    output = jax.eval_shape(decide, params, row, goal)
    assert output.logits.shape == (5, method.control.num_choices)


@pytest.mark.slow
def test_methods_of_add_a_method_pass_check_method(page_modules):
    """The calls of the page pass under the suite's strict rules of types and ranks."""
    exec(page_modules, {"__name__": "page"})
