"""A public check of the contract of methods, for methods of your own.

In the style of `jaxnav.env.testing`: run it in a test; it raises `AssertionError` with the promise that is broken.
"""

from collections.abc import Mapping
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.causal import do
from jaxnav.env.build import build
from jaxnav.env.objectnav import NUM_PRIORS, ObjectNav
from jaxnav.env.types import EnvParams
from jaxnav.layout import SETTINGS, prior_from_counts
from jaxnav.policies.acting import Acting, Agent, carried
from jaxnav.policies.methods import Knowledge, Method, Percept, find_method
from jaxnav.policies.pathways import Memory, Pathways
from jaxnav.policies.perception import View
from jaxnav.policies.policy import Params, Policy, init_params
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.worlds import WORLDS, generated

_SIZES = Sizes(hidden=16, view_outputs=8, appearance=4, row_hidden=8, row_outputs=4)
_BATCH = 6


def check_method(
    name: str,
    method_sizes: Mapping[str, int] | None = None,
    steps: int = 8,
    seed: int = 0,
    bank: Bank | None = None,
) -> None:
    """Check that a method keeps the promises of the seam.

    It acts in a few scenes and checks: shapes and dtypes of pathways and decisions, all of them finite; a batch
    equals its single members; `do` leaves the experience as it is; logits are deaf to the view and to the goal's
    detection when both direct pathways are zero and the experience is given; the tracker takes in every step once, its
    first view included, and its notes and readings keep their shapes; a choice becomes a legal action.

    Args:
      name: of the method, see `jaxnav.policies.methods.find_method`.
      method_sizes: the method's own sizes, where they are not the usual ones.
      steps: environment steps to act for.
      seed: of parameters, episodes and actions.
      bank: of the scenes; None for two generated rooms.

    Raises:
      InputError: there is no such method.
      AssertionError: a promise is broken.
    """
    method, rooms = find_method(name), WORLDS["rooms"]
    if bank is None:
        scenes = generated("rooms", "train", 2, seed)
        bank = compile_bank([scenes[0], scenes[1]], rooms.task)
    env, params = build(bank, {}, rooms.step_limit)
    spec = PolicySpec(name, len(env.categories), _SIZES, tuple(sorted((method_sizes or {}).items())))
    acting = Acting(env, spec, SETTINGS["calibrated"] if method.hosts_layout else None)
    knowledge, key = _knowledge(method, env, bank), jax.random.key(seed)
    weights = _lively(jax.jit(init_params, static_argnums=0)(spec, key), key)

    interval = getattr(method.control, "interval", 0)
    _promise(isinstance(interval, int) and interval >= 1, "a control that does not say how long a choice lasts")

    @jax.jit
    def start() -> Agent:
        memory = acting.bind(weights).initial_memory((_BATCH,))
        return acting.start(key, _BATCH, memory, knowledge, params)

    act = jax.jit(lambda agent, key: _act(acting, acting.bind(weights), agent, key, knowledge, params))
    agents, choices = [start()], []
    for time in range(steps):
        agent, choice = act(agents[-1], jax.random.fold_in(key, time))
        agents.append(agent)
        choices.append(choice)
        action = carried(agents[-1]).action
        _promise(bool(((action >= 0) & (action < env.num_actions)).all()), "a choice that becomes no action")
    _check_notes(method, agents, choices, env, knowledge, params)
    _check_decision(acting, weights, agents[-1], method.control.num_choices, knowledge, params)


def _knowledge(method: Method, env: ObjectNav, bank: Bank) -> Knowledge:
    counts = np.ones((NUM_PRIORS, len(env.categories), len(env.categories)), np.float32)
    prior = jax.vmap(prior_from_counts)(jnp.asarray(counts))
    return Knowledge(prior, {} if method.learn is None else jax.tree.map(jnp.asarray, method.learn([bank], counts)))


def _lively(params: dict[str, Any], key: jax.Array) -> dict[str, Any]:
    """Return parameters of a policy that is not indifferent."""
    kernel = jax.random.normal(key, params["actor"]["kernel"].shape)
    return params | {"actor": params["actor"] | {"kernel": kernel}}


