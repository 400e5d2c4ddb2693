"""YAML files applied to config dataclasses: accepted values, refused values, and the advice in messages."""

import dataclasses
from pathlib import Path
from typing import Literal

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from support.refusals import assert_message_names

from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig
from jaxnav.runs.config_files import CONFIGS, apply_yaml


@dataclasses.dataclass(frozen=True)
class Ppo:
    learning_rate: float = 1e-3
    clip: float | None = 0.2
    epochs: int = 4
    anneal: bool = True


@dataclasses.dataclass(frozen=True)
class Config:
    ppo: Ppo = Ppo(epochs=2)
    name: str = "run"
    setting: Literal["paper", "calibrated", 1] = "paper"
    epsilons: tuple[float, ...] = (0.1,)
    view: tuple[int, int] = (11, 11)
    limit: "int | None" = None


@pytest.fixture
def apply_text(tmp_path):
    """Function that applies the text of a file to the default `Config`."""

    def apply(text: str | bytes) -> Config:
        path = tmp_path / "config.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return apply_yaml(Config(), path)

    return apply


def test_apply_yaml_changes_only_named_values(apply_text):
    # ppo.epochs is 2 in the default instance and 4 in the class: values that the file omits stay as in the instance.
    assert apply_text("ppo:\n  learning_rate: 0.5\nname: x\n") == Config(ppo=Ppo(learning_rate=0.5, epochs=2), name="x")


@pytest.mark.parametrize("text", ["", "# nothing\n", "---\n", "{}"])
def test_apply_yaml_of_an_empty_file_changes_nothing(apply_text, text):
    assert apply_text(text) == Config()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("ppo: {learning_rate: 3e-4}", Config(ppo=Ppo(learning_rate=3e-4, epochs=2))),  # a text in YAML 1.1
        ("ppo: {learning_rate: 1}", Config(ppo=Ppo(learning_rate=1.0, epochs=2))),
        ("ppo: {clip: null}", Config(ppo=Ppo(clip=None, epochs=2))),
        ("ppo: {clip: 1e-1}", Config(ppo=Ppo(clip=0.1, epochs=2))),
        ("ppo: {anneal: false}", Config(ppo=Ppo(anneal=False, epochs=2))),
        ("epsilons: [1e-2, 1, .inf]", Config(epsilons=(0.01, 1.0, float("inf")))),
        ("epsilons: []", Config(epsilons=())),
        ("view: [5, 7]", Config(view=(5, 7))),
        ("limit: 3", Config(limit=3)),
        ("setting: calibrated", Config(setting="calibrated")),
        ("setting: 1", Config(setting=1)),
        ("name: '3'", Config(name="3")),
    ],
)
def test_apply_yaml_converts_values_by_annotation(apply_text, text, expected):
    config = apply_text(text)
    assert config == expected
    assert repr(config) == repr(expected)  # 1 == 1.0, but their texts differ


@pytest.mark.parametrize(
    ("text", "key", "expected_type", "wrong_value"),
    [
        ("ppo: {learning_rate: fast}", "ppo.learning_rate", "float", "'fast' (str)"),
        ("ppo: {learning_rate: true}", "ppo.learning_rate", "float", "True (bool)"),
        ("ppo: {learning_rate: null}", "ppo.learning_rate", "float", "null"),
        ("ppo: {learning_rate: .nan}", "ppo.learning_rate", "float", "nan (float)"),
        ("ppo: {epochs: 4.0}", "ppo.epochs", "int", "4.0 (float)"),
        ("ppo: {epochs: true}", "ppo.epochs", "int", "True (bool)"),
        ("ppo: {epochs: 1e3}", "ppo.epochs", "int", "'1e3' (str)"),
        ("ppo: {anneal: 1}", "ppo.anneal", "bool", "1 (int)"),
        ("ppo: {clip: [1]}", "ppo.clip", "float or null", "[1] (list)"),
        ("name: 3", "name", "str", "3 (int)"),
        ("setting: papr", "setting", "one of 'paper', 'calibrated', 1", "'papr' (str)"),
        ("setting: true", "setting", "one of", "True (bool)"),
        ("epsilons: 0.1", "epsilons", "a list of float", "0.1 (float)"),
        ("epsilons: [0.1, x]", "epsilons", "a list of float", "[0.1, 'x'] (list)"),
        ("view: [1]", "view", "a list [int, int]", "[1] (list)"),
        ("limit: many", "limit", "int or null", "'many' (str)"),
        ("ppo: 3", "ppo", "a mapping", "3 (int)"),
        ("ppo:", "ppo", "a mapping", "null"),
    ],
)
def test_apply_yaml_refuses_values_of_wrong_types(apply_text, text, key, expected_type, wrong_value):
    with pytest.raises(InputError) as error:
        apply_text(text)
    for part in ("config.yaml: ", f" {key} ", expected_type, wrong_value):
        assert part in str(error.value)


