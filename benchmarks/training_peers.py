"""Training against other trainers on this environment.

`python benchmarks/training_peers.py` prints steps per second. jaxnav's learner, rejax's PPO (feed-forward) and a
recurrent PPO in purejaxrl's style train the same network on the same rooms with the same episodes, rollout, epochs,
minibatches and losses. Each is a process of its own that compiles first and then trains for some whole updates when its
turn comes (A B A B), going on from where it was; the success of the episodes of its last turn shows that it learns.
rejax lives in a virtual environment of its own, made on first use. Takes about four minutes.

jaxnav and purejaxrl's style also differentiate through time, rejax does not. rejax wants two networks: `rejax, two
torsos` uses it as it is meant, `rejax, linear critic` gives it no more floating-point work than jaxnav has.
"""

import json
import os
import subprocess
import sys
import venv
from pathlib import Path

from _common import TUNED_ALLOCATOR, in_turns, rates, ratios, report

from jaxnav.training.config import PPOConfig

HERE = Path(__file__).parent
PEERS = HERE.parent / ".cache" / "peers"
PINNED = ("rejax==0.1.3", "gymnax==0.0.9", "jax==0.10.2", "jaxlib==0.10.2", "flax==0.12.8")
TURNS = 5
OURS, DEFAULT = "jaxnav, baseline", "jaxnav, the default run"
REJAX, LEAN, RECURRENT = "rejax, two torsos", "rejax, linear critic", "purejaxrl style"
SCRIPTS = {
    OURS: ("_jaxnav_worker.py", "baseline"),
    DEFAULT: ("_jaxnav_worker.py", "layout"),
    REJAX: ("_rejax_worker.py", "torso"),
    LEAN: ("_rejax_worker.py", "linear"),
    RECURRENT: ("_purejaxrl_style.py",),
}
#: Allocator, epochs, minibatches, updates of one turn, trainers.
CASES = (
    ("default", 1, 8, 16, tuple(SCRIPTS)),
    ("tuned", 1, 8, 16, (OURS, REJAX, LEAN, RECURRENT)),
    ("default", 4, 8, 6, (OURS, REJAX, LEAN, RECURRENT)),
)
GOAL = 1.5


class Trainer:
    """Run a trainer as a process that answers with `words`."""

    def __init__(self, name: str, allocator: str, *settings: int) -> None:
        script, *kind = SCRIPTS[name]
        python = PEERS / "rejax" / "bin" / "python" if name in (REJAX, LEAN) else sys.executable
        kept = {key: value for key, value in os.environ.items() if key not in TUNED_ALLOCATOR}
        self._process = subprocess.Popen(
            [python, HERE / script, *kind, *map(str, settings)],
            env=kept | {"PYTHONPATH": str(HERE.parent)} | (TUNED_ALLOCATOR if allocator == "tuned" else {}),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.words = {}

    def train(self) -> None:
        """Train for one turn."""
        print("train", file=self._process.stdin, flush=True)
        self.listen()

    def listen(self) -> None:
        """Wait for its next words."""
        assert self._process.stdout is not None
        self.words |= json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.communicate()


def main() -> None:
    install()
    cases = {}
    for allocator, epochs, minibatches, updates, names in CASES:
        case = f"epochs {epochs}, minibatches {minibatches}, {allocator} allocator"
        print(case, file=sys.stderr, flush=True)
        cases[case] = compare(allocator, epochs, minibatches, updates, names)
    by_what = {
        what: {case: results[what] for case, results in cases.items()} for what in ("steps_per_s", "ratios", "trainers")
    }
    reached = {
        case: {peer: ratio[f"{OURS} / {peer}"]["median"] >= GOAL for peer in (REJAX, LEAN)}
        for case, ratio in by_what["ratios"].items()
    }
    config = PPOConfig()
    report(
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
                RECURRENT: "one more bias in its recurrent cell; an episode cut at its step limit counts as ended",
                DEFAULT: "also estimates the layout and distils the counterfactual branch",
            },
            "not_installable": {"XLand-MiniGrid's trainer": "not in its package, only in its repository"},
            **by_what,
            "goal": {"at_least": GOAL, "reached": reached},
        }
    )


def compare(allocator: str, epochs: int, minibatches: int, updates: int, names: tuple[str, ...]) -> dict:
    """Time trainers in turns, and compare the first with each."""
    trainers = {name: Trainer(name, allocator, epochs, minibatches, updates) for name in names}
    for trainer in trainers.values():
        trainer.listen()  # until it has compiled
    taken = in_turns({name: trainer.train for name, trainer in trainers.items()}, TURNS)
    for trainer in trainers.values():
        trainer.close()
    config = PPOConfig()
    steps = updates * config.num_envs * config.rollout
    about = {"updates_per_turn": updates, "steps_trained": (TURNS + 1) * steps}
    return {
        "steps_per_s": {name: rates(taken[name], steps) for name in names},
        "trainers": about | {name: trainer.words for name, trainer in trainers.items()},
        "ratios": {f"{OURS} / {name}": ratios(taken[name], taken[OURS]) for name in names if name != OURS},
    }


def install() -> None:
    """Install rejax in a virtual environment of its own."""
    home = PEERS / "rejax"
    if not home.exists():
        venv.create(home, with_pip=True)
        command = [home / "bin" / "python", "-m", "pip", "install", "--quiet", *PINNED]
        subprocess.run(command, check=True, stdout=sys.stderr)


if __name__ == "__main__":
    main()
