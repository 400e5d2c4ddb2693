"""Methods from training to evaluation, export and action; those with more to show are tested beside that."""

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


def config_of(method, folder):
    """Settings of a run of two chunks of a method, one of each of its stages."""
    sizes = SIZES.get(method, {})
    config = dataclasses.replace(tiny_config(folder), method=method, method_sizes=sizes, seeds=1, validations=0)
    worlds = dataclasses.replace(config.worlds, num_train=16)  # among them rooms as large as those of val, for maps
    config = dataclasses.replace(config, arms=("baseline",), worlds=worlds)
    if any(stage.uses_expert for stage in find_method(method).stages):
        config = dataclasses.replace(config, imitation=0.5)  # a chunk for each stage
    return config


@pytest.mark.parametrize("method", params_by_tier(["rgb", "sp", "savn", "eotp", "tpn", "vtnet", "hoz", "semexp"]))
def test_method_is_trained_exported_and_evaluated(method, tmp_path):
    """The exported policy is that of the run, with the same knowledge."""
    run = train(config_of(method, tmp_path / "one"))
    folder = run.config.run_dir
    assert main(["export", str(folder), "--policy", "baseline-0", "--out", str(tmp_path / "out")]) == 0
    exported = jaxnav.load_policy(tmp_path / "out")
    chex.assert_trees_all_equal(exported, jaxnav.load_policy(folder / "policies" / "baseline-0"))
    assert bool(exported.knowledge.method) == (find_method(method).learn is not None)

    results = jaxnav.evaluate(run, episodes=8)
    assert {leaf.shape[-1] for leaf in results.outcome} == {8}
    assert main(["export", str(folder), "--format", "stablehlo", "--out", str(tmp_path / "step")]) == 0


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["savn", "hoz", "semexp"])
def test_method_with_tracker_state_resumes_bit_for_bit(method, tmp_path, monkeypatch):
    """Fast weights, zones and maps are in the checkpoint; those of several stages are resumed in `test_budget`."""
    config = config_of(method, tmp_path / "one")
    whole = train(config)
    resumed = train_in_two(dataclasses.replace(config, run_dir=tmp_path / "two"), monkeypatch)
    assert resumed.log() == whole.log()
    runs = [jaxnav.load_policy(run.config.run_dir / "policies" / "baseline-0") for run in (whole, resumed)]
    chex.assert_trees_all_equal(*runs)


PRIORS = """
import dataclasses, functools
from jaxnav.policies.methods import METHODS
from jaxnav.policies.methods.sp import graph_from_file

PRIORS = dataclasses.replace(METHODS["sp"], learn=functools.partial(graph_from_file, "edges.csv"))
"""


@pytest.mark.exhaustive
def test_custom_edges_must_match_the_categories_of_the_world(tmp_path, monkeypatch, capsys):
    (tmp_path / "my_priors.py").write_text(PRIORS)
    (tmp_path / "edges.csv").write_text("Mug,DiningTable")  # which rooms do not know
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    method = "my_priors:PRIORS"
    config = dataclasses.replace(tiny_config(tmp_path / "one"), method=method, method_sizes={}, seeds=1, validations=0)
    with pytest.raises(InputError, match=r"fails check_method \(InputError: edges.csv:1: category 'Mug' is unknown"):
        train(config)
    worlds = dataclasses.replace(config.worlds, num_train=2)
    config = dataclasses.replace(config, world="apartments", arms=("baseline",), worlds=worlds, total_steps=256)
    learned = train(config).policies().knowledge.method["mixing"]
    edge = [config.task.categories.index(name) for name in ("Mug", "DiningTable")]
    assert learned[edge[0], edge[1]] == 0.5  # one of two: the edge and the loop
    assert float(learned.sum()) == len(learned)


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
    """The fit takes the place of training, and is read by a repeated command."""
    config = tiny_config(tmp_path)
    worlds = dataclasses.replace(config.worlds, num_train=16)
    config = dataclasses.replace(config, method="belief", method_sizes={}, arms=ARMS, worlds=worlds, validations=1)
    run = train(config)
    folder = run.config.run_dir
    assert run.config.arms == ("layout",)
    estimator_config = run.policies().estimator_config
    assert estimator_config is not None
    assert estimator_config.form == "paper"
    assert run.config.steps_by_purpose == {"exploration": 64 * 20, "searches": 512}
    assert run.success_by_budget() is not None
    policies = [jaxnav.load_policy(folder / "policies" / f"layout-{seed}") for seed in range(2)]
    chex.assert_trees_all_equal(policies[0].knowledge, policies[1].knowledge)
    assert (policies[0].params["method"]["relations"] != policies[1].params["method"]["relations"]).any()

    # A repeated command reads the fit, and exports it again.
    before = (folder / "policies" / "layout-1" / "params.safetensors").read_bytes()
    train(config)
    assert (folder / "policies" / "layout-1" / "params.safetensors").read_bytes() == before

    # Without removal a sweep gives the complete belief; the program of a step is exported.
    sweep = jaxnav.sweep(run, epsilon=[0.0, 1.0], episodes=8)
    assert sweep.sr.shape[:2] == (2, 2)
    results = jaxnav.evaluate(run, episodes=8)
    assert {leaf.shape[-1] for leaf in results.outcome} == {8}
    assert main(["export", str(folder), "--format", "stablehlo", "--out", str(tmp_path / "step")]) == 0


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
    assert (config.arms, config.total_steps, config.spatial_memory) == (("layout",), FITTED_STEPS, False)
