"""Steps per second of training, learning included.

`python benchmarks/training.py` times all seeds of both arms, as `train.py` runs them with the default policy, in turns
with one seed of each arm.
"""

import dataclasses

from _common import peak_device_gb, peak_resident_gb, print_report, steps_per_second, time_in_turns
from _setup import accelerator_mesh, make_training_call, set_up_training

from jaxnav.runs.config import RunConfig
from jaxnav.runs.train import make_trainer

CHUNK = 4
TURNS = 5


def main() -> None:
    config = RunConfig(chunk=CHUNK)
    setup = set_up_training(config)

    # One run of everything, and one of a single seed for each arm.
    run_configs = {"all arms and seeds": config}
    for arm in config.arms:
        run_configs[arm] = dataclasses.replace(config, arms=(arm,), seeds=1)
    calls = {}
    for name, run_config in run_configs.items():
        mesh = accelerator_mesh(run_config)
        trainer = make_trainer(run_config, setup.compiled_world.env, setup.estimator_config, setup.knowledge, mesh)
        calls[name] = make_training_call(trainer, trainer.init(setup.params), setup.params)

    times = time_in_turns(calls, TURNS)
    rates = {}
    for name, run_config in run_configs.items():
        num_seeds = run_config.seeds * len(run_config.arms)
        rates[name] = steps_per_second(times[name], CHUNK * config.steps_per_update * num_seeds)
    print_report(
        {
            "episodes": config.ppo.num_envs,
            "rollout_steps": config.ppo.rollout,
            "seeds": config.seeds,
            "steps_per_s": rates,
            "peak_resident_gb": peak_resident_gb(),
            "peak_device_gb": peak_device_gb(),
        }
    )


if __name__ == "__main__":
    main()
