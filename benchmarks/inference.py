"""Microseconds per decision with and without sTDE.

In `python benchmarks/inference.py`, *factual* is one jitted call per step of all episodes: gather the row, unpack it,
the three pathways, one decision, the best action. *sTDE* adds the update of the layout's belief with its gap, the
weights for the goal, the counterfactual decision and equation 2. Neither includes the environment's step: the poses of
a random walk are given. Every call is timed from Python until its actions are ready. Both are timed in turns at each
number of episodes. At few episodes XLA makes the two decisions in parallel on two cores, so processor time is given
beside wall time.

At one episode the sTDE step is also timed in turns with a transcription of the released flow to PyTorch
(`_released_flow.py`), over the same walk, once in the released sizes and once in jaxnav's layers and sizes; each with
one thread and with PyTorch's default, of which the faster counts. PyTorch runs in an environment of its own:

    python -m venv .cache/peers/torch && .cache/peers/torch/bin/pip install torch numpy
"""

import dataclasses
import functools
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _common import PEERS_DIR, WorkerProcess, print_report, ratio_by_turn, summarize, time_in_turns
from _setup import set_up_training

from jaxnav.causal import do, stde
from jaxnav.env.objectnav import EnvParams, ObjectNav, State
from jaxnav.layout import ESTIMATORS, LayoutEstimator, LayoutState
from jaxnav.policies.agent_loop import Agent, AgentLoop, policy_memory
from jaxnav.policies.features import unpack_features
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods import find_method
from jaxnav.policies.network import Params, init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.config import RunConfig
from jaxnav.scenes.task import DONE
from jaxnav.training.calibration import layout_priors

TURNS = 9
EPSILON = 0.5
#: Steps of a walk, by the number of episodes.
WALK_STEPS = {1: 64, 64: 64, 4096: 16}
#: Walks in a timed call, by the number of episodes.
WALKS_PER_CALL = {1: 8, 64: 4, 4096: 1}
#: Walks in a timed call, by the network of the transcription.
RELEASED_WALKS_PER_CALL = {"released": 1, "equal": 8}
SPEC = PolicySpec(find_method("org"))
SIZES = dataclasses.asdict(SPEC.sizes) | dict(SPEC.method.experience.sizes)
WORKER = Path(__file__).with_name("_released_flow.py")
PYTHON = PEERS_DIR / "torch" / "bin" / "python"


class FixedInputs(NamedTuple):
    """Everything that does not change during an episode."""

    weights: Params
    params: EnvParams
    knowledge: Knowledge


def main() -> None:
    setup = set_up_training(RunConfig())
    env = setup.compiled_world.env
    inputs = FixedInputs(init_params(SPEC, jax.random.key(1)), setup.params, setup.knowledge)
    print_report(
        {
            "excluded_from_all": "the environment's step",
            "steps": WALK_STEPS,
            "turns": TURNS,
            "episodes": {num_episodes: compare_with_factual(env, inputs, num_episodes) for num_episodes in WALK_STEPS},
            "against_released_flow": compare_with_released(env, inputs, setup.exploration.counts),
        }
    )


# Decisions along a walk


def decide(agent_loop: AgentLoop, inputs: FixedInputs, agent: Agent, state: State) -> tuple[Agent, jax.Array]:
    """Decide in E episodes, then perceive the next views.

    Args:
      agent_loop: without a layout estimator the decision is the factual one.
      inputs: weights, environment and knowledge.
      agent: before the decision.
      state: the next state of the walk.

    Returns:
      The agent in the next state, and the actions int32 [E].
    """
    # The factual decision, from which sTDE subtracts the counterfactual one.
    policy = agent_loop.bind(inputs.weights)
    memory = policy_memory(agent)
    pathways = policy.pathways(agent_loop.policy_inputs(agent, inputs.knowledge, inputs.params), memory)
    factual = policy.decide(pathways, memory)
    logits = factual.logits
    if agent.perception.layout is not None:
        counterfactual = policy.decide(do(pathways, scene=0.0, goal=0.0), memory)
        logits = stde(logits, counterfactual.logits, agent_loop.layout_gap(agent), EPSILON)
    action = jnp.argmax(logits, axis=-1).astype(jnp.int32)

    # The next state is given: perceive it.
    moved = agent_loop.env.cell_of_pose(state.pose) != agent_loop.env.cell_of_pose(agent.state.pose)
    agent = agent._replace(state=state, memory=factual.next_state(action))
    return agent_loop.perceive(agent, action, moved, inputs.knowledge, inputs.params), action


