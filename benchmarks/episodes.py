"""How many parallel episodes to train with: speed, memory, and success after equal time.

`python benchmarks/episodes.py` trains one policy of the arm `layout` in rooms with 64 to 16,384 parallel episodes, each
number in a process of its own. Minibatches keep the 32 episodes of the default, so all numbers take as many gradient
steps for as many environment steps. Every run has `SECONDS` of training, at the speed of its first updates; success is
that of best and of sampled actions in val scenes, over `NUM_SEEDS` seeds one after the other. Peaks are of resident
memory, with Python, JAX, its compiler and the scenes.
"""

import dataclasses
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from _common import peak_device_gb, peak_resident_gb, print_report, steps_per_second, summarize, time_in_turns
from _setup import accelerator_mesh, make_training_call, set_up_training

import jaxnav
from jaxnav.runs.config import RunConfig
from jaxnav.runs.train import make_trainer

NUM_EPISODES = (64, 256, 1024, 4096, 16384)
MINIBATCH_EPISODES = 32
CHUNK_EPISODES = 1024
SECONDS = 30.0
NUM_SEEDS = 3
ARM = "layout"


def main() -> None:
    points = {}
    for num_envs in NUM_EPISODES:
        print(f"{num_envs} episodes", file=sys.stderr, flush=True)
        completed = subprocess.run([sys.executable, __file__, str(num_envs)], stdout=subprocess.PIPE, check=True)
        points[str(num_envs)] = json.loads(completed.stdout)
    print_report({"arm": ARM, "seconds": SECONDS, "seeds": NUM_SEEDS, "episodes": points})


def measure_point(num_envs: int) -> dict:
    """Return speed, success after `SECONDS` and peak memory with so many parallel episodes."""
    # Chunks have about as many steps up to 1,024 episodes, so that logs and checkpoints weigh alike.
    config = RunConfig(seeds=1, arms=(ARM,), chunk=max(1, CHUNK_EPISODES // num_envs), validations=1, val_episodes=1000)
    ppo = dataclasses.replace(config.ppo, num_envs=num_envs, minibatches=num_envs // MINIBATCH_EPISODES)
    config = dataclasses.replace(config, ppo=ppo)

    # Speed of single chunks.
    setup = set_up_training(config)
    mesh = accelerator_mesh(config)
    trainer = make_trainer(config, setup.compiled_world.env, setup.estimator_config, setup.knowledge, mesh)
    call = make_training_call(trainer, trainer.init(setup.params), setup.params)
    update_times = time_in_turns({"chunk": call}, turns=3)["chunk"]
    rate = steps_per_second(update_times, config.chunk * config.steps_per_update)

    # Runs of equal time.
    total_steps = round(rate["median"] * SECONDS)
    success = {"argmax": [], "sample": []}
    last_row = {}
    for seed in range(NUM_SEEDS):
        with tempfile.TemporaryDirectory() as folder:
            run_config = dataclasses.replace(config, seed=seed, total_steps=total_steps, run_dir=Path(folder) / "run")
            if mesh is not None:
                run_config = dataclasses.replace(run_config, devices=1)
            last_row = jaxnav.train(run_config).log()[-1]
            success["argmax"].append(100 * last_row["val_success"])
            success["sample"].append(100 * last_row["val_success_sampled"])
    return {
        "steps_per_s": rate,
        "steps": last_row["env_steps"],
        "success_argmax": summarize(success["argmax"], digits=3),
        "success_sample": summarize(success["sample"], digits=3),
        "peak_resident_gb": peak_resident_gb(),
        "peak_device_gb": peak_device_gb(),
    }


if __name__ == "__main__":
    if sys.argv[1:]:
        print(json.dumps(measure_point(int(sys.argv[1]))))
    else:
        main()
