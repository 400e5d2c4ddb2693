"""Training stages, their shares of the step budget, and the environment steps behind a policy."""

import dataclasses
import json

import chex
import numpy as np
import pytest
from support.stopping import train_in_two

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.notes import budget_note
from jaxnav.policies.method import Method, Stage
from jaxnav.policies.methods.rgb import NoExperience
from jaxnav.runs.config import LayoutConfig, RunConfig, check_config
from jaxnav.runs.train import train
from jaxnav.runs.validation import Validator
from jaxnav.training.config import PPOConfig

#: Ten chunks of two updates of 64 x 10 steps.
CONFIG = RunConfig(
    method="vtnet",
    chunk=2,
    total_steps=10 * 2 * 640,
    ppo=PPOConfig(num_envs=64, rollout=10, minibatches=4),
    layout=LayoutConfig(walks=30, steps=20),
)


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"world": "gardens"}, "world"),
        ({"counterfactual": "distill"}, "counterfactual"),
        ({"arms": ("base",)}, "arms"),
        ({"seeds": 2.5}, "seeds"),
        ({"total_steps": 1e6}, "total_steps"),
        ({"layout": LayoutConfig(setting="Paper")}, "layout.setting"),  # pyright: ignore[reportArgumentType]
        ({"ppo": PPOConfig(num_envs=64.0)}, "ppo.num_envs"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_check_config_refuses_settings_of_wrong_types(settings, key):
    with pytest.raises(InputError, match=f"^config: {key} must be "):
        check_config(dataclasses.replace(CONFIG, **settings))


def test_check_config_converts_numpy_numbers_and_lists():
    config = check_config(dataclasses.replace(CONFIG, seeds=np.int64(2), arms=["layout"]))
    assert (type(config.seeds), config.seeds, config.arms) == (int, 2, ("layout",))


def test_imitation_stage_counts_towards_the_step_budget():
    # VTNet imitates first: a fifth of ten chunks of 1,280 steps. Exploration takes 30 walks of 20 steps.
    assert CONFIG.stage_by_chunk == [0, 0, 1, 1, 1, 1, 1, 1, 1, 1]
    assert CONFIG.steps_by_purpose == {"exploration": 600, "imitation": 2 * 1280, "learning": 8 * 1280}

    # ORG has a single stage.
    org_config = dataclasses.replace(CONFIG, method="org")
    assert org_config.stage_by_chunk == 10 * [0]
    assert org_config.steps_by_purpose == {"exploration": 600, "imitation": 0, "learning": 12800}

    # TPN imitates in its last stage, with an equal budget.
    tpn_config = dataclasses.replace(CONFIG, method="tpn")
    assert tpn_config.stage_by_chunk == [0, 0, 0, 0, 0, 0, 0, 0, 1, 1]
    assert tpn_config.steps_by_purpose == CONFIG.steps_by_purpose
    assert dataclasses.replace(tpn_config, imitation=0.5).stage_by_chunk == 5 * [0] + 5 * [1]

    budget = "600 of random exploration for the layout priors, 2,560 of imitation learning, 10,240 of reinforcement"
    assert budget in budget_note(CONFIG.steps_by_purpose)


@pytest.mark.parametrize(("share", "num_chunks"), [(0.5, 5), (0.25, 3), (0.01, 1), (0.9, 9)])
def test_stage_share_is_rounded_to_whole_chunks(share, num_chunks):
    config = check_config(dataclasses.replace(CONFIG, imitation=share))
    assert config.stage_by_chunk == num_chunks * [0] + (10 - num_chunks) * [1]
    assert sum(stage.share for stage in config.stages) == pytest.approx(1.0)
    assert sum(config.steps_by_purpose.values()) - 600 == CONFIG.total_steps


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"imitation": 0.0}, "config: imitation is 0.0; give a share between 0 and 1, both excluded"),
        ({"imitation": 1.0}, "config: imitation is 1.0; give a share between 0 and 1, both excluded"),
        ({"imitation": float("nan")}, "config: imitation must be float or null, but is nan"),
        ({"imitation": 0.95}, "config: imitation is 0.95; stage 2 of method 'vtnet', a share of 0.05, gets none"),
        ({"total_steps": 1}, "config: total_steps is 1; stage 2 of method 'vtnet', a share of 0.8, gets none of the 1"),
        (
            {"method": "tpn", "imitation": 0.01, "total_steps": 1280},
            "config: imitation is 0.01; stage 2 of method 'tpn', a share of 0.01, gets none of the 1 chunks",
        ),
        ({"method": "org", "imitation": 0.2}, "config: imitation is 0.2; method 'org' does not have stages both"),
    ],
)
def test_config_refuses_impossible_stage_shares(options, message):
    with pytest.raises(InputError) as refusal:
        check_config(dataclasses.replace(CONFIG, **options))
    assert str(refusal.value).startswith(message)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("shares", [(), (0.5,), (0.5, 0.6), (0.0, 1.0)])
