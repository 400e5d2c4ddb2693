"""Training against other trainers on this environment.

`python benchmarks/training_peers.py` prints steps per second. jaxnav's learner, rejax's PPO (feed-forward) and a
recurrent PPO in purejaxrl's style train the same network on the same rooms with the same episodes, rollout, epochs,
minibatches and losses. Each is a process of its own that compiles first, then trains for some whole updates in each of
its turns (A B A B) and continues where it stopped. rejax has a virtual environment of its own, created on first use.
The benchmark takes about four minutes.

jaxnav and purejaxrl's style also differentiate through time, rejax does not. rejax needs two networks: `rejax, two
torsos` is its intended use, `rejax, linear critic` gives it no more floating-point work than jaxnav has.
"""

import sys
from pathlib import Path
from typing import NamedTuple

from _common import (
    TUNED_ALLOCATOR,
    WorkerProcess,
    install,
    print_report,
    ratio_by_turn,
    steps_per_second,
    time_in_turns,
)

from jaxnav.training.config import PPOConfig

FOLDER = Path(__file__).parent
REJAX_PINS = ("rejax==0.1.3", "gymnax==0.0.9", "jax==0.10.2", "jaxlib==0.10.2", "flax==0.12.8")
TURNS = 5

# Names of the trainers.
JAXNAV_BASELINE = "jaxnav, baseline"
JAXNAV_DEFAULT = "jaxnav, the default run"
REJAX_TWO_TORSOS = "rejax, two torsos"
REJAX_LINEAR_CRITIC = "rejax, linear critic"
PUREJAXRL_STYLE = "purejaxrl style"

#: Script of each trainer, and its first argument.
SCRIPTS = {
    JAXNAV_BASELINE: ("_jaxnav_worker.py", "baseline"),
    JAXNAV_DEFAULT: ("_jaxnav_worker.py", "layout"),
    REJAX_TWO_TORSOS: ("_rejax_worker.py", "torso"),
    REJAX_LINEAR_CRITIC: ("_rejax_worker.py", "linear"),
    PUREJAXRL_STYLE: ("_purejaxrl_worker.py",),
}


class Case(NamedTuple):
    """A comparison of trainers.

    Attributes:
      allocator: `default` or `tuned`.
      epochs, minibatches: of an update.
      num_updates: of one turn.
      trainers: names of the trainers.
    """

    allocator: str
    epochs: int
    minibatches: int
    num_updates: int
    trainers: tuple[str, ...]

    @property
    def title(self) -> str:
        return f"epochs {self.epochs}, minibatches {self.minibatches}, {self.allocator} allocator"


#: The default run learns in another way, so it is compared once.
COMPARABLE = (JAXNAV_BASELINE, REJAX_TWO_TORSOS, REJAX_LINEAR_CRITIC, PUREJAXRL_STYLE)
CASES = (
    Case("default", epochs=1, minibatches=8, num_updates=16, trainers=tuple(SCRIPTS)),
    Case("tuned", epochs=1, minibatches=8, num_updates=16, trainers=COMPARABLE),
    Case("default", epochs=4, minibatches=8, num_updates=6, trainers=COMPARABLE),
)


def main() -> None:
    rejax_python = install("rejax", *REJAX_PINS)
    rates = {}
    ratios = {}
    for case in CASES:
        print(case.title, file=sys.stderr, flush=True)
        rates[case.title], ratios[case.title] = compare_trainers(case, rejax_python)

    config = PPOConfig()
    print_report(
        {
            "world": "rooms",
            "episodes": config.num_envs,
            "rollout": config.rollout,
            "learning_rate": f"{config.learning_rate}, constant",
            "seeds": 1,
            "rejax": " ".join(REJAX_PINS),
            "differs": {
                "rejax": "no memory, no backpropagation through time; minibatches over steps; two optimisers; clips "
                "the value loss, and gradients by element; an episode cut at its step limit counts as ended",
                PUREJAXRL_STYLE: "one more bias in its recurrent cell; "
                "an episode cut at its step limit counts as ended",
                JAXNAV_DEFAULT: "also estimates the layout and distils the counterfactual branch",
            },
            "steps_per_s": rates,
            "ratios": ratios,
        }
    )


def compare_trainers(case: Case, rejax_python: Path) -> tuple[dict, dict]:
    """Time trainers in turns, and return the speed of each and jaxnav's over it."""
    settings = TUNED_ALLOCATOR if case.allocator == "tuned" else {}
    workers = {}
    for name in case.trainers:
        script, *arguments = SCRIPTS[name]
        python = rejax_python if name in (REJAX_TWO_TORSOS, REJAX_LINEAR_CRITIC) else sys.executable
        command = [python, FOLDER / script, *arguments, case.epochs, case.minibatches, case.num_updates]
        workers[name] = WorkerProcess(command, settings)

    times = time_in_turns({name: worker.request for name, worker in workers.items()}, TURNS)
    for worker in workers.values():
        worker.close()

    config = PPOConfig()
    num_steps = case.num_updates * config.num_envs * config.rollout
    rates = {name: steps_per_second(times[name], num_steps) for name in case.trainers}
    ratios = {}
    for name in case.trainers:
        if name != JAXNAV_BASELINE:
            ratios[f"{JAXNAV_BASELINE} / {name}"] = ratio_by_turn(times[name], times[JAXNAV_BASELINE])
    return rates, ratios


if __name__ == "__main__":
    main()
