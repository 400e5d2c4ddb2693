"""Local names say what a thing is: no pronoun, preposition or participle stands for a value."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = [
    *sorted(ROOT.glob("jaxnav/**/*.py")),
    *sorted(ROOT.glob("benchmarks/*.py")),
    *sorted(ROOT.glob("examples/*.py")),
    *sorted(ROOT.glob("tests/**/*.py")),
    ROOT / "train.py",
    ROOT / "eval.py",
]
BANNED = frozenset(
    [
        "told",
        "there",
        "found",
        "most",
        "of",
        "at",
        "left",
        "each",
        "known",
        "beside",
        "chosen",
        "taken",
        "carried",
        "spent",
        "renewed",
        "averaged",
        "looks",
        "comes",
        "gone",
        "kept",
        "every",
        "beforehand",
        "across",
    ]
)


def local_names(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and name of everything that a function binds, its parameters included."""
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        for node in ast.walk(function):
            if isinstance(node, ast.arg):
                yield node.lineno, node.arg
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                yield node.lineno, node.id


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_local_name_is_a_pronoun_or_a_participle(path):
    assert [(line, name) for line, name in local_names(path.read_text()) if name in BANNED] == []


@pytest.mark.parametrize(
    "source",
    [
        "def f(told): pass",
        "def f():\n    found = 1",
        "f = lambda each: each",
        "def f():\n    for left in range(3): pass",
        "def f():\n    return [of for of in range(3)]",
        "async def f(*, at=0): pass",
    ],
)
def test_banned_names_are_noticed(source):
    assert [name for _, name in local_names(source) if name in BANNED]
