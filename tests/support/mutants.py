"""Mutants of the scientific modules, which the fast tests of each module have to kill.

`python -m support.mutants [COUNT [SEED]]` in `tests` draws COUNT of all mutants, runs the tests of each mutant's module
in a copy of the project, and prints the results and the share of killed mutants. The exit code is 1 if this share is
below `MIN_KILLED_SHARE`.

A mutant differs from the package in one expression: an operator, a comparison, a number, a truth value, or a missing
term.
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
MIN_KILLED_SHARE = 0.9
FAST_TIER = "not slow and not exhaustive"
TIMEOUT_S = 900  # a mutant whose tests take longer does not end, and counts as killed
#: The mutated modules, and the files of `tests` that have to kill their mutants.
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
#: The mutated functions of modules that are not mutated as a whole.
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
#: Nodes and fields that are not mutated, because they do not change behaviour: imports, messages, types.
SKIPPED_NODES = (ast.Import, ast.ImportFrom, ast.Raise, ast.Assert, ast.JoinedStr)
SKIPPED_FIELDS = {"annotation", "returns", "decorator_list"}


class Mutant(NamedTuple):
    """A module with one changed expression.

    Attributes:
      module: path in `jaxnav`.
      line: line of the expression.
      expression: the original expression.
      replacement: the changed expression.
      source: source of the whole mutated module.
    """

    module: str
    line: int
    expression: str
    replacement: str
    source: str

    def __str__(self) -> str:
        return f"{self.module}:{self.line}: {self.expression}  ->  {self.replacement}"


def variants(node: ast.AST) -> list[ast.expr]:
    """Return the replacements of an expression."""
    match node:
        case ast.BinOp(left, ast.Add() | ast.Sub() as operator, right):
            return [ast.BinOp(left, OPERATORS[type(operator)](), right), left, right]
        case ast.BinOp(left, operator, right) if type(operator) in OPERATORS:
            return [ast.BinOp(left, OPERATORS[type(operator)](), right)]
        case ast.BoolOp(operator, values):
            return [ast.BoolOp(OPERATORS[type(operator)](), values), *values]
        case ast.Compare(left, [operator, *later_operators], right) if type(operator) in OPERATORS:
            return [ast.Compare(left, [OPERATORS[type(operator)](), *later_operators], right)]
        case ast.UnaryOp(_, operand):
            return [operand]
        case ast.IfExp(test, body, orelse):
            return [ast.IfExp(test, orelse, body)]
        case ast.Constant(bool() as value):
            return [ast.Constant(not value)]
        case ast.Constant(int() | float() as value):
            return [ast.Constant(value + 1)]
    return []


def replaceable_nodes(node: ast.AST) -> Iterator[tuple[Callable[[ast.AST], None], ast.AST]]:
    """Yield all nodes below a node, each with a function that replaces it."""
    for field_name, value in ast.iter_fields(node):
        if field_name in SKIPPED_FIELDS:
            continue
        if isinstance(value, list):
            children = [(functools.partial(value.__setitem__, index), child) for index, child in enumerate(value)]
        else:
            children = [(functools.partial(setattr, node, field_name), value)]
        for replace, child in children:
            if isinstance(child, ast.AST) and not isinstance(child, SKIPPED_NODES):
                yield replace, child
                yield from replaceable_nodes(child)


def mutants_of(module: str) -> Iterator[Mutant]:
    """Yield all mutants of a module, a path in `jaxnav`."""
    tree = ast.parse((ROOT / "jaxnav" / module).read_text())
    for replace, node in list(replaceable_nodes(_mutated_part(module, tree))):
        for variant in variants(node):
            assert isinstance(node, ast.expr)
            replace(variant)
            yield Mutant(module, node.lineno, ast.unparse(node), ast.unparse(variant), ast.unparse(tree))
            replace(node)


def _mutated_part(module: str, tree: ast.Module) -> ast.Module:
    """Return the functions of a module that `FUNCTIONS` names; the whole module if it names none."""
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
    """Copy the parts of the project that tests need to a temporary folder."""
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        for part_name in ("jaxnav", "tests", "docs", "pyproject.toml"):
            source = ROOT / part_name
            if source.is_dir():
                shutil.copytree(source, folder / part_name)
            else:
                shutil.copy(source, folder / part_name)
        yield folder


def passes(folder: Path, tests: str, tier: str = FAST_TIER) -> bool:
    """True if tests pass in a copy of the project.

    Args:
      folder: the copy.
      tests: files in `tests`, separated by spaces.
      tier: the tests of these files, as an expression of markers.
    """
    environment = os.environ | {
        "PYTHONPATH": str(folder),
        "PYTEST_XDIST_WORKER": "mutants",  # compiled programs are kept from one mutant to the next
        "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
    options = ["-x", "-n", "0", "-m", tier, "-p", "no:cacheprovider", "--timeout", "0"]
    test_files = [str(folder / "tests" / name) for name in tests.split()]
    command = [sys.executable, "-m", "pytest", *options, *test_files]
    try:
        process = subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return False
    return process.returncode == 0


def survives(folder: Path, module: str, source: str, tests: str, tier: str = FAST_TIER) -> bool:
    """True if the tests of a tier pass with a changed source of a module."""
    path = folder / "jaxnav" / module
    original = path.read_text()
    path.write_text(source)
    try:
        return passes(folder, tests, tier)
    finally:
        path.write_text(original)


def main(count: int, seed: int) -> bool:
    """Draw mutants, print the result of each, and return whether enough were killed."""
    # Draw from the mutants of all modules.
    all_mutants: list[Mutant] = []
    for module in TESTS:
        all_mutants.extend(mutants_of(module))
    mutants = random.Random(seed).sample(all_mutants, min(count, len(all_mutants)))
    num_mutants = collections.Counter(mutant.module for mutant in mutants)

    num_killed = collections.Counter()
    with project() as folder:
        for module in num_mutants:
            if not passes(folder, TESTS[module]):
                raise SystemExit(f"the tests of {module} fail without a mutant; fix them first")
        for mutant in mutants:
            has_survived = survives(folder, mutant.module, mutant.source, TESTS[mutant.module])
            num_killed[mutant.module] += not has_survived
            print("SURVIVED" if has_survived else "killed  ", mutant, flush=True)

    for module, number in sorted(num_mutants.items()):
        print(f"{module}: {num_killed[module]} of {number} killed")
    print(f"{num_killed.total()} of {len(mutants)} killed; there are {len(all_mutants)} mutants in all")
    return num_killed.total() >= MIN_KILLED_SHARE * len(mutants)


if __name__ == "__main__":
    count_argument, seed_argument = (*sys.argv[1:], *("120", "0")[len(sys.argv) - 1 :])
    sys.exit(not main(int(count_argument), int(seed_argument)))
