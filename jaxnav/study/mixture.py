"""Removal in a mixed population: what it keeps of the value of experience, and what it recovers of the cost.

Half of the episodes are in scenes laid out like those of training, half in shifted ones, and no agent is told which. A
removal is worth what it gains over the mixture. A gap is worth what it gains over the gap of another episode of the
mixture, over the mean gap of all episodes at the time, and over clocks.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from rich.console import Console

from jaxnav.causal import Form
from jaxnav.errors import InputError
from jaxnav.evaluation.accounting import share_left
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import Outcome
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.statistics import Clusters, Interval, paired_difference, summary
from jaxnav.runs.config import RunConfig
from jaxnav.runs.policies import Gap, gap_settings, load_policies
from jaxnav.scenes.worlds import WORLDS
from jaxnav.study.bench import Bench, Subject, layout_setting
from jaxnav.study.mixture_report import ByShift, Compared, Mixture, Removal
from jaxnav.study.outcomes import mean_weight
from jaxnav.study.population import mixed_population
from jaxnav.study.trials import Control, Schedule, Trial, Use

#: Constant gaps, and times by the second budget of the world, after or until which experience is taken out whole. All
#: times are below 1, for nothing that comes later changes success within the budget.
CONSTANTS = (0.25, 0.5, 0.75)
TIMES = (0.1, 0.25, 0.5)
ORACLE = "told the shift"


class Way(NamedTuple):
    """Name a way of removal: a gap, whether it is held, and its use."""

    gap: Gap
    hold: bool
    use: Use

    def __str__(self) -> str:
        held = " held" if self.hold else ""
        return f"{self.gap}{held}, {self.use.form}, eps {self.use.epsilon:g}"


#: Soft removal by every gap, and handing over: a switch that does not go back.
WAYS = (
    Way("novelty", False, Use(0.5, "residual")),
    *(Way(gap, False, Use(0.0, "paper")) for gap in ("novelty", "evidence", "learned", "overdue")),
    *(Way(gap, True, Use(0.5, "switch")) for gap in ("evidence", "overdue")),
    Way("learned", True, Use(0.75, "switch")),
)
#: Controls of each form; a mean gap is no switch.
CONTROLS: Mapping[Form, tuple[Control | Schedule, ...]] = {
    "residual": ("shuffled", "course"),
    "paper": ("shuffled", "course"),
    "switch": ("shuffled",),
}
Values = Mapping[str, np.ndarray]


class Subset(NamedTuple):
    """Hold which episodes count, and their scenes."""

    chosen: np.ndarray
    scenes: Clusters


class Ledger:
    """Hold outcomes on the episodes of a population, and compare them.

    Args:
      episodes: of the population.
      shift: int [E], index of each episode's shift.
      budgets: numbers of actions within which success is counted too.
    """

    def __init__(self, episodes: EpisodeList, shift: np.ndarray, budgets: Sequence[int]) -> None:
        self._episodes, self._budgets = episodes, budgets
        self.metrics = ("sr", "spl", *(f"sr@{budget}" for budget in budgets))
        chosen = [shift == part for part in range(shift.max() + 1)]
        self._parts = [Subset(each, episodes.take(each).clusters()) for each in chosen]
        self._all = Subset(np.ones(len(shift), bool), episodes.clusters())

    def measure(self, outcome: Outcome) -> Values:
        """Return the metrics of outcomes in percent, [S, E]."""
        found = episode_metrics(outcome, self._episodes.best_length, self._budgets)
        return {name: 100.0 * found[name] for name in self.metrics}

    def told(self, plain: Outcome, hard: Outcome) -> Outcome:
        """Return what hard removal at all shifts but the first gives."""
        return jax.tree.map(lambda kept, removed: np.where(self._parts[0].chosen, kept, removed), plain, hard)

    def weights(self, outcome: Outcome) -> tuple[float, ...]:
        """Return the mean weight of what is removed at each shift."""
        parts = [jax.tree.map(lambda leaf: leaf[:, part.chosen], outcome) for part in self._parts]  # noqa: B023
        return tuple(map(mean_weight, parts))

    def by_shift(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return values [..., E] of each shift."""
        return tuple(values[..., part.chosen] for part in self._parts)

    def means(self, measured: Values) -> dict[str, ByShift]:
        """Return the means at each shift."""
        return {
            name: tuple(summary(measured[name][:, part.chosen], part.scenes) for part in self._parts)
            for name in self.metrics
        }

    def changes(self, a: Values, b: Values, *, same_runs: bool) -> dict[str, ByShift]:
        """Return `b - a` at each shift."""
        return {
            name: tuple(self._difference(a[name], b[name], part, same_runs=same_runs) for part in self._parts)
            for name in self.metrics
        }

    def overall(self, a: Values, b: Values) -> dict[str, Interval]:
        """Return `b - a` of the same policies over all episodes."""
        return {name: paired_difference(a[name], b[name], self._all.scenes, same_runs=True) for name in self.metrics}

    def left(self, without: Values, agent: Values, removed: Values) -> dict[str, ByShift]:
        """Return the share of a lead that removal leaves."""

        def share(name: str, part: Subset) -> Interval:
            nobody, acting, left = (each[name][:, part.chosen] for each in (without, agent, removed))
            return share_left(nobody, acting, left, part.scenes)

        return {name: tuple(share(name, part) for part in self._parts) for name in self.metrics}

    @staticmethod
    def _difference(a: np.ndarray, b: np.ndarray, part: Subset, *, same_runs: bool) -> Interval:
        return paired_difference(a[:, part.chosen], b[:, part.chosen], part.scenes, same_runs=same_runs)


