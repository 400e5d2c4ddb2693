"""What the documentation shows is what happens."""

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
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


def test_doctests_of_concepts_pass():
    failed, tried = doctest.testfile(str(DOCS / "concepts.md"), module_relative=False)
    assert (failed, tried > 10) == (0, True)


def test_concepts_contain_the_worked_divergences():
    """psi(n) = -gamma + 1 + 1/2 + ... + 1/(n - 1), so psi(3) - psi(9) = -(1/3 + ... + 1/8)."""
    mug_divergence = np.log(4) - sum(1 / count for count in range(3, 9))
    bed_divergence = np.log(2) - (1 / 3 + 1 / 4)
    text = (DOCS / "concepts.md").read_text()
    mean_divergence = (mug_divergence + bed_divergence) / 2
    for value in (mug_divergence, bed_divergence, mean_divergence, np.tanh(mean_divergence)):
        assert f"{value:.4f}" in text


@pytest.mark.exhaustive
def test_python_blocks_of_use_run(tmp_path, monkeypatch, capsys):
    """In a folder of its own, in the order of the page, with a run of a few updates."""
    monkeypatch.chdir(tmp_path)
    small = "jaxnav.runs.config_files.apply_yaml(jaxnav.RunConfig(run_dir=Path('runs/org')), Path('tiny.yaml'))"
    write_config(tmp_path)
    blocks = [block for block in BLOCK.findall((DOCS / "use.md").read_text()) if "rejax" not in block]
    assert len(blocks) == 3
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        code = "\n".join(blocks).replace("import jaxnav\n", "import jaxnav\nimport jaxnav.runs.config_files\n")
        exec(re.sub(r"jaxnav\.RunConfig\(.*?\)(?=\))", small.replace("\\", "\\\\"), code, flags=re.DOTALL), {})
    assert "['detections', 'goal', 'heading', 'horizon', 'moved', 'view']" in capsys.readouterr().out
    assert jaxnav.Run.open("runs/org").config.seeds == 2


def test_python_block_of_scene_format_writes_a_scene_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r"```python\n(.*?)```", (DOCS / "scene_format.md").read_text(), re.DOTALL)
    exec(block, {"__name__": "scene_format"})
    (scene,) = read_scenes("my_scenes.jsonl.gz")
    assert scene.reach.tolist()[2] == [True, True, False, False, True, True]
    assert scene.types[scene.parents[1]] == "Desk"


def load_script(name):
    """The names of a script of the documentation."""
    return runpy.run_path(str(DOCS / f"{name}.py"), run_name=name)


@pytest.mark.parametrize("name", ["commands.md", "commands_train.md"])
def test_pages_of_commands_are_up_to_date(name):
    assert (DOCS / name).read_text() == load_script("write_commands")["write_pages"]()[name], (
        "run: python docs/write_commands.py"
    )


def test_leaderboard_is_up_to_date():
    assert (DOCS / "leaderboard.md").read_text() == load_script("write_leaderboard")["write_page"](), (
        "run: python docs/write_leaderboard.py"
    )


LEADERBOARD = sorted((DOCS.parent / "results" / "leaderboard").rglob("*.json"))


@pytest.mark.parametrize("path", LEADERBOARD, ids=lambda path: path.stem)
def test_scores_of_the_leaderboard_follow_from_their_episodes(path):
    scores = json.loads(path.read_text())
    assert scores["benchmark"] == path.parent.name
    episodes_by_line = collections.defaultdict(list)
    with gzip.open(path.with_name(f"{path.stem}.episodes.csv.gz"), "rt") as file:
        for episode in csv.DictReader(file):
            line = (episode["track"], *(episode[name] for name in ("variant", "epsilon", "form", "decoding")))
            values = (int(episode["success"]), int(episode["length"]), int(episode["best_length"]))
            episodes_by_line[*line, float(episode["shift"])].append(values)
            episodes_by_line[*line, "mixed"].append(values)

    # Every score is the mean of its episodes, and every episode counts in two scores.
    assert len(scores["rows"]) == len(episodes_by_line)
    for row in scores["rows"]:
        epsilon = "" if row["epsilon"] is None else str(row["epsilon"])
        line = (row["track"], row["variant"], epsilon, row["form"] or "", row["decoding"], row["shift"])
        success, length, best_length = np.array(episodes_by_line[line]).T
        assert row["sr"]["mean"] == pytest.approx(100.0 * success.mean())
        path_shares = success * best_length / np.maximum(length, best_length)
        assert row["spl"]["mean"] == pytest.approx(100.0 * path_shares.mean())


def public_names_with_links():
    """The names in the tables of the overview, and where each links to."""
    return dict(re.findall(r"^\| \[`(\w+)`\]\(([^)]+)\)", (DOCS / "reference.md").read_text(), re.MULTILINE))


def test_reference_lists_every_public_name():
    assert sorted(public_names_with_links()) == sorted(jaxnav.__all__)


