"""The scale at which the layout weights enter, for every method and kind of weights (`--layout.weights`).

`python benchmarks/weight_scale.py [FOLDER] [--methods org ...] [--total-steps N]` trains one policy with layout weights
per method and kind in rooms, acts with sampled actions in val scenes, and measures at every decision:

  factor          factor on the features of visible categories other than the goal: median, and 5th to 95th percentile
  moved N         mean relative change of the goal's column of w from the prior to the N-th step, over these categories
  categories / Z  share of the change of the recurrent core's input that other categories make: mean square of the
                  change when the other categories in Z become those of another episode, over that when all of Z does
  untrained       the same share of a policy before training
  Z / all         mean square of the change when Z becomes that of another episode, over that when all pathways and the
                  previous action do

The input of the recurrent core is measured before its activation (ReLU).

Runs are stored in FOLDER, by default a temporary one, and a repeated command uses those that are finished. The result
goes to stdout as JSON, the table to stderr.
"""

import argparse
import dataclasses
import sys
import tempfile
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from _common import SEMEXP_PPO, print_report
from rich.console import Console

import jaxnav
from jaxnav.evaluation.replacements import (
    DecisionContext,
    ReplacedPart,
    embed_decision_inputs,
    other_running_episode,
    replace_part,
)
from jaxnav.layout import scale_weights
from jaxnav.numerics.trees import take_rows
from jaxnav.policies.network import Policy, init_params
from jaxnav.policies.pathways import Pathways
from jaxnav.policies.spec import WeightKind
from jaxnav.runs.policies import Policies
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world
from jaxnav.training.config import PPOConfig

METHODS = ("org", "eotp", "vtnet", "hoz", "semexp")
NUM_EPISODES = 256
NUM_STEPS = 60
#: Steps of an episode at which the change of w is reported.
REPORTED_STEPS = (1, 5, 10, 20, 50)


def main(folder: Path, methods: list[str], total_steps: int) -> None:
    rows = []
    for method in methods:
        for weight_kind in get_args(WeightKind):
            config = jaxnav.RunConfig(
                run_dir=folder / f"{method}-{weight_kind}",
                method=method,
                arms=("layout",),
                seeds=1,
                total_steps=total_steps,
                validations=1,
                layout=dataclasses.replace(jaxnav.RunConfig().layout, weights=weight_kind),
                ppo=SEMEXP_PPO if method == "semexp" else PPOConfig(),
            )
            run = jaxnav.train(config)
            compiled_world = compile_evaluation_world(run.config, "val", None, None, Console(quiet=True))
            policies = run.policies()
            fresh_params = init_params(policies.spec, jax.random.key(0))
            untrained = policies._replace(params=jax.tree.map(lambda leaf: leaf[None], fresh_params))
            row = {"method": method, "weights": weight_kind} | measure(policies, compiled_world)
            rows.append(row | {"untrained": measure(untrained, compiled_world)["categories / Z"]})
            print(rows[-1], file=sys.stderr, flush=True)
    print(format_table(rows), file=sys.stderr)
    print_report({"total_steps": total_steps, "rows": rows})


def measure(policies: Policies, compiled_world: CompiledWorld) -> dict[str, float]:
    """Measure the weights of the first policy, and what Z changes in the input of its recurrent core."""
    recorded = jax.tree.map(np.asarray, record_steps(policies, compiled_world))

    # Visible categories other than the goal, in episodes that still run: [T, E, K].
    counted = recorded["visible"] & ~recorded["is_goal"] & recorded["running"][..., None]
    factors = recorded["factor"][counted]
    changes = np.abs(recorded["weights"] / recorded["prior_weights"] - 1)
    row = {"factor": np.median(factors), "low": np.quantile(factors, 0.05), "high": np.quantile(factors, 0.95)}
    for step in REPORTED_STEPS:
        row[f"moved {step}"] = changes[step - 1][counted[step - 1]].mean()

    # Mean squares over the decisions with a partner.
    is_paired = recorded["running"] & (recorded["running"].sum(axis=1, keepdims=True) > 1)
    names = ("other_categories", "experience", "all")
    other_categories, experience, everything = (recorded[name][is_paired].mean() for name in names)
    row |= {"categories / Z": other_categories / experience, "Z / all": experience / everything}
    return {name: float(f"{value:.3g}") for name, value in row.items()}


