"""Manifest of a run, and differences between manifests."""

import json

import jax

from jaxnav.store.files import list_differences, make_manifest

MANIFEST = make_manifest({"env": {"num_envs": 8, "view": (11, 11)}, "name": "run"})


def test_make_manifest_gives_json_with_package_versions():
    assert json.loads(json.dumps(MANIFEST)) == MANIFEST
    assert MANIFEST["config"]["env"]["view"] == [11, 11]
    assert MANIFEST["versions"]["jax"] == jax.__version__


def test_list_differences_gives_sorted_dotted_keys():
    first_config = {"b": {"c": 1, "d": {"e": 2}}, "a": [1], "only": 1}
    second_config = {"b": {"c": 1, "d": {"e": 3}}, "a": [2], "b2": {}}
    differences = list_differences(first_config, second_config)
    assert differences == ["a: [1] != [2]", "b.d.e: 2 != 3", "b2: (absent) != {}", "only: 1 != (absent)"]
    assert list_differences(first_config, first_config) == []