def test_stage_shares_of_a_method_add_up(shares):
    with pytest.raises(ValueError, match="add up to 1"):
        Method(NoExperience, stages=tuple(Stage(share) for share in shares))


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["vtnet", "tpn"])
def test_staged_run_resumes_between_its_stages(method, config, tmp_path, monkeypatch):
    """With two chunks, one of each stage, a run that stops after the first chunk ends like an uninterrupted run."""
    imitates_first = method == "vtnet"
    if imitates_first:
        sizes = {"token_width": 8, "feedforward": 8, "encoder_layers": 1, "decoder_layers": 1, "query_outputs": 1}
    else:
        sizes = {"tentative_width": 8}
    options = {"method": method, "method_sizes": sizes, "imitation": 0.5, "arms": ("baseline",), "seeds": 1}
    config = dataclasses.replace(config, **options, validations=2, val_episodes=4, run_dir=tmp_path / "uninterrupted")

    # Train the uninterrupted run, and record with which adaptation each validation measures.
    adapts_online_by_validation = []
    measure = Validator.measure

    def record_and_measure(validator, policies, adapts_online):
        adapts_online_by_validation.append(adapts_online)
        return measure(validator, policies, adapts_online)

    with monkeypatch.context() as patch:
        patch.setattr(Validator, "measure", record_and_measure)
        run = train(config)

    # A validation adapts where its stage does: the first stage of TPN does not.
    assert adapts_online_by_validation == [method != "tpn", True]

    # A chunk of imitation logs the imitation loss, and a chunk of reinforcement learning the policy loss.
    has_imitation_loss = ["imitation_loss" in row for row in run.log()]
    assert has_imitation_loss == ([True, False] if imitates_first else [False, True])
    assert ["policy_loss" in row for row in run.log()] == [not is_imitation for is_imitation in has_imitation_loss]

    # Checkpoints and the report state the budget: 64 walks of 20 steps, and two chunks of 2 x 16 x 8 steps.
    expected_budget = {"exploration": 1280, "imitation": 256, "learning": 256}
    for checkpoint in (run.config.run_dir / "checkpoints").iterdir():
        metadata = json.loads((checkpoint / "_CHECKPOINT_METADATA").read_text())["custom_metadata"]
        assert metadata["manifest"]["config"]["budget"] == expected_budget

    # The resumed run has equal logs and parameters.
    resumed_run = train_in_two(dataclasses.replace(config, run_dir=tmp_path / "resumed"), monkeypatch)
    assert resumed_run.log() == run.log()
    policy = jaxnav.load_policy(run.config.run_dir / "policies" / "baseline-0")
    resumed_policy = jaxnav.load_policy(resumed_run.config.run_dir / "policies" / "baseline-0")
    chex.assert_trees_all_equal(policy.params, resumed_policy.params)
    assert jaxnav.evaluate(run, episodes=8).report["run"]["budget"] == expected_budget
