"""One environment in a process of its own, for `peers.py`.

The process makes one call for every line on stdin. It runs in the virtual environment of the measured package, so it
imports that package only. The first line on stdout describes the compiled program; each further line says that a call
has ended. A call is a `lax.scan` over steps of all episodes with auto-reset, and continues where the previous
call ended. Actions are drawn in advance. The outputs of a step (every element of every observation, rewards, endings)
are either `consumed`, added to arrays in the carry, or `stored` as in a rollout: a call then makes rollouts of
`ROLLOUT` steps, and each returns the outputs of its steps. Episodes are divided over the devices of XLA.
"""

import importlib
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import NamedSharding, PartitionSpec

ROLLOUT = 64  # steps


class Environment(NamedTuple):
    """Functions of one episode.

    `reset(key, params) -> state` and `step(key, state, action, params) -> outputs, state`.
    """

    reset: Callable[..., Any]
    step: Callable[..., Any]
    num_actions: int
    params: Any = ()


def jaxnav(name: str) -> Environment:
    env, params = importlib.import_module("jaxnav").make(name)

    def step(key, state, action, params):
        observation, state, reward, terminated, truncated, _ = env.step(key, state, action, params)
        return (observation, reward, terminated | truncated), state

    return Environment(lambda key, params: env.reset(key, params)[1], step, env.num_actions, params)


def gymnax(name: str) -> Environment:
    env, params = importlib.import_module("gymnax").make(name)

    def step(key, state, action, _):
        observation, state, reward, terminated, truncated, _ = env.step(key, state, action, params)
        return (observation, reward, terminated | truncated), state

    return Environment(lambda key, _: env.reset(key, params)[1], step, env.num_actions)


def xminigrid(name: str) -> Environment:
    env, params = importlib.import_module("xminigrid").make(name)
    env = importlib.import_module("xminigrid.wrappers").GymAutoResetWrapper(env)

    def step(_, state, action, __):
        state = env.step(params, state, action)
        return (state.observation, state.reward, state.last()), state

    return Environment(lambda key, _: env.reset(params, key), step, env.num_actions(params))


def navix(name: str) -> Environment:
    env = importlib.import_module("navix").make(name)

    def step(_, state, action, __):
        state = env.step(state, action)
        return (state.observation, state.reward, state.step_type > 0), state

    return Environment(lambda key, _: env.reset(key), step, len(env.action_set))


def jumanji(name: str) -> Environment:
    env = importlib.import_module("jumanji").make(name)
    env = importlib.import_module("jumanji.wrappers").AutoResetWrapper(env)

    def step(_, state, action, __):
        state, timestep = env.step(state, action)
        return (timestep.observation, timestep.reward, timestep.last()), state

    return Environment(lambda key, _: env.reset(key)[0], step, env.action_spec.num_values)


def jaxmarl(name: str) -> Environment:
    env = importlib.import_module("jaxmarl").make(name, act_type="Discrete")
    num_agent_actions = env.action_space(env.agents[0]).n

    def step(key, state, action, _):
        # One number stands for the actions of all agents: a digit each.
        actions = {}
        for index, agent in enumerate(env.agents):
            actions[agent] = action // num_agent_actions**index % num_agent_actions
        observations, state, rewards, dones, _ = env.step(key, state, actions)
        return (observations, rewards, dones["__all__"]), state

    return Environment(lambda key, _: env.reset(key)[1], step, num_agent_actions**env.num_agents)


PACKAGES = {package.__name__: package for package in (jaxnav, gymnax, xminigrid, navix, jumanji, jaxmarl)}


def compile_call(
    env: Environment, num_episodes: int, num_steps: int, store_outputs: bool
) -> tuple[Callable[[], None], dict[str, Any]]:
    """Return a call of so many steps, and a description of the compiled program."""
    scan_length = min(num_steps, ROLLOUT) if store_outputs else num_steps
    calls_per_turn = num_steps // scan_length

    # Episodes are divided over the devices; parameters are replicated.
    mesh = jax.make_mesh((jax.device_count(),), ("episodes",), axis_types=(jax.sharding.AxisType.Auto,))
    replicated = PartitionSpec()
    by_episode = PartitionSpec("episodes")
    by_step_and_episode = PartitionSpec(None, "episodes")

    # Draw the actions, reset, and start the sums of all outputs at zero.
    key = jax.random.key(0)
    params = jax.device_put(env.params, NamedSharding(mesh, replicated))
    actions = jax.random.randint(key, (scan_length, num_episodes), 0, env.num_actions, jnp.int32)
    actions = jax.device_put(actions, NamedSharding(mesh, by_step_and_episode))
    states = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(key, num_episodes), env.params)
    first_state = jax.tree.map(lambda leaf: leaf[0], states)
    output_shapes, _ = jax.eval_shape(env.step, key, first_state, actions[0, 0], env.params)
    totals = jax.tree.map(lambda leaf: jnp.zeros((num_episodes, *leaf.shape), leaf.dtype), output_shapes)
    carry = jax.device_put((states, totals), NamedSharding(mesh, by_episode))

    def run(key, carry, actions, params):
        key = jax.random.fold_in(key, jax.lax.axis_index("episodes"))

        def step(carry, inputs):
            states, totals = carry
            time_index, action = inputs
            keys = jax.random.split(jax.random.fold_in(key, time_index), len(action))
            outputs, states = jax.vmap(env.step, (0, 0, 0, None))(keys, states, action, params)
            if store_outputs:
                return (states, totals), outputs
            return (states, jax.tree.map(jnp.add, totals, outputs)), None

        return jax.lax.scan(step, carry, (jnp.arange(len(actions)), actions))

    start_time = time.perf_counter()
    sharded_run = jax.shard_map(
        run,
        mesh=mesh,
        in_specs=(replicated, by_episode, by_step_and_episode, replicated),
        out_specs=(by_episode, by_step_and_episode),
        check_vma=False,
    )
    program = jax.jit(sharded_run).lower(key, carry, actions, params).compile()
    compile_s = time.perf_counter() - start_time

    def call() -> None:
        nonlocal carry
        for _ in range(calls_per_turn):
            carry, _ = jax.block_until_ready(program(key, carry, actions, params))

    observation_leaves = jax.tree.leaves(output_shapes[0])
    description = {
        "steps_per_call": calls_per_turn * scan_length,
        "compile_s": round(compile_s, 2),
        "observation_elements": sum(leaf.size for leaf in observation_leaves),
        "devices": jax.device_count(),
    }
    return call, description


def main() -> None:
    package, name, num_episodes, num_steps, output_mode = sys.argv[1:]

    # Packages print, even while they compile: answers go to the real stdout, everything else to stderr.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    env = PACKAGES[package](name)
    call, description = compile_call(env, int(num_episodes), int(num_steps), output_mode == "stored")
    print(json.dumps(description), file=answers, flush=True)
    for _ in sys.stdin:
        call()
        print("null", file=answers, flush=True)


if __name__ == "__main__":
    main()
