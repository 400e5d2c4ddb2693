"""Episodes played by hand: `prepare_game` chooses one, `play_game` plays it with named keys from any source."""

from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxnav.env.objectnav import Observation
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.evaluation.grid import start_states
from jaxnav.game.config import PlayConfig
from jaxnav.layout import EstimatorConfig
from jaxnav.plain_console import to_plain_console
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import ActionControl, Knowledge
from jaxnav.runs.config import LayoutConfig, RunConfig, WorldConfig
from jaxnav.runs.loaded_policy import LoadedPolicy, load_policy
from jaxnav.runs.policies import config_for_policy
from jaxnav.runs.train import calibrate_estimator, explore_world
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world, compile_training_world
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT
from jaxnav.training.calibration import layout_priors

#: Actions by the names of keys; other keys do nothing.
KEY_ACTIONS = {
    "up": MOVE_AHEAD,
    "left": ROTATE_LEFT,
    "right": ROTATE_RIGHT,
    "enter": DONE,
    "w": MOVE_AHEAD,
    "a": ROTATE_LEFT,
    "d": ROTATE_RIGHT,
    "r": LOOK_UP,
    "f": LOOK_DOWN,
}
QUIT_KEY = "q"


class Game(NamedTuple):
    """Episode to be played by hand, with the agent whose belief is displayed.

    Attributes:
      compiled_world: compiled scenes; the game takes place in the first bank.
      episode: list of one episode.
      knowledge: layout priors.
      estimator_config: configuration of the layout estimator.
      policy: policy that gives advice; None for no advice.
      epsilon: threshold of sTDE in the advice.
    """

    compiled_world: CompiledWorld
    episode: EpisodeList
    knowledge: Knowledge
    estimator_config: EstimatorConfig
    policy: LoadedPolicy | None = None
    epsilon: float = 0.5

    @property
    def bank(self) -> Bank:
        """Tables of the scenes."""
        return self.compiled_world.banks[0]

    @property
    def goal(self) -> str:
        """Name of the category to search for."""
        return self.bank.task.categories[int(self.episode.goal[0])]


class GameView(NamedTuple):
    """State of a game at one step, for K categories and A actions.

    Attributes:
      pose: index of the pose in the bank, whose row holds the observation.
      time: number of actions so far.
      step_limit: largest number of actions.
      layout_weights: float32 [K], the goal's column of w (eq. 7).
      layout_gap: layout gap D.
      advice: float32 [A], the policy's probability of each action; None without a policy.
    """

    pose: int
    time: int
    step_limit: int
    layout_weights: np.ndarray
    layout_gap: float
    advice: np.ndarray | None


class GameResult(NamedTuple):
    """Result of a game that ended after T actions.

    Attributes:
      poses: int [T + 1], indices of the poses in the bank, from the start on.
      ending: `found in`, `wrong Done after`, `out of time after` or `left after`, which the number of actions follows.
    """

    poses: list[int]
    ending: Literal["found in", "wrong Done after", "out of time after", "left after"]


def prepare_game(config: PlayConfig, console: Console) -> Game:
    """Prepare a game.

    Args:
      config: settings of the game.
      console: receives messages.

    Raises:
      InputError: no such scenes, goal or policy, or a policy of another world or without actions to advise.
    """
    console = to_plain_console(console)

    # Check the policy first, since compiling scenes takes longer.
    policy = config.policy
    adviser = None
    layout_config = LayoutConfig()
    front_cell = None
    if policy is not None:
        policy_config = config_for_policy(policy)
        policy_world = policy_config.world
        layout_config = policy_config.layout
        front_cell = policy_config.worlds.front_cell
        adviser = load_policy(policy)
        method = adviser.spec.method
        if policy_world != config.world:
            raise InputError(f"--policy {policy}: was trained for {policy_world}; play with --world {policy_world}")
        if not isinstance(method.control, ActionControl):
            raise InputError(f"--policy {policy}: method {method.name!r} does not choose actions; give another policy")

    # The game takes one episode of the list that an evaluation with this seed would play.
    worlds = WorldConfig(seed=config.seed, front_cell=front_cell)
    run_config = RunConfig(world=config.world, worlds=worlds, layout=layout_config)
    compiled_world = compile_evaluation_world(
        run_config, config.split, config.scenes, config.shift, console, shift_by=config.shift_by
    )
    episode = choose_episode(compiled_world.banks[0], config.goal, config.seed)

    # Without a policy that estimates the layout, the belief starts from random walks in training scenes.
    if adviser is not None and adviser.estimator_config is not None:
        knowledge = adviser.knowledge
        estimator_config = adviser.estimator_config
    else:
        training_world = compile_training_world(run_config, console)
        exploration = explore_world(run_config, training_world)
        estimator_config = calibrate_estimator(run_config, training_world, exploration, console)
        knowledge = Knowledge(layout_priors(exploration.prior_counts, estimator_config))
    return Game(compiled_world, episode, knowledge, estimator_config, adviser, config.epsilon)


