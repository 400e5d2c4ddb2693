"""Training against other trainers on this environment.

`python benchmarks/training_peers.py` prints steps per second. jaxnav's learner, rejax's PPO (feed-forward) and a
recurrent PPO in purejaxrl's style train the same network on the same rooms with the same episodes, rollout, epochs,
minibatches and losses. Each is a process of its own that compiles first, then trains for some whole updates in each of
its turns (A B A B) and continues where it stopped; the success of the episodes of its last turn shows that it learns.
rejax has a virtual environment of its own, created on first use. The benchmark takes about four minutes.

jaxnav and purejaxrl's style also differentiate through time, rejax does not. rejax needs two networks: `rejax, two
torsos` is its intended use, `rejax, linear critic` gives it no more floating-point work than jaxnav has.
"""

import json
import os
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any, NamedTuple

from _common import TUNED_ALLOCATOR, print_report, ratio_by_turn, steps_per_second, time_in_turns

from jaxnav.training.config import PPOConfig

FOLDER = Path(__file__).parent
REJAX_DIR = FOLDER.parent / ".cache" / "peers" / "rejax"
PINNED = ("rejax==0.1.3", "gymnax==0.0.9", "jax==0.10.2", "jaxlib==0.10.2", "flax==0.12.8")
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
    PUREJAXRL_STYLE: ("_purejaxrl_style.py",),
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
#: Ratio of our speed to that of rejax that we want to reach.
GOAL = 1.5


class TrainerProcess:
    """A trainer in a process of its own.

    Attributes:
      answers: all that the process has answered, the latest value of each key.
    """

    def __init__(self, name: str, case: Case) -> None:
        script, *script_arguments = SCRIPTS[name]
        is_rejax = name in (REJAX_TWO_TORSOS, REJAX_LINEAR_CRITIC)
        python = REJAX_DIR / "bin" / "python" if is_rejax else sys.executable
        settings = map(str, (case.epochs, case.minibatches, case.num_updates))

        environment = {key: value for key, value in os.environ.items() if key not in TUNED_ALLOCATOR}
        environment["PYTHONPATH"] = str(FOLDER.parent)
        if case.allocator == "tuned":
            environment |= TUNED_ALLOCATOR

        self._process = subprocess.Popen(
            [python, FOLDER / script, *script_arguments, *settings],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.answers = {}

    def train(self) -> None:
        """Train for one turn."""
        print("train", file=self._process.stdin, flush=True)
        self.read_answer()

    def read_answer(self) -> None:
        """Wait for the next answer."""
        assert self._process.stdout is not None
        self.answers |= json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.communicate()


def main() -> None:
    install_rejax()
    results = {}
    for case in CASES:
        print(case.title, file=sys.stderr, flush=True)
        results[case.title] = compare_trainers(case)

    # The report groups the results of all cases by kind.
    results_by_kind = {}
    for kind in ("steps_per_s", "ratios", "trainers"):
        results_by_kind[kind] = {title: case_results[kind] for title, case_results in results.items()}
    goal_reached = {}
    for title, ratios in results_by_kind["ratios"].items():
        goal_reached[title] = {}
        for peer in (REJAX_TWO_TORSOS, REJAX_LINEAR_CRITIC):
            goal_reached[title][peer] = ratios[f"{JAXNAV_BASELINE} / {peer}"]["median"] >= GOAL

    config = PPOConfig()
    print_report(
        {
            "world": "rooms",
            "episodes": config.num_envs,
            "rollout": config.rollout,
            "learning_rate": f"{config.learning_rate}, constant",
            "seeds": 1,
            "rejax": " ".join(PINNED),
            "differs": {
                "rejax": "no memory, no backpropagation through time; minibatches over steps; two optimisers; clips "
                "the value loss, and gradients by element; an episode cut at its step limit counts as ended",
                PUREJAXRL_STYLE: "one more bias in its recurrent cell; "
                "an episode cut at its step limit counts as ended",
                JAXNAV_DEFAULT: "also estimates the layout and distils the counterfactual branch",
            },
            "not_installable": {"XLand-MiniGrid's trainer": "not in its package, only in its repository"},
            **results_by_kind,
            "goal": {"at_least": GOAL, "reached": goal_reached},
        }
    )


def compare_trainers(case: Case) -> dict:
    """Time trainers in turns, and compare jaxnav's with each."""
    processes = {name: TrainerProcess(name, case) for name in case.trainers}
    for process in processes.values():
        process.read_answer()  # once compiled
    times = time_in_turns({name: process.train for name, process in processes.items()}, TURNS)
    for process in processes.values():
        process.close()

    config = PPOConfig()
    num_steps = case.num_updates * config.num_envs * config.rollout
    trainers: dict[str, Any] = {"updates_per_turn": case.num_updates, "steps_trained": (TURNS + 1) * num_steps}
    trainers |= {name: process.answers for name, process in processes.items()}
    ratios = {}
    for name in case.trainers:
        if name != JAXNAV_BASELINE:
            ratios[f"{JAXNAV_BASELINE} / {name}"] = ratio_by_turn(times[name], times[JAXNAV_BASELINE])
    return {
        "steps_per_s": {name: steps_per_second(times[name], num_steps) for name in case.trainers},
        "trainers": trainers,
        "ratios": ratios,
    }


def install_rejax() -> None:
    """Install rejax in a virtual environment of its own."""
    if not REJAX_DIR.exists():
        venv.create(REJAX_DIR, with_pip=True)
        command = [REJAX_DIR / "bin" / "python", "-m", "pip", "install", "--quiet", *PINNED]
        subprocess.run(command, check=True, stdout=sys.stderr)


if __name__ == "__main__":
    main()
