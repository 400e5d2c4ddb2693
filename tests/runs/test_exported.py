"""Exported programs act as their policies, also where neither jaxnav nor flax can be imported."""

import dataclasses
import json
import re
import subprocess
import sys
from typing import Any

import chex
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.commands import contents, refusal
from support.refusals import assert_message_names
from support.tiers import params_by_tier

import jaxnav
from jaxnav.__main__ import main
from jaxnav.env.objectnav import NUM_PRIORS, Observation
from jaxnav.policies.methods import METHODS
from jaxnav.runs.loaded_policy import LoadedPolicy, export_program, input_shapes
from jaxnav.runs.policies import POLICIES_DIR
from jaxnav.scenes.tables.observation_row import RowFormat

NUM_EPISODES = 3
NUM_STEPS = 4
#: Methods whose program is exported with streams in the tests; the decision of all other methods is fused.
STREAM_METHODS = ("savn", "sp", "vtnet")
#: Code of a process that imports JAX and none of its libraries: the code of the model card, then the steps of a file.
JAX_ONLY_SCRIPT = """
import sys

class RefuseImports:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("jaxnav", "flax", "optax", "chex"):
            raise ImportError(name)

sys.meta_path.insert(0, RefuseImports())
{code}
steps = np.load("steps.npz")
inputs = jax.tree.map(lambda leaf: np.zeros((3, *leaf.shape[1:]), leaf.dtype), shapes)
results = {{}}
for time in range(4):
    inputs |= {{name: steps[name][time] for name in steps.files}}
    outputs = step.call(inputs, np.float32(0.1))
    inputs["memory"] = outputs.pop("memory")
    for name, value in outputs.items():
        results.setdefault(name, []).append(value)
np.savez("results.npz", **results)
"""


# Equal steps by the policy and by its program


def draw_steps(policy: LoadedPolicy) -> dict[str, np.ndarray]:
    """Return random inputs [NUM_STEPS, NUM_EPISODES, ...] of a program, without its memory.

    The inputs belong to no world, so no two of them are alike. The second episode begins anew at step 2.
    """
    rng = np.random.default_rng(0)
    shapes = input_shapes(policy, NUM_EPISODES)
    limits = {"detections": 256, "view": 3, "goal": 5, "action": 6, "heading": 8, "horizon": 2, "room": 5, "moved": 2}
    steps = {}
    for name, leaf in shapes.items():
        if name in limits:
            steps[name] = rng.integers(0, limits[name], (NUM_STEPS, *leaf.shape)).astype(leaf.dtype)

    steps["detections"][..., 0] *= rng.random(steps["detections"].shape[:-1]) < 0.12  # few are detected
    steps["room"][:] = steps["room"][0]
    steps["first"] = np.zeros((NUM_STEPS, NUM_EPISODES), bool)
    steps["first"][0] = True
    steps["first"][2, 1] = True
    return steps


