"""Each method from training to evaluation and export; `belief`, custom edges and macro steps have further tests."""

import dataclasses

import chex
import pytest
from support.stopping import train_in_two
from support.tiers import params_by_tier
from support.tiny_run import tiny_config

import jaxnav
from jaxnav.__main__ import main
from jaxnav.errors import InputError
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.methods import find_method
from jaxnav.runs.config import ARMS, FITTED_STEPS, RunConfig, check_config
from jaxnav.runs.train import train, warn_if_rollout_too_short

SMALL_VTNET = {"token_width": 8, "feedforward": 8, "encoder_layers": 1, "decoder_layers": 1, "query_outputs": 1}
SIZES = {"vtnet": SMALL_VTNET, "tpn": {"tentative_width": 8}}


def make_config(method, folder):
    """Settings of a run of a method with two chunks; methods of two stages have one chunk for each stage."""
    sizes = SIZES.get(method, {})
    config = dataclasses.replace(tiny_config(folder), method=method, method_sizes=sizes, seeds=1, validations=0)
    # Among 16 training rooms are some as large as the rooms of val, which maps need.
    worlds = dataclasses.replace(config.worlds, num_train=16)
    config = dataclasses.replace(config, arms=("baseline",), worlds=worlds)
    if any(stage.uses_expert for stage in find_method(method).stages):
        config = dataclasses.replace(config, imitation=0.5)
    return config


@pytest.mark.parametrize("method", params_by_tier(["rgb", "sp", "savn", "eotp", "tpn", "vtnet", "hoz", "semexp"]))
def test_method_is_trained_exported_and_evaluated(method, tmp_path):
    """The exported policy equals the policy of the run, including its knowledge."""
    run = train(make_config(method, tmp_path / "run"))
    run_dir = run.config.run_dir
    assert main(["export", str(run_dir), "--policy", "baseline-0", "--out", str(tmp_path / "out")]) == 0
    exported_policy = jaxnav.load_policy(tmp_path / "out")
    chex.assert_trees_all_equal(exported_policy, jaxnav.load_policy(run_dir / "policies" / "baseline-0"))
    assert bool(exported_policy.knowledge.method) == (find_method(method).learn is not None)

    results = jaxnav.evaluate(run, episodes=8)
    assert {leaf.shape[-1] for leaf in results.outcome} == {8}
    assert main(["export", str(run_dir), "--format", "stablehlo", "--out", str(tmp_path / "step")]) == 0


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["savn", "hoz", "semexp"])
def test_method_with_tracker_state_resumes_bit_for_bit(method, tmp_path, monkeypatch):
    """Checkpoints hold fast weights, zones and maps; `test_budget` resumes runs of methods with two stages."""
    config = make_config(method, tmp_path / "uninterrupted")
    run = train(config)
    resumed_run = train_in_two(dataclasses.replace(config, run_dir=tmp_path / "resumed"), monkeypatch)
    assert resumed_run.log() == run.log()
    policy = jaxnav.load_policy(run.config.run_dir / "policies" / "baseline-0")
    resumed_policy = jaxnav.load_policy(resumed_run.config.run_dir / "policies" / "baseline-0")
    chex.assert_trees_all_equal(policy, resumed_policy)


#: Module with a variant of the method `sp`, whose graph is read from a file of edges.
PRIORS_MODULE = """
import dataclasses, functools
from jaxnav.policies.methods import METHODS
from jaxnav.policies.methods.sp import graph_from_file

PRIORS = dataclasses.replace(METHODS["sp"], learn=functools.partial(graph_from_file, "edges.csv"))
"""


