"""HOZ: the hierarchical object-to-zone graph, which plans the next zone on the way to the goal.

Source: S. Zhang et al., *Hierarchical Object-to-Zone Graph for Object Navigation*, ICCV 2021, and its released code; a
host of L-sTDE in the paper.

Kept: the poses of every training scene are clustered into zones by their detected categories, and the zones of all
scenes of a room type are merged. In an episode, the zone of the view, the goal's zone and the next zone on the best
path between them are embedded by one layer of graph convolution, and the view pulls the node of its zone. Changed: two
poses adjoin if one action leads from one pose to the other, the embeddings are columns of ORG's category table, and
naive Bayes predicts the room type from the categories detected so far, in place of a classifier that only
reinforcement trains.

The file has two parts: `learn_zones` builds the graphs before training; `ZoneTracker` and `ZoneRelations` use them.
"""

import dataclasses
import warnings
from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from scipy.cluster.vq import kmeans2
from scipy.optimize import linear_sum_assignment

from jaxnav.env.objectnav import NUM_PRIORS, prior_index
from jaxnav.errors import InputError
from jaxnav.numerics.product import Linear
from jaxnav.policies.features import Features
from jaxnav.policies.method import Knowledge, Method, Percept
from jaxnav.policies.methods.org import ObjectRelations
from jaxnav.policies.methods.sp import normalize_adjacency
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.lattice import pose_successors
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import RowFormat

#: Number of zones of a room type.
NUM_ZONES = 8
#: Share of the uniform distribution in the distribution of detections of a room type.
UNIFORM_SHARE = 0.05

_KMEANS_ITERATIONS = 30
#: Number of zones that the network reads: current zone, next zone and goal's zone.
_NUM_READ_ZONES = 3


# Learning the zones before training


class ZoneGraph(NamedTuple):
    """Counts over the poses of Z zones; graphs may be stacked.

    Attributes:
      category_counts: float64 [..., Z, K], poses of a zone at which a category is detected.
      pose_counts: float64 [..., Z], poses of a zone; 0 for an empty zone.
      transition_counts: float64 [..., Z, Z], actions that lead from a pose of one zone to a pose of another.
    """

    category_counts: np.ndarray
    pose_counts: np.ndarray
    transition_counts: np.ndarray

    @property
    def category_shares(self) -> np.ndarray:
        """Share of a zone's poses at which a category is detected, [..., Z, K]."""
        return self.category_counts / np.maximum(self.pose_counts, 1.0)[..., None]


def learn_zones(banks: Iterable[Bank], counts: np.ndarray, num_zones: int = NUM_ZONES) -> dict[str, np.ndarray]:
    """Learn the zones of each room type.

    Args:
      banks: banks of the training scenes.
      counts: [rooms, K, K], co-occurrence counts, of which only the number of categories is used.
      num_zones: Z, number of zones of a room type.

    Returns:
      `nodes` float32 [rooms, Z, K], in 0 to 1, the share of a zone's poses at which a category is detected; -1 in an
      empty zone, which is therefore nearest to no view.
      `mixing` float32 [rooms, Z, Z], the edges with loops, symmetrically normalised for a graph convolution.
      `next_zone` int32 [rooms, Z, Z], the first zone on the best path from one zone to another.
      `detected` float32 [rooms, K], log shares of the categories among the detections in a room type.
      `frequency` float32 [rooms], log shares of the room types among the scenes; -87 for a room type without scenes.

    Raises:
      InputError: a scene has fewer poses than zones.
    """
    # Edges relative to the strongest edge of the room type: otherwise hardly any best path would be indirect.
    graphs, scene_counts = build_room_graphs(banks, counts.shape[-1], num_zones)
    adjacency = compute_adjacency(graphs)
    strongest_edge = adjacency.max(axis=(-2, -1), keepdims=True)
    edges = adjacency / np.maximum(strongest_edge, np.finfo(float).tiny)

    # Naive Bayes: distribution of the detections of a room type, and frequency of the room type.
    detection_counts = graphs.category_counts.sum(axis=-2)
    detection_shares = detection_counts / np.maximum(detection_counts.sum(axis=-1, keepdims=True), 1.0)
    mixed_shares = (1.0 - UNIFORM_SHARE) * detection_shares + UNIFORM_SHARE / detection_shares.shape[-1]
    room_shares = np.maximum(scene_counts / scene_counts.sum(), np.finfo(np.float32).tiny)

    # Empty zones get nodes that are far from every view.
    nodes = np.where(graphs.pose_counts[..., None] > 0, graphs.category_shares, -1.0)
    return {
        "nodes": nodes.astype(np.float32),
        "mixing": normalize_adjacency(edges).astype(np.float32),
        "detected": np.log(mixed_shares).astype(np.float32),
        "frequency": np.log(room_shares).astype(np.float32),
        "next_zone": find_next_zones(edges),
    }


