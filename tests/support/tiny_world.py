"""A world of two drawn rooms and policies of a few thousand parameters, which compile in seconds.

Import it as `from support import tiny_world as tiny`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.causal import do
from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import NUM_PRIORS, Observation
from jaxnav.layout import ESTIMATORS, LayoutEstimator, prior_from_counts
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods import find_method
from jaxnav.policies.network import bind, init_params
from jaxnav.policies.pathways import PolicyInputs
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.runs.policies import Policies
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import FileScenes
from support.scenes import CATEGORIES, SMALL, draw

#: Layer sizes of the policies.
SIZES = Sizes(hidden=32, view_outputs=8, appearance=4, row_hidden=8, row_outputs=4)
SPEC = PolicySpec(find_method("org"), len(CATEGORIES), SIZES, method_sizes=(("relation_layers", 2),), goal_row=False)
STREAMS = dataclasses.replace(SPEC, decision="streams", direct="goal")
ESTIMATOR = ESTIMATORS["calibrated"]
#: Step limits of the kitchen, scene 0, and of the bedroom, scene 1.
STEP_LIMITS = (6, 8)

_ITEMS = (("Book", 0.25, 0.8, 1.75, *SMALL), ("Chair", 1.5, 0.5, 1.5, 0.5, 0.9, 0.5), ("Book", 1.5, 0.8, 0.0, *SMALL))
KITCHEN = draw(["....##", "....##", "....##", "....##", "######"], *_ITEMS)
BEDROOM = dataclasses.replace(
    draw(["..", "..", ".."], ("Fridge", 0.25, 0.9, 2.0, 0.7, 1.8, 0.7), ("Chair", -0.5, 0.5, 0.5, 0.5, 0.9, 0.5)),
    name="other",
    room_type="bedroom",
)
BANK = compile_bank([KITCHEN, BEDROOM], Task(CATEGORIES))
POSES_PER_CELL = BANK.task.rules.poses_per_cell


def world():
    """The environment and its parameters."""
    return build_environment(BANK, {"kitchen": STEP_LIMITS[0], "bedroom": STEP_LIMITS[1]}, 0)


def compiled_world(bank=BANK):
    """The kitchen and the bedroom as a compiled world; `bank` may have changed rows for these scenes."""
    env, _ = world()
    return CompiledWorld(
        scenes=FileScenes((KITCHEN, BEDROOM), "tiny"),
        env=env,
        banks=(bank,),
        step_limits={"kitchen": STEP_LIMITS[0], "bedroom": STEP_LIMITS[1]},
        step_limit=0,
        num_cells=len(bank.ahead),
        num_scenes=2,
        fingerprint="tiny",
    )


def knowledge():
    """A random layout prior of each room type, [NUM_PRIORS, K, K]."""
    num_categories = len(CATEGORIES)
    counts = np.random.default_rng(0).integers(0, 9, (NUM_PRIORS, num_categories, num_categories))
    priors = jax.vmap(lambda room_counts: prior_from_counts(room_counts, ESTIMATOR))(jnp.asarray(counts))
    return Knowledge(priors)


def make_untrained_policies(spec=SPEC, learned_knowledge=None, task=BANK.task):
    """Policies without parameters, enough for callers that need only the method and its knowledge."""
    if learned_knowledge is None:
        learned_knowledge = knowledge()
    prior_counts = jnp.zeros_like(learned_knowledge.priors)
    return Policies({}, (), learned_knowledge, prior_counts, spec, None, 0, task)


def first_reading(method, count):
    """The reading of a method's tracker before the first view, [count, ...]; None without a tracker."""
    if method.tracker is None:
        return None
    statistics = {}
    if method.learn is not None:
        statistics = method.learn([BANK], np.ones((NUM_PRIORS, len(CATEGORIES), len(CATEGORIES))))
    method_knowledge = knowledge()._replace(method=jax.tree.map(jnp.asarray, statistics))
    reading = method.tracker.read(method.tracker.init(method_knowledge), method_knowledge, jnp.int32(0))
    return jax.tree.map(lambda leaf: jnp.repeat(leaf[None], count, axis=0), reading)


_init_params = jax.jit(init_params, static_argnums=0)


def random_params(seed, spec=SPEC):
    """Random parameters whose actions depend on the view; those of an untrained policy are close to indifferent."""
    params = _amplify(_init_params(spec, jax.random.key(seed)), seed + 1000)
    if spec.decision == "streams":
        params["experience_stream"] = _amplify(params["experience_stream"], seed + 2000)
    return params


def _amplify(params, seed):
    """Replace the kernel of the actor by a random one, and triple the weights before it."""
    kernel = jax.random.normal(jax.random.key(seed), params["actor"]["kernel"].shape)
    actor = params["actor"] | {"kernel": kernel, "bias": jnp.zeros(kernel.shape[-1])}
    larger_weights = {}
    for name in ("fuse", "method"):
        if name in params:
            larger_weights[name] = jax.tree.map(lambda leaf: 3 * leaf, params[name])
    return params | larger_weights | {"actor": actor}


@jax.jit
def decide(weights, row, goal, layout_weights, memory):
    """The decision of `SPEC` on a row [R] with layout weights [K], and its counterfactual without direct pathways."""
    policy = bind(SPEC, weights)
    pathways = policy.pathways(PolicyInputs(Observation(row=row, goal=goal), layout_weights))
    counterfactual_pathways = do(pathways, scene=0.0, goal=0.0)
    return policy.decide(pathways, memory), policy.decide(counterfactual_pathways, memory)


@jax.jit
def believe(prior, layout, row):
    """The belief after the detections of a row [R]; `layout` is None at the start of an episode."""
    estimator = LayoutEstimator(prior, ESTIMATOR)
    last_belief = estimator.init() if layout is None else layout
    return estimator.update(last_belief, RowFormat(len(CATEGORIES)).presence(row))


goal_weights = jax.jit(LayoutEstimator.goal_weights)


def leaves_at(tree, *index):
    """A tree of the leaves at an index, such as the episode of a batch."""
    return jax.tree.map(lambda leaf: leaf[index], tree)