def _act(
    acting: Acting, policy: Policy, agent: Agent, key: jax.Array, knowledge: Knowledge, params: EnvParams
) -> tuple[Agent, jax.Array]:
    """Act once, without reset, and return what was chosen too."""
    pathways = policy.pathways(*acting.view(agent, knowledge, params), carried(agent))
    decision = policy.decide(pathways, carried(agent))
    choice = jax.random.categorical(key, decision.logits)
    return acting.step(agent, choice, knowledge, params, policy=policy, decision=decision)[0], choice


def _check_notes(
    method: Method,
    agents: list[Agent],
    choices: list[jax.Array],
    env: ObjectNav,
    knowledge: Knowledge,
    params: EnvParams,
) -> None:
    """Check that notes take in every view once, and every choice."""
    tracker = method.tracker
    if tracker is None:
        return
    update = jax.jit(lambda note, percept: tracker.update(note, knowledge, percept))
    control = jax.jit(lambda choice, note: method.control.act(choice, note, knowledge)[1])
    for i in range(_BATCH):
        note = tracker.init(knowledge)
        for before, agent, choice in zip([None, *agents], agents, [None, *choices], strict=False):
            pose = agent.state.pose[i]
            note = note if choice is None else control(choice[i], note)
            cell, heading, horizon = env.task.rules.split(pose)
            moved = jnp.bool_(before is not None and env.cell(before.state.pose[i]) != cell)
            position = heading, carried(agent).action[i], moved, horizon
            percept = Percept(params.tables.rows[pose], *position, agent.state.goal[i])
            note = update(note, percept)
            kept = jax.tree.map(lambda leaf, i=i: leaf[i], agent.perceived.note)
            chex.assert_trees_all_equal_shapes_and_dtypes(kept, note)
            chex.assert_trees_all_close(kept, note, rtol=1e-5, atol=1e-6)


def _check_decision(
    acting: Acting, weights: Params, agent: Agent, num_choices: int, knowledge: Knowledge, params: EnvParams
) -> None:
    """Check pathways and decisions in the middle of episodes."""
    view, memory = acting.view(agent, knowledge, params), carried(agent)

    def embed_view(view: View, memory: Memory) -> Pathways:
        return acting.bind(weights).pathways(*view, memory)

    embed = jax.jit(embed_view)
    decide = jax.jit(lambda pathways, memory: acting.bind(weights).decide(pathways, memory))
    pathways = embed(view, memory)
    decision = decide(pathways, memory)
    chex.assert_shape(pathways.experience, (_BATCH, acting.bind(weights).method.width))
    chex.assert_shape([decision.logits, decision.value], [(_BATCH, num_choices), (_BATCH,)])
    chex.assert_type([pathways.experience, decision.logits, decision.value], jnp.float32)
    chex.assert_trees_all_equal_shapes_and_dtypes(decision.memory(memory.action), memory)
    chex.assert_tree_all_finite((pathways, decision))
    for i in range(_BATCH):
        one: tuple[View, Memory] = jax.tree.map(lambda leaf, i=i: leaf[i], (view, memory))
        alone = decide(embed(one[0], one[1]), one[1])
        expected = jax.tree.map(lambda leaf, i=i: leaf[i], decision)
        chex.assert_trees_all_close(alone, expected, rtol=1e-4, atol=1e-5)

    counterfactual = do(pathways, scene=0.0, goal=0.0)
    chex.assert_trees_all_equal(counterfactual.experience, pathways.experience)
    elsewhere = jax.tree.map(lambda leaf: jnp.roll(leaf, 1, axis=0), pathways)
    mixed = elsewhere._replace(experience=pathways.experience, gate=pathways.gate)
    deaf = decide(do(mixed, scene=0.0, goal=0.0), memory).logits
    chex.assert_trees_all_equal(deaf, decide(counterfactual, memory).logits)


def _promise(kept: bool, broken: str) -> None:
    if not kept:
        raise AssertionError(f"the method breaks its contract: {broken}")
