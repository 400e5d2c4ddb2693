"""One environment in a process of its own, for `peers.py`.

It is run once for every line on stdin. It runs in the virtual environment of the package it measures, so it stands
alone and imports that package only. The first line on stdout describes what was compiled; every further one is the wall
seconds of one call. A call is `lax.scan` over steps of all episodes with auto-reset, from where the last call ended.
Actions are drawn beforehand. What a step delivers (every element of every observation, rewards, endings) is `consumed`,
added to arrays in the carry, or `stored` as a rollout does: a call is then rollout after rollout of `ROLLOUT` steps,
and each returns what its steps have delivered. Episodes are divided over the devices that XLA shows.
"""

import importlib
import importlib.metadata
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
    """Hold the functions of one episode.

    `reset(key, params) -> state` and `step(key, state, action, params) -> delivered, state`.
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
        state, after = env.step(state, action)
        return (after.observation, after.reward, after.last()), state

    return Environment(lambda key, _: env.reset(key)[0], step, env.action_spec.num_values)


def jaxmarl(name: str) -> Environment:
    env = importlib.import_module("jaxmarl").make(name, act_type="Discrete")
    per_agent = env.action_space(env.agents[0]).n

    def step(key, state, action, _):
        # One number stands for the actions of all agents: a digit each.
        actions = {agent: action // per_agent**i % per_agent for i, agent in enumerate(env.agents)}
        observations, state, rewards, dones, _ = env.step(key, state, actions)
        return (observations, rewards, dones["__all__"]), state

    return Environment(lambda key, _: env.reset(key)[1], step, per_agent**env.num_agents)


PACKAGES = {package.__name__: package for package in (jaxnav, gymnax, xminigrid, navix, jumanji, jaxmarl)}


def compiled(env: Environment, episodes: int, steps: int, stored: bool) -> tuple[Callable[[], None], dict[str, Any]]:
    """Return a call of these steps, and what was compiled."""
    length = min(steps, ROLLOUT) if stored else steps
    mesh = jax.make_mesh((jax.device_count(),), ("episodes",), axis_types=(jax.sharding.AxisType.Auto,))
    everywhere, divided, per_step = PartitionSpec(), PartitionSpec("episodes"), PartitionSpec(None, "episodes")
    key = jax.random.key(0)
    params = jax.device_put(env.params, NamedSharding(mesh, everywhere))
    actions = jax.random.randint(key, (length, episodes), 0, env.num_actions, jnp.int32)
    actions = jax.device_put(actions, NamedSharding(mesh, per_step))
    states = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(key, episodes), env.params)
    one = jax.eval_shape(env.step, key, jax.tree.map(lambda leaf: leaf[0], states), actions[0, 0], env.params)[0]
    totals = jax.tree.map(lambda leaf: jnp.zeros((episodes, *leaf.shape), leaf.dtype), one)
    carry = jax.device_put((states, totals), NamedSharding(mesh, divided))

    def run(key, carry, actions, params):
        key = jax.random.fold_in(key, jax.lax.axis_index("episodes"))

        def step(carry, inputs):
            states, totals = carry
            now, action = inputs
            keys = jax.random.split(jax.random.fold_in(key, now), len(action))
            delivered, states = jax.vmap(env.step, (0, 0, 0, None))(keys, states, action, params)
            if stored:
                return (states, totals), delivered
            return (states, jax.tree.map(jnp.add, totals, delivered)), None

        return jax.lax.scan(step, carry, (jnp.arange(len(actions)), actions))

    specs, results = (everywhere, divided, per_step, everywhere), (divided, per_step)
    began = time.perf_counter()
    program = jax.jit(jax.shard_map(run, mesh=mesh, in_specs=specs, out_specs=results, check_vma=False))
    program = program.lower(key, carry, actions, params).compile()
    taken = time.perf_counter() - began

    def call() -> None:
        nonlocal carry
        for _ in range(steps // length):
            carry, _ = jax.block_until_ready(program(key, carry, actions, params))

    leaves = jax.tree.leaves(one[0])
    described = {
        "steps_per_call": steps // length * length,
        "compile_s": round(taken, 2),
        "observation_elements": sum(leaf.size for leaf in leaves),
        "observation_bytes": sum(leaf.size * leaf.dtype.itemsize for leaf in leaves),
        "devices": jax.device_count(),
    }
    return call, described


def main() -> None:
    package, name, episodes, steps, what = sys.argv[1:]
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # packages print, even while they compile
    call, described = compiled(PACKAGES[package](name), int(episodes), int(steps), what == "stored")
    print(json.dumps(described), file=answers, flush=True)
    for _ in sys.stdin:
        began = time.perf_counter()
        call()
        print(time.perf_counter() - began, file=answers, flush=True)


if __name__ == "__main__":
    main()
