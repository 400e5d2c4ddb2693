"""Information in HOZ's graph of zones: indirect paths, zones on the way to a goal, the type of a room.

`python benchmarks/zones.py [WORLD ...] [--zones 8] [--scenes N]` learns the zones of training scenes (all three worlds
without arguments) and tests them in val scenes. Columns:

  indirect             shares of the pairs of zones, and of the pairs of a zone and a goal, whose best path has another
                       zone between
  absolute             these shares with edges that are not relative to the strongest
  shuffled             the first share with each room type's edges permuted over its pairs of zones
  next zone            of poses and goals drawn at random, where the best path leaves the zone: how often the zone that
                       it enters is the graph's next one, that of the permuted graph, or the goal's
  room type            how often it is recognised after so many views of a random walk

The result goes to stdout as JSON, the table to stderr.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from _common import print_report

from jaxnav.env.objectnav import NUM_PRIORS, prior_index
from jaxnav.policies.methods.hoz import (
    NUM_ZONES,
    build_room_graphs,
    compute_adjacency,
    find_next_zones,
    learn_permuted_zones,
    learn_zones,
)
from jaxnav.scenes.lattice import best_actions
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

NUM_PAIRS = 20_000
NUM_WALKS = 2_000
#: Views of a walk after which the room type is tested.
TESTED_VIEWS = (1, 10, 50)
NUM_SHUFFLES = 200
#: Arrays of the knowledge that HOZ learns, by name.
Zones = Mapping[str, np.ndarray]


def main(worlds: Sequence[str], num_zones: int, num_scenes: int | None) -> None:
    results = {world: measure_world(world, num_zones, num_scenes) for world in worlds}
    print(format_table(results), file=sys.stderr)
    print_report({"zones": num_zones, "worlds": results})


def measure_world(world: str, num_zones: int, num_scenes: int | None) -> dict[str, Any]:
    """Learn the zones of a world's training scenes, and test them in its val scenes."""
    train = compile_split(world, "train", num_scenes)
    val = compile_split(world, "val", num_scenes)
    num_categories = len(train.task.categories)
    is_goal = train.task.is_goal()

    # The layout prior does not matter here.
    no_prior = np.zeros((NUM_PRIORS, num_categories, num_categories))
    zones = learn_zones([train], no_prior, num_zones)
    permuted_zones = learn_permuted_zones([train], no_prior, num_zones)
    graphs, _ = build_room_graphs([train], num_categories, num_zones)
    adjacency = compute_adjacency(graphs)

    shuffled_shares = []
    for next_zone in shuffle_edges(adjacency):
        shuffled_shares.append(measure_indirect_paths(zones["nodes"], next_zone, is_goal)[0])
    return {
        "scenes": len(train.names),
        "indirect": measure_indirect_paths(zones["nodes"], zones["next_zone"], is_goal),
        "absolute": measure_indirect_paths(zones["nodes"], find_next_zones(adjacency), is_goal),
        "shuffled": float(np.mean(shuffled_shares)),
        "next_zone": measure_next_zone(val, zones, permuted_zones),
        "room_type": measure_room_type(val, zones),
    }


def compile_split(world: str, split: str, num_scenes: int | None) -> Bank:
    scenes = make_generated_scenes(world, split, num_scenes)
    return compile_bank((scenes[index] for index in range(len(scenes))), WORLDS[world].task)