def test_every_public_name_is_on_the_page_it_links_to():
    """Functions and classes by the directive that renders their docstring, everything else by its name."""
    for name, link in public_names_with_links().items():
        page, _, anchor = link.partition("#")
        text = (DOCS / page).read_text()
        if anchor.startswith("jaxnav."):
            assert f"::: {anchor}\n" in text, name
            module, _, attribute = anchor.rpartition(".")
            assert getattr(importlib.import_module(module), attribute) is getattr(jaxnav, name)
        else:
            assert re.search(rf"`(jaxnav\.)?{name}`", text), name


def test_constants_of_the_reference_have_their_values():
    rows = re.findall(r"^\| `(\w+)` \| `([^`]+)` \|", (DOCS / "reference_environment.md").read_text(), re.MULTILINE)
    assert len(rows) == 11
    for name, value in rows:
        assert ast.literal_eval(value) == getattr(jaxnav, name)
    assert f"`NUM_FEATURES` is {jaxnav.NUM_FEATURES}" in (DOCS / "reference_networks.md").read_text()
    assert all(f"`{name}`" in (DOCS / "reference_parts.md").read_text() for name in jaxnav.METHODS)


def run_python_blocks(path, containing=""):
    """Execute the Python blocks of a page in order, under the rules of promotion of a user; return their names."""
    blocks = [block for block in BLOCK.findall(path.read_text()) if containing in block]
    assert blocks
    names: dict[str, Any] = {"__name__": "page"}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        exec(compile("\n".join(blocks), str(path), "exec"), names)
    return names


@pytest.mark.slow
def test_python_blocks_of_own_detections_run():
    run_python_blocks(DOCS / "own_detections.md")


@pytest.mark.slow
def test_python_blocks_of_evaluate_your_agent_run(capsys):
    """The searcher beats Random in the few episodes of the page."""
    names = run_python_blocks(DOCS / "evaluate_your_agent.md")
    searcher, random = names["results"].metrics()["sr"].mean(axis=(1, 2))[:2]
    assert searcher > random
    assert names["compiled"].rows[0].variant == "agent"


@pytest.mark.slow
def test_recipe_of_rejax_trains():
    """The returns before and after training that the page states."""
    pytest.importorskip("rejax")
    returns = run_python_blocks(DOCS / "use.md", containing="rejax")["returns"]
    np.testing.assert_allclose(returns.mean(axis=1), [0.30, 0.76], atol=0.15)


@pytest.fixture
def page_modules(tmp_path, monkeypatch):
    """A folder with the modules of the page on methods, in the path; returns the code that follows them."""
    blocks = BLOCK.findall((DOCS / "add_a_method.md").read_text())
    module_blocks = {name[1]: block for block in blocks if (name := re.match(r"# (\w+)\.py\n", block))}
    assert sorted(module_blocks) == ["judged", "sectors", "shortest"]
    for name, block in module_blocks.items():
        (tmp_path / f"{name}.py").write_text(block)
    monkeypatch.syspath_prepend(tmp_path)
    yield "".join(block for block in blocks if block not in module_blocks.values())
    for name in module_blocks:
        sys.modules.pop(name, None)
    find_method.cache_clear()


def test_methods_of_add_a_method_are_found(page_modules):
    sectored_method, judged_method = find_method("sectors:SECTORED"), find_method("judged:JUDGED")
    assert (sectored_method.control.num_choices, judged_method.adaptation is None) == (4, False)
    assert find_method("shortest:SHORTEST").tracker is None
    assert all(name in page_modules for name in ("shortest:SHORTEST", "sectors:SECTORED", "judged:JUDGED"))


@pytest.mark.parametrize("decision", ["fused", "streams"])
@pytest.mark.parametrize("name", ["shortest:SHORTEST", "sectors:SECTORED", "judged:JUDGED"])
def test_methods_of_add_a_method_decide_fused_and_in_streams(page_modules, name, decision):
    """Shapes alone: nothing is computed."""
    spec = dataclasses.replace(tiny.SPEC, method=find_method(name), method_sizes=(), decision=decision)
    row = jax.ShapeDtypeStruct((5, tiny.BANK.rows.shape[-1]), np.uint8)

    def decide(params, row, goal):
        policy = bind(spec, params)
        memory = policy.initial_memory(goal.shape)
        reading = None if find_method(name).tracker is None else jnp.zeros((*goal.shape, 2))
        pathways = policy.pathways(PolicyInputs(Observation(row, goal), jnp.ones((*goal.shape, 3)), reading), memory)
        return policy.decide(pathways, memory)

    params = jax.eval_shape(lambda key: init_params(spec, key), jax.random.key(0))
    decided = jax.eval_shape(decide, params, row, jax.ShapeDtypeStruct((5,), np.int32))
    assert decided.logits.shape == (5, find_method(name).control.num_choices)


@pytest.mark.slow
def test_methods_of_add_a_method_pass_check_method(page_modules):
    """The page's own calls, under the suite's strict rules of types and ranks."""
    exec(page_modules, {"__name__": "page"})