def learn_permuted_zones(
    banks: Iterable[Bank], counts: np.ndarray, num_zones: int = NUM_ZONES
) -> dict[str, np.ndarray]:
    """Learn the zones and permute their relations, for an ablation: each zone gets edges and paths of another zone."""
    # Permute both sides of the edges.
    learned = learn_zones(banks, counts, num_zones)
    permutation = np.roll(np.arange(num_zones), 1)
    mixing = learned["mixing"][:, permutation][:, :, permutation]

    # The values of `next_zone` are zones too, so the inverse permutation renames them.
    renamed_zones = np.argsort(permutation)[learned["next_zone"]]
    next_zone = renamed_zones[:, permutation][:, :, permutation].astype(np.int32)
    return learned | {"mixing": mixing, "next_zone": next_zone}


def build_room_graphs(banks: Iterable[Bank], num_categories: int, num_zones: int) -> tuple[ZoneGraph, np.ndarray]:
    """Merge the graphs of the scenes of each room type, one scene after another.

    Zones of a scene are matched one to one with the zones merged so far, such that their category shares differ least.

    Returns:
      Graphs with leaves [rooms, ...], and the number of scenes, int [rooms].
    """
    # Start with empty graphs of all room types.
    empty_graph = ZoneGraph(
        category_counts=np.zeros((num_zones, num_categories)),
        pose_counts=np.zeros(num_zones),
        transition_counts=np.zeros((num_zones, num_zones)),
    )
    graphs = [empty_graph] * NUM_PRIORS
    scene_counts = np.zeros(NUM_PRIORS, int)

    # Add scene by scene to the graph of its room type.
    for bank in banks:
        for scene, room_type in enumerate(bank.room_types):
            room = prior_index(room_type)
            merged = graphs[room]
            graph = build_scene_graph(bank, scene, num_zones)

            # Optimal assignment; the first scene keeps the order of its zones.
            differences = np.square(merged.category_shares[:, None] - graph.category_shares).sum(axis=-1)
            if scene_counts[room] == 0:
                differences = np.zeros_like(differences)
            _, partners = linear_sum_assignment(differences)

            # Sum the counts of matched zones.
            graphs[room] = ZoneGraph(
                merged.category_counts + graph.category_counts[partners],
                merged.pose_counts + graph.pose_counts[partners],
                merged.transition_counts + graph.transition_counts[np.ix_(partners, partners)],
            )
            scene_counts[room] += 1
    return jax.tree.map(lambda *leaves: np.stack(leaves), *graphs), scene_counts


