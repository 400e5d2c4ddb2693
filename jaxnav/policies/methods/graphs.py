"""Graphs of categories, as scene priors know them before training (SP: Yang et al., ICLR 2019)."""

import difflib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.files.record import read_bytes
from jaxnav.scenes.tables.compile import Bank


def learn_graph(banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Learn which categories are detected together.

    An edge is the number of poses that show both categories over the geometric mean of the numbers that show either.

    Args:
      banks: not used.
      counts: [rooms, K, K], poses of exploration at which two categories were detected together; added up over rooms.

    Returns:
      `mixing` float32 [K, K], the edges as a graph convolution takes them.
    """
    together = counts.sum(axis=0, dtype=float)
    seen = np.maximum(np.diagonal(together), 1.0)
    edges = together / np.sqrt(np.outer(seen, seen)) * (1.0 - np.eye(len(seen)))
    return {"mixing": normalised(edges).astype(np.float32)}


def learn_permuted(banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Learn a graph as above, its edges permuted.

    Each category gets the edges of another: the ablation of the graph.
    """
    return {"mixing": np.roll(learn_graph(banks, counts)["mixing"], 1, axis=(0, 1))}


def graph_from_file(path: str | Path, banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Read a graph from a file of edges.

    A line is `Book,Desk` or `Book,Desk,0.5`: two categories and a weight above 0, at most 1, which is 1 unless given.
    What follows a # is a comment. Edges have no direction.

    The file is no part of the settings by which a run is known, and is read again when a run goes on: leave it as it
    is until the run has ended.

    Args:
      path: of the file.
      banks: of the training scenes; only the names of their categories are used.
      counts: not used.

    Returns:
      As `learn_graph`.

    Raises:
      InputError: the file cannot be read, a line is no edge of the scenes' categories, or there is none.
    """
    categories = next(iter(banks)).task.categories
    edges = np.zeros(2 * (len(categories),))
    for number, line in enumerate(read_bytes(Path(path)).decode(errors="replace").splitlines(), 1):
        text = line.partition("#")[0].strip()
        if text:
            one, other, weight = _edge(f"{path}:{number}", text, categories)
            edges[one, other] = edges[other, one] = weight
    if not edges.any():
        raise InputError(f"{path}: has no edges; write one a line, such as {','.join(categories[:2])}")
    return {"mixing": normalised(edges).astype(np.float32)}


def normalised(edges: np.ndarray) -> np.ndarray:
    """Add loops and normalise symmetrically.

    That is D^-1/2 (A + I) D^-1/2, where D holds the row sums of A + I (Kipf and Welling, ICLR 2017).

    Args:
      edges: A, float64 [..., N, N], at least 0, symmetric, 0 on the diagonal.
    """
    looped = edges + np.eye(edges.shape[-1])
    degree = looped.sum(axis=-1)
    return looped / np.sqrt(degree[..., :, None] * degree[..., None, :])


def _edge(where: str, text: str, categories: tuple[str, ...]) -> tuple[int, int, float]:
    """Return two categories' indices and a weight."""
    fields = [field.strip() for field in text.split(",")]
    names = tuple(fields[:2])
    if len(fields) not in (2, 3) or names[0] == names[-1]:
        raise InputError(f"{where}: {text!r} is no edge; name two categories, such as {','.join(categories[:2])}")
    one, other = category_ids(names, categories)
    for name, index in zip(names, (one, other), strict=True):
        if index < 0:
            near = difflib.get_close_matches(name, categories, n=1)
            mend = f"did you mean {near[0]!r}?" if near else f"choose of {', '.join(categories)}, or take the line out"
            raise InputError(f"{where}: category {name!r} is unknown; {mend}")
    try:
        weight = float(fields[2]) if len(fields) == 3 else 1.0
    except ValueError:
        weight = np.nan
    if not 0.0 < weight <= 1.0:
        raise InputError(f"{where}: weight {fields[2]!r} is not above 0 and at most 1; mend it or leave it out")
    return one, other, weight
