"""Train PPO of Stable-Baselines3 in generated rooms, and compare it with random actions.

pip install '.[gym]' stable-baselines3
python examples/stable_baselines3_ppo.py [STEPS]
"""

import sys
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

ROOMS = "jaxnav.env.gym:jaxnav/rooms-v0"


class SideBySide(VecEnv):
    """A Gymnasium vector environment for Stable-Baselines3, which has a type of its own."""

    def __init__(self, env: Any) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        return self.env.reset()[0]

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> Any:
        observations, rewards, terminated, truncated, infos = self.env.step(self.actions)
        ended, told = terminated | truncated, [{} for _ in range(self.num_envs)]
        for number in np.flatnonzero(ended):
            told[number] = {
                "terminal_observation": infos["final_obs"][number],
                "TimeLimit.truncated": bool(truncated[number]),
                "success": bool(infos["final_info"]["success"][number]),
            }
        return observations, rewards, ended, told

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


def success_rate(env: VecEnv, act: Any, episodes: int = 1000) -> float:
    """Return the share of episodes that succeed, in percent."""
    observations, found = env.reset(), []
    while len(found) < episodes:
        observations, _, ended, infos = env.step(act(observations))
        found += [info["success"] for info, over in zip(infos, ended, strict=True) if over]
    return 100 * float(np.mean(found))


def main(steps: int) -> None:
    train, val = (SideBySide(gymnasium.make_vec(ROOMS, num_envs=64, split=split)) for split in ("train", "val"))
    model = PPO("MultiInputPolicy", train, n_steps=64, batch_size=512, n_epochs=4, ent_coef=0.01, seed=0, device="cpu")
    model.learn(steps)
    print(f"PPO after {steps:,} steps: {success_rate(val, lambda seen: model.predict(seen)[0]):.1f} % of val episodes")
    rng = np.random.default_rng(0)
    print(f"random actions: {success_rate(val, lambda _: rng.integers(0, 6, 64)):.1f} %")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400_000)
