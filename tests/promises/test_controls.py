"""The mistakes and mutants that `make mutants` plants still fit the package."""

import ast

import pytest
from support.mutants import FUNCTIONS, ROOT, TESTS, mutants_of
from support.planted import MISTAKES


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: f"{mistake.module}: {mistake.after!r}")
def test_planted_mistakes_match_one_place(mistake):
    source = (ROOT / "jaxnav" / mistake.module).read_text()
    assert source.count(mistake.before) == 1
    ast.parse(source.replace(mistake.before, mistake.after))
    assert (ROOT / "tests" / mistake.tests).is_file()


@pytest.mark.parametrize("module", TESTS)
def test_mutated_modules_have_mutants_and_tests(module):
    mutant = next(mutants_of(module))
    ast.parse(mutant.source)
    for name in TESTS[module].split():
        assert (ROOT / "tests" / name).is_file()


def test_mutants_change_parts_of_tested_modules_alone():
    assert FUNCTIONS.keys() <= TESTS.keys()