@pytest.mark.parametrize(
    ("text", "key", "problem"),
    [
        # YAML 1.1 reads these as octal or in base 60; the command line and YAML 1.2 read 010 as 10.
        ("limit: 010", "limit", "010, which YAML 1.1 reads as 8"),
        ("ppo: {epochs: -010}", "ppo.epochs", "-010, which YAML 1.1 reads as -8"),
        ("limit: 1:30", "limit", "1:30, which YAML 1.1 reads as 90"),
        ("epsilons: [0.1, 010]", "epsilons", "[0.1, '010']"),
        ("ppo: {learning_rate: 010}", "ppo.learning_rate", "010, which YAML 1.1 reads as 8"),
        ("ppo: {learning_rate: 1:30.5}", "ppo.learning_rate", "1:30.5, which YAML 1.1 reads as 90.5"),
        # Numbers that would overflow, or silently become infinite.
        (f"ppo: {{learning_rate: 1{'0' * 400}}}", "ppo.learning_rate", "which is too large"),
        ("ppo: {learning_rate: 1e400}", "ppo.learning_rate", "'1e400', which is too large"),
        ("ppo: {learning_rate: 1.0e+400}", "ppo.learning_rate", "'1.0e+400', which is too large"),
    ],
)
def test_apply_yaml_refuses_ambiguous_and_too_large_numbers(apply_text, text, key, problem):
    with pytest.raises(InputError) as error:
        apply_text(text)
    assert_message_names(error.value, "config.yaml: ", f"{key} must be", problem, "; change the value")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("limit: 0", Config(limit=0)),
        ("limit: 0x10", Config(limit=16)),
        ("limit: 1_000", Config(limit=1000)),
        ("limit: -7", Config(limit=-7)),
        ("ppo: {learning_rate: 0.5}", Config(ppo=Ppo(learning_rate=0.5, epochs=2))),
        ("ppo: {learning_rate: -.inf}", Config(ppo=Ppo(learning_rate=float("-inf"), epochs=2))),
        ("ppo: {learning_rate: Infinity}", Config(ppo=Ppo(learning_rate=float("inf"), epochs=2))),
    ],
)
def test_apply_yaml_reads_numbers_with_one_meaning(apply_text, text, expected):
    assert apply_text(text) == expected


@pytest.mark.parametrize("seed", ["010", "1:30"])
def test_settings_of_a_run_refuse_ambiguous_seeds(tmp_path, seed):
    path = tmp_path / "config.yaml"
    path.write_text(f"seed: {seed}")
    with pytest.raises(InputError, match=f"seed must be int, but is {seed}, which YAML 1.1 reads as"):
        apply_yaml(RunConfig(), path)


@pytest.mark.parametrize(
    ("text", "message_parts"),
    [
        ("ppo: {learning_rat: 1}", ["unknown key ppo.learning_rat", "did you mean ppo.learning_rate?"]),
        ("nmae: x", ["unknown key nmae", "did you mean name?"]),
        ("qqqq: 1", ["unknown key qqqq", "known here are ppo, name, setting"]),
        ("learning_rate: 1", ["unknown key learning_rate"]),  # a key of another level is not searched for
        ("1: x", ["unknown key 1"]),
        ("- 1", ["holds [1] (list)", "give a mapping"]),
        ("just words", ["holds 'just words' (str)", "give a mapping"]),
    ],
)
def test_apply_yaml_refuses_unknown_keys_and_non_mappings(apply_text, text, message_parts):
    with pytest.raises(InputError) as error:
        apply_text(text)
    for part in ["config.yaml: ", *message_parts]:
        assert part in str(error.value)


@dataclasses.dataclass(frozen=True)
class Nested:
    base: RunConfig = RunConfig()


def test_apply_yaml_names_the_new_name_of_a_renamed_key(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("sizes: {relation_layers: 2}")
    with pytest.raises(InputError, match=r"key sizes.relation_layers was renamed; use method_sizes.relation_layers$"):
        apply_yaml(RunConfig(), path)

    # The message also names the place of a nested configuration.
    path.write_text("base: {sizes: {hidden: 8, relation_layers: 2}}")
    message = r"key base.sizes.relation_layers was renamed; use method_sizes.relation_layers$"
    with pytest.raises(InputError, match=message):
        apply_yaml(Nested(), path)

    # The new name is accepted.
    path.write_text("base: {method_sizes: {relation_layers: 2}}")
    assert apply_yaml(Nested(), path).base == RunConfig(method_sizes={"relation_layers": 2})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: x\nname: y\n", "line 2: not valid YAML (name is given twice)"),
        ("ppo:\n  epochs: 1\n  anneal: true\n  'epochs': 2\n", "line 4: not valid YAML (epochs is given twice)"),
        ("name: x\nppo: [1\n", "line 3: not valid YAML"),
        ("name: x\n---\nname: y\n", "line 2: not valid YAML"),
        ("name: !!python/object:os.system x\n", "line 1: not valid YAML"),
        ("? [a]\n: 1\n", "line 1: not valid YAML"),
        ("name: 2024-99-99\n", "not valid YAML (month must be"),
        (b"name: \xff\n", "not valid YAML ("),
        ("[" * 5000, "not valid YAML ("),
    ],
)
def test_apply_yaml_names_the_line_of_broken_yaml(apply_text, text, message):
    with pytest.raises(InputError) as error:
        apply_text(text)
    assert message in str(error.value)


