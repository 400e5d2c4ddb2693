"""Train PPO of Stable-Baselines3 in generated rooms, and compare it with random actions.

pip install '.[gym]' stable-baselines3
python examples/stable_baselines3_ppo.py                    # 400,000 steps
python examples/stable_baselines3_ppo.py --steps 1000000 --benchmark    # the row of the leaderboard
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from jaxnav.runs.benchmark import run_benchmark

ROOMS = "jaxnav.env.gym:jaxnav/rooms-v0"


class GymnasiumVecEnv(VecEnv):
    """Adapter from Gymnasium's vector environments to those of Stable-Baselines3."""

    def __init__(self, env: Any) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        return self.env.reset()[0]

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> Any:
        observations, rewards, terminated, truncated, infos = self.env.step(self.actions)
        ended = terminated | truncated

        # Stable-Baselines3 expects one dictionary per environment, filled where an episode ended.
        env_infos = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(ended):
            env_infos[index] = {
                "terminal_observation": infos["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index]),
                "is_success": bool(infos["final_info"]["success"][index]),
            }
        return observations, rewards, ended, env_infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class SampledActions:
    """A model whose actions are sampled, as in training; `jaxnav.evaluate(model)` evaluates its best actions."""

    def __init__(self, model: PPO) -> None:
        self.model = model
        self.observation_space = model.observation_space

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        return self.model.predict(observation, deterministic=False)


def success_rate(env: VecEnv, choose_actions: Callable[[Any], np.ndarray], num_episodes: int = 1000) -> float:
    """Return the share of the first `num_episodes` episodes to end that succeed, in percent."""
    observations = env.reset()
    successes = []
    while len(successes) < num_episodes:
        observations, _, ended, infos = env.step(choose_actions(observations))
        successes += [infos[index]["is_success"] for index in np.flatnonzero(ended)]
    return 100 * float(np.mean(successes))


def main(num_steps: int, has_benchmark: bool) -> None:
    train_env = GymnasiumVecEnv(gymnasium.make_vec(ROOMS, num_envs=64, split="train"))
    val_env = GymnasiumVecEnv(gymnasium.make_vec(ROOMS, num_envs=64, split="val"))

    model = PPO(
        "MultiInputPolicy", train_env, n_steps=64, batch_size=512, n_epochs=4, ent_coef=0.01, seed=0, device="cpu"
    )
    model.learn(num_steps)
    # `predict` samples actions by default.
    ppo_rate = success_rate(val_env, lambda observations: model.predict(observations)[0])
    print(f"PPO after {num_steps:,} steps: {ppo_rate:.1f} % of val episodes")

    rng = np.random.default_rng(0)
    random_rate = success_rate(val_env, lambda _: rng.integers(0, val_env.action_space.n, val_env.num_envs))
    print(f"random actions: {random_rate:.1f} %")

    if has_benchmark:
        score_file = Path("stable_baselines3_ppo.json")
        run_benchmark(SampledActions(model), tracks=["rooms"]).write(score_file)
        print(f"scores of the benchmark written to {score_file}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=400_000)
    parser.add_argument("--benchmark", action="store_true")
    options = parser.parse_args()
    main(options.steps, options.benchmark)