def build_scene_graph(bank: Bank, scene: int, num_zones: int) -> ZoneGraph:
    """Cluster the poses of a scene by their detected categories.

    In a scene with fewer different views than zones, the last zones are empty.

    Raises:
      InputError: there are fewer poses than zones.
    """
    # Rows of all poses of the scene, [P, R].
    rules = bank.task.rules
    num_categories = len(bank.task.categories)
    first_cell = bank.first_cell[scene]
    end_cell = first_cell + bank.num_cells[scene]
    rows = bank.rows[first_cell * rules.poses_per_cell : end_cell * rules.poses_per_cell]
    num_poses = len(rows)
    if num_zones > num_poses:
        raise InputError(
            f"scene {bank.names[scene]!r}: has {num_poses} poses for {num_zones} zones; give at most {num_poses} zones"
        )

    # Cluster the poses; SciPy would warn of a cluster that loses all its poses.
    presence = RowFormat(num_categories).presence(rows).astype(float)
    num_clusters = min(num_zones, len(np.unique(presence, axis=0)))
    generator = np.random.default_rng(scene)
    with warnings.catch_warnings(action="ignore"):
        _, zone_of_pose = kmeans2(presence, num_clusters, iter=_KMEANS_ITERATIONS, minit="++", rng=generator)

    # Count detections and poses by zone.
    category_counts = np.zeros((num_zones, num_categories))
    np.add.at(category_counts, zone_of_pose, presence)
    pose_counts = np.bincount(zone_of_pose, minlength=num_zones).astype(float)

    # Count the actions that change the pose, by the zones of start and end.
    successors = pose_successors(bank.ahead[first_cell:end_cell] - first_cell, rules)
    start_pose, action = np.nonzero(successors != np.arange(num_poses)[:, None])
    end_pose = successors[start_pose, action]
    transition_counts = np.zeros((num_zones, num_zones))
    np.add.at(transition_counts, (zone_of_pose[start_pose], zone_of_pose[end_pose]), 1.0)
    return ZoneGraph(category_counts, pose_counts, transition_counts)


def compute_adjacency(graph: ZoneGraph) -> np.ndarray:
    """Return the edges between zones: the share of their pose pairs that one action connects, in either direction.

    Returns:
      float64 [..., Z, Z], in 0 to 1, symmetric, 0 on the diagonal.
    """
    pose_pairs = graph.pose_counts[..., :, None] * graph.pose_counts[..., None, :]
    both_directions = graph.transition_counts + np.swapaxes(graph.transition_counts, -1, -2)
    adjacency = both_directions / np.maximum(2.0 * pose_pairs, 1.0)
    return adjacency * (1.0 - np.eye(adjacency.shape[-1]))


def find_next_zones(edges: np.ndarray) -> np.ndarray:
    """Return the first zone on the best path between any two zones (Floyd-Warshall).

    The best path has the largest product of edges; among equal paths the direct one is chosen.

    Args:
      edges: float64 [..., Z, Z], in 0 to 1; 0 for no edge.

    Returns:
      int32 [..., Z, Z], by start and target zone; the target itself if it is the next zone or no path leads there.
    """
    # Costs of direct paths: the largest product of edges has the smallest sum of costs.
    zones = np.arange(edges.shape[-1])
    with np.errstate(divide="ignore"):
        path_costs = -np.log(edges + np.eye(len(zones)))
    next_zone = np.broadcast_to(zones, edges.shape).astype(np.int32)

    # Allow one more intermediate zone at a time.
    for middle_zone in zones:
        costs_through = path_costs[..., :, middle_zone, None] + path_costs[..., middle_zone, None, :]
        is_better = costs_through < path_costs - 1e-9
        next_zone = np.where(is_better, next_zone[..., :, middle_zone, None], next_zone)
        path_costs = np.where(is_better, costs_through, path_costs)
    return next_zone


# Following an episode through the zones


class ZoneState(NamedTuple):
    """Position of an episode in the graph.

    Attributes:
      seen_categories: bool [K], True for categories detected so far.
      room_type: int32 [], the most likely room type.
      zone: int32 [], the zone of the view.
      nodes: float32 [Z, K], nodes of the room type, pulled towards the views of the episode.
    """

    seen_categories: jax.Array
    room_type: jax.Array
    zone: jax.Array
    nodes: jax.Array


class ZoneReading(NamedTuple):
    """Network inputs from the graph.

    Attributes:
      room_probs: float32 [..., R], the probabilities of the room types.
      zone_rows: float32 [..., 3, K], nodes of the current zone, the next zone and the goal's zone, each mixed with the
        nodes of adjoining zones.
    """

    room_probs: jax.Array
    zone_rows: jax.Array


