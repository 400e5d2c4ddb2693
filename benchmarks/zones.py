"""What HOZ's graph of zones tells: paths that are not direct, zones on the way to a goal, the type of a room.

`python benchmarks/zones.py [WORLD ...] [--zones 8] [--scenes N]` learns the zones of training scenes (all three worlds
without arguments) and tries them in val scenes. Columns:

  indirect             shares of the pairs of zones, and of the pairs of a zone and a goal, whose best path has another
                       zone between
  absolute             the same where edges are not taken relative to the strongest
  shuffled             the first share where each room type's edges are dealt out anew to its pairs of zones
  next zone            of poses and goals drawn at random, where the best path leaves the zone: how often the zone that
                       it enters is the graph's next one, the one of the same graph permuted, or the goal's
  room type            is it recognised after so many views of a random walk

The result goes to stdout as JSON, the table to stderr.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from _common import report

from jaxnav.env.objectnav import NUM_PRIORS, prior_index
from jaxnav.policies.methods.zones import (
    NUM_ZONES,
    adjacency,
    indirect_shares,
    learn_permuted,
    learn_zones,
    next_zones,
    room_graphs,
)
from jaxnav.scenes.lattice import best_actions
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE
from jaxnav.scenes.worlds import WORLDS, generated

PAIRS, WALKS, VIEWS, DEALS = 20_000, 2_000, (1, 10, 50), 200
Zones = Mapping[str, np.ndarray]


def main(worlds: Sequence[str], num_zones: int, scenes: int | None) -> None:
    results = {world: measured(world, num_zones, scenes) for world in worlds}
    print(table(results), file=sys.stderr)
    report({"zones": num_zones, "worlds": results})


def measured(world: str, num_zones: int, scenes: int | None) -> dict[str, Any]:
    """Learn the zones of a world, and try them."""
    train, val = (compiled(world, split, scenes) for split in ("train", "val"))
    size, is_goal = len(train.task.categories), train.task.is_goal()
    nothing = np.zeros((NUM_PRIORS, size, size))
    zones, permuted = learn_zones([train], nothing, num_zones), learn_permuted([train], nothing, num_zones)
    graphs, _ = room_graphs([train], size, num_zones)
    near = adjacency(graphs)
    absolute = indirect_shares(zones["nodes"], next_zones(near), is_goal)
    return {
        "scenes": len(train.names),
        "indirect": indirect_shares(zones["nodes"], zones["next_zone"], is_goal),
        "absolute": absolute,
        "shuffled": float(np.mean([indirect_shares(zones["nodes"], dealt, is_goal)[0] for dealt in shuffled(near)])),
        "next_zone": entered(val, zones, permuted),
        "room_type": recognised(val, zones),
    }


def shuffled(near: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the next zones of graphs whose edges, relative to the strongest, are dealt out anew."""
    draws, (one, other) = np.random.default_rng(2), np.triu_indices(near.shape[-1], 1)
    strongest = np.maximum(near.max(axis=(1, 2), keepdims=True), np.finfo(float).tiny)
    for _ in range(DEALS):
        edges = np.zeros_like(near)
        edges[:, one, other] = draws.permuted((near / strongest)[:, one, other], axis=1)
        yield next_zones(edges + np.swapaxes(edges, 1, 2))


def compiled(world: str, split: str, scenes: int | None) -> Bank:
    every = generated(world, split, scenes)
    return compile_bank((every[i] for i in range(len(every))), WORLDS[world].task)


def rooms_of(bank: Bank) -> np.ndarray:
    """Return the room type of every pose."""
    return np.repeat(list(map(prior_index, bank.room_types)), bank.num_cells * bank.task.rules.poses_per_cell)


def entered(bank: Bank, zones: Zones, permuted: Zones) -> dict[str, float]:
    """Return how often the zone entered next is foretold."""
    draws, room, following = np.random.default_rng(0), rooms_of(bank), bank.successor
    presence = RowFormat(len(bank.task.categories)).presence(bank.rows).astype(float)
    zone = np.empty(len(room), int)
    for each in np.unique(room):
        here = room == each
        zone[here] = np.square(presence[here][:, None] - zones["nodes"][each]).sum(axis=-1).argmin(axis=-1)
    pose, goal = np.nonzero(bank.best_length > 1)
    chosen = draws.integers(0, len(pose), PAIRS)
    start, goal = pose[chosen], goal[chosen]
    room, first = room[start], zone[start]
    sought = zones["nodes"][room, :, goal].argmax(axis=-1)
    now = start
    while True:
        on = (zone[now] == first) & (bank.best_length[now, goal] > 1)
        if not on.any():
            break
        now = np.where(on, following[now, best_actions(following, bank.best_length, now, goal)], now)
    left = (zone[now] != first) & (sought != first)
    told = {
        "graph": zones["next_zone"][room, first, sought],
        "permuted": permuted["next_zone"][room, first, sought],
        "goal": sought,
    }
    return {name: float((each == zone[now])[left].mean()) for name, each in told.items()}


def recognised(bank: Bank, zones: Zones) -> dict[int, float]:
    """Return how often the type of a room is recognised."""
    draws, room, following = np.random.default_rng(1), rooms_of(bank), bank.successor
    presence = RowFormat(len(bank.task.categories)).presence(bank.rows)
    pose, right = draws.integers(0, len(room), WALKS), {}
    truth, seen = room[pose], np.zeros((WALKS, presence.shape[1]), bool)
    for view in range(1, max(VIEWS) + 1):
        seen |= presence[pose]
        if view in VIEWS:
            right[view] = float(((zones["frequency"] + seen @ zones["detected"].T).argmax(axis=1) == truth).mean())
        pose = following[pose, draws.integers(0, DONE, WALKS)]
    return right


def table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the results in Markdown, percent."""
    heads = (
        "indirect pairs of zones",
        "of a zone and a goal",
        "both, absolute",
        "zones, shuffled",
        "next zone: graph",
        "permuted",
        "goal's",
    )
    lines = [
        f"| world | {' | '.join(heads)} | room type after {', '.join(map(str, VIEWS))} views |",
        "| --- |" + " ---: |" * (len(heads) + 1),
    ]
    for world, one in results.items():
        share = [*one["indirect"], max(one["absolute"]), one["shuffled"], *one["next_zone"].values()]
        cells = [f"{100 * each:.0f}" for each in share]
        lines.append(
            f"| {world} | {' | '.join(cells)} | {', '.join(f'{100 * v:.0f}' for v in one['room_type'].values())} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("worlds", nargs="*", metavar="WORLD")
    parser.add_argument("--zones", type=int, default=NUM_ZONES)
    parser.add_argument("--scenes", type=int, help="of each split; default: the world's usual number")
    asked = parser.parse_args()
    main(asked.worlds or [*WORLDS], asked.zones, asked.scenes)
