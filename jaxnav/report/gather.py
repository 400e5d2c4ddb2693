"""From finished runs to what their page holds."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np
from rich.console import Console

from jaxnav.evaluation.accounting import Entry
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.report_tables import label
from jaxnav.evaluation.similarity import scene_counts
from jaxnav.report.players import Player
from jaxnav.report.replays import Replays, make_replays
from jaxnav.runs.account import leads
from jaxnav.runs.directory import Run
from jaxnav.runs.evaluate import Results, evaluate
from jaxnav.runs.policies import Policies
from jaxnav.runs.worlds import CompiledWorld, evaluation_world
from jaxnav.study.association import similarity_points, success_by_similarity
from jaxnav.study.records import SuccessBySimilarity
from jaxnav.study.tracking import GapTraces, gap_traces
from jaxnav.training.calibration import layout_priors

#: Length of the curves of the gap, steps.
GAP_STEPS = 40


@dataclasses.dataclass(frozen=True)
class Options:
    """Say what a report measures.

    Attributes:
      split: scenes to evaluate on.
      shift: layout shifts, from 0 to 1.
      episodes: in the fixed list, at each shift.
      epsilon: thresholds of sTDE.
      threshold: that of the tables and of the replays; added to `epsilon`.
      replays: episodes to replay, in all.
      seed: of the episode list and the sampled actions.
    """

    split: str
    shift: tuple[float, ...]
    episodes: int
    epsilon: tuple[float, ...]
    threshold: float
    replays: int
    seed: int

    def evaluate(self, run: Run, shift: float, world: CompiledWorld, console: Console) -> Results:
        """Evaluate a run at a shift, as `jaxnav eval` does."""
        return evaluate(
            run,
            split=self.split,
            shift=shift,
            episodes=self.episodes,
            epsilon=sorted({*self.epsilon, self.threshold}),
            seed=self.seed,
            compiled=world,
            console=console,
        )


class Measured(NamedTuple):
    """Hold what was measured at one layout shift.

    Attributes:
      results: the evaluation of the run.
      account: its leads over agents without experience; None where no run of these is given.
      similarity: success by layout similarity; None where scenes are streamed.
      gaps: the gap along the episodes; None where scenes are streamed, or without the layout.
      replays: episodes, step by step.
    """

    results: Results
    account: list[Entry] | None
    similarity: SuccessBySimilarity | None
    gaps: GapTraces | None
    replays: Replays


def measure(run: Run, beside: Run | None, shift: float, options: Options, console: Console) -> Measured:
    """Measure a run at one layout shift.

    Args:
      run: a finished run.
      beside: a finished run of agents that cannot know any layout, in the same world; None for none.
      shift: of the layout.
      options: what to measure.
      console: tells of progress.

    Raises:
      InputError: no finished run, an impossible option, or runs that cannot be compared.
    """
    world = evaluation_world(run.config, options.split, None, shift, console)
    results, policies = options.evaluate(run, shift, world, console), run.policies()
    players, entries = _players(results, policies, world, options.threshold), None
    if beside is not None:
        other = evaluation_world(beside.config, options.split, None, shift, Console(quiet=True))
        known = options.evaluate(beside, shift, other, Console(quiet=True))
        entries = leads(results, known)
        others = _players(known, beside.policies(), other, options.threshold)
        players += [player._replace(role="without") for player in others if player.role == "baseline"]
    first = _first_bank(results.episodes, world)
    alone = len(world.banks) == 1
    return Measured(
        results=results,
        account=entries,
        similarity=_similarity(results, policies, world) if alone else None,
        gaps=_gaps(first, policies, world, options.seed) if alone and policies.setting is not None else None,
        replays=make_replays(players, first, options.replays // len(set(options.shift)), shift, options.split),
    )


def _players(results: Results, policies: Policies, world: CompiledWorld, threshold: float) -> list[Player]:
    """Return the agents whose episodes are replayed: those with best actions, and sTDE at the threshold."""
    players, count = [], len(_first_bank(results.episodes, world).goal)
    for i, row in enumerate(results.rows):
        if row.decoding != "argmax" or row.variant in ("oracle", "tde") or row.epsilon not in (None, threshold):
            continue
        success, length = (np.asarray(leaf)[i, 0, :count] for leaf in (results.outcome.success, results.outcome.length))
        players.append(Player(row.variant, label(results.report["rows"][i]), policies, world, row, success, length))
    return players


def _first_bank(episodes: EpisodeList, world: CompiledWorld) -> EpisodeList:
    """Return the episodes of the first bank; those of all banks are as many each."""
    return episodes.take(np.arange(len(episodes.goal) // len(world.banks)))


def _similarity(results: Results, policies: Policies, world: CompiledWorld) -> SuccessBySimilarity:
    """Relate the success of the first row to layout similarity."""
    bank = world.banks[0]
    room = np.asarray(world.params(0).room)[: len(bank.names)]
    points = similarity_points(results.episodes, scene_counts(bank), np.asarray(policies.counts, np.float64)[room])
    return success_by_similarity(points, np.asarray(results.outcome.success)[0])


def _gaps(episodes: EpisodeList, policies: Policies, world: CompiledWorld, seed: int) -> GapTraces:
    """Walk the episodes with the layout arm."""
    assert policies.setting is not None
    return gap_traces(
        policies.of("layout"),
        episodes,
        world.params(0),
        policies.acting(world),
        policies.knowledge,
        [policies.setting],
        layout_priors(policies.counts, policies.setting)[None],
        GAP_STEPS,
        jax.random.key(seed),
    )
