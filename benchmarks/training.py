"""Steps per second of training, learning included.

`python benchmarks/training.py` times all seeds of both arms, as `train.py` runs them with the default policy, in turns
with one seed of each arm. The program of a chunk of updates is compared with that of a training a hundred times as
long: equal programs need equal memory.
"""

from functools import partial

import jax
from _common import in_turns, peak_resident_gb, rates, report
from _phases import program
from _setup import set_up

from jaxnav.runs.config import RunConfig

CHUNK, TURNS = 4, 5


def main() -> None:
    config = RunConfig(chunk=CHUNK)
    setup = set_up(config)
    trainer, params = setup.trainer, setup.params
    kept = {"states": trainer.init(params)}

    def everything():
        kept["states"], _ = trainer.train(kept["states"], params)

    calls, steps = {"all arms and seeds": everything}, CHUNK * config.update_steps
    temporary, same = {}, {}
    for name, learner in trainer.learners.items():
        train = partial(learner.train, num_updates=CHUNK)
        state, scalars, *rest = setup.arguments(name)
        chunk = program(train, state, scalars, *rest)
        calls[name], temporary[name] = chunk.call, chunk.temp_gb
        longer = config.ppo.scalars(100 * config.total_updates)
        texts = {jax.jit(train).lower(state, each, *rest).as_text() for each in (scalars, longer)}
        same[name] = len(texts) == 1
    taken = in_turns(calls, TURNS)
    many = config.seeds * len(trainer.learners)
    report(
        {
            "episodes": config.ppo.num_envs,
            "rollout_steps": config.ppo.rollout,
            "seeds": config.seeds,
            "steps_per_s": {
                name: rates(taken[name], steps * (many if name == "all arms and seeds" else 1)) for name in calls
            },
            "temporary_gb_of_a_chunk": temporary,
            "same_program_for_100_times_the_steps": same,
            "peak_resident_gb": peak_resident_gb(),
        }
    )


if __name__ == "__main__":
    main()
