"""Imports of version 0.2 are refused by a line that gives the new name."""

import importlib

import pytest

import jaxnav
from jaxnav.renames import MODULES, NAMES


@pytest.mark.parametrize("module", MODULES)
def test_an_old_module_gives_its_successor(module):
    importlib.import_module(f"jaxnav.{MODULES[module]}")
    with pytest.raises(ModuleNotFoundError, match=rf"^jaxnav\.{module} is jaxnav\.{MODULES[module]} since 0\.3"):
        importlib.import_module(f"jaxnav.{module}")


@pytest.mark.parametrize("old_name", [name for name in NAMES if name.rpartition(".")[0] not in MODULES])
def test_an_old_name_gives_its_successor(old_name):
    module_name, _, name = f"jaxnav.{old_name}".rpartition(".")
    module = importlib.import_module(module_name)
    with pytest.raises(ImportError, match=rf"^{module_name}\.{name} is jaxnav\.{NAMES[old_name]} since 0\.3$"):
        getattr(module, name)


@pytest.mark.parametrize("new_name", NAMES.values())
def test_a_new_name_exists(new_name):
    module_name, _, name = f"jaxnav.{new_name}".rpartition(".")
    assert hasattr(importlib.import_module(module_name), name)


def test_an_old_module_lists_the_names_that_changed():
    with pytest.raises(
        ModuleNotFoundError, match=r"training\.loss is .* \(advantages is compute_advantages, replay is"
    ):
        importlib.import_module("jaxnav.training.loss")


def test_other_missing_modules_and_names_fail_as_usual():
    with pytest.raises(ModuleNotFoundError, match=r"^No module named 'jaxnav\.nowhere'$"):
        importlib.import_module("jaxnav.nowhere")
    with pytest.raises(AttributeError, match=r"^module 'jaxnav\.layout' has no attribute 'nothing'$"):
        getattr(jaxnav.layout, "nothing")  # noqa: B009