def choose_episode(bank: Bank, goal: str | None, seed: int) -> EpisodeList:
    """Draw one of the episodes of an evaluation, as a list of one.

    Raises:
      InputError: no episode has this goal, or the seed is negative.
    """
    if seed < 0:
        raise InputError(f"--seed {seed}: give a number of at least 0")

    # Of the episodes in a random order, take the first one with this goal.
    episodes = draw_episodes(bank, seed=seed)
    goal_names = np.array(bank.task.categories)[episodes.goal]
    candidate_indices = np.random.default_rng(seed).permutation(len(goal_names))
    if goal is not None:
        candidate_indices = candidate_indices[goal_names[candidate_indices] == goal]
    if not len(candidate_indices):
        raise InputError(f"--goal {goal}: choose one of {', '.join(sorted(set(goal_names)))}")
    return episodes.take(candidate_indices[:1])


def play_game(game: Game, keys: Iterable[str], show: Callable[[GameView], None]) -> GameResult:
    """Play until Done, the step limit, the key to quit or the last key.

    Args:
      game: episode to play.
      keys: names of keys, read one at a time.
      show: receives the view at the start and after each action but the last.
    """
    # The agent is a batch of one, steered by the keys.
    agent_loop = AgentLoop(game.compiled_world.env, None, game.estimator_config)
    params = game.compiled_world.make_env_params(0)
    agent = _begin(agent_loop, start_states(game.episode), None, game.knowledge, params)
    poses = [int(agent.state.pose[0])]
    scene = int(game.episode.scene[0])

    # An adviser, if any, observes the same episode.
    policy = game.policy
    memory = None if policy is None else policy.begin(params.room[scene])
    output = None
    moved = jnp.bool_(False)

    remaining_keys = iter(keys)
    while True:
        # The view from the present pose, with the advice and the belief.
        if policy is not None and memory is not None:
            observation = Observation(jnp.asarray(game.bank.rows[poses[-1]]), jnp.asarray(game.episode.goal[0]))
            _, heading, horizon = game.bank.task.rules.split_pose(poses[-1])
            output = _decide(policy, observation, memory, game.epsilon, heading=heading, moved=moved, horizon=horizon)
        view = GameView(
            pose=poses[-1],
            time=len(poses) - 1,
            step_limit=int(params.step_limit[scene]),
            layout_weights=np.asarray(_read_inputs(agent_loop, agent, game.knowledge, params).layout_weights[0]),
            layout_gap=float(agent_loop.layout_gap(agent)[0]),
            advice=None if output is None else np.asarray(jax.nn.softmax(output.logits)),
        )
        show(view)

        # Wait for a key that has a meaning.
        key = next((key for key in remaining_keys if key in KEY_ACTIONS or key == QUIT_KEY), QUIT_KEY)
        if key == QUIT_KEY:
            return GameResult(poses, "left after")

        # Act, and end the game with the episode.
        action = KEY_ACTIONS[key]
        agent, step_result = _step(agent_loop, agent, jnp.array([action], jnp.int32), game.knowledge, params)
        poses.append(int(agent.state.pose[0]))
        if step_result.success[0]:
            return GameResult(poses, "found in")
        if step_result.ended[0]:
            return GameResult(poses, "wrong Done after" if action == DONE else "out of time after")

        # The adviser remembers the action of the player, not the one that it would have chosen.
        if policy is not None and output is not None:
            _, memory = _apply_choice(policy, output, jnp.int32(action), params.room[scene])
        moved = step_result.moved[0]


_begin = jax.jit(AgentLoop.start_from, static_argnums=0)
_step = jax.jit(AgentLoop.step, static_argnums=0)
_read_inputs = jax.jit(AgentLoop.policy_inputs, static_argnums=0)
_decide = jax.jit(LoadedPolicy.decide)
_apply_choice = jax.jit(LoadedPolicy.apply_choice)
