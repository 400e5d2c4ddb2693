"""Imports of version 0.2 are refused by a line that gives the new name."""

import importlib
import re

import pytest

import jaxnav
from jaxnav.renames import MODULES, NAMES


@pytest.mark.parametrize("module", MODULES)
def test_old_module_names_its_successor(module):
    importlib.import_module(f"jaxnav.{MODULES[module]}")
    with pytest.raises(ModuleNotFoundError, match=re.escape(f"jaxnav.{MODULES[module]}")):
        importlib.import_module(f"jaxnav.{module}")


@pytest.mark.parametrize("old_name", [name for name in NAMES if name.rpartition(".")[0] not in MODULES])
def test_old_name_names_its_successor(old_name):
    module_name, _, name = f"jaxnav.{old_name}".rpartition(".")
    module = importlib.import_module(module_name)
    with pytest.raises(ImportError, match=re.escape(f"jaxnav.{NAMES[old_name]}")):
        getattr(module, name)


@pytest.mark.parametrize("new_name", NAMES.values())
def test_new_name_exists(new_name):
    module_name, _, name = f"jaxnav.{new_name}".rpartition(".")
    assert hasattr(importlib.import_module(module_name), name)


def test_old_module_lists_its_changed_names():
    with pytest.raises(ModuleNotFoundError, match="advantages is compute_advantages"):
        importlib.import_module("jaxnav.training.loss")


def test_other_missing_names_fail_as_usual():
    with pytest.raises(ModuleNotFoundError, match=r"jaxnav\.nowhere"):
        importlib.import_module("jaxnav.nowhere")
    with pytest.raises(AttributeError, match="nothing"):
        getattr(jaxnav.layout, "nothing")  # noqa: B009
