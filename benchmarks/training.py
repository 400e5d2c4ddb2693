"""Steps per second of training with the default policy, learning included: `python benchmarks/training.py`.

All seeds of both arms side by side, as `train.py` runs them; each arm alone, with the rollout's share; and the memory
of a compiled chunk of updates.
"""

import dataclasses
import time

import jax
from _common import rates, report, timings

from jaxnav.cli.arms import Arms
from jaxnav.cli.config import RunConfig
from jaxnav.env.make import make
from jaxnav.env.types import EnvParams
from jaxnav.layout import SETTINGS
from jaxnav.policies.policy import bind
from jaxnav.training.calibration import layout_priors
from jaxnav.training.exploration import explore
from jaxnav.training.learner import Learner
from jaxnav.training.rollout import rollout

CHUNK, REPEATS = 2, 5


def main() -> None:
    config = dataclasses.replace(RunConfig(), chunk=CHUNK)
    env, params = make(config.world)
    counts = jax.jit(explore, static_argnums=0)(env, params, jax.random.key(0)).counts
    setting = SETTINGS[config.layout.setting]
    priors = layout_priors(counts, setting)
    arms = Arms(config, env, setting, priors)
    steps = CHUNK * config.ppo.num_envs * config.ppo.rollout * config.seeds * len(arms.learners)
    report(
        {
            "episodes": config.ppo.num_envs,
            "rollout": config.ppo.rollout,
            "updates_per_call": CHUNK,
            "seeds": config.seeds,
            "all_arms_and_seeds_steps_per_s": side_by_side(arms, params, steps),
            "arms": {name: alone(learner, config, params, priors) for name, learner in arms.learners.items()},
        }
    )


def side_by_side(arms: Arms, params: EnvParams, steps: int) -> dict:
    states, _ = arms.train(arms.init(params), params)
    measured = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        states, _ = arms.train(states, params)
        measured.append(round(steps / (time.perf_counter() - began)))
    measured.sort()
    return {"median": measured[REPEATS // 2], "min": measured[0], "max": measured[-1]}


def alone(learner: Learner, config: RunConfig, params, priors) -> dict:
    state = jax.jit(learner.init)(jax.random.key(0), params, priors)

    @jax.jit
    def train(state, scalars, params, priors):
        return learner.train(state, scalars, params, priors, CHUNK)

    @jax.jit
    def act(state, params, priors):
        policy = bind(learner.spec, state.params)
        coin = learner.counterfactual == "coin"
        return rollout(learner.acting, policy, state.agent, state.key, config.ppo.rollout, coin, params, priors)

    def lowered(total_steps: int):
        return train.lower(state, config.ppo.scalars(total_steps), params, priors)

    compiled = lowered(config.total_steps).compile()
    memory = compiled.memory_analysis()
    training = timings(compiled, state, config.ppo.scalars(config.total_steps), params, priors, repeats=REPEATS)
    acting = timings(act, state, params, priors, repeats=REPEATS)
    steps = config.ppo.num_envs * config.ppo.rollout
    longer = lowered(100 * config.total_steps).as_text()
    return {
        "steps_per_s": rates(training, CHUNK * steps),
        "rollout_steps_per_s": rates(acting, steps),
        "rollout_share": round(CHUNK * acting["wall_median_ms"] / training["wall_median_ms"], 3),
        "temp_bytes": memory.temp_size_in_bytes,
        "argument_bytes": memory.argument_size_in_bytes,
        # Equal programs need equal memory.
        "same_program_for_100_times_the_steps": lowered(config.total_steps).as_text() == longer,
    }


if __name__ == "__main__":
    main()