def measure_mixture(
    run: RunConfig,
    without: RunConfig,
    decoding: Decoding,
    bench: Bench,
    console: Console,
    ways: Sequence[Way] = WAYS,
    *,
    hand_over: bool = False,
) -> Mixture:
    """Evaluate removals and their controls in a mixed population.

    Args:
      run: finished, with the arm of the layout.
      without: finished, of agents that cannot know any layout, with as many seeds.
      decoding: of actions.
      bench: evaluates.
      console: shows the progress.
      ways: of removal, besides TDE and clocks.
      hand_over: whether removal leaves the agents of `without`, and not the run's own direct effect.

    Raises:
      InputError: a run is not finished, they differ in world, goals or number of seeds, cannot hand over, or see
        `mixed_population`.
    """
    for name in ("world", "scenes", "worlds", "task", "seeds"):
        if getattr(run, name) != getattr(without, name):
            raise InputError(f"{run.run_dir} and {without.run_dir} differ in {name}; train both alike")
    config, budgets = bench.config, WORLDS[run.world].budgets
    shifts = (config.shifts[0], config.shifts[-1])
    world, episodes, shift = mixed_population(run, shifts, config, console)
    ledger = Ledger(episodes, shift, budgets)
    unaware = Subject(load_policies(without, ("baseline",)), world, episodes)
    policies = load_policies(run, ("layout",))
    subject = Subject(policies.handing_over(unaware.policies) if hand_over else policies, world, episodes)
    nobody = ledger.measure(bench.run(unaware, None, [Trial("baseline", decoding)])[0])
    known = {"plain": Trial("layout", decoding), "TDE": Trial("tde", decoding)} | clock_trials(decoding, budgets[-1])
    console.print("TDE and clocks")
    outcomes = bench.run(subject, layout_setting(subject.policies), list(known.values()))
    plain, hard, *clocks = outcomes
    agent = ledger.measure(plain)

    def removal(name: str, outcome: Outcome, controls: Mapping[str, Outcome] | None = None) -> Removal:
        removed = ledger.measure(outcome)
        compared = {
            key: Compared(ledger.weights(each), ledger.overall(ledger.measure(each), removed))
            for key, each in (controls or {}).items()
        }
        return Removal(
            name=name,
            weight=ledger.weights(outcome),
            change=ledger.changes(agent, removed, same_runs=True),
            mixture=ledger.overall(agent, removed),
            left=ledger.left(nobody, agent, removed),
            compared=compared or None,
        )

    timed = dict(zip(list(known)[2:], clocks, strict=True))
    rows = [removal(name, outcome) for name, outcome in timed.items()]
    score = f"sr@{budgets[-1]}"
    best = max(rows, key=lambda row: row.mixture[score].mean).name
    rows = [removal("TDE", hard), removal(ORACLE, ledger.told(plain, hard)), *rows]
    for way in ways:
        console.print(str(way))
        setting = dataclasses.replace(gap_settings(layout_setting(subject.policies))[way.gap], hold=way.hold)
        trial = Trial("stde", decoding, *way.use)
        controls = CONTROLS[way.use.form]
        own, *others = bench.run(subject, setting, [trial, *(dataclasses.replace(trial, control=c) for c in controls)])
        rows.append(removal(str(way), own, dict(zip(controls, others, strict=True)) | {best: timed[best]}))
    return Mixture(
        run=run.run_dir.name,
        heir=without.run_dir.name if hand_over else None,
        decoding=decoding,
        world=world.scenes[0].world,
        shifts=shifts,
        scenes=len(episodes.scenes) // len(shifts),
        episodes=len(episodes.goal) // len(shifts),
        length=tuple(float(np.median(part)) for part in ledger.by_shift(np.asarray(plain.length))),
        without=ledger.means(nobody),
        agent=ledger.means(agent),
        lead=ledger.changes(nobody, agent, same_runs=False),
        removals=tuple(rows),
    )


def clock_trials(decoding: Decoding, budget: int) -> dict[str, Trial]:
    """Return removals that know nothing of the episode.

    Constant gaps, and hard removal after or until a time, as a share of a budget of actions.
    """
    constants = {
        f"constant {weight:g}": Trial("stde", decoding, 0.0, "paper", "constant", weight=weight) for weight in CONSTANTS
    }
    steps = [round(time * budget) for time in TIMES]
    return constants | {
        f"{control} step {step}": Trial("stde", decoding, 0.0, "paper", control, step)
        for control in ("after", "until")
        for step in steps
    }
