"""An exported step acts as the policy, where neither jaxnav nor flax can be imported."""

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

import jaxnav
from jaxnav.__main__ import main
from jaxnav.env.objectnav import NUM_PRIORS, Observation
from jaxnav.policies.methods import METHODS
from jaxnav.runs.policies import POLICIES_DIR
from jaxnav.runs.policy import LoadedPolicy, export_program, input_shapes
from jaxnav.scenes.tables.observation_row import RowFormat

EPISODES, STEPS = 3, 4
#: A process that knows JAX alone runs the code of the model card, then the steps of a file.
ALONE = """
import sys

class Nothing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("jaxnav", "flax", "optax", "chex"):
            raise ImportError(name)

sys.meta_path.insert(0, Nothing())
{code}
steps = np.load("steps.npz")
inputs = jax.tree.map(lambda each: np.zeros((3, *each.shape[1:]), each.dtype), shapes)
found = {{}}
for time in range(4):
    inputs |= {{name: steps[name][time] for name in steps.files}}
    outputs = step.call(inputs, np.float32(0.1))
    inputs["memory"] = outputs.pop("memory")
    for name, value in outputs.items():
        found.setdefault(name, []).append(value)
np.savez("found.npz", **found)
"""


def walk(policy: LoadedPolicy) -> dict[str, np.ndarray]:
    """Inputs of steps that are no episode of any world, so that nothing in them is alike; the second begins anew."""
    rng = np.random.default_rng(0)
    shapes = input_shapes(policy, EPISODES)
    del shapes["memory"]
    limits = {"detections": 256, "view": 3, "goal": 5, "action": 6, "heading": 8, "horizon": 2, "room": 5, "moved": 2}
    steps = {
        name: rng.integers(0, limits[name], (STEPS, *leaf.shape)).astype(leaf.dtype)
        for name, leaf in shapes.items()
        if name in limits
    }
    steps["detections"][..., 0] *= rng.random(steps["detections"].shape[:-1]) < 0.12  # few are detected
    steps["room"][:] = steps["room"][0]
    steps["first"] = np.zeros((STEPS, EPISODES), bool)
    steps["first"][0], steps["first"][2, 1] = True, True
    return steps