@dataclasses.dataclass(frozen=True)
class ZoneTracker:
    """Tracker of the zones of an episode.

    Attributes:
      node_rate: rate at which a view pulls the node of its zone.
    """

    node_rate: float = 0.005

    def init(self, knowledge: Knowledge) -> ZoneState:
        """Return the most frequent room type, with the nodes as learned."""
        graph = knowledge.method
        seen_categories = jnp.zeros(graph["nodes"].shape[-1], bool)
        room_type = _room_logits(seen_categories, graph).argmax()
        return ZoneState(seen_categories, room_type, jnp.int32(0), graph["nodes"][room_type])

    def update(self, state: ZoneState, knowledge: Knowledge, percept: Percept) -> ZoneState:
        """Update room type and zone by a view."""
        graph = knowledge.method
        presence = RowFormat(len(state.seen_categories)).presence(percept.row)

        # The nodes are reset when the room type changes.
        seen_categories = state.seen_categories | presence
        room_type = _room_logits(seen_categories, graph).argmax()
        nodes = jnp.where(room_type == state.room_type, state.nodes, graph["nodes"][room_type])

        # The zone of the view has the nearest node, which is pulled towards the view.
        differences = presence.astype(jnp.float32)[None] - nodes
        zone = jnp.square(differences).sum(axis=-1).argmin()
        nodes = nodes.at[zone].add(self.node_rate * differences[zone])
        return ZoneState(seen_categories, room_type, zone, nodes)

    def read(self, state: ZoneState, knowledge: Knowledge, goal: jax.Array) -> ZoneReading:
        """Return the current zone, the next zone on the best path to the goal, and the goal's zone."""
        # The goal's zone has the largest share of poses that show the goal.
        graph = knowledge.method
        goal_zone = state.nodes[:, goal].argmax()
        next_zone = graph["next_zone"][state.room_type, state.zone, goal_zone]
        read_zones = jnp.stack([state.zone, next_zone, goal_zone])

        # One step of graph convolution; the network has the kernel.
        zone_rows = graph["mixing"][state.room_type, read_zones] @ state.nodes
        room_probs = jax.nn.softmax(_room_logits(state.seen_categories, graph))
        return ZoneReading(room_probs, zone_rows)


def _room_logits(seen_categories: jax.Array, graph: dict[str, jax.Array]) -> jax.Array:
    """Return the log probabilities of the room types up to a constant, float32 [R].

    Each category of `seen_categories`, bool [K], counts once, as a draw from the detections in a room type.
    """
    return graph["frequency"] + graph["detected"] @ seen_categories.astype(jnp.float32)


class ZoneRelations(ObjectRelations):
    """Relations between the detected categories, the goal and the zones.

    The row of each category in ORG's table also holds the category's entries in the embeddings of three zones. The
    layout weights multiply the whole row.
    """

    columns = ObjectRelations.columns + _NUM_READ_ZONES

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        self.embed = Linear(spec.num_categories, spec.num_categories, use_bias=False, rngs=rngs)
        self.width = self.maps.width + NUM_PRIORS

    def replace_other_categories(
        self, features: Features, reading: ZoneReading, other_features: Features, other_reading: ZoneReading
    ) -> tuple[Features, ZoneReading]:
        """Replace the detections, and with them room type and zones, which follow from the categories seen so far."""
        mixed_features, _ = super().replace_other_categories(features, reading, other_features, other_reading)
        return mixed_features, other_reading

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: ZoneReading) -> jax.Array:
        """Return experience, each category weighted by the layout, and the probabilities of the room types."""
        zone_columns = jnp.swapaxes(nnx.relu(self.embed(reading.zone_rows)), -1, -2)
        table = jnp.concatenate([features.table, zone_columns], axis=-1)
        relations = self.relate(features, appearance, weights, table)
        return jnp.concatenate([relations, reading.room_probs], axis=-1)


HOZ = Method(ZoneRelations, tracker=ZoneTracker(), learn=learn_zones, name="hoz")
#: Ablation: HOZ with permuted relations of its zones.
PERMUTED = Method(ZoneRelations, tracker=ZoneTracker(), learn=learn_permuted_zones)
