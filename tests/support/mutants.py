"""Mutants of the modules that hold the science: do their fast tests notice them?

`python -m support.mutants [COUNT [SEED]]` in `tests` draws so many of all mutants, runs the tests of each one's module
in a copy of the project, and prints the survivors and the share that was killed. It ends with code 1 below `LEAST`.

A mutant has one expression changed: an operator, a comparison, a number, a truth value, a term that is left out.
"""

import ast
import collections
import contextlib
import functools
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
LEAST = 0.9
FAST_TIER = "not slow and not exhaustive"
SECONDS = 900  # after which a mutant counts as killed: it does not end
#: The modules, and the files of `tests` that have to kill their mutants.
TESTS = {
    "causal.py": "test_causal.py",
    "layout.py": "test_layout.py test_gaps.py test_evidence.py",
    "numerics/dirichlet.py": "numerics/test_dirichlet.py",
    "numerics/product.py": "numerics/test_product.py",
    "numerics/recurrence.py": "numerics/test_recurrence.py",
    "numerics/rounding.py": "numerics/test_rounding.py",
    "numerics/sparse.py": "numerics/test_sparse.py",
    "training/ppo.py": (
        "training/test_loss.py training/test_collect.py training/test_guidance.py "
        "training/test_counterfactual_memory.py"
    ),
    "evaluation/grid.py": "evaluation/test_episodes.py",
    "evaluation/statistics.py": (
        "evaluation/test_statistics.py evaluation/test_interval.py "
        "evaluation/test_shared_design.py evaluation/test_ranks.py"
    ),
}
#: The functions that are changed, for modules of which only a part is science.
FUNCTIONS = {
    "training/ppo.py": {
        "compute_advantages",
        "replay_rollout",
        "_replay_in_parallel",
        "_unroll_with_attention",
        "_replay_step_by_step",
        "ppo_loss",
    },
    "evaluation/grid.py": {"episode_metrics"},
}
OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.MatMult: ast.Add,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
#: Nodes that no test of behaviour is about: types, docstrings, messages.
SKIPPED = (ast.Import, ast.ImportFrom, ast.Raise, ast.Assert, ast.JoinedStr)
SKIPPED_FIELDS = {"annotation", "returns", "decorator_list"}


class Mutant(NamedTuple):
    """A changed expression, and the source of the whole module with it."""

    module: str
    line: int
    before: str
    after: str
    source: str

    def __str__(self) -> str:
        return f"{self.module}:{self.line}: {self.before}  ->  {self.after}"


def variants(node: ast.AST) -> list[ast.expr]:
    """Return replacements of an expression."""
    match node:
        case ast.BinOp(left, ast.Add() | ast.Sub() as operator, right):
            return [ast.BinOp(left, OPERATORS[type(operator)](), right), left, right]
        case ast.BinOp(left, operator, right) if type(operator) in OPERATORS:
            return [ast.BinOp(left, OPERATORS[type(operator)](), right)]
        case ast.BoolOp(operator, values):
            return [ast.BoolOp(OPERATORS[type(operator)](), values), *values]
        case ast.Compare(left, [operator, *others], right) if type(operator) in OPERATORS:
            return [ast.Compare(left, [OPERATORS[type(operator)](), *others], right)]
        case ast.UnaryOp(_, operand):
            return [operand]
        case ast.IfExp(test, body, orelse):
            return [ast.IfExp(test, orelse, body)]
        case ast.Constant(bool() as value):
            return [ast.Constant(not value)]
        case ast.Constant(int() | float() as value):
            return [ast.Constant(value + 1)]
    return []


def places(node: ast.AST) -> Iterator[tuple[Callable[[ast.AST], None], ast.AST]]:
    """Yield all nodes below a node, each with a function that replaces it."""
    for name, value in ast.iter_fields(node):
        if name in SKIPPED_FIELDS:
            continue
        if isinstance(value, list):
            children = [(functools.partial(value.__setitem__, i), child) for i, child in enumerate(value)]
        else:
            children = [(functools.partial(setattr, node, name), value)]
        for put, child in children:
            if isinstance(child, ast.AST) and not isinstance(child, SKIPPED):
                yield put, child
                yield from places(child)


def mutants_of(module: str) -> Iterator[Mutant]:
    """Yield all mutants of a module, a path in `jaxnav`."""
    tree = ast.parse((ROOT / "jaxnav" / module).read_text())
    for put, node in list(places(_changed_part(module, tree))):
        for variant in variants(node):
            assert isinstance(node, ast.expr)
            put(variant)
            yield Mutant(module, node.lineno, ast.unparse(node), ast.unparse(variant), ast.unparse(tree))
            put(node)


def _changed_part(module: str, tree: ast.Module) -> ast.Module:
    """Return the functions of a module that `FUNCTIONS` names, else the whole module."""
    if module not in FUNCTIONS:
        return tree

    functions = []
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.name in FUNCTIONS[module]:
            functions.append(node)
    if len(functions) < len(FUNCTIONS[module]):
        raise ValueError(f"{module} lacks a function of {sorted(FUNCTIONS[module])}; bring the list up to date")
    return ast.Module(functions, type_ignores=[])


@contextlib.contextmanager
def project() -> Iterator[Path]:
    """Copy what the tests need to a folder of its own."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("jaxnav", "tests", "docs", "pyproject.toml"):
            whole = ROOT / part
            (shutil.copytree if whole.is_dir() else shutil.copy)(whole, folder / part)
        yield folder


def passes(folder: Path, tests: str, tier: str = FAST_TIER) -> bool:
    """Check whether the tests of a tier in files, separated by spaces, pass in a copy of the project."""
    environment = os.environ | {
        "PYTHONPATH": str(folder),
        "PYTEST_XDIST_WORKER": "mutants",  # what is compiled is kept here, from one mutant to the next
        "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
    options = ["-x", "-n", "0", "-m", tier, "-p", "no:cacheprovider", "--timeout", "0"]
    test_files = [str(folder / "tests" / name) for name in tests.split()]
    command = [sys.executable, "-m", "pytest", *options, *test_files]
    try:
        process = subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return False
    return process.returncode == 0


def survives(folder: Path, module: str, source: str, tests: str, tier: str = FAST_TIER) -> bool:
    """Check whether the tests of a tier overlook another source of a module."""
    path = folder / "jaxnav" / module
    original = path.read_text()
    path.write_text(source)
    try:
        return passes(folder, tests, tier)
    finally:
        path.write_text(original)


def main(count: int, seed: int) -> bool:
    """Draw mutants, print what becomes of them, and return whether enough were killed."""
    everything = [mutant for module in TESTS for mutant in mutants_of(module)]
    drawn = random.Random(seed).sample(everything, min(count, len(everything)))
    num_drawn = collections.Counter(mutant.module for mutant in drawn)
    killed = collections.Counter()
    with project() as folder:
        for module in num_drawn:
            if not passes(folder, TESTS[module]):
                raise SystemExit(f"the tests of {module} fail without a mutant; fix them first")
        for mutant in drawn:
            alive = survives(folder, mutant.module, mutant.source, TESTS[mutant.module])
            killed[mutant.module] += not alive
            print("SURVIVED" if alive else "killed  ", mutant, flush=True)
    for module, number in sorted(num_drawn.items()):
        print(f"{module}: {killed[module]} of {number} killed")
    print(f"{killed.total()} of {len(drawn)} killed; there are {len(everything)} mutants in all")
    return killed.total() >= LEAST * len(drawn)


if __name__ == "__main__":
    sys.exit(not main(*(int(argument) for argument in [*sys.argv[1:], "120", "0"][:2])))
