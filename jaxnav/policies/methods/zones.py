"""Zones of the training scenes: what is seen in each, and which adjoin (HOZ: Zhang et al., ICCV 2021)."""

import warnings
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.optimize import linear_sum_assignment

from jaxnav.env.objectnav import NUM_PRIORS, prior_index
from jaxnav.errors import InputError
from jaxnav.policies.methods.graphs import normalised
from jaxnav.scenes.lattice import successors
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import RowFormat

#: Zones of a room type, and share of the uniform distribution in what is detected in one.
NUM_ZONES, UNIFORM = 8, 0.05
_ITERATIONS = 30  # of k-means


class ZoneGraph(NamedTuple):
    """Hold counts over the poses of Z zones; graphs may be stacked.

    Attributes:
      seen: float64 [..., Z, K], poses of a zone at which a category is detected.
      poses: float64 [..., Z]; 0 for a zone that is empty.
      moves: float64 [..., Z, Z], actions that lead from a pose of one zone to a pose of another.
    """

    seen: np.ndarray
    poses: np.ndarray
    moves: np.ndarray

    @property
    def centres(self) -> np.ndarray:
        """Return the shares of poses that show a category, [..., Z, K]."""
        return self.seen / np.maximum(self.poses, 1.0)[..., None]


def learn_zones(banks: Iterable[Bank], counts: np.ndarray, num_zones: int = NUM_ZONES) -> dict[str, np.ndarray]:
    """Learn the zones of each room type.

    Args:
      banks: of the training scenes.
      counts: [rooms, K, K]; only the number of categories is used.
      num_zones: Z, zones of a room type.

    Returns:
      `nodes` float32 [rooms, Z, K], in 0 to 1, the share of a zone's poses at which a category is detected; -1 in an
      empty zone, to which no view is nearest.
      `mixing` float32 [rooms, Z, Z], the edges as a graph convolution takes them, with loops, symmetrically normalised.
      `next_zone` int32 [rooms, Z, Z], the first zone on the best path from one zone to another.
      `detected` float32 [rooms, K], log shares of the categories in what is detected in a room type.
      `frequency` float32 [rooms], log shares of the room types among the scenes; -87 for one without any.

    Raises:
      InputError: a scene has fewer poses than zones.
    """
    graphs, scenes = room_graphs(banks, counts.shape[-1], num_zones)
    near = adjacency(graphs)
    edges = near / np.maximum(near.max(axis=(-2, -1), keepdims=True), np.finfo(float).tiny)
    detected = graphs.seen.sum(axis=-2)
    shares = detected / np.maximum(detected.sum(axis=-1, keepdims=True), 1.0)
    learned = {
        "nodes": np.where(graphs.poses[..., None] > 0, graphs.centres, -1.0),
        "mixing": normalised(edges),
        "detected": np.log((1.0 - UNIFORM) * shares + UNIFORM / shares.shape[-1]),
        "frequency": np.log(np.maximum(scenes / scenes.sum(), np.finfo(np.float32).tiny)),
    }
    return {name: array.astype(np.float32) for name, array in learned.items()} | {"next_zone": next_zones(edges)}


def learn_permuted(banks: Iterable[Bank], counts: np.ndarray, num_zones: int = NUM_ZONES) -> dict[str, np.ndarray]:
    """Learn zones as above, their relations permuted.

    Each zone gets the edges and the paths of another: the ablation of the graph.
    """
    learned = learn_zones(banks, counts, num_zones)
    to = np.roll(np.arange(num_zones), 1)  # next_zone holds zones, which are renamed too
    renamed = np.argsort(to)[learned["next_zone"]][:, to][:, :, to].astype(np.int32)
    return learned | {"mixing": learned["mixing"][:, to][:, :, to], "next_zone": renamed}


def room_graphs(banks: Iterable[Bank], num_categories: int, num_zones: int) -> tuple[ZoneGraph, np.ndarray]:
    """Merge the scenes of each room type, one after another.

    Zones of a scene join those of the scenes before, one to one, so that what is seen differs least.

    Returns:
      Graphs with leaves [rooms, ...], and the number of scenes, int [rooms].
    """
    sizes = (num_zones, num_categories), num_zones, (num_zones, num_zones)
    graphs = [ZoneGraph(*map(np.zeros, sizes)) for _ in range(NUM_PRIORS)]
    scenes = np.zeros(NUM_PRIORS, int)
    for bank in banks:
        for scene, room in enumerate(map(prior_index, bank.room_types)):
            merged, graph = graphs[room], scene_graph(bank, scene, num_zones)
            difference = np.square(merged.centres[:, None] - graph.centres).sum(axis=-1)
            _, partner = linear_sum_assignment(difference if scenes[room] else np.zeros_like(difference))
            moves = graph.moves[np.ix_(partner, partner)]
            graphs[room] = ZoneGraph(
                merged.seen + graph.seen[partner], merged.poses + graph.poses[partner], merged.moves + moves
            )
            scenes[room] += 1
    return ZoneGraph(*map(np.stack, zip(*graphs, strict=True))), scenes


