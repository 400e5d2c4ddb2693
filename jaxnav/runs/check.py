"""What is possible among the settings of a run."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError
from jaxnav.policies.methods import Method, find_method
from jaxnav.runs.config import ARMS, RunConfig
from jaxnav.scenes.task import NUM_ACTIONS
from jaxnav.training.devices import Devices

#: The most that a run may be asked for; more would end for want of memory or of counters, not finish.
_MOST = {
    "seeds": 1024,
    "total_steps": 10**12,
    "chunk": 10**5,
    "save_every": 10**6,
    "validations": 10**4,
    "val_episodes": 10**5,
}
_MOST_OF_A_GROUP = 10**6
_MOST_STEPS = 2**28  # side by side, and kept
_MOST_CHUNKS = 4 * 10**6


def check(config: RunConfig) -> RunConfig:
    """Return the config, complete and possible.

    A method that cannot host the layout loses the arm `layout`; paths may be given as texts. With streams the direct
    pathway sees the goal's detection alone, and the counterfactual branch needs no training of its own: both
    streams are policies.

    Raises:
      InputError: names the first impossible setting.
    """
    paths = {"run_dir": config.run_dir, "scenes": config.scenes, "cache": config.cache}
    config = dataclasses.replace(config, **{name: Path(path) for name, path in paths.items() if path is not None})
    method = find_method(config.method)
    if not method.hosts_layout and config.arms == ARMS:
        config = dataclasses.replace(config, arms=("baseline",))
    if config.decision == "streams":
        config = dataclasses.replace(config, direct="goal", counterfactual="none")
    _check_method(config, method)
    _check_numbers(config)
    _check_stages(config, method)
    _check_layout(config)
    _check_learning(config)
    _check_world(config)
    return config


def _need(holds: bool, name: str, value: object, mend: str) -> None:
    if not holds:
        raise InputError(f"config: {name} is {value}; {mend}")


def _check_method(config: RunConfig, method: Method) -> None:
    arms, sizes = config.arms, method.experience.sizes
    _need(len(set(arms)) == len(arms) > 0, "arms", arms, f"give some of {', '.join(ARMS)}, each once")
    hosted = method.hosts_layout or "layout" not in arms
    _need(hosted, "arms", arms, f"method {config.method!r} cannot host the layout; give baseline alone")
    gated = not config.done_gate or method.control.num_choices == NUM_ACTIONS
    _need(gated, "done_gate", True, f"what method {config.method!r} chooses are no actions; leave it out")
    for name, value in config.method_sizes.items():
        known = f"{config.method!r} has {', '.join(sizes)}" if sizes else f"{config.method!r} has no sizes of its own"
        _need(name in sizes, f"method_sizes.{name}", value, f"is unknown; {known}")
        _need(value >= 1, f"method_sizes.{name}", value, "give at least 1")


def _check_stages(config: RunConfig, method: Method) -> None:
    share = config.imitation
    if share is not None:
        _need(0.0 < share < 1.0, "imitation", share, "give a share between 0 and 1, both excluded")
        kinds = {stage.imitates for stage in method.stages}
        _need(len(kinds) == 2, "imitation", share, f"{config.method!r} has no stages of both kinds; leave it out")
    name, value = ("total_steps", config.total_steps) if share is None else ("imitation", share)
    for number, stage in enumerate(config.stages, 1):
        mend = (
            f"stage {number} of method {config.method!r}, a share of {stage.share:.3g}, gets none of the "
            f"{len(config.schedule)} chunks of {config.chunk} updates: give more total_steps or a smaller chunk"
        )
        _need(number - 1 in config.schedule, name, value, mend)


def _check_numbers(config: RunConfig) -> None:
    for name, most in _MOST.items():
        value = getattr(config, name)
        least = 0 if name == "validations" else 1
        _need(value is None or value >= least, name, value, f"give at least {least}")
        _need(value is None or value <= most, name, value, f"give at most {most:,}")
    if config.devices is not None:
        forms = "give a number, `cluster` or HOST:PORT,INDEX,PROCESSES with INDEX from 0"
        _need(Devices.parse(str(config.devices)) is not None, "devices", repr(config.devices), forms)
    seeds = {"seed": config.seed, "worlds.seed": config.worlds.seed, "detector.seed": config.detector.seed}
    for name, seed in seeds.items():
        _need(0 <= seed < 2**32, name, seed, "give a whole number from 0 to 2**32 - 1")
    for group in ("worlds", "layout", "sizes", "ppo"):
        for field in dataclasses.fields(getattr(config, group)):
            value = getattr(getattr(config, group), field.name)
            if isinstance(value, int) and field.name != "seed":
                _need(value >= 1, f"{group}.{field.name}", value, "give at least 1")
                _need(value <= _MOST_OF_A_GROUP, f"{group}.{field.name}", value, f"give at most {_MOST_OF_A_GROUP:,}")
    together = {
        "layout.walks x layout.steps": config.layout.walks * config.layout.steps,
        "ppo.num_envs x ppo.rollout": config.update_steps,
    }
    for name, count in together.items():
        _need(count <= _MOST_STEPS, name, count, f"give at most {_MOST_STEPS:,}")
    chunks = config.total_updates // config.chunk
    _need(chunks <= _MOST_CHUNKS, "total_steps", config.total_steps, f"makes {chunks:,} chunks; give a larger chunk")


def _check_layout(config: RunConfig) -> None:
    layout, strength = config.layout, config.layout.strength
    fixed = layout.setting != "calibrated" and (strength, layout.reduction) != (None, None)
    _need(not fixed, "layout.setting", layout.setting, "only `calibrated` takes a strength and a reduction")
    _need(strength is None or 0.0 < strength < float("inf"), "layout.strength", strength, "give a positive number")


def _check_learning(config: RunConfig) -> None:
    ppo = config.ppo
    _need_all(ppo, "ppo", ("gamma", "gae_lambda"), lambda x: 0.0 <= x <= 1.0, "give a number from 0 to 1")
    between = "give a number between 0 and 1, both excluded"
    _need_all(ppo, "ppo", ("experience",), lambda x: 0.0 < x < 1.0, between)
    _need_all(ppo, "ppo", ("alone",), lambda x: 0.0 <= x < 1.0, "give a share from 0 to below 1")
    rates = ("learning_rate", "experience_rate", "clip", "max_grad_norm")
    _need_all(ppo, "ppo", rates, lambda x: 0.0 < x < float("inf"), "give a positive number")
    weights = ("entropy", "final_entropy", "value", "distil")
    _need_all(ppo, "ppo", weights, lambda x: 0.0 <= x < float("inf"), "give 0 or more")
    fewer = ppo.num_envs // ppo.minibatches * ppo.minibatches
    nearest = " or ".join(str(count) for count in (fewer, fewer + ppo.minibatches) if count)
    mend = f"give a multiple of ppo.minibatches ({ppo.minibatches}), such as {nearest}"
    _need(ppo.num_envs == fewer, "ppo.num_envs", ppo.num_envs, mend)
    mend = f"give at most worlds.train_step_limit ({config.train_step_limit})"
    _need(ppo.rollout <= config.train_step_limit, "ppo.rollout", ppo.rollout, mend)


def _check_world(config: RunConfig) -> None:
    rates = ("miss_near", "miss_far", "false_alarm")
    _need_all(config.detector, "detector", rates, lambda x: 0.0 <= x <= 1.0, "give a probability from 0 to 1")
    task, shift, shaping = config.task, config.worlds.shift, config.worlds.shaping
    _need(0.0 <= shift <= 1.0, "worlds.shift", shift, "give a number from 0 to 1")
    _need(shaping is None or 0.0 <= shaping < float("inf"), "worlds.shaping", shaping, "give 0 or more")
    near = config.worlds.near_starts
    _need(near is None or 0.0 <= near <= 1.0, "worlds.near_starts", near, "give a probability from 0 to 1")
    _need(len(task.categories) >= 2, "worlds.categories", task.categories, "give at least 2")
    _need(len(set(task.categories)) == len(task.categories), "worlds.categories", task.categories, "give each once")
    unknown = [goal for goal in task.goals if goal not in task.categories]
    _need(not unknown, "worlds.goals", unknown, f"give some of the categories {', '.join(task.categories)}")


def _need_all(group: Any, prefix: str, names: tuple[str, ...], valid: Callable[[float], bool], mend: str) -> None:
    for name in names:
        _need(valid(getattr(group, name)), f"{prefix}.{name}", getattr(group, name), mend)