def stack_results(results: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return the results of steps as arrays with a leading axis, without results that the method does not have."""
    stacked_results = {}
    for name, value in results[0].items():
        if value is not None:
            stacked_results[name] = np.stack([result[name] for result in results])
    return stacked_results


def act_by_policy(policy: LoadedPolicy, steps: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the policy's results [NUM_STEPS, NUM_EPISODES, ...], which it computes episode by episode."""
    decide = jax.jit(LoadedPolicy.decide)
    row_format = RowFormat(policy.spec.num_categories)
    results_by_episode = []
    for episode in range(NUM_EPISODES):
        results = []
        memory = policy.begin(jnp.int32(0))
        for time in range(NUM_STEPS):
            inputs = {name: jnp.asarray(values[time, episode]) for name, values in steps.items()}

            # A first step begins a new memory; a later one gets the action that was taken.
            if inputs["first"]:
                memory = policy.begin(inputs["room"])
            else:
                memory = memory._replace(policy_state=memory.policy_state._replace(action=inputs["action"]))

            # Nothing has moved before the first step of an episode.
            odometry = {name: inputs[name] for name in ("heading", "horizon")}
            odometry["moved"] = inputs["moved"] & ~inputs["first"]
            observation = Observation(row_format.pack(inputs["detections"], inputs["view"]), inputs["goal"])
            choice = decide(policy, observation, memory, jnp.float32(0.1), **odometry)
            best_choice = jnp.argmax(choice.logits).astype(jnp.int32)
            action, memory = policy.apply_choice(choice, best_choice, memory.room)
            result = {"action": action}
            for name in ("logits", "factual", "counterfactual", "gap", "weights"):
                result[name] = getattr(choice, name)
            results.append(result)
        results_by_episode.append(stack_results(results))

    # The episodes become the second axis.
    stacked_results = {}
    for name in results_by_episode[0]:
        stacked_results[name] = np.stack([episode_results[name] for episode_results in results_by_episode], axis=1)
    return stacked_results


def assert_programs_agree(result, expected, rounding_step=0.0):
    """Check the results of two compiled programs, which may round logits to neighbouring steps of a grid."""
    assert result.keys() == expected.keys()
    np.testing.assert_array_equal(result["action"], expected["action"])
    # (1 + s) a - s a_bar, with s in [0, 1], moves by at most three steps.
    num_rounding_steps = {"factual": 1, "counterfactual": 1, "logits": 3}
    for name in result:
        tolerance = 1e-5 + num_rounding_steps.get(name, 0) * rounding_step
        np.testing.assert_allclose(result[name], expected[name], rtol=1e-4, atol=tolerance, err_msg=name)


@pytest.mark.slow
def test_program_of_the_model_card_needs_only_jax(drawn_run, tmp_path):
    out_dir = tmp_path / "out"
    options = ["--format", "stablehlo", "--policy", "layout-1", "--out", str(out_dir)]
    assert main(["export", str(drawn_run.config.run_dir), *options]) == 0
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-1")

    # The code of the card, in a process that can import neither jaxnav nor flax.
    steps: dict[str, Any] = draw_steps(policy)
    np.savez(out_dir / "steps.npz", **steps)
    card = (out_dir / "README.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    subprocess.run([sys.executable, "-c", JAX_ONLY_SCRIPT.format(code=code)], cwd=out_dir, check=True, timeout=200)

    # The program acts as the policy does, and removes experience.
    results = np.load(out_dir / "results.npz")
    expected = act_by_policy(policy, steps)
    assert_programs_agree({name: results[name] for name in results.files}, expected)
    assert np.ptp(expected["gap"]) > 0.01
    assert not np.allclose(expected["logits"], expected["factual"])

    # Actions, categories and inputs are described as those of the policy.
    description = json.loads((out_dir / "step.json").read_text())
    assert description["actions"][0] == "MoveAhead"
    assert description["categories"] == list(drawn_run.config.task.categories)
    num_params = sum(leaf.size for leaf in jax.tree.leaves(policy.params))
    for fact in ("`detections` uint8 [K, 4]", "`counterfactual` float32 [6]", "`org`", "`fused`", f"{num_params:,}"):
        assert fact in card


def default_decision(method_name: str) -> str:
    """Return the decision with which the program of a method is tested."""
    return "streams" if method_name in STREAM_METHODS else "fused"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method_name", "decision"),
    [
        ("org", "streams"),
        *params_by_tier([(name, default_decision(name)) for name in METHODS]),
    ],
)
def test_exported_program_acts_as_its_policy(method_name, decision):
    method = METHODS[method_name]
    direct = "goal" if decision == "streams" else "all"
    spec = dataclasses.replace(tiny.SPEC, method=method, method_sizes=(), decision=decision, direct=direct)

    # The policy, with random parameters and the knowledge that its method learns in the tiny world.
    knowledge = tiny.knowledge()
    if method.learn is not None:
        learned = method.learn([tiny.BANK], np.ones((NUM_PRIORS, spec.num_categories, spec.num_categories)))
        knowledge = knowledge._replace(method=jax.tree.map(jnp.asarray, learned))
    estimator = tiny.ESTIMATOR if method.hosts_layout else None
    policy = LoadedPolicy(tiny.random_params(2, spec), knowledge, spec, estimator, tiny.BANK.task)

    # Read the program back from its bytes, and run it step by step.
    exported = jax.export.deserialize(bytearray(export_program(policy)))
    steps = draw_steps(policy)
    memory_shapes = input_shapes(policy, NUM_EPISODES)["memory"]
    memory = {name: jnp.zeros(leaf.shape, leaf.dtype) for name, leaf in memory_shapes.items()}
    results = []
    for time in range(NUM_STEPS):
        inputs = {name: values[time] for name, values in steps.items()}
        outputs: Any = exported.call({"memory": memory} | inputs, np.float32(0.1))
        memory = outputs.pop("memory")
        results.append(outputs)

    # Streams round their logits to a grid.
    rounding_step = 2.0**-10 if decision == "streams" else 0.0
    assert_programs_agree(stack_results(results), act_by_policy(policy, steps), rounding_step)


# The export command


def test_export_command_copies_policies_and_replaces_earlier_exports(drawn_run, tmp_path):
    run_dir = drawn_run.config.run_dir
    out_dir = tmp_path / "out"

    def export(*options):
        assert main(["export", str(run_dir), *options, "--out", str(out_dir)]) == 0

    export("--policy", "baseline-1")
    original_policy = jaxnav.load_policy(run_dir / POLICIES_DIR / "baseline-1")
    chex.assert_trees_all_equal(jaxnav.load_policy(out_dir), original_policy)
    assert "no layout weights" in (out_dir / "README.md").read_text()

    # An export in another format removes all files of the earlier export.
    export("--policy", "baseline-0")
    export("--format", "stablehlo")
    assert set(contents(out_dir)) == {"README.md", "step.stablehlo", "step.json"}
    export("--policy", "baseline-0")
    original_params = run_dir / POLICIES_DIR / "baseline-0" / "params.safetensors"
    assert contents(out_dir)["params.safetensors"] == original_params.read_bytes()


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        (["--policy", "layout-9"], "has baseline-0, baseline-1, layout-0, layout-1"),
        (["--out", "."], "give another --out"),
        (["--out", "mine"], "give another --out"),
        (["--out", "file"], "give another --out"),
        (["--out", "file/out"], "cannot be written"),
    ],
)
def test_export_refuses_unknown_policies_and_foreign_folders(drawn_run, tmp_path, monkeypatch, capsys, options, advice):
    run_dir = drawn_run.config.run_dir.absolute()

    # A working directory with a file, and with a folder of another project.
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "README.md").write_text("a project of one's own")

    # The refused export changes nothing.
    assert main(["export", str(run_dir), *options]) == 2
    assert advice in refusal(capsys)
    assert contents(tmp_path) == {"file": b"", "mine/README.md": b"a project of one's own"}


def test_export_of_a_program_names_the_extra_without_flatbuffers(drawn_run, tmp_path, monkeypatch, capsys):
    def raise_import_error(_):
        raise ImportError("flatbuffers")

    monkeypatch.setattr(jax.export.Exported, "serialize", raise_import_error)
    out_dir = tmp_path / "out"
    assert main(["export", str(drawn_run.config.run_dir), "--format", "stablehlo", "--out", str(out_dir)]) == 2
    assert_message_names(refusal(capsys), "flatbuffers", "pip install 'jaxnav[export]'")
    assert not out_dir.exists()
