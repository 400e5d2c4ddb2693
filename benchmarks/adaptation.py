"""Effect of adaptation within the episode on trained policies.

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
import operator
from pathlib import Path
from typing import cast

import jax
import numpy as np
from _common import print_report

import jaxnav
from jaxnav.env.objectnav import EnvParams
from jaxnav.evaluation.statistics import paired_difference
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.adaptation import (
    WINDOW,
    FastWeights,
    HasLearnedLoss,
    LearnedLossAdaptation,
    replay_window,
    zero_output_changes,
)
from jaxnav.policies.agent_loop import Agent, AgentLoop, policy_memory
from jaxnav.policies.method import Knowledge
from jaxnav.policies.network import Params
from jaxnav.runs.results import Results
from jaxnav.runs.worlds import compile_evaluation_world

NUM_EPISODES = 64
NUM_STEPS = 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--episodes", type=int, default=1000)
    options = parser.parse_args()

    # Evaluate without adaptation and with the method's usual number of inner steps.
    run = jaxnav.Run.open(options.run)
    plain = jaxnav.evaluate(run, episodes=options.episodes, inner_steps=0)
    adapted = jaxnav.evaluate(run, episodes=options.episodes)
    clusters = adapted.episodes.clusters()
    plain_metrics = plain.metrics()
    adapted_metrics = adapted.metrics()

    changed_episodes = {}
    differences = {}
    for row_index, row in enumerate(adapted.rows):
        if row.variant != "baseline":
            continue
        plain_outcomes = stack_outcomes(plain, row_index)
        adapted_outcomes = stack_outcomes(adapted, row_index)
        is_changed = (plain_outcomes != adapted_outcomes).any(axis=0)
        changed_episodes[row.decoding] = round(100.0 * float(is_changed.mean()), 1)

        differences[row.decoding] = {}
        for name in ("sr", "spl", "dts"):
            difference = paired_difference(
                plain_metrics[name][row_index], adapted_metrics[name][row_index], clusters, same_runs=True
            )
            differences[row.decoding][name] = f"{difference:+.4f}"
    print_report({"falls": percent_falling(run), "others": changed_episodes, "adapted": differences})


def stack_outcomes(results: Results, row_index: int) -> np.ndarray:
    """Return all outcomes of a row but the mean weight, [outcomes, S, E]."""
    leaves = jax.tree.leaves(results.outcome._replace(total_weight=None))
    return np.stack(leaves)[:, row_index]


def percent_falling(run: jaxnav.Run) -> list[float]:
    """Return the percentage of windows whose loss falls, for each seed."""
    policies = run.policies()
    compiled_world = compile_evaluation_world(run.config, "val", None, None, PlainConsole(quiet=True))
    agent_loop = dataclasses.replace(policies.make_agent_loop(compiled_world), estimator_config=None)
    arm_params = policies.arm_params("baseline")

    percentages = []
    for seed in range(policies.num_seeds):
        weights = jax.tree.map(operator.itemgetter(seed), arm_params)
        window_losses = measure_windows(agent_loop, weights, policies.knowledge, compiled_world.make_env_params(0))
        is_full, loss_before, loss_after = map(np.asarray, window_losses)
        percentages.append(round(100.0 * float((loss_after < loss_before)[is_full].mean()), 2))
    return percentages


@functools.partial(jax.jit, static_argnums=0)
def measure_windows(
    agent_loop: AgentLoop, weights: Params, knowledge: Knowledge, params: EnvParams
) -> tuple[jax.Array, ...]:
    """Return where windows are full, bool [T, B], and the learned loss of each before and after its inner step."""
    policy = agent_loop.bind(weights)
    adaptation = cast(LearnedLossAdaptation, policy.adaptation)

    def learned_loss(fast: FastWeights) -> jax.Array:
        rows, _ = replay_window(policy, fast.window, fast.layer_changes, zero_output_changes(fast.layer_changes))
        return cast(HasLearnedLoss, policy.method).learned_loss(rows)

    def step(agent: Agent, key: jax.Array) -> tuple[Agent, tuple[jax.Array, ...]]:
        memory = policy_memory(agent)
        pathways = policy.pathways(agent_loop.policy_inputs(agent, knowledge, params), memory)
        decision = policy.decide(pathways, memory)

        # The same window with the weights before and after the inner step.
        fast_after = decision.fast
        fast_before = decision.fast._replace(layer_changes=memory.fast.layer_changes)
        is_complete = fast_after.num_decisions % WINDOW == 0
        is_adapting = fast_after.num_decisions <= adaptation.inner_steps * WINDOW

        choice = jax.random.categorical(key, decision.logits)
        keys = jax.random.split(key, NUM_EPISODES)
        agent, _ = agent_loop.step(agent, choice, knowledge, params, policy=policy, decision=decision, reset_keys=keys)
        losses = (learned_loss(fast_before), learned_loss(fast_after))
        return agent, (is_complete & is_adapting, *losses)

    memory = policy.initial_memory((NUM_EPISODES,))
    agent = agent_loop.start(jax.random.key(0), NUM_EPISODES, memory, knowledge, params)
    return jax.lax.scan(step, agent, jax.random.split(jax.random.key(1), NUM_STEPS))[1]


if __name__ == "__main__":
    main()
