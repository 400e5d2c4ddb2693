"""What adaptation within the episode does to trained policies.

`python benchmarks/adaptation.py RUN [--episodes 1000]` takes a run of a method that adapts by a learned loss (`savn`,
`eotp:ADAPTED`), arm `baseline`, in its val scenes:

  falls       percent of the windows of 60 steps of 64 episodes, whose actions are sampled, after which the learned loss
              is lower than before the step, of each seed
  others      percent of the episodes that go another way without adaptation, by decoding
  adapted     success, SPL and DTS with adaptation less without it, by decoding, with intervals over runs and scenes

The result goes to stdout as JSON.
"""

import argparse
import dataclasses
import functools
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from _common import report
from rich.console import Console

import jaxnav
from jaxnav.env.types import EnvParams
from jaxnav.evaluation.statistics import paired_difference
from jaxnav.policies.acting import Acting, Agent, carried
from jaxnav.policies.adaptation import WINDOW, FastWeights, LearnedSteps, replay_window
from jaxnav.policies.learned_loss import Judging
from jaxnav.policies.methods import Knowledge
from jaxnav.policies.policy import Params
from jaxnav.runs.worlds import evaluation_world

EPISODES, STEPS = 64, 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--episodes", type=int, default=1000)
    options = parser.parse_args()
    run = jaxnav.Run.open(options.run)
    plain, adapted = (jaxnav.evaluate(run, episodes=options.episodes, inner_steps=steps) for steps in (0, None))
    clusters, before, after = adapted.episodes.clusters(), plain.metrics(), adapted.metrics()
    others, differences = {}, {}
    for i, row in enumerate(adapted.rows):
        if row.variant == "baseline":
            ends = [np.stack(jax.tree.leaves(each.outcome._replace(weight=None)))[:, i] for each in (plain, adapted)]
            others[row.decoding] = round(100.0 * float((ends[0] != ends[1]).any(axis=0).mean()), 1)
            differences[row.decoding] = {
                name: f"{paired_difference(before[name][i], after[name][i], clusters, same_runs=True):+.4f}"
                for name in ("sr", "spl", "dts")
            }
    report({"falls": falls(run), "others": others, "adapted": differences})


def falls(run: jaxnav.Run) -> list[float]:
    """Return the share of windows whose loss falls, in percent, of each seed."""
    policies, world = run.policies(), evaluation_world(run.config, "val", None, None, Console(quiet=True))
    acting = dataclasses.replace(policies.acting(world), setting=None)
    found = []
    for seed in range(policies.seeds):
        weights = jax.tree.map(lambda leaf, seed=seed: leaf[seed], policies.of("baseline"))
        full, before, after = map(np.asarray, windows(acting, weights, policies.knowledge, world.params(0)))
        found.append(round(100.0 * float((after < before)[full].mean()), 2))
    return found


@functools.partial(jax.jit, static_argnums=0)
def windows(acting: Acting, weights: Params, knowledge: Knowledge, params: EnvParams) -> tuple[jax.Array, ...]:
    """Return which windows are full, bool [T, B], and the learned loss of each before and after its step."""
    policy = acting.bind(weights)
    adaptation = cast(LearnedSteps, policy.adaptation)

    def loss(fast: FastWeights) -> jax.Array:
        nothing = {layer: jnp.zeros_like(factors.outputs[:WINDOW]) for layer, factors in fast.factors.items()}
        return cast(Judging, policy.method).learned_loss(replay_window(policy, fast, nothing)[0])

    def step(agent: Agent, key: jax.Array) -> tuple[Agent, tuple[jax.Array, ...]]:
        memory = carried(agent)
        decision = policy.decide(policy.pathways(*acting.view(agent, knowledge, params), memory), memory)
        after, before = decision.fast, decision.fast._replace(factors=memory.fast.factors)
        choice, keys = jax.random.categorical(key, decision.logits), jax.random.split(key, EPISODES)
        agent, _ = acting.step(agent, choice, knowledge, params, policy=policy, decision=decision, keys=keys)
        full = (after.decisions % WINDOW == 0) & (after.decisions <= adaptation.inner_steps * WINDOW)
        return agent, (full, jax.vmap(loss)(before), jax.vmap(loss)(after))

    agent = acting.start(jax.random.key(0), EPISODES, policy.initial_memory((EPISODES,)), knowledge, params)
    return jax.lax.scan(step, agent, jax.random.split(jax.random.key(1), STEPS))[1]


if __name__ == "__main__":
    main()
