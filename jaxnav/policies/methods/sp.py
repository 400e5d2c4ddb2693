"""SP: scene priors, a graph convolution over which categories belong together.

Source: W. Yang et al., *Visual Semantic Navigation using Scene Priors*, ICLR 2019, in the form of SAVN's released code.

Kept: three layers of graph convolution with symmetric normalisation and loops, without biases, over a graph that is
fixed before training; their output is one number per category. Changed: nodes get the detection of their category in
place of the scores of an image classifier, edges have weights, the graph is learned from exploration or read from a
file, and the last layer is linear.
"""

import dataclasses
import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.errors import InputError
from jaxnav.numerics.product import Linear
from jaxnav.policies.features import NUM_FEATURES, Features
from jaxnav.policies.method import Experience, Knowledge, Method, Percept
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.files.scene_file import read_bytes
from jaxnav.scenes.tables.compile import Bank
from jaxnav.store.files import expand_home


def learn_graph(banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Learn the co-occurrence graph of the categories.

    The edge of two categories is the number of poses that show both categories, divided by the geometric mean of the
    numbers of poses that show each category.

    Args:
      banks: not used.
      counts: [rooms, K, K], poses of exploration at which two categories were detected together; summed over rooms.

    Returns:
      `mixing` float32 [K, K], the normalised edges of a graph convolution.
    """
    # The diagonal counts the poses that show one category.
    co_visible = counts.sum(axis=0, dtype=float)
    visible = np.maximum(np.diagonal(co_visible), 1.0)
    without_loops = 1.0 - np.eye(len(visible))
    edges = co_visible / np.sqrt(np.outer(visible, visible)) * without_loops
    return {"mixing": normalize_adjacency(edges).astype(np.float32)}


def learn_permuted_graph(banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Learn the graph and permute its categories, for an ablation: each category gets the edges of another."""
    mixing = learn_graph(banks, counts)["mixing"]
    return {"mixing": np.roll(mixing, 1, axis=(0, 1))}


def graph_from_file(path: str | Path, banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Read a graph from a file of edges.

    A line is `Book,Desk` or `Book,Desk,0.5`: two categories and a weight above 0 and at most 1, which is 1 if omitted.
    A # starts a comment. Edges have no direction.

    The configuration of a run does not include the file. A run that continues reads the file again, so do not change
    the file until the run has ended.

    Args:
      path: file of edges.
      banks: banks of the training scenes, of which only the names of the categories are used.
      counts: not used.

    Returns:
      `mixing`, as from `learn_graph`.

    Raises:
      InputError: the file cannot be read, a line is no edge of the scenes' categories, or the file has no edges.
    """
    # Every line but comments and empty ones is an edge, entered in both directions.
    categories = next(iter(banks)).task.categories
    edges = np.zeros((len(categories), len(categories)))
    lines = read_bytes(expand_home(path)).decode(errors="replace").splitlines()
    for line_number, line in enumerate(lines, 1):
        edge_text = line.partition("#")[0].strip()
        if not edge_text:
            continue
        first_category, second_category, weight = _parse_edge(f"{path}:{line_number}", edge_text, categories)
        edges[first_category, second_category] = weight
        edges[second_category, first_category] = weight

    # A file without any edge is probably the wrong file.
    if not edges.any():
        raise InputError(f"{path}: has no edges; write one edge per line, such as {','.join(categories[:2])}")
    return {"mixing": normalize_adjacency(edges).astype(np.float32)}


def normalize_adjacency(edges: np.ndarray) -> np.ndarray:
    """Add loops and normalise symmetrically: D^-1/2 (A + I) D^-1/2 (Kipf and Welling, ICLR 2017).

    D is the diagonal matrix of the row sums of A + I.

    Args:
      edges: A, float64 [..., N, N], at least 0, symmetric, 0 on the diagonal.

    Returns:
      float64 [..., N, N], the normalised adjacency.
    """
    with_loops = edges + np.eye(edges.shape[-1])
    degrees = with_loops.sum(axis=-1)
    return with_loops / np.sqrt(degrees[..., :, None] * degrees[..., None, :])


def _parse_edge(source: str, edge_text: str, categories: tuple[str, ...]) -> tuple[int, int, float]:
    """Return the indices of two categories and the weight of their edge.

    Args:
      source: file and line, for error messages.
      edge_text: the line without its comment.
      categories: names of the categories.
    """
    example = ",".join(categories[:2])
    problem = InputError(f"{source}: {edge_text!r} is not an edge; write two categories, such as {example}")

    # Two different names, and perhaps a weight.
    fields = [field.strip() for field in edge_text.split(",")]
    names = tuple(fields[:2])
    if len(fields) not in (2, 3) or names[0] == names[1]:
        raise problem

    # Unknown categories have a negative index. Two names can stand for one category.
    first_category, second_category = category_ids(names, categories)
    if first_category == second_category >= 0:
        raise problem
    for name, category in zip(names, (first_category, second_category), strict=True):
        if category < 0:
            close_matches = difflib.get_close_matches(name, categories, n=1)
            hint = f"choose one of {', '.join(categories)}, or remove the line"
            if close_matches:
                hint = f"did you mean {close_matches[0]!r}?"
            raise InputError(f"{source}: category {name!r} is unknown; {hint}")

    # An omitted weight is 1; a text that is no number fails the check of the range.
    try:
        weight = float(fields[2]) if len(fields) == 3 else 1.0
    except ValueError:
        weight = np.nan
    if not 0.0 < weight <= 1.0:
        raise InputError(f"{source}: weight {fields[2]!r} is not a number above 0 and at most 1; change or omit it")
    return first_category, second_category, weight


@dataclasses.dataclass(frozen=True)
class GraphTracker:
    """Tracker without a state, which passes the graph to the network."""

    def init(self, knowledge: Knowledge) -> Any:
        """Return the empty tracker state."""
        return ()

    def update(self, state: Any, knowledge: Knowledge, percept: Percept) -> Any:
        """Return the empty tracker state."""
        return state

    def read(self, state: Any, knowledge: Knowledge, goal: jax.Array) -> jax.Array:
        """Return the graph, float32 [K, K]."""
        return knowledge.method["mixing"]


class GraphConvolution(Experience):
    """Graph convolution over the detections and the goal.

    A node holds the embedding of its category, detected or not, its detection and the goal flag. Three layers without
    biases compute one number per category, which the layout weights multiply (eq. 7). The last layer is linear: a ReLU
    on a single output may be 0 everywhere from the start, and could then not learn.
    """

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        hidden_width = spec.sizes.row_hidden
        self.named = Linear(spec.sizes.appearance, hidden_width, use_bias=False, rngs=rngs)
        self.seen = Linear(NUM_FEATURES, hidden_width, use_bias=False, rngs=rngs)
        self.second = Linear(hidden_width, hidden_width, use_bias=False, rngs=rngs)
        self.third = Linear(hidden_width, 1, use_bias=False, rngs=rngs)
        self.width = spec.num_categories

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: jax.Array) -> jax.Array:
        """Return experience, each category weighted by the layout."""
        # First layer, in two parts: detections [..., K, h] and appearances [K, h], which the batch shares.
        graph = reading
        detections = self.seen(features.table)
        appearances = jnp.broadcast_to(self.named(appearance), detections.shape)
        nodes = nnx.relu(graph @ (detections + appearances))

        # Two more layers leave one number per category, [..., K].
        nodes = nnx.relu(graph @ self.second(nodes))
        return weights * (graph @ self.third(nodes))[..., 0]


SP = Method(GraphConvolution, tracker=GraphTracker(), learn=learn_graph, name="sp")
#: Ablation: SP with permuted edges.
PERMUTED = dataclasses.replace(SP, learn=learn_permuted_graph)