@pytest.mark.exhaustive
def test_custom_edges_must_match_the_categories_of_the_world(tmp_path, monkeypatch):
    (tmp_path / "my_priors.py").write_text(PRIORS_MODULE)
    (tmp_path / "edges.csv").write_text("Mug,DiningTable")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)

    # Rooms have none of these categories.
    method = "my_priors:PRIORS"
    config = dataclasses.replace(tiny_config(tmp_path / "run"), method=method, method_sizes={}, seeds=1, validations=0)
    with pytest.raises(InputError, match=r"fails check_method \(InputError: edges.csv:1: category 'Mug' is unknown"):
        train(config)

    # Apartments have both: the edge and the loop of the node weigh a half each, and every row sums up to 1.
    worlds = dataclasses.replace(config.worlds, num_train=2)
    config = dataclasses.replace(config, world="apartments", arms=("baseline",), worlds=worlds, total_steps=256)
    mixing = train(config).policies().knowledge.method["mixing"]
    mug = config.task.categories.index("Mug")
    dining_table = config.task.categories.index("DiningTable")
    assert mixing[mug, dining_table] == 0.5
    assert float(mixing.sum()) == len(mixing)


@pytest.mark.parametrize(("rollout", "is_warned"), [(24, True), (25, False)])
def test_train_warns_of_rollouts_shorter_than_a_macro_step(rollout, is_warned, tmp_path, capsys):
    config = dataclasses.replace(tiny_config(tmp_path), method="semexp", method_sizes={})
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, rollout=rollout))
    warn_if_rollout_too_short(config, PlainConsole(width=200))
    assert ("give --ppo.rollout 50 or more" in capsys.readouterr().out) == is_warned
    warn_if_rollout_too_short(dataclasses.replace(config, method="org"), PlainConsole())
    assert capsys.readouterr().out == ""


@pytest.mark.exhaustive
def test_belief_is_fitted_exported_swept_and_evaluated(tmp_path):
    """Method `belief` is fitted instead of trained, and a repeated command reads the fit."""
    config = tiny_config(tmp_path)
    worlds = dataclasses.replace(config.worlds, num_train=16)
    config = dataclasses.replace(config, method="belief", method_sizes={}, arms=ARMS, worlds=worlds, validations=1)
    run = train(config)
    run_dir = run.config.run_dir
    assert run.config.arms == ("layout",)
    estimator_config = run.policies().estimator_config
    assert estimator_config is not None
    assert estimator_config.form == "paper"
    assert run.config.steps_by_purpose == {"exploration": 64 * 20, "searches": 512}
    assert run.success_by_budget() is not None

    # Seeds share their knowledge, and differ in their fits.
    policies = [jaxnav.load_policy(run_dir / "policies" / f"layout-{seed}") for seed in range(2)]
    chex.assert_trees_all_equal(policies[0].knowledge, policies[1].knowledge)
    assert (policies[0].params["method"]["relations"] != policies[1].params["method"]["relations"]).any()

    # A repeated command reads the fit, and exports it again.
    params_file = run_dir / "policies" / "layout-1" / "params.safetensors"
    params_before = params_file.read_bytes()
    train(config)
    assert params_file.read_bytes() == params_before

    # A sweep has two thresholds and two seeds; without removal, at epsilon 1, the agent acts by its complete belief.
    sweep = jaxnav.sweep(run, epsilon=[0.0, 1.0], episodes=8)
    assert sweep.sr.shape[:2] == (2, 2)

    # The run can be evaluated, and the program of a step can be exported.
    results = jaxnav.evaluate(run, episodes=8)
    assert {leaf.shape[-1] for leaf in results.outcome} == {8}
    assert main(["export", str(run_dir), "--format", "stablehlo", "--out", str(tmp_path / "step")]) == 0


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"arms": ("baseline",)}, r"arms is \('baseline',\); method 'belief' holds its agent without experience"),
        ({"decision": "streams"}, "decision is streams; the scores of method 'belief' are a sum already"),
    ],
)
def test_belief_has_one_arm_and_one_decision(settings, problem):
    with pytest.raises(InputError, match=problem):
        check_config(RunConfig(method="belief", **settings))
    config = check_config(RunConfig(method="belief"))
    assert config.arms == ("layout",)
    assert config.total_steps == FITTED_STEPS
    assert not config.spatial_memory
