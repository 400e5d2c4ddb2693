"""The list command prints every registered entry with its description and facts, within 80 columns."""

import json
from importlib import metadata
from typing import Any

import pytest

import jaxnav
from jaxnav.cli.list import main
from jaxnav.layout import ESTIMATORS
from jaxnav.policies.methods import METHODS
from jaxnav.registry import _described_options
from jaxnav.runs.config_files import CONFIGS
from jaxnav.scenes.worlds import WORLDS


@pytest.fixture(scope="module")
def entries_by_kind():
    return jaxnav.registered()


def test_every_registry_is_listed_with_a_description(entries_by_kind):
    names_by_kind = {}
    for kind, entries in entries_by_kind.items():
        names_by_kind[kind] = [entry["name"] for entry in entries]

    # The names are those of each registry.
    assert names_by_kind["worlds"] == list(WORLDS)
    assert names_by_kind["methods"] == sorted(METHODS)
    policy_names = ["apartments-belief", "apartments-org", "houses-belief", "houses-org", "rooms-org"]
    assert names_by_kind["policies"] == policy_names
    assert {"study", "table2", "mixture"} <= set(names_by_kind["experiments"])
    assert names_by_kind["configurations"] == list(CONFIGS)
    assert set(ESTIMATORS) - {"calibrated"} <= set(names_by_kind["settings"])  # `calibrated` is the default

    # A description is one line.
    for entries in entries_by_kind.values():
        for entry in entries:
            assert 5 < len(entry["summary"]) <= 120, entry
            assert "\n" not in entry["summary"]


def test_entries_hold_the_facts_of_their_kind(entries_by_kind):
    # Worlds, methods and packaged policies.
    rooms = entries_by_kind["worlds"][0]
    assert (rooms["scenes"]["val"], rooms["categories"], rooms["goals"], rooms["step_limit"]) == (20, 22, 22, 100)
    hosts_layout = {entry["name"]: entry["hosts_layout"] for entry in entries_by_kind["methods"]}
    assert (hosts_layout["org"], hosts_layout["anonymous"]) == (True, False)
    rooms_policy = entries_by_kind["policies"][-1]  # rooms-org
    assert (rooms_policy["method"], rooms_policy["world"], rooms_policy["arm"]) == ("org", "rooms", "layout")
    assert "92.2 %" in rooms_policy["summary"]

    # Experiments, and the inputs that they need.
    experiments = {entry["name"]: entry for entry in entries_by_kind["experiments"]}
    assert experiments["account"]["needs_run"]
    assert (experiments["account"]["runs"], experiments["account"]["steps"]) == (0, 0)
    assert not experiments["study"]["needs_run"]
    assert experiments["accounts"]["scene_files"] == ["ITHOR.jsonl.gz", "ROBOTHOR.jsonl.gz"]

    # Frozen benchmarks.
    assert [benchmark["name"] for benchmark in entries_by_kind["benchmarks"]] == ["v1", "v2"]
    for benchmark in entries_by_kind["benchmarks"]:
        assert (benchmark["tracks"], benchmark["episodes"]) == (["rooms", "apartments", "houses"], 1000)

    # Three agents of five seeds, of which one has both arms: 6 M steps each, rounded up to whole chunks.
    assert (experiments["study"]["runs"], experiments["study"]["policies"]) == (3, 20)
    assert 120e6 <= experiments["study"]["steps"] < 122e6


def test_list_fits_80_columns(entries_by_kind, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main([]) == 0
    output = capsys.readouterr().out
    assert max(map(len, output.splitlines())) <= 80
    for entries in entries_by_kind.values():
        for entry in entries:
            assert f"\n{entry['name']} " in output


def test_list_prints_one_kind_as_json(capsys):
    assert main(["methods", "--format", "json"]) == 0
    assert json.loads(capsys.readouterr().out) == jaxnav.registered("methods")


def test_methods_of_other_packages_are_listed(monkeypatch):
    # A method that can be imported, one that cannot, and one with the name of a method of jaxnav.
    entry_points = (
        metadata.EntryPoint("mine", "jaxnav.policies.methods.eotp:UNIFORM", "jaxnav.methods"),
        metadata.EntryPoint("broken", "no_such_package:METHOD", "jaxnav.methods"),
        metadata.EntryPoint("org", "no_such_package:METHOD", "jaxnav.methods"),
    )
    monkeypatch.setattr(metadata, "entry_points", lambda group: metadata.EntryPoints(entry_points).select(group=group))
    entries = {entry["name"]: entry for entry in jaxnav.registered("methods")["methods"]}

    assert entries["mine"]["source"] == "jaxnav.policies.methods.eotp:UNIFORM"
    assert entries["mine"]["summary"] == entries["eotp"]["summary"]
    assert entries["broken"]["hosts_layout"] is None
    assert "cannot be imported" in entries["broken"]["summary"]
    assert entries["org"]["source"] == "jaxnav"  # the method of jaxnav takes precedence


def test_list_refuses_unknown_kinds(capsys):
    unknown_kind: Any = "agents"
    with pytest.raises(jaxnav.InputError, match="'agents': choose one of worlds, methods"):
        jaxnav.registered(unknown_kind)
    with pytest.raises(SystemExit, match="2"):
        main(["agents"])
    assert "agents" in capsys.readouterr().err


def test_options_of_a_docstring_are_described_by_their_first_sentence():
    docstring = """Title.

    Attributes:
      gap: measure of the gap.
        `one`: the first. More about it.
        `two`: a description that goes on
          over two lines.
        `three`: another, which goes on
        without indent.
      other: `four` is no option.
    """
    assert _described_options(docstring) == {
        "one": "The first.",
        "two": "A description that goes on over two lines.",
        "three": "Another, which goes on without indent.",
    }
