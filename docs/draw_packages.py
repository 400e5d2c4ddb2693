"""Draw the packages of jaxnav and their imports into docs/images/packages.png.

The order of the packages is that of the contract of `lint-imports` in pyproject.toml.
"""

import tomllib
from pathlib import Path

import grimp
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
TEXT_COLOR = "#1a1a1a"
LINE_COLOR = "#d5dde3"
BOX_COLOR = "#eaf2f8"
DOT_COLOR = "#0072B2"


def read_package_names() -> list[str]:
    """Return the names of packages and modules of jaxnav, from the highest layer to the lowest."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layer_contract = next(item for item in project["tool"]["importlinter"]["contracts"] if item["type"] == "layers")

    # A line of the contract may hold several modules, separated by bars. `__main__` only starts the command line.
    package_names = []
    for layer in layer_contract["layers"]:
        package_names += [name for name in layer.split(" | ") if name != "__main__"]
    return package_names


def find_imports(package_names: list[str]) -> set[tuple[str, str]]:
    """Return the pairs of packages of which the first imports the second."""
    graph = grimp.build_graph("jaxnav")
    imports = set()
    for importer in package_names:
        for imported in package_names:
            if importer == imported:
                continue
            is_import = graph.direct_import_exists(
                importer=f"jaxnav.{importer}", imported=f"jaxnav.{imported}", as_packages=True
            )
            if is_import:
                imports.add((importer, imported))
    return imports


def draw_packages() -> Figure:
    """Draw the packages on a diagonal, and a dot where one imports another.

    A package imports the packages in whose rows its column has a dot. No import points up, so all dots are below the
    diagonal.
    """
    package_names = read_package_names()
    num_packages = len(package_names)
    figure = Figure(figsize=(8.0, 7.0), dpi=150)
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set(xlim=(-0.6, num_packages + 0.8), ylim=(num_packages - 0.4, -0.6))
    axes.axis("off")

    # A row to the left of each name, a column below.
    for index, name in enumerate(package_names):
        axes.plot([index, index], [index, num_packages - 0.5], color=LINE_COLOR, lw=0.8, zorder=1)
        axes.plot([-0.5, index], [index, index], color=LINE_COLOR, lw=0.8, zorder=1)
        box_style = {"boxstyle": "round,pad=0.3", "fc": BOX_COLOR, "ec": TEXT_COLOR, "lw": 0.8}
        axes.text(index - 0.35, index, name, va="center", fontsize=9, color=TEXT_COLOR, bbox=box_style, zorder=3)

    for importer, imported in find_imports(package_names):
        position = (package_names.index(importer), package_names.index(imported))
        axes.plot(*position, "o", color=DOT_COLOR, ms=6, zorder=2)
    return figure


if __name__ == "__main__":
    draw_packages().savefig(ROOT / "docs" / "images" / "packages.png", metadata={"Software": None})