def scene_graph(bank: Bank, scene: int, num_zones: int) -> ZoneGraph:
    """Cluster the poses of a scene by what is detected.

    With fewer different views than zones, the last zones are empty.

    Raises:
      InputError: there are fewer poses than zones.
    """
    rules, num_categories = bank.task.rules, len(bank.task.categories)
    cells = slice(bank.first_cell[scene], bank.first_cell[scene] + bank.num_cells[scene])
    rows = bank.rows[cells.start * rules.poses_per_cell : cells.stop * rules.poses_per_cell]
    if num_zones > len(rows):
        name, most = bank.names[scene], len(rows)
        raise InputError(f"scene {name!r}: has {most} poses for {num_zones} zones; give at most {most} zones")
    presence = RowFormat(num_categories).presence(rows).astype(float)
    clusters = min(num_zones, len(np.unique(presence, axis=0)))
    with warnings.catch_warnings(action="ignore"):  # a cluster may lose all its poses
        _, zone = kmeans2(presence, clusters, iter=_ITERATIONS, minit="++", rng=np.random.default_rng(scene))
    seen, moves = np.zeros((num_zones, num_categories)), np.zeros((num_zones, num_zones))
    np.add.at(seen, zone, presence)
    following = successors(bank.ahead[cells] - cells.start, rules)
    start, action = np.nonzero(following != np.arange(len(rows))[:, None])
    np.add.at(moves, (zone[start], zone[following[start, action]]), 1.0)
    return ZoneGraph(seen, np.bincount(zone, minlength=num_zones).astype(float), moves)


def adjacency(graph: ZoneGraph) -> np.ndarray:
    """Return the share of pairs of poses that adjoin.

    Of all pairs of one pose in each of two zones, those an action apart, either way.

    Returns:
      float64 [..., Z, Z], in 0 to 1, symmetric, 0 on the diagonal.
    """
    pairs = graph.poses[..., :, None] * graph.poses[..., None, :]
    near = (graph.moves + np.swapaxes(graph.moves, -1, -2)) / np.maximum(2.0 * pairs, 1.0)
    return near * (1.0 - np.eye(near.shape[-1]))


def next_zones(edges: np.ndarray) -> np.ndarray:
    """Return the first zone on the best paths.

    The best path has the largest product of edges. Of equal ones the direct one is taken.

    Args:
      edges: float64 [..., Z, Z], in 0 to 1; 0 where there is none.

    Returns:
      int32 [..., Z, Z], from one zone to another; the other itself where it is next, or where no path leads there.
    """
    zones = np.arange(edges.shape[-1])
    with np.errstate(divide="ignore"):
        cost = -np.log(edges + np.eye(len(zones)))
    first = np.broadcast_to(zones, edges.shape).astype(np.int32)
    for by in zones:  # Floyd and Warshall
        through = cost[..., :, by, None] + cost[..., by, None, :]
        better = through < cost - 1e-9
        first = np.where(better, first[..., :, by, None], first)
        cost = np.where(better, through, cost)
    return first


def indirect_shares(nodes: np.ndarray, next_zone: np.ndarray, is_goal: np.ndarray) -> tuple[float, float]:
    """Return how often the best path has another zone between.

    Args:
      nodes, next_zone: see `learn_zones`.
      is_goal: bool [K], which categories are sought.

    Returns:
      The share of the pairs of different zones, and that of the pairs of a zone and a goal which is sought in another
      zone; 0 without any.
    """
    zones = np.arange(nodes.shape[-2])
    held = nodes.max(axis=-1) >= 0
    pairs = held[:, :, None] & held[:, None, :] & (zones[:, None] != zones)
    indirect = pairs & (next_zone != zones)
    rooms, goals = np.nonzero(is_goal & (nodes.max(axis=-2) > 0))
    sought = nodes.argmax(axis=-2)[rooms, goals]
    by_goal = [which[rooms, :, sought].sum() for which in (indirect, pairs)]
    return float(indirect.sum() / max(pairs.sum(), 1)), float(by_goal[0] / max(by_goal[1], 1))