def shuffle_edges(adjacency: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the next zones of graphs whose edges are permuted within each room type.

    Args:
      adjacency: strengths of the edges, [rooms, zones, zones].
    """
    rng = np.random.default_rng(2)
    strongest = np.maximum(adjacency.max(axis=(1, 2), keepdims=True), np.finfo(float).tiny)
    relative_strength = adjacency / strongest
    rows, columns = np.triu_indices(adjacency.shape[-1], 1)
    for _ in range(NUM_SHUFFLES):
        edges = np.zeros_like(adjacency)
        edges[:, rows, columns] = rng.permuted(relative_strength[:, rows, columns], axis=1)
        yield find_next_zones(edges + np.swapaxes(edges, 1, 2))


def measure_indirect_paths(nodes: np.ndarray, next_zone: np.ndarray, is_goal: np.ndarray) -> tuple[float, float]:
    """Measure how often the best path leads through an intermediate zone.

    Args:
      nodes: float32 [rooms, Z, K], from `learn_zones`.
      next_zone: int32 [rooms, Z, Z], from `learn_zones`.
      is_goal: bool [K], True for categories that can be goals.

    Returns:
      The share of indirect paths among pairs of different zones, and among pairs of a zone and a goal in a different
      zone; 0 without such pairs.
    """
    # Pairs [rooms, Z, Z] of different zones that are not empty.
    zones = np.arange(nodes.shape[-2])
    has_poses = nodes.max(axis=-1) >= 0
    pairs = has_poses[:, :, None] & has_poses[:, None, :] & (zones[:, None] != zones)
    indirect_pairs = pairs & (next_zone != zones)

    # Pairs of a zone and a goal that occurs in the room type.
    rooms, goals = np.nonzero(is_goal & (nodes.max(axis=-2) > 0))
    goal_zones = nodes.argmax(axis=-2)[rooms, goals]
    num_goal_pairs = pairs[rooms, :, goal_zones].sum()
    num_indirect_goal_pairs = indirect_pairs[rooms, :, goal_zones].sum()

    # Shares among both kinds of pairs.
    zone_share = float(indirect_pairs.sum() / max(pairs.sum(), 1))
    goal_share = float(num_indirect_goal_pairs / max(num_goal_pairs, 1))
    return zone_share, goal_share


def room_type_of_poses(bank: Bank) -> np.ndarray:
    """Return the index of the room type of every pose, int [poses]."""
    room_types = [prior_index(room_type) for room_type in bank.room_types]
    return np.repeat(room_types, bank.num_cells * bank.task.rules.poses_per_cell)


def measure_next_zone(bank: Bank, zones: Zones, permuted_zones: Zones) -> dict[str, float]:
    """Return how often the zone that a best path enters next is predicted."""
    # The zone of a pose is the node nearest to what is detected there.
    room_types = room_type_of_poses(bank)
    presence = RowFormat(len(bank.task.categories)).presence(bank.rows).astype(float)
    zone = np.empty(len(room_types), int)
    for room_type in np.unique(room_types):
        in_room = room_types == room_type
        distances = np.square(presence[in_room][:, None] - zones["nodes"][room_type]).sum(axis=-1)
        zone[in_room] = distances.argmin(axis=-1)

    # Draw pairs of a start and a goal.
    poses, goals = np.nonzero(bank.best_length > 1)
    rng = np.random.default_rng(0)
    pairs = rng.integers(0, len(poses), NUM_PAIRS)
    start = poses[pairs]
    goal = goals[pairs]
    room = room_types[start]
    start_zone = zone[start]
    goal_zone = zones["nodes"][room, :, goal].argmax(axis=-1)

    # Follow each best path until it leaves the zone or arrives.
    pose = start
    while True:
        running = (zone[pose] == start_zone) & (bank.best_length[pose, goal] > 1)
        if not running.any():
            break
        action = best_actions(bank.successor, bank.best_length, pose, goal)
        pose = np.where(running, bank.successor[pose, action], pose)

    next_zone = zone[pose]
    has_left = (next_zone != start_zone) & (goal_zone != start_zone)
    predictions = {
        "graph": zones["next_zone"][room, start_zone, goal_zone],
        "permuted": permuted_zones["next_zone"][room, start_zone, goal_zone],
        "goal": goal_zone,
    }
    return {name: float((predicted == next_zone)[has_left].mean()) for name, predicted in predictions.items()}


def measure_room_type(bank: Bank, zones: Zones) -> dict[int, float]:
    """Return how often the type of a room is recognised, by the number of views of a random walk."""
    rng = np.random.default_rng(1)
    room_types = room_type_of_poses(bank)
    presence = RowFormat(len(bank.task.categories)).presence(bank.rows)
    pose = rng.integers(0, len(room_types), NUM_WALKS)
    true_type = room_types[pose]
    seen = np.zeros((NUM_WALKS, presence.shape[1]), bool)

    accuracy = {}
    for view in range(1, max(TESTED_VIEWS) + 1):
        seen |= presence[pose]
        if view in TESTED_VIEWS:
            scores = zones["frequency"] + seen @ zones["detected"].T
            accuracy[view] = float((scores.argmax(axis=1) == true_type).mean())
        pose = bank.successor[pose, rng.integers(0, DONE, NUM_WALKS)]
    return accuracy


def format_table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the results in Markdown, percent."""
    headings = (
        "indirect pairs of zones",
        "of a zone and a goal",
        "both, absolute",
        "zones, shuffled",
        "next zone: graph",
        "permuted",
        "goal's",
    )
    lines = [
        f"| world | {' | '.join(headings)} | room type after {', '.join(map(str, TESTED_VIEWS))} views |",
        "| --- |" + " ---: |" * (len(headings) + 1),
    ]
    for world, row in results.items():
        shares = [*row["indirect"], max(row["absolute"]), row["shuffled"], *row["next_zone"].values()]
        cells = [f"{100 * share:.0f}" for share in shares]
        accuracies = [f"{100 * accuracy:.0f}" for accuracy in row["room_type"].values()]
        lines.append(f"| {world} | {' | '.join(cells)} | {', '.join(accuracies)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("worlds", nargs="*", metavar="WORLD")
    parser.add_argument("--zones", type=int, default=NUM_ZONES)
    parser.add_argument("--scenes", type=int, help="of each split; default: the world's usual number")
    options = parser.parse_args()
    main(options.worlds or [*WORLDS], options.zones, options.scenes)