def test_apply_yaml_refuses_missing_files_and_folders(tmp_path):
    for path, problem in ((tmp_path / "none.yaml", "no such configuration; give"), (tmp_path, "cannot be read")):
        with pytest.raises(InputError, match=f"{path}: {problem}"):
            apply_yaml(Config(), path)


def test_apply_yaml_reads_packaged_configurations_by_name():
    assert apply_yaml(RunConfig(), "smoke") == apply_yaml(RunConfig(), CONFIGS["smoke"])
    assert apply_yaml(RunConfig(), Path("smoke")).seeds == 1


def test_configuration_extends_another_file_or_a_packaged_one(tmp_path):
    (tmp_path / "first.yaml").write_text("name: first\nppo: {learning_rate: 0.5}\nepsilons: [1, 2]\n")
    (tmp_path / "second.yaml").write_text("extends: first.yaml\nname: second\nppo: {clip: 0.1}\n")
    (tmp_path / "third.yaml").write_text("extends: packaged\nepsilons: []\n")
    configs = {"packaged": tmp_path / "second.yaml"}

    # Sections are merged, field by field; lists are replaced.
    second = Config(ppo=Ppo(learning_rate=0.5, clip=0.1, epochs=2), name="second", epsilons=(1.0, 2.0))
    assert apply_yaml(Config(), tmp_path / "second.yaml") == second
    assert apply_yaml(Config(), tmp_path / "third.yaml", configs) == dataclasses.replace(second, epsilons=())


@pytest.mark.parametrize(
    ("extends", "message_parts"),
    [
        ("second.yaml", ("first.yaml", "extends itself", "name another configuration")),
        ("../{folder}/first.yaml", ("first.yaml", "extends itself")),
        ("none.yaml", ("first.yaml", "extends none.yaml", "does not exist", "give")),
        ("", ("first.yaml", "extends", "null", "change the value")),
        ("''", ("first.yaml", "extends", "''", "change the value")),
        ("[a, b]", ("first.yaml", "extends", "['a', 'b']", "change the value")),
    ],
)
def test_impossible_extensions_are_refused(tmp_path, extends, message_parts):
    (tmp_path / "first.yaml").write_text(f"extends: {extends.format(folder=tmp_path.name)}\n")
    (tmp_path / "second.yaml").write_text("extends: first.yaml\n")
    with pytest.raises(InputError) as error:
        apply_yaml(Config(), tmp_path / "first.yaml")
    assert_message_names(error.value, *message_parts)


@pytest.mark.parametrize("text", ["false", "[]", "0", "''"])
def test_apply_yaml_requires_a_mapping(apply_text, text):
    with pytest.raises(InputError, match="give a mapping of names to values"):
        apply_text(text)


@given(
    st.builds(
        Config,
        ppo=st.builds(Ppo, st.floats(allow_nan=False), st.none() | st.floats(allow_nan=False), st.integers()),
        name=st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"])),
        setting=st.sampled_from(["paper", "calibrated", 1]),
        epsilons=st.lists(st.floats(allow_nan=False), max_size=3).map(tuple),
        view=st.tuples(st.integers(), st.integers()),
        limit=st.none() | st.integers(),
    )
)
def test_apply_yaml_inverts_a_yaml_dump(tmp_path_factory, config):
    path = tmp_path_factory.getbasetemp() / "dumped.yaml"
    values = dataclasses.asdict(config) | {"epsilons": list(config.epsilons), "view": list(config.view)}
    path.write_text(yaml.safe_dump(values, allow_unicode=True), encoding="utf-8")
    assert apply_yaml(Config(), path) == config


@given(st.binary(max_size=60) | st.text("ponamepochs: {}[]&*!|>-'\"\n\t1.e", max_size=60).map(str.encode))
def test_apply_yaml_of_any_bytes_gives_a_config_or_an_input_error(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(data)
    try:
        assert isinstance(apply_yaml(Config(), path), Config)
    except InputError as error:
        assert str(error).startswith(str(path))  # noqa: PT017  (reading may also succeed)
