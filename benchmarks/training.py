"""Steps per second of training, learning included.

`python benchmarks/training.py` times all seeds of both arms, as `train.py` runs them with the default policy, in turns
with one seed of each arm. The program of a chunk of updates is compared with that of a training a hundred times as
long: equal programs need equal memory.
"""

from functools import partial

import jax
from _common import peak_resident_gb, print_report, steps_per_second, time_in_turns
from _phases import compile_program
from _setup import set_up_training

from jaxnav.runs.config import RunConfig

CHUNK = 4
TURNS = 5
ALL_SEEDS = "all arms and seeds"


def main() -> None:
    config = RunConfig(chunk=CHUNK)
    setup = set_up_training(config)
    trainer = setup.trainer
    params = setup.params
    states = trainer.init(params)

    def train_all_seeds():
        nonlocal states
        states, _ = trainer.train(states, params)

    # One call for everything, and one for a seed of each arm.
    calls = {ALL_SEEDS: train_all_seeds}
    temp_gb = {}
    is_same_program = {}
    for arm, learner in trainer.learners.items():
        train = partial(learner.train, num_updates=CHUNK)
        state, scalars, env_params, knowledge = setup.update_arguments(arm)
        program = compile_program(train, state, scalars, env_params, knowledge)
        calls[arm] = program.call
        temp_gb[arm] = program.temp_gb

        # Compare the program with that of a training a hundred times as long.
        long_scalars = config.ppo.scalars(100 * config.total_updates)
        program_text = jax.jit(train).lower(state, scalars, env_params, knowledge).as_text()
        long_program_text = jax.jit(train).lower(state, long_scalars, env_params, knowledge).as_text()
        is_same_program[arm] = program_text == long_program_text

    times = time_in_turns(calls, TURNS)
    rates = {}
    for name, call_times in times.items():
        num_seeds = config.seeds * len(trainer.learners) if name == ALL_SEEDS else 1
        rates[name] = steps_per_second(call_times, CHUNK * config.steps_per_update * num_seeds)
    print_report(
        {
            "episodes": config.ppo.num_envs,
            "rollout_steps": config.ppo.rollout,
            "seeds": config.seeds,
            "steps_per_s": rates,
            "temporary_gb_of_a_chunk": temp_gb,
            "same_program_for_100_times_the_steps": is_same_program,
            "peak_resident_gb": peak_resident_gb(),
        }
    )


if __name__ == "__main__":
    main()