def acted(policy: LoadedPolicy, steps: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What the policy makes of the same steps, one episode after the other."""
    decide, result = jax.jit(LoadedPolicy.decide), []
    for episode in range(EPISODES):
        memory = policy.begin(jnp.int32(0))
        for time in range(STEPS):
            inputs = {name: jnp.asarray(values[time, episode]) for name, values in steps.items()}
            if inputs["first"]:
                memory = policy.begin(inputs["room"])
            else:
                memory = memory._replace(policy_state=memory.policy_state._replace(action=inputs["action"]))
            row = RowFormat(policy.spec.num_categories).pack(inputs["detections"], inputs["view"])
            observation = Observation(row, inputs["goal"])
            odometry = {name: inputs[name] for name in ("heading", "moved", "horizon")}
            odometry["moved"] = inputs["moved"] & ~inputs["first"]
            choice = decide(policy, observation, memory, jnp.float32(0.1), **odometry)
            action, memory = policy.apply_choice(choice, jnp.argmax(choice.logits).astype(jnp.int32), memory.room)
            names = ("logits", "factual", "counterfactual", "gap", "weights")
            result.append({"action": action} | {name: getattr(choice, name) for name in names})
    shape = EPISODES, STEPS
    return {
        name: np.stack([step_result[name] for step_result in result]).reshape(*shape, *np.shape(value)).swapaxes(0, 1)
        for name, value in result[0].items()
        if value is not None
    }


def assert_same(result, expected, rounding_step=0.0):
    """Two compiled programs agree; where logits are rounded to a grid, one may take the next step of it."""
    assert result.keys() == expected.keys()
    np.testing.assert_array_equal(result["action"], expected["action"])
    # (1 + s) a - s a_bar, with s in [0, 1], moves by at most three steps.
    num_steps = {"factual": 1, "counterfactual": 1, "logits": 3}
    for name in result:
        tolerance = 1e-5 + num_steps.get(name, 0) * rounding_step
        np.testing.assert_allclose(result[name], expected[name], rtol=1e-4, atol=tolerance, err_msg=name)


def test_model_card_program_runs_with_jax_alone(drawn_run, tmp_path):
    out = tmp_path / "out"
    options = ["--format", "stablehlo", "--policy", "layout-1", "--out", str(out)]
    assert main(["export", str(drawn_run.config.run_dir), *options]) == 0
    policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-1")
    steps: dict[str, Any] = walk(policy)
    card = (out / "README.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    np.savez(out / "steps.npz", **steps)
    subprocess.run([sys.executable, "-c", ALONE.format(code=code)], cwd=out, check=True, timeout=200)
    result = np.load(out / "found.npz")
    assert_same({name: result[name] for name in result.files}, expected := acted(policy, steps))
    assert np.ptp(expected["gap"]) > 0.01
    assert not np.allclose(expected["logits"], expected["factual"])  # experience was removed
    named = json.loads((out / "step.json").read_text())
    assert named["actions"][0] == "MoveAhead"
    assert named["categories"] == list(drawn_run.config.task.categories)
    assert "* `detections` uint8 [K, 4]: for each category" in card
    assert "`counterfactual` float32 [6]" in card
    assert "**Method**: `org`, decision `fused`, layout weights" in card
    assert f"**Parameters**: {sum(leaf.size for leaf in jax.tree.leaves(policy.params)):,}" in card


@pytest.mark.parametrize(
    ("method", "decision"),
    [
        ("org", "streams"),
        *(
            pytest.param(method, "streams" if method in ("savn", "sp", "vtnet") else "fused", marks=pytest.mark.slow)
            for method in METHODS
        ),
    ],
)
def test_exported_program_acts_as_its_policy(method, decision):
    direct = "goal" if decision == "streams" else "all"
    spec = dataclasses.replace(tiny.SPEC, method=METHODS[method], method_sizes=(), decision=decision, direct=direct)
    learn, method_knowledge = METHODS[method].learn, tiny.knowledge()
    if learn is not None:
        learned = learn([tiny.BANK], np.ones((NUM_PRIORS, spec.num_categories, spec.num_categories)))
        method_knowledge = method_knowledge._replace(method=jax.tree.map(jnp.asarray, learned))
    setting = tiny.ESTIMATOR if METHODS[method].hosts_layout else None
    policy = LoadedPolicy(tiny.random_params(2, spec), method_knowledge, spec, setting, tiny.BANK.task)
    exported, steps = jax.export.deserialize(bytearray(export_program(policy))), walk(policy)
    memory = {name: jnp.zeros(leaf.shape, leaf.dtype) for name, leaf in input_shapes(policy, 3)["memory"].items()}
    result = []
    for time in range(STEPS):
        outputs: Any = exported.call(
            {"memory": memory} | {name: values[time] for name, values in steps.items()}, np.float32(0.1)
        )
        memory = outputs.pop("memory")
        result.append(outputs)
    stacked = {name: np.stack([step_result[name] for step_result in result]) for name in result[0]}
    assert_same(stacked, acted(policy, steps), rounding_step=2.0**-10 if decision == "streams" else 0.0)


def test_export_command_copies_policies_and_replaces_earlier_exports(drawn_run, tmp_path):
    run, out = drawn_run.config.run_dir, tmp_path / "out"
    assert main(["export", str(run), "--policy", "baseline-1", "--out", str(out)]) == 0
    policies = [jaxnav.load_policy(folder) for folder in (out, run / POLICIES_DIR / "baseline-1")]
    chex.assert_trees_all_equal(*policies)
    assert "no layout weights" in (out / "README.md").read_text()
    assert main(["export", str(run), "--policy", "baseline-0", "--out", str(out)]) == 0  # replaced
    assert main(["export", str(run), "--format", "stablehlo", "--out", str(out)]) == 0
    assert set(contents(out)) == {"README.md", "step.stablehlo", "step.json"}  # nothing of the other format is left
    assert main(["export", str(run), "--policy", "baseline-0", "--out", str(out)]) == 0
    assert contents(out)["params.safetensors"] == contents(run / POLICIES_DIR / "baseline-0")["params.safetensors"]


@pytest.mark.parametrize(
    ("options", "mend"),
    [
        (["--policy", "layout-9"], "has baseline-0, baseline-1, layout-0, layout-1"),
        (["--out", "."], "is there and holds no export; give another --out"),
        (["--out", "mine"], "is there and holds no export; give another --out"),
        (["--out", "file"], "is there and holds no export; give another --out"),
        (["--out", "file/out"], "cannot be written"),
    ],
)
def test_export_refuses_unknown_policies_and_foreign_folders(drawn_run, tmp_path, monkeypatch, capsys, options, mend):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "README.md").write_text("a project of one's own")
    assert main(["export", str(drawn_run.config.run_dir.absolute()), *options]) == 2
    assert mend in refusal(capsys)
    assert contents(tmp_path) == {"file": b"", "mine/README.md": b"a project of one's own"}


def test_export_of_a_program_names_the_extra_without_flatbuffers(drawn_run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(jax.export.Exported, "serialize", nothing_there)
    out = tmp_path / "out"
    assert main(["export", str(drawn_run.config.run_dir), "--format", "stablehlo", "--out", str(out)]) == 2
    assert "needs flatbuffers; install it by: pip install 'jaxnav[export]'" in refusal(capsys)
    assert not out.exists()


def nothing_there(_):
    raise ImportError("flatbuffers")
