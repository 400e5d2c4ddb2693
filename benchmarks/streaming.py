"""Homes by the ten thousand: `python benchmarks/streaming.py [HOUSES]` compiles, streams and trains on them.

It prints the time and the disk that compiling takes, and steps per second of training (both arms, one seed each) from
the stream against the same training within one bank, chunk by chunk in turns. Resident memory is the peak of the whole
process. 1,000 houses by default; the compiled houses stay in the cache.
"""

import dataclasses
import resource
import statistics
import sys
import time
from pathlib import Path

from _common import report
from rich.console import Console

from jaxnav.cli.train import explored
from jaxnav.layout import SETTINGS
from jaxnav.runs.config import RunConfig, WorldConfig
from jaxnav.runs.worlds import bank_order, read_ahead, training_world
from jaxnav.training.calibration import layout_priors
from jaxnav.training.trainer import Arms

TURNS, CHUNK = 7, 8


def main() -> None:
    houses = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    worlds = WorldConfig(num_train=houses, shard_scenes=min(128, -(-houses // 4)))
    config = dataclasses.replace(RunConfig(), world="houses", seeds=1, chunk=CHUNK, worlds=worlds)
    began = time.perf_counter()
    world = training_world(config, Console(stderr=True))
    compiling = time.perf_counter() - began
    disk = sum(file.stat().st_size for path in world.banks.paths for file in Path(path).rglob("*"))
    rooms = sum(len(world.scenes[i].rooms) for i in range(min(houses, 200))) / min(houses, 200)

    began = time.perf_counter()
    found = explored(config, world)
    exploring = time.perf_counter() - began
    setting = SETTINGS[config.layout.setting]
    arms = Arms(config, world.env, setting, layout_priors(found.counts, setting))
    still, coming = world.params(0), read_ahead(world, bank_order(world, config.seed, TURNS))
    memory, streamed = arms.init(still), arms.init(still)
    memory, _ = arms.train(memory, still)  # compiles
    streamed = arms.restart(streamed, still)
    seconds = {"in_memory": [], "streamed": []}
    for _ in range(TURNS):
        began = time.perf_counter()
        memory, _ = arms.train(memory, still)
        seconds["in_memory"].append(time.perf_counter() - began)
        began = time.perf_counter()
        params = next(coming)
        streamed, _ = arms.train(arms.restart(streamed, params), params)
        seconds["streamed"].append(time.perf_counter() - began)
    steps = CHUNK * config.update_steps * len(arms.learners)
    rates = {name: round(steps / statistics.median(values)) for name, values in seconds.items()}
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
            "steps_per_s": rates,
            "streamed_over_in_memory": round(rates["streamed"] / rates["in_memory"], 3),
            "peak_resident_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 2),
        }
    )


if __name__ == "__main__":
    main()