def start_walk(agent_loop: AgentLoop, inputs: FixedInputs, state: State) -> Agent:
    """Return the agent at the start of a walk, after its first view."""
    memory = agent_loop.bind(inputs.weights).initial_memory(state.pose.shape)
    return agent_loop.start_from(state, memory, inputs.knowledge, inputs.params)


def make_walk(env: ObjectNav, params: EnvParams, num_episodes: int) -> list[State]:
    """Return the states along random walks without Done, leaves [E]."""
    num_steps = WALK_STEPS[num_episodes]
    action_key, reset_key = jax.random.split(jax.random.key(0))
    _, start = jax.vmap(env.reset, (0, None))(jax.random.split(reset_key, num_episodes), params)
    actions = jax.random.randint(action_key, (num_steps, num_episodes), 0, DONE)

    @jax.jit
    def walk(state: State, params: EnvParams) -> State:
        def step(state: State, action: jax.Array) -> tuple[State, State]:
            next_state = jax.vmap(env.advance, (0, 0, None))(state, action, params)[0]
            return next_state, next_state

        return jax.lax.scan(step, state, actions)[1]

    # Divide the leaves [T, E] by step.
    leaves, treedef = jax.tree.flatten(walk(start, params))
    host_leaves = [np.asarray(leaf) for leaf in leaves]
    states = [start]
    for t in range(num_steps):
        states.append(treedef.unflatten([jnp.asarray(leaf[t]) for leaf in host_leaves]))
    return states


def make_walk_call(
    agent_loop: AgentLoop, inputs: FixedInputs, states: list[State], num_walks: int
) -> Callable[[], None]:
    """Return a call that decides along walks, action by action."""
    jitted_start = jax.jit(functools.partial(start_walk, agent_loop))
    jitted_decide = jax.jit(functools.partial(decide, agent_loop), donate_argnums=1)

    def act() -> None:
        for _ in range(num_walks):
            agent = jitted_start(inputs, states[0])
            for state in states[1:]:
                agent, action = jitted_decide(inputs, agent, state)
                np.asarray(action)  # waits for the action

    return act


def microseconds_per_decision(call_times: list[float], num_episodes: int, num_walks: int) -> list[float]:
    num_decisions = WALK_STEPS[num_episodes] * num_walks * num_episodes
    return [1e6 * call_time / num_decisions for call_time in call_times]


# sTDE against the factual decision


def compare_with_factual(env: ObjectNav, inputs: FixedInputs, num_episodes: int) -> dict[str, Any]:
    """Compare decisions of sTDE with factual ones."""
    states = make_walk(env, inputs.params, num_episodes)
    num_walks = WALKS_PER_CALL[num_episodes]
    calls = {
        "factual": make_walk_call(AgentLoop(env, SPEC), inputs, states, num_walks),
        "stde": make_walk_call(AgentLoop(env, SPEC, ESTIMATORS["calibrated"]), inputs, states, num_walks),
    }

    # Wall time in turns, then processor time one after the other.
    wall_us = {}
    for name, call_times in time_in_turns(calls, TURNS).items():
        wall_us[name] = microseconds_per_decision(call_times, num_episodes, num_walks)
    cpu_us = {}
    for name, call in calls.items():
        cpu_times = [measure_cpu_time(call) for _ in range(TURNS)]
        cpu_us[name] = microseconds_per_decision(cpu_times, num_episodes, num_walks)
    return {
        **{f"{name}_us_per_decision": summarize(values) for name, values in wall_us.items()},
        **{f"{name}_cpu_us_per_decision": summarize(values) for name, values in cpu_us.items()},
        "stde_over_factual": ratio_by_turn(wall_us["stde"], wall_us["factual"]),
    }


