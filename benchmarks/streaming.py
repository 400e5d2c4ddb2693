"""Homes by the ten thousand: compiled, streamed and trained on.

`python benchmarks/streaming.py [HOUSES]` prints the time and the disk that compiling takes, and steps per second of
training (both arms, one seed each) from the stream against the same training within one bank, chunk by chunk in turns.
Resident memory is the peak of the whole process. 1,000 houses by default; the compiled houses stay in the cache.
"""

import dataclasses
import sys
import time

import jax
from _common import in_turns, peak_resident_gb, rates, ratios, report
from rich.console import Console

from jaxnav.layout import SETTINGS
from jaxnav.runs.config import RunConfig, WorldConfig
from jaxnav.runs.prepare import explore_world, learn_knowledge, make_trainer
from jaxnav.runs.worlds import bank_order, read_ahead, training_world
from jaxnav.scenes.tables.shards import Shards

TURNS, CHUNK = 7, 8


def main() -> None:
    houses = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    worlds = WorldConfig(num_train=houses, shard_scenes=min(128, -(-houses // 4)))
    config = dataclasses.replace(RunConfig(), world="houses", seeds=1, chunk=CHUNK, worlds=worlds)
    began = time.perf_counter()
    world = training_world(config, Console(stderr=True))
    compiling = time.perf_counter() - began
    assert isinstance(world.banks, Shards)
    disk = sum(file.stat().st_size for path in world.banks.paths for file in path.rglob("*"))
    rooms = sum(len(world.scenes[i].rooms) for i in range(min(houses, 200))) / min(houses, 200)

    began = time.perf_counter()
    explored = jax.block_until_ready(explore_world(config, world))
    exploring = time.perf_counter() - began
    setting = SETTINGS[config.layout.setting]
    trainer = make_trainer(config, world.env, setting, learn_knowledge(config, world, explored, setting))
    still = world.params(0)
    coming = read_ahead(world, bank_order(world, config.seed, TURNS + 1))  # one more for the warm-up
    states = {name: trainer.init(still) for name in ("in_memory", "streamed")}

    def in_memory() -> None:
        states["in_memory"], _ = trainer.train(states["in_memory"], still)

    def streamed() -> None:
        params = next(coming)
        states["streamed"], _ = trainer.train(trainer.restart(states["streamed"], params), params)

    taken = in_turns({"in_memory": in_memory, "streamed": streamed}, TURNS)
    steps = CHUNK * config.update_steps * len(trainer.learners)
    report(
        {
            "houses": houses,
            "shards": len(world.banks),
            "scenes_per_shard": world.num_scenes,
            "compile_s": round(compiling, 1),
            "houses_per_s": round(houses / compiling, 1),
            "disk_gb": round(disk / 1e9, 2),
            "disk_kb_per_house": round(disk / 1e3 / houses),
            "disk_kb_per_room": round(disk / 1e3 / houses / rooms),
            "explore_s": round(exploring, 1),
            "steps_per_s": {name: rates(seconds, steps) for name, seconds in taken.items()},
            "streamed_over_in_memory": ratios(taken["in_memory"], taken["streamed"]),
            "peak_resident_gb": peak_resident_gb(),
        }
    )


if __name__ == "__main__":
    main()
