"""All trials of a run at one layout shift."""

from collections.abc import Sequence

import numpy as np
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation.grid import Outcome
from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.similarity import scene_counts
from jaxnav.runs.config import RunConfig
from jaxnav.runs.policies import Gap
from jaxnav.study.association import gain_by_similarity, similarity_points, success_by_similarity
from jaxnav.study.bench import Bench, Subject
from jaxnav.study.config import StudyConfig
from jaxnav.study.outcomes import TrialOutcomes, mean_weight
from jaxnav.study.records import Condition, FullCondition, GainBySimilarity, Gains, SuccessBySimilarity
from jaxnav.study.results import load_condition
from jaxnav.study.trials import SWEPT, THRESHOLD, USES, Control, Trial, Variant

DECODINGS: tuple[Decoding, ...] = ("argmax", "sample")
GAPS: tuple[Gap, ...] = ("novelty", "evidence", "clock")
#: Controls of sTDE with best actions; zeros, which cannot change these, with sampled ones. The constant needs the mean
#: weight, so it comes later.
CONTROLS: tuple[tuple[Control, Decoding], ...] = (
    ("shuffled", "argmax"),
    ("noise", "argmax"),
    ("random", "argmax"),
    ("zeros", "sample"),
)


def measure_condition(run: RunConfig, full: bool, shift: float, bench: Bench, console: Console) -> Condition:
    """Evaluate the trials of a run at one shift.

    Args:
      run: a finished run.
      full: evaluate all trials, and similarity; else those of Table 1 with best actions.
      shift: layout shift.
      bench: evaluates them.
      console: shows the progress.

    Raises:
      InputError: epsilon was not chosen on `val`, or see `Bench.subject`.
    """
    subject = bench.subject(run, shift, console)
    with_baseline = "baseline" in run.arms
    plain = bench.outcomes(subject, "novelty", _plain_trials(DECODINGS if full else ("argmax",), with_baseline))
    if full:
        return _full_condition(subject, shift, bench, plain)
    uses = [Trial("stde", "argmax", *use) for use in USES.values()]
    outcomes = TrialOutcomes(plain | bench.outcomes(subject, "novelty", uses), subject.episodes)
    return Condition(
        shift=shift,
        world=subject.world.scenes[0].world,
        scenes=len(subject.episodes.scenes),
        rows=tuple(outcomes.rows("novelty")),
        episodes=len(subject.episodes.goal),
        parameters=subject.parameters,
    )


def chosen_epsilon(config: StudyConfig) -> float:
    """Return the epsilon of the greatest SR on `val`.

    It is chosen at the first shift, with eq. 5's gap in the residual form.

    Raises:
      InputError: the study has not been done on `val`.
    """
    path = config.results / "val" / f"main-shift{config.shifts[0]:g}.json"
    if not path.exists():
        raise InputError(f"{path}: is missing; run the study with --split val first, epsilon is chosen there")
    sweep = load_condition(path).sweep("residual")
    return max(sweep, key=lambda epsilon: sweep[epsilon].sr.mean)


def _full_condition(subject: Subject, shift: float, bench: Bench, plain: dict[Trial, Outcome]) -> FullCondition:
    """Evaluate all trials, with those without sTDE given."""
    config, episodes = bench.config, subject.episodes
    chosen = chosen_epsilon(config) if config.split == "test" else None
    epsilons = {*config.epsilon, *(use.epsilon for use in USES.values())} if chosen is None else {chosen}
    outcomes = {
        gap: TrialOutcomes(plain | _stde_outcomes(subject, gap, bench, sorted(epsilons)), episodes) for gap in GAPS
    }
    rows = outcomes["novelty"].rows("novelty")
    for gap in GAPS[1:]:
        # Without sTDE the gap has no effect.
        rows += [row for row in outcomes[gap].rows(gap) if row.trial.variant == "stde"]
    similarity, gains = _by_similarity(subject, outcomes["novelty"])
    return FullCondition(
        shift=shift,
        world=subject.world.scenes[0].world,
        scenes=len(episodes.scenes),
        rows=tuple(rows),
        episodes=len(episodes.goal),
        parameters=subject.parameters,
        chosen=chosen,
        similarity=similarity,
        gains=gains,
        effects=outcomes["novelty"].effects(Trial("stde", "argmax", *THRESHOLD), Trial("layout")),
    )


def _plain_trials(decodings: Sequence[Decoding], with_baseline: bool) -> list[Trial]:
    """Return the trials without sTDE."""
    variants: tuple[Variant, ...] = ("baseline", "layout", "tde")
    return [Trial(variant, decoding) for variant in variants[not with_baseline :] for decoding in decodings]


def _stde_outcomes(subject: Subject, gap: Gap, bench: Bench, epsilons: Sequence[float]) -> dict[Trial, Outcome]:
    """Evaluate sTDE and its controls with one gap.

    The epsilons are for `novelty` alone.
    """
    uses = USES.values()
    trials = [Trial("stde", decoding, *use) for use in uses for decoding in DECODINGS]
    if gap == "novelty":
        trials += [Trial("stde", "argmax", epsilon, form) for form in SWEPT for epsilon in epsilons]
    if gap == "clock":
        return bench.outcomes(subject, gap, trials)
    trials += [Trial("stde", decoding, *use, control) for use in uses for control, decoding in CONTROLS]
    outcomes = bench.outcomes(subject, gap, trials)
    weights = {use: mean_weight(outcomes[Trial("stde", "argmax", *use)]) for use in uses}
    constants = [Trial("stde", "argmax", *use, "constant", weight=weight) for use, weight in weights.items()]
    return outcomes | bench.outcomes(subject, gap, constants)


def _by_similarity(subject: Subject, outcomes: TrialOutcomes) -> tuple[SuccessBySimilarity, Gains]:
    """Relate success and gains to layout similarity."""
    policies, world, episodes = subject
    bank = world.banks[0]
    room = np.asarray(world.params(0).room)[: len(bank.names)]
    points = similarity_points(episodes, scene_counts(bank), np.asarray(policies.counts, np.float64)[room])
    baseline = outcomes.success(Trial("baseline"))

    def gain(trial: Trial) -> GainBySimilarity:
        success = outcomes.success(trial)
        return gain_by_similarity(points, baseline, success, world.env.categories)

    return success_by_similarity(points, baseline), Gains(
        gain(Trial("layout")), gain(Trial("stde", "argmax", *THRESHOLD))
    )
