"""Runs and exported policies of earlier versions, which lack some settings and fields of this version."""

import dataclasses
import shutil

import jax.numpy as jnp
import pytest
from support.commands import contents
from support.mutations import resigned

import jaxnav
from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, WorldConfig, check_config
from jaxnav.runs.policies import POLICIES_DIR, export_policy, knowledge_from_arrays
from jaxnav.runs.run import claim_run_dir, comparable_settings, load_run_config, manifest_settings, run_settings
from jaxnav.store.export import load_params
from jaxnav.store.files import write_json_with_digest
from jaxnav.training.calibration import Exploration
from jaxnav.training.config import PPOConfig


def make_config(**changes):
    """Completed default settings of a run, with changes."""
    return check_config(dataclasses.replace(RunConfig(), **changes))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"ppo": PPOConfig(experience=0.8)},
        {"counterfactual_memory": "own"},
        {"counterfactual_memory": "own", "ppo": PPOConfig(experience=0.5)},
        {"decision": "streams"},
        {"decision": "streams", "ppo": PPOConfig(experience=0.6)},
    ],
)
def test_settings_of_a_run_survive_writing_and_reading(tmp_path, changes):
    config = make_config(run_dir=tmp_path / "run", **changes)
    claim_run_dir(config)
    loaded_config = load_run_config(config.run_dir)
    assert run_settings(loaded_config) == run_settings(config)
    assert loaded_config.policy_spec(9) == config.policy_spec(9)
    assert loaded_config.ppo == config.ppo


def test_experience_dropout_changes_the_settings_of_a_run():
    default_settings = run_settings(make_config())
    dropout_settings = run_settings(make_config(ppo=PPOConfig(experience=0.8)))
    assert default_settings != dropout_settings
    assert "counterfactual_memory" not in default_settings


@pytest.mark.parametrize("ignored_experience", [0.8, 0.3])
def test_fused_run_of_an_earlier_version_has_no_experience_dropout(tmp_path, ignored_experience):
    """Files of such runs hold `ppo.experience`, which fused networks ignored, and no kind of counterfactual memory."""
    settings = run_settings(make_config())
    settings["ppo"]["experience"] = ignored_experience
    (tmp_path / "run").mkdir()
    write_json_with_digest(tmp_path / "run" / "config.json", settings)
    config = load_run_config(tmp_path / "run")
    assert config.ppo.experience == 1.0
    assert config.counterfactual_memory == "factual"


def test_houses_of_an_earlier_version_keep_the_earlier_views(tmp_path):
    """Results without the setting `front_cell` are recognized as earlier ones, and the manifest of a run is kept."""
    earlier_config = make_config(world="houses", worlds=WorldConfig(front_cell="nearest"), run_dir=tmp_path / "run")
    settings = run_settings(earlier_config)
    del settings["worlds"]["front_cell"]
    (tmp_path / "run").mkdir()
    write_json_with_digest(tmp_path / "run" / "config.json", settings)
    assert load_run_config(tmp_path / "run").task.rules.front_cell == "nearest"

    # The run resumes under its own settings; the views of this version would make it another run.
    claim_run_dir(earlier_config)
    assert manifest_settings(earlier_config) == settings
    with pytest.raises(InputError, match=r"worlds.front_cell: 'nearest' != 'move'"):
        claim_run_dir(make_config(world="houses", run_dir=tmp_path / "run"))

    # Earlier views are recognized by the absent setting. In rooms both kinds of views are equal.
    assert "front_cell" not in comparable_settings(earlier_config)["worlds"]
    assert comparable_settings(make_config(world="houses"))["worlds"]["front_cell"] == "move"
    assert "front_cell" not in comparable_settings(make_config(world="rooms"))["worlds"]


def test_rooms_of_an_earlier_version_resume_with_default_settings(tmp_path):
    """In rooms both kinds of views are equal, so the defaults of this version are those of the earlier run."""
    config = make_config(world="rooms", run_dir=tmp_path / "run")
    settings = run_settings(config)
    del settings["worlds"]["front_cell"]
    (tmp_path / "run").mkdir()
    write_json_with_digest(tmp_path / "run" / "config.json", settings)
    claim_run_dir(config)
    assert manifest_settings(config) == settings


def test_missing_setting_is_refused(tmp_path):
    settings = run_settings(make_config())
    del settings["ppo"]["gamma"]
    (tmp_path / "run").mkdir()
    write_json_with_digest(tmp_path / "run" / "config.json", settings)
    with pytest.raises(InputError, match=r"lacks settings \(ppo.gamma: \(absent\) != 0.99\)"):
        load_run_config(tmp_path / "run")


@pytest.mark.parametrize("front_cell", ["nearest", "move"])
def test_export_of_an_earlier_version_is_kept_when_its_policy_is_exported_again(drawn_run, tmp_path, front_cell):
    """An export without the field has the earlier views, so a policy with the views of this version is another one."""
    config = make_config(world="houses", worlds=WorldConfig(front_cell=front_cell), sizes=drawn_run.config.sizes)
    arrays, _ = load_params(drawn_run.config.run_dir / POLICIES_DIR / "baseline-0")
    counts = jnp.asarray(arrays["layout"]["counts"])
    exploration = Exploration(counts, prior_counts=counts, steps=jnp.int32(10), poses=jnp.int32(4))
    knowledge = knowledge_from_arrays(arrays)

    def export():
        export_policy(tmp_path, config, arrays["policy"], knowledge, None, exploration)

    export()

    # Exports of earlier versions lack the field.
    with resigned(tmp_path / "policy.json") as exported:
        del exported["spec"]["task"]["rules"]["front_cell"]
        del exported["spec"]["spatial_memory"]["front_cell"]
    earlier_files = contents(tmp_path)

    # A repeated export changes no file, and one with other views is refused.
    if front_cell == "nearest":
        export()
    else:
        with pytest.raises(InputError, match="another policy"):
            export()
    assert contents(tmp_path) == earlier_files


def test_policy_of_an_earlier_version_is_loaded(drawn_run, tmp_path):
    folder = shutil.copytree(drawn_run.config.run_dir / POLICIES_DIR / "layout-0", tmp_path / "layout-0")
    with resigned(folder / "policy.json") as exported:
        del exported["spec"]["experience_dropout"]
        del exported["spec"]["counterfactual_memory"]
    policy = jaxnav.load_policy(folder)
    assert policy.spec == jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-0").spec
    assert not policy.spec.experience_dropout
    assert policy.spec.counterfactual_memory == "factual"
    assert policy.init().policy_state.use_experience is None