def measure_cpu_time(call: Callable[[], None]) -> float:
    """Return the processor seconds of one call, over all cores."""
    start_time = time.process_time()
    call()
    return time.process_time() - start_time


# sTDE against the released flow


def compare_with_released(env: ObjectNav, inputs: FixedInputs, counts: jax.Array) -> dict[str, Any]:
    """Compare sTDE at one episode with the transcription."""
    if not PYTHON.exists():
        return {"not_installed": str(PYTHON)}

    # Features of every state in which a decision is made, so in all but the last.
    states = make_walk(env, inputs.params, num_episodes=1)
    decision_states = states[:-1]
    rows = jnp.stack([inputs.params.tables.rows[state.pose[0]] for state in decision_states])
    goals = jnp.concatenate([state.goal for state in decision_states])
    features = unpack_features(rows, goals, env.row_format)
    prior = layout_priors(counts, "released")[inputs.params.room[states[0].scene[0]]]

    # The transcription runs in a process of its own, on the same walk.
    with tempfile.TemporaryDirectory() as folder:
        arrays_path = Path(folder, "walk.npz")
        np.savez(arrays_path, table=np.asarray(features.table), view=np.asarray(features.view), prior=np.asarray(prior))
        worker = WorkerProcess([PYTHON, WORKER, arrays_path, json.dumps(SIZES)])
    description = worker.description

    def run_network(network: str, num_threads: int) -> list[float]:
        """Return the gaps of the walk."""
        return worker.request(f"{network} {num_threads} {RELEASED_WALKS_PER_CALL[network]}")

    gaps = np.array(run_network("equal", 1))
    largest_difference = np.abs(gaps - compute_released_gaps(prior, features.visible)).max()

    # Both networks with one thread and with PyTorch's default.
    agent_loop = AgentLoop(env, SPEC, ESTIMATORS["calibrated"])
    calls: dict[str, Callable[[], Any]] = {"jaxnav": make_walk_call(agent_loop, inputs, states, WALKS_PER_CALL[1])}
    for network in RELEASED_WALKS_PER_CALL:
        for num_threads in sorted({1, description["threads"]}):
            calls[f"{network}_{num_threads}_threads"] = functools.partial(run_network, network, num_threads)
    times = time_in_turns(calls, TURNS)
    worker.close()

    decision_us = {}
    for name, call_times in times.items():
        num_walks = RELEASED_WALKS_PER_CALL.get(name.split("_")[0], WALKS_PER_CALL[1])
        decision_us[name] = microseconds_per_decision(call_times, 1, num_walks)

    # Of each network the faster number of threads counts.
    fastest = {}
    for network in RELEASED_WALKS_PER_CALL:
        variants = [times_us for name, times_us in decision_us.items() if name.startswith(network)]
        fastest[network] = min(variants, key=np.median)

    num_parameters = sum(leaf.size for leaf in jax.tree.leaves(inputs.weights))
    return {
        "torch": description["torch"],
        "parameters": description["parameters"] | {"jaxnav": num_parameters},
        "us_per_decision": {name: summarize(values) for name, values in decision_us.items()},
        "released_sizes_over_jaxnav": ratio_by_turn(fastest["released"], decision_us["jaxnav"]),
        "equal_sizes_over_jaxnav": ratio_by_turn(fastest["equal"], decision_us["jaxnav"]),
        "largest_difference_of_released_gap": float(largest_difference),
        "equal": "walk, categories, work per step: belief, gap, two decisions, eq. 2, best action, read back to Python",
        "equal_sizes": "also layers and sizes; features are given to the transcription, jaxnav unpacks them from bytes",
        "not_equal": "estimator settings (released there, calibrated here); released_sizes: network and features",
    }


def compute_released_gaps(prior: jax.Array, visible: jax.Array) -> jax.Array:
    """Return the gaps that the transcription should have."""
    estimator = LayoutEstimator(prior, "released")

    def step(layout: LayoutState, visible: jax.Array) -> tuple[LayoutState, jax.Array]:
        layout = estimator.update(layout, visible)
        return layout, layout.gap

    return jax.lax.scan(step, estimator.init(), visible)[1]


if __name__ == "__main__":
    main()