def record_steps(policies: Policies, compiled_world: CompiledWorld) -> dict[str, jax.Array]:
    """Act for some steps in random episodes, and record each of them, leaves [T, E, ...]."""
    agent_loop = policies.make_agent_loop(compiled_world)
    env_params = compiled_world.make_env_params(0)
    knowledge = policies.knowledge
    keys = jax.random.split(jax.random.key(0), NUM_EPISODES)

    def record(params: Any) -> dict[str, jax.Array]:
        policy = agent_loop.bind(params)
        agent = agent_loop.start(
            jax.random.key(1), NUM_EPISODES, policy.initial_memory((NUM_EPISODES,)), knowledge, env_params
        )

        def step(carry: tuple[Any, jax.Array], step_key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
            agent, running = carry
            context = DecisionContext(policy, jnp.bool_(True), agent_loop, knowledge, env_params)
            factual = embed_decision_inputs(agent, context)
            inputs, memory = factual.inputs, factual.memory
            decision = policy.decide(factual.pathways, memory)

            # Inputs of the recurrent core: factual, and with parts of another episode.
            core_input = project(policy, factual.pathways, memory.action)
            partner = other_running_episode(running, keys)
            categories_replaced, _ = replace_part(ReplacedPart.OTHER_CATEGORIES, partner, factual, context)
            experience_replaced, _ = replace_part(ReplacedPart.EXPERIENCE, partner, factual, context)
            changed_inputs = {
                "other_categories": project(policy, categories_replaced, memory.action),
                "experience": project(policy, experience_replaced, memory.action),
                "all": take_rows(core_input, partner),
            }
            is_goal = jax.nn.one_hot(agent.state.goal, inputs.layout_weights.shape[-1], dtype=bool)
            factor = inputs.layout_weights
            if policy.weight_kind == "relative":
                factor = scale_weights(factor, agent.state.goal)
            recorded = {
                "weights": inputs.layout_weights,
                "prior_weights": agent_loop.prior_weights(agent, knowledge, env_params),
                "factor": factor,
                "visible": compiled_world.env.row_format.presence(inputs.observation.row),
                "is_goal": is_goal,
                "running": running,
            }
            for name, changed_input in changed_inputs.items():
                recorded[name] = jnp.square(changed_input - core_input).sum(axis=-1)

            # Act; ended episodes go on but do not count.
            choice = jax.random.categorical(step_key, decision.logits)
            next_agent, result = agent_loop.step(agent, choice, knowledge, env_params, policy=policy, decision=decision)
            return (next_agent, running & ~result.ended), recorded

        step_keys = jax.random.split(jax.random.key(2), NUM_STEPS)
        return jax.lax.scan(step, (agent, jnp.ones(NUM_EPISODES, bool)), step_keys)[1]

    return jax.jit(record)(jax.tree.map(lambda leaf: leaf[0], policies.params))


def project(policy: Policy, pathways: Pathways, action: jax.Array) -> jax.Array:
    """Return the input of the recurrent core before its activation, float32 [E, H]."""
    return policy.direct_input(pathways) + policy.mediated_input(pathways, action)


def format_table(rows: list[dict[str, Any]]) -> str:
    """Return the rows in Markdown."""
    names = [name for name in rows[0] if name not in ("method", "weights", "low", "high")]
    lines = [f"| method | weights | {' | '.join(names)} |", "| --- | --- |" + " ---: |" * len(names)]
    for row in rows:
        cells = [f"{row[name]:.3g}" for name in names]
        cells[0] += f" ({row['low']:.3g} to {row['high']:.3g})"
        lines.append(f"| {row['method']} | {row['weights']} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--total-steps", type=int, default=600_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary_folder:
        main(options.folder or Path(temporary_folder), options.methods, options.total_steps)
