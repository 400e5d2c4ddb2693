"""Microseconds per decision with and without sTDE.

In `python benchmarks/inference.py`, *factual* is one jitted call per step of all episodes: gather the row, unpack it,
the three pathways, one decision, the best action. *sTDE* adds the update of the layout's belief with its gap, the
weights for the goal, the counterfactual decision and equation 2. The environment's step is in neither: the poses of a
random walk are given. Every call is timed from Python with its actions waited for. Both are timed in turns at each
number of episodes. At few episodes XLA makes the two decisions side by side on two cores, so the processor's time is
given beside the wall's.

At one episode the sTDE step is also timed in turns with a transcription of the released flow to PyTorch
(`_released_flow.py`), over the same walk, once in the released sizes and once in jaxnav's layers and sizes; each with
one thread and with PyTorch's default, of which the faster counts. It runs in an environment of its own:

    python -m venv .cache/peers/torch && .cache/peers/torch/bin/pip install torch numpy
"""

import contextlib
import dataclasses
import functools
import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _common import in_turns, ratios, report, spread
from _setup import set_up

from jaxnav.causal import do, stde
from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams, State
from jaxnav.layout import SETTINGS, LayoutEstimator, LayoutState
from jaxnav.policies.acting import Acting, Agent, carried
from jaxnav.policies.features import features
from jaxnav.policies.methods import Knowledge, find_method
from jaxnav.policies.policy import Params, init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.config import RunConfig
from jaxnav.scenes.task import DONE
from jaxnav.training.calibration import layout_priors

TURNS, EPSILON = 9, 0.5
GOALS = {"stde_over_factual_at_4096": 1.6, "released_sizes_over_jaxnav": 20.0}
STEPS = {1: 64, 64: 64, 4096: 16}  # of a walk, by the number of episodes
WALKS = {1: 8, 64: 4, 4096: 1}  # in a timed call
RELEASED_WALKS = {"released": 1, "equal": 8}
SPEC = PolicySpec()
SIZES = dataclasses.asdict(SPEC.sizes) | dict(find_method(SPEC.method).experience.sizes)
WORKER = Path(__file__).with_name("_released_flow.py")
PYTHON = Path(__file__).parents[1] / ".cache/peers/torch/bin/python"


class World(NamedTuple):
    """Hold what does not change during an episode."""

    weights: Params
    params: EnvParams
    knowledge: Knowledge


def decide(acting: Acting, world: World, agent: Agent, state: State) -> tuple[Agent, jax.Array]:
    """Decide in E episodes, then take in the next views.

    `state` is where the walk goes on to. Without a layout estimator the decision is the factual one. Returns the agent
    in that state and the actions int32 [E].
    """
    policy, memory = acting.bind(world.weights), carried(agent)
    pathways = policy.pathways(*acting.view(agent, world.knowledge, world.params), memory)
    factual = policy.decide(pathways, memory)
    logits = factual.logits
    if agent.perceived.layout is not None:
        counterfactual = policy.decide(do(pathways, scene=0.0, goal=0.0), memory)
        logits = stde(logits, counterfactual.logits, acting.gap(agent), EPSILON)
    action = jnp.argmax(logits, axis=-1).astype(jnp.int32)
    moved = acting.env.cell(state.pose) != acting.env.cell(agent.state.pose)
    agent = agent._replace(state=state, memory=factual.memory(action))
    return acting.perceive(agent, action, moved, world.knowledge, world.params), action


def start(acting: Acting, world: World, state: State) -> Agent:
    """Begin a walk, the first view taken in."""
    memory = acting.bind(world.weights).initial_memory(state.pose.shape)
    return acting.begin(state, memory, world.knowledge, world.params)


def walked(env: ObjectNav, params: EnvParams, episodes: int) -> list[State]:
    """Return states along random walks without Done, leaves [E]."""
    key, first = jax.random.split(jax.random.key(0))
    _, state = jax.vmap(env.reset, (0, None))(jax.random.split(first, episodes), params)
    actions = jax.random.randint(key, (STEPS[episodes], episodes), 0, DONE)

    @jax.jit
    def walk(state: State, params: EnvParams) -> State:
        def step(state: State, action: jax.Array) -> tuple[State, State]:
            after = jax.vmap(env.advance, (0, 0, None))(state, action, params)[0]
            return after, after

        return jax.lax.scan(step, state, actions)[1]

    later = jax.tree.map(np.asarray, walk(state, params))
    return [state, *(jax.tree.map(lambda leaf, t=t: jnp.asarray(leaf[t]), later) for t in range(STEPS[episodes]))]


def acts(acting: Acting, world: World, states: list[State], walks: int) -> Callable[[], None]:
    """Return a call that decides along walks, action by action."""
    begin = jax.jit(functools.partial(start, acting))
    step = jax.jit(functools.partial(decide, acting), donate_argnums=1)

    def act() -> None:
        for _ in range(walks):
            agent = begin(world, states[0])
            for state in states[1:]:
                agent, action = step(world, agent, state)
                np.asarray(action)

    return act


def per_decision(taken: list[float], episodes: int, walks: int) -> list[float]:
    """Return microseconds."""
    return [1e6 * one / (STEPS[episodes] * walks * episodes) for one in taken]


