"""Draw the packages of jaxnav and their imports into docs/images/rooms.png."""

from pathlib import Path

import grimp
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
LAYERS = (
    ("cli",),
    ("report",),
    ("experiments",),
    ("viz",),
    ("game",),
    ("runs",),
    ("baselines",),
    ("evaluation",),
    ("training",),
    ("policies",),
    ("env",),
    ("scenes",),
    ("causal", "layout", "store"),
    ("numerics",),
)
INK, PALE, FILL, DOT = "#1a1a1a", "#d5dde3", "#eaf2f8", "#0072B2"


def lines_of(name: str) -> int:
    """Count the lines of a package or module."""
    path = ROOT / "jaxnav" / name
    files = path.rglob("*.py") if path.is_dir() else [path.with_suffix(".py")]
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def imports() -> set[tuple[str, str]]:
    """Return the pairs of packages of which the first imports the second."""
    graph = grimp.build_graph("jaxnav")
    names = [name for layer in LAYERS for name in layer]
    pairs = set()
    for one in names:
        for other in names:
            chain = one != other and graph.direct_import_exists(
                importer=f"jaxnav.{one}", imported=f"jaxnav.{other}", as_packages=True
            )
            if chain:
                pairs.add((one, other))
    return pairs


def draw() -> Figure:
    """Draw the packages on a diagonal, and a dot where one imports another.

    A package imports those whose rows have a dot in its column; below the diagonal no import points up.
    """
    names = [name for layer in LAYERS for name in layer]
    size = len(names)
    figure = Figure(figsize=(7.0, 6.0), dpi=150)
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set(xlim=(-0.6, size + 1.3), ylim=(size - 0.4, -0.6))
    axes.axis("off")
    for i, name in enumerate(names):
        axes.plot([i, i], [i, size - 0.5], color=PALE, lw=0.8, zorder=1)
        axes.plot([-0.5, i], [i, i], color=PALE, lw=0.8, zorder=1)
        style = {"boxstyle": "round,pad=0.3", "fc": FILL, "ec": INK, "lw": 0.8}
        axes.text(i - 0.35, i, f"{name}  {lines_of(name):,}", va="center", fontsize=9, color=INK, bbox=style, zorder=3)
    for one, other in imports():
        axes.plot(names.index(one), names.index(other), "o", color=DOT, ms=6, zorder=2)
    return figure


if __name__ == "__main__":
    draw().savefig(ROOT / "docs" / "images" / "rooms.png", metadata={"Software": None})
