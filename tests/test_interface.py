"""What the package promises to those who import it, and what its modules may not do."""

import ast
import importlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

import jaxnav

ROOT = Path(__file__).parent.parent
PACKAGE = {path.relative_to(ROOT).as_posix(): path.read_text() for path in sorted((ROOT / "jaxnav").rglob("*.py"))}
DOCUMENTS = "\n".join(path.read_text() for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))))


# The public names


def test_the_package_shows_its_public_names_alone():
    assert dir(jaxnav) == sorted(jaxnav.__all__)
    assert len(set(jaxnav.__all__)) == len(jaxnav.__all__)
    for name in jaxnav.__all__:
        assert getattr(jaxnav, name) is not None
    with pytest.raises(AttributeError, match="module 'jaxnav' has no attribute 'trian'"):
        jaxnav.trian  # noqa: B018


def test_type_checkers_see_the_names_that_there_are():
    tree = ast.parse(PACKAGE["jaxnav/__init__.py"])
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {}
    for node in typed.body:
        assert isinstance(node, ast.ImportFrom)
        assert node.module is not None
        home = importlib.import_module(node.module)
        seen |= {alias.name: getattr(home, alias.name) for alias in node.names}
    assert seen.keys() | {"__version__"} == set(jaxnav.__all__)
    for name, value in seen.items():
        assert getattr(jaxnav, name) is value


# The equations are what runs


def public_functions(source: str, classes: Sequence[str]) -> Iterator[tuple[str | None, ast.FunctionDef]]:
    """Yield the public functions of a module, and the public methods of some classes with the name of their class."""
    for node in ast.parse(source).body:
        owner = node.name if isinstance(node, ast.ClassDef) and node.name in classes else None
        for item in node.body if isinstance(node, ast.ClassDef) and owner else [node]:
            if isinstance(item, ast.FunctionDef) and not item.name.startswith("_"):
                yield owner, item


def names_used(tree: ast.AST, besides: int | None = None) -> set[str]:
    """Return the names and attributes that are read, but for those in the function that begins at a line."""
    names, pending = set(), [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.FunctionDef) and node.lineno == besides:
            continue
        pending.extend(ast.iter_child_nodes(node))
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
            names.add(node.attr)
    return names


def uncalled(module: str, sources: dict[str, str], documents: str, classes: Sequence[str] = ()) -> list[str]:
    """Return the functions of a module that no source uses outside their definition and no document names as code.

    A method is used where both its class and the method are read: `update` alone may be another's.
    """
    code = "\n".join(re.findall(r"```.*?```|`[^`\n]+`|^    .*$", documents, re.DOTALL | re.MULTILINE))
    elsewhere = [names_used(ast.parse(source)) for path, source in sources.items() if path != module]
    missing = []
    for owner, function in public_functions(sources[module], classes):
        inside = names_used(ast.parse(sources[module]), besides=function.lineno)
        used = function.name in inside or any({function.name, owner or function.name} <= names for names in elsewhere)
        qualified = f"{owner or Path(module).stem}.{function.name}"
        if not used and not re.search(rf"\b{re.escape(qualified)}\b", code):
            missing.append(qualified)
    return missing


@pytest.mark.parametrize("module", ["causal", "layout"])
def test_every_equation_is_called(module):
    assert list(public_functions(PACKAGE[f"jaxnav/{module}.py"], ["LayoutEstimator"]))
    assert uncalled(f"jaxnav/{module}.py", PACKAGE, DOCUMENTS, ["LayoutEstimator"]) == []


MODULE = """
def called(x): return x
def mapped(x): return x
def imported(x): return x
def recursive(x): return recursive(x - 1)
def lonely(x): return x
def documented(x): return x
def mentioned(x): return x
def _private(x): return x
class Belief:
    def update(self): return self
    def reset(self): return self.reset()
    def name(self): return self
class Other:
    def hidden(self): return self
"""
CALLER = """
from module import called, imported, mapped
from module import Belief
called(1), vmap(mapped)(2)
Belief().update()
lonely = 3
"""
STRANGER = "other.reset(), belief.name()"


def test_functions_without_a_caller_are_flagged():
    sources = {"module.py": MODULE, "caller.py": CALLER, "stranger.py": STRANGER}
    documents = "Call `module.documented(x)`; mentioned and module.mentioned stand in plain text.\n"
    flagged = [
        "module.imported",
        "module.recursive",
        "module.lonely",
        "module.mentioned",
        "Belief.reset",
        "Belief.name",
    ]
    assert uncalled("module.py", sources, documents, ["Belief"]) == flagged
    assert uncalled("module.py", sources | {"more.py": "module.recursive(2); module.lonely(1)"}, documents) == [
        "module.imported",
        "module.mentioned",
    ]
    assert "module.mentioned" not in uncalled("module.py", sources, documents + "\n    module.mentioned(x)\n")


# Nobody imports the command line


def imports(path: str, source: str) -> Iterator[str]:
    """Yield the dotted names that a file imports, also relatively and by `import_module` with a plain beginning."""
    package = path.removesuffix(".py").split("/")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            near = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*near, *([node.module] if node.module else [])])
            yield from (f"{module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and "import_module" in names_used(node.func):
            texts = [text.value for text in ast.walk(node) if isinstance(text, ast.Constant)]
            yield from (text.rstrip(".") for text in texts if isinstance(text, str))


def importers(package: str, sources: dict[str, str]) -> list[str]:
    """Return the files that import a package or a part of it."""
    return [
        path
        for path, source in sources.items()
        if any(f"{name}.".startswith(f"{package}.") for name in imports(path, source))
    ]


def test_nobody_imports_the_command_line():
    outside = {path: source for path, source in PACKAGE.items() if not path.startswith("jaxnav/cli/")}
    assert importers("jaxnav.cli", outside) == ["jaxnav/__main__.py"]


@pytest.mark.parametrize(
    ("source", "flagged"),
    [
        ("import jaxnav.cli", True),
        ("def f():\n    import jaxnav.cli.train as t", True),
        ("from jaxnav.cli import train", True),
        ("from jaxnav.cli.console import parse", True),
        ("from jaxnav import cli", True),
        ("from ..cli import options", True),
        ("from ..cli.options import parse", True),
        ("from .. import cli", True),
        ("import importlib\nimportlib.import_module('jaxnav.cli.train')", True),
        ("from importlib import import_module\nimport_module(f'jaxnav.cli.{name}')", True),
        ("'''See jaxnav.cli.'''", False),
        ("from jaxnav import climate", False),
        ("from jaxnav.runs import train", False),
        ("from . import cli", False),
        ("import other.cli", False),
    ],
)
def test_imports_of_the_command_line_are_flagged(source, flagged):
    assert (importers("jaxnav.cli", {"jaxnav/study/a.py": source}) == ["jaxnav/study/a.py"]) == flagged
