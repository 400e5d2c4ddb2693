"""Compiling ten thousand homes, and streaming them into training.

`python benchmarks/streaming.py [HOUSES]` prints the time and the disk that compiling takes, and steps per second of
training (both arms, one seed each) from the stream against the same training within one bank, chunk by chunk in turns.
Resident memory is the peak of the whole process. 1,000 houses by default; the compiled houses stay in the cache.
"""

import dataclasses
import math
import sys
import time

import jax
from _common import peak_resident_gb, print_report, ratio_by_turn, steps_per_second, time_in_turns

from jaxnav.layout import ESTIMATORS
from jaxnav.plain_console import PlainConsole
from jaxnav.runs.config import RunConfig, WorldConfig
from jaxnav.runs.train import explore_world, learn_knowledge, make_trainer
from jaxnav.runs.worlds import compile_training_world, draw_bank_order, prefetch_env_params
from jaxnav.scenes.tables.shards import Shards

TURNS = 7
CHUNK = 8


def main() -> None:
    num_houses = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    shard_scenes = min(128, math.ceil(num_houses / 4))  # at least four shards
    worlds = WorldConfig(num_train=num_houses, shard_scenes=shard_scenes)
    config = dataclasses.replace(RunConfig(), world="houses", seeds=1, chunk=CHUNK, worlds=worlds)

    # Compile the houses; rooms are counted in a sample of them.
    start_time = time.perf_counter()
    compiled_world = compile_training_world(config, PlainConsole(stderr=True))
    compile_s = time.perf_counter() - start_time
    assert isinstance(compiled_world.banks, Shards)
    disk_bytes = sum(file.stat().st_size for path in compiled_world.banks.paths for file in path.rglob("*"))
    num_sampled = min(num_houses, 200)
    rooms_per_house = sum(len(compiled_world.scenes[index].rooms) for index in range(num_sampled)) / num_sampled

    # Prepare the training.
    start_time = time.perf_counter()
    exploration = jax.block_until_ready(explore_world(config, compiled_world))
    explore_s = time.perf_counter() - start_time
    estimator_config = ESTIMATORS[config.layout.setting]
    knowledge = learn_knowledge(config, compiled_world, exploration, estimator_config)
    trainer = make_trainer(config, compiled_world.env, estimator_config, knowledge)

    # One training stays within a bank; the other takes the next bank for each chunk, one more for the warm-up.
    first_params = compiled_world.make_env_params(0)
    next_params = prefetch_env_params(compiled_world, draw_bank_order(compiled_world, config.seed, TURNS + 1))
    states = {name: trainer.init(first_params) for name in ("in_memory", "streamed")}

    def train_in_memory() -> None:
        states["in_memory"], _ = trainer.train(states["in_memory"], first_params)

    def train_streamed() -> None:
        params = next(next_params)
        states["streamed"], _ = trainer.train(trainer.restart(states["streamed"], params), params)

    times = time_in_turns({"in_memory": train_in_memory, "streamed": train_streamed}, TURNS)
    num_steps = CHUNK * config.steps_per_update * len(trainer.learners)
    print_report(
        {
            "houses": num_houses,
            "shards": len(compiled_world.banks),
            "scenes_per_shard": compiled_world.num_scenes,
            "compile_s": round(compile_s, 1),
            "houses_per_s": round(num_houses / compile_s, 1),
            "disk_gb": round(disk_bytes / 1e9, 2),
            "disk_kb_per_house": round(disk_bytes / 1e3 / num_houses),
            "disk_kb_per_room": round(disk_bytes / 1e3 / num_houses / rooms_per_house),
            "explore_s": round(explore_s, 1),
            "steps_per_s": {name: steps_per_second(call_times, num_steps) for name, call_times in times.items()},
            "streamed_over_in_memory": ratio_by_turn(times["in_memory"], times["streamed"]),
            "peak_resident_gb": peak_resident_gb(),
        }
    )


if __name__ == "__main__":
    main()
