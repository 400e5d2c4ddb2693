"""Steps per second of training with the default policy, learning included: `python benchmarks/training.py`.

All seeds of both arms, as `train.py` runs them, in turns with one seed of each arm. The program of a chunk of updates
is compared with that of a training a hundred times as long: equal programs need equal memory.
"""

from functools import partial

import jax
from _common import in_turns, peak_resident_gb, rates, report
from _phases import program

from jaxnav.env.make import make
from jaxnav.layout import SETTINGS
from jaxnav.runs.config import RunConfig
from jaxnav.training.calibration import layout_priors
from jaxnav.training.exploration import explore
from jaxnav.training.trainer import Arms

CHUNK, TURNS = 4, 5


def main() -> None:
    config = RunConfig(chunk=CHUNK)
    env, params = make(config.world)
    counts = jax.jit(explore, static_argnums=0)(env, params, jax.random.key(0)).counts
    setting = SETTINGS[config.layout.setting]
    priors = layout_priors(counts, setting)
    arms = Arms(config, env, setting, priors)
    kept = {"states": arms.init(params)}

    def everything():
        kept["states"], _ = arms.train(kept["states"], params)

    calls, steps = {"all arms and seeds": everything}, CHUNK * config.update_steps
    temporary, same = {}, {}
    for name, learner in arms.learners.items():
        state = jax.jit(learner.init)(jax.random.key(0), params, priors)
        train = partial(learner.train, num_updates=CHUNK)
        inputs = state, config.ppo.scalars(config.total_updates), params, priors
        own = program(train, *inputs)
        calls[name], temporary[name] = own.call, own.temp_gb
        longer = state, config.ppo.scalars(100 * config.total_updates), params, priors
        same[name] = jax.jit(train).lower(*inputs).as_text() == jax.jit(train).lower(*longer).as_text()
    taken = in_turns(calls, TURNS)
    many = config.seeds * len(arms.learners)
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