def cpu_seconds(call: Callable[[], None]) -> float:
    """Return the processor time of one call, over all cores."""
    began = time.process_time()
    call()
    return time.process_time() - began


def alone(env: ObjectNav, world: World, episodes: int) -> dict[str, Any]:
    """Compare factual decisions with sTDE."""
    states, walks = walked(env, world.params, episodes), WALKS[episodes]
    ways = {"factual": Acting(env, SPEC), "stde": Acting(env, SPEC, SETTINGS["calibrated"])}
    calls = {name: acts(way, world, states, walks) for name, way in ways.items()}
    wall = {name: per_decision(taken, episodes, walks) for name, taken in in_turns(calls, TURNS).items()}
    busy = {
        name: per_decision([cpu_seconds(call) for _ in range(TURNS)], episodes, walks) for name, call in calls.items()
    }
    return {
        **{f"{name}_us_per_decision": spread(values) for name, values in wall.items()},
        **{f"{name}_cpu_us_per_decision": spread(values) for name, values in busy.items()},
        "stde_over_factual": ratios(wall["stde"], wall["factual"]),
    }


@contextlib.contextmanager
def worker(arrays: dict[str, Any]) -> Iterator[tuple[dict[str, Any], Callable[[str, int], list[float]]]]:
    """Run the transcription in a process of its own.

    Yields what it is, and a call `(network, threads) -> gaps of the walk`.
    """
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder, "walk.npz")
        np.savez(inputs, **arrays)
        command = [PYTHON, WORKER, inputs, json.dumps(SIZES)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            requests, answers = process.stdin, process.stdout
            assert requests is not None
            assert answers is not None

            def ask(network: str, threads: int) -> list[float]:
                print(network, threads, RELEASED_WALKS[network], file=requests, flush=True)
                return json.loads(answers.readline())

            yield json.loads(answers.readline()), ask
            requests.close()  # ends it


def against_released(env: ObjectNav, world: World, counts: jax.Array) -> dict[str, Any]:
    """Compare sTDE at one episode with the transcription."""
    if not PYTHON.exists():
        return {"not_installed": str(PYTHON)}
    states = walked(env, world.params, 1)
    seen_at = states[:-1]  # a decision at each
    rows = jnp.stack([world.params.tables.rows[state.pose[0]] for state in seen_at])
    seen = features(rows, jnp.concatenate([state.goal for state in seen_at]), env.row_format)
    prior = layout_priors(counts, "released")[world.params.room[states[0].scene[0]]]
    arrays = {"table": seen.table, "view": seen.view, "prior": prior}
    with worker({name: np.asarray(array) for name, array in arrays.items()}) as (about, ask):
        calls: dict[str, Callable[[], Any]] = {
            f"{network}_{threads}_threads": functools.partial(ask, network, threads)
            for network in RELEASED_WALKS
            for threads in sorted({1, about["threads"]})
        }
        difference = np.abs(np.array(ask("equal", 1)) - gaps(prior, seen.visible)).max()
        ours = acts(Acting(env, SPEC, SETTINGS["calibrated"]), world, states, WALKS[1])
        taken = in_turns({"jaxnav": ours} | calls, TURNS)
    walks = {name: RELEASED_WALKS.get(name.split("_")[0], WALKS[1]) for name in taken}
    per_call = {name: per_decision(one, 1, walks[name]) for name, one in taken.items()}
    best = {
        network: min((name for name in calls if name.startswith(network)), key=lambda name: np.median(per_call[name]))
        for network in RELEASED_WALKS
    }
    return {
        "torch": about["torch"],
        "parameters": about["parameters"] | {"jaxnav": sum(leaf.size for leaf in jax.tree.leaves(world.weights))},
        "us_per_decision": {name: spread(values) for name, values in per_call.items()},
        "released_sizes_over_jaxnav": ratios(per_call[best["released"]], per_call["jaxnav"]),
        "equal_sizes_over_jaxnav": ratios(per_call[best["equal"]], per_call["jaxnav"]),
        "largest_difference_of_released_gap": float(difference),
        "equal": "walk, categories, work per step: belief, gap, two decisions, eq. 2, best action, read back to Python",
        "equal_sizes": "also layers and sizes; features are given to the transcription, jaxnav unpacks them from bytes",
        "not_equal": "estimator settings (released there, calibrated here); released_sizes: network and features",
    }


def gaps(prior: jax.Array, visible: jax.Array) -> jax.Array:
    """Return the gaps that the transcription should have."""
    estimator = LayoutEstimator(prior, "released")

    def step(layout: LayoutState, seen: jax.Array) -> tuple[LayoutState, jax.Array]:
        layout = estimator.update(layout, seen)
        return layout, layout.gap

    return jax.lax.scan(step, estimator.init(), visible)[1]


def main() -> None:
    setup = set_up(RunConfig())
    env, world = setup.world.env, World(init_params(SPEC, jax.random.key(1)), setup.params, setup.knowledge)
    report(
        {
            "excluded_from_all": "the environment's step",
            "steps": STEPS,
            "turns": TURNS,
            "goals": GOALS,
            "episodes": {episodes: alone(env, world, episodes) for episodes in WALKS},
            "against_released_flow": against_released(env, world, setup.explored.counts),
        }
    )


if __name__ == "__main__":
    main()
