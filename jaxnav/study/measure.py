"""The parts of the study: every trial at one shift of the layout, and the course of the gap."""

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.evaluation.grid import Evaluator, Outcome
from jaxnav.evaluation.report import Decoding, Form
from jaxnav.evaluation.similarity import scene_counts
from jaxnav.layout import SETTINGS, Setting
from jaxnav.policies.acting import Acting
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.config import RunConfig
from jaxnav.runs.policies import Policies, load_policies
from jaxnav.runs.worlds import CompiledWorld, evaluation_world
from jaxnav.study.association import gain_by_similarity, success_by_similarity
from jaxnav.study.claims import select
from jaxnav.study.config import StudyConfig
from jaxnav.study.tracking import FROZEN, UPDATED, Course, auc_by_step, gap_traces, mean_by_step
from jaxnav.study.trials import USES, Control, Results, Trial, mean_weight, trial_grid
from jaxnav.training.calibration import layout_priors

DECODINGS: tuple[Decoding, ...] = ("argmax", "sample")
FORMS: tuple[Form, ...] = ("residual", "paper")
#: What is changed about sTDE with best actions; zeros, which cannot change these, with sampled ones. The constant needs
#: the mean weight, so it comes later.
CONTROLS: tuple[tuple[Control, Decoding], ...] = (
    ("shuffled", "argmax"),
    ("noise", "argmax"),
    ("random", "argmax"),
    ("zeros", "sample"),
)


class Bench:
    """Evaluates trials in blocks of one size, so that all that is alike is compiled once."""

    BLOCK = 2

    def __init__(self, config: StudyConfig) -> None:
        self.config = config
        self._evaluators: dict[tuple[Acting, PolicySpec], Evaluator] = {}

    def outcomes(
        self, world: CompiledWorld, episodes: EpisodeList, policies: Policies, gap: str, trials: Iterable[Trial]
    ) -> dict[Trial, Outcome]:
        """The outcomes of each trial, leaves [S, E]."""
        trials, seeds = list(dict.fromkeys(trials)), self.config.base.seeds
        acting = Acting(world.env, gap_settings(policies.setting)[gap])
        evaluator = self._evaluators.setdefault((acting, policies.spec), Evaluator(acting, policies.spec))
        found: dict[Trial, Outcome] = {}
        params = world.params(0)
        for first in range(0, len(trials), self.BLOCK):
            block = trials[first : first + self.BLOCK]
            filled = block + block[-1:] * (self.BLOCK - len(block))
            outcome = evaluator(
                trial_grid(filled, seeds),
                policies.params,
                [(episodes, params)],
                policies.priors,
                jax.random.key(self.config.seed),
            )
            for i, trial in enumerate(block):
                found[trial] = jax.tree.map(lambda leaf, i=i: leaf[i * seeds : (i + 1) * seeds], outcome)
        return found


def table(run: RunConfig, full: bool, shift: float, bench: Bench, console: Console) -> dict[str, Any]:
    """The trials of a run at one shift: those of Table 1 with best actions, or in `full` all, and Figs. 4 and 5."""
    config, both = bench.config, "baseline" in run.arms
    world = evaluation_world(run, config.split, None, shift, console)
    episodes, policies = _episodes(world, config), load_policies(run, run.arms)
    if not both:
        policies = policies._replace(params=jax.tree.map(lambda x: jnp.concatenate([x, x]), policies.params))
    rows: list[dict[str, Any]] = []

    def add(gap: str, outcomes: Mapping[Trial, Outcome]) -> Results:
        results = Results(outcomes, episodes)
        # Without sTDE the gap is of no effect.
        own = (row for row in results.rows(config.seed) if row["variant"] == "stde" or gap == "novelty")
        rows.extend({"gap": gap, **row} for row in own)
        return results

    about = {"shift": shift, "world": world.scenes[0].world, "scenes": len(episodes.scenes), "rows": rows}
    about |= {"episodes": len(episodes.goal), "parameters": sum(x[0].size for x in jax.tree.leaves(policies.params))}
    plain = bench.outcomes(world, episodes, policies, "novelty", _plain(DECODINGS if full else ("argmax",), both))
    if not full:
        uses = [Trial("stde", "argmax", *use) for use in USES]
        add("novelty", plain | bench.outcomes(world, episodes, policies, "novelty", uses))
        return about
    if config.split == "test":
        about["chosen"] = chosen(config)
    for gap in ("novelty", "evidence", "clock"):
        trials = [Trial("stde", decoding, *use) for use in USES for decoding in DECODINGS]
        if gap == "novelty":
            epsilons = (
                {*config.epsilon, *(epsilon for epsilon, _ in USES)} if config.split == "val" else {chosen(config)}
            )
            trials += [Trial("stde", "argmax", epsilon, form) for form in FORMS for epsilon in sorted(epsilons)]
        if gap != "clock":
            trials += [Trial("stde", decoding, *use, control) for use in USES for control, decoding in CONTROLS]
        found = bench.outcomes(world, episodes, policies, gap, trials)
        if gap != "clock":
            weights = {use: mean_weight(found[Trial("stde", "argmax", *use)]) for use in USES}
            constants = [Trial("stde", "argmax", *use, "constant", weight) for use, weight in weights.items()]
            found |= bench.outcomes(world, episodes, policies, gap, constants)
        results = add(gap, plain | found)
        if gap == "novelty":
            about |= _similarity(world, episodes, policies, results, config)
    return about


def gap_settings(setting: Setting) -> dict[str, Setting]:
    """The ways to measure the gap for policies of one setting: none of them changes the layout's weights.

    `clock` is what the released code's gap comes to: all at once when something new is seen, then gone in steps.
    """
    return {
        "novelty": setting,
        "evidence": dataclasses.replace(setting, gap="evidence"),
        "clock": dataclasses.replace(setting, gap="clock", passes=SETTINGS["released"].passes),
    }


def chosen(config: StudyConfig) -> float:
    """Epsilon of the greatest SR on `val` at the first shift, eq. 5's gap, residual form.

    Raises:
      InputError: the study has not been done on `val`.
    """
    path = config.results / "val" / f"main-shift{config.shifts[0]:g}.json"
    if not path.exists():
        raise InputError(f"{path}: is missing; run the study with --split val first, epsilon is chosen there")
    return max(
        select(json.loads(path.read_text()), variant="stde", form="residual"), key=lambda row: row["sr"]["mean"]
    )["epsilon"]


def _plain(decodings: Sequence[Decoding], baseline: bool = True) -> list[Trial]:
    variants = ("baseline", "layout", "tde") if baseline else ("layout", "tde")
    return [Trial(variant, decoding) for variant in variants for decoding in decodings]


def _episodes(world: CompiledWorld, config: StudyConfig) -> EpisodeList:
    if len(world.banks) > 1:
        raise InputError("study: takes as many scenes of a split as fit into one shard; give more --shard-scenes")
    return episode_list(world.banks[0], config.episodes, config.seed)


def _similarity(
    world: CompiledWorld, episodes: EpisodeList, policies: Policies, results: Results, config: StudyConfig
) -> dict[str, Any]:
    """Figures 4 and 5: success, and what is gained on it, against the layout's similarity to the prior."""
    bank = world.banks[0]
    room = np.asarray(world.params(0).room)[: len(bank.names)]
    about = episodes, scene_counts(bank), np.asarray(policies.counts, np.float64)[room]
    baseline = results.success(Trial("baseline", "argmax"))
    found = success_by_similarity(baseline, *about, np.random.default_rng(config.seed))
    gains = {}
    for name, trial in {"layout": Trial("layout", "argmax"), "stde": Trial("stde", "argmax", *USES[0])}.items():
        gain = gain_by_similarity(baseline, results.success(trial), *about, np.random.default_rng(config.seed))
        gains[name] = _lists(gain) | {"categories": [world.env.categories[k] for k in gain.category]}
    return {"similarity": _lists(found), "gains": gains}


def _lists(values: Any) -> dict[str, Any]:
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values._asdict().items()
    }


def gaps(run: RunConfig, config: StudyConfig, console: Console) -> dict[str, Any]:
    """The gap step by step in every setting, at every shift, and whether it tells a shift from none."""
    policies = load_policies(run)
    own = gap_settings(policies.setting)
    named = {"paper": SETTINGS["paper"], "released": SETTINGS["released"]}
    named |= {"calibrated": own["novelty"], "evidence": own["evidence"]}
    priors = jnp.stack([layout_priors(policies.counts, setting) for setting in named.values()])
    layouts = jax.tree.map(lambda leaf: leaf[run.seeds :], policies.params)
    traces = []
    for shift in config.shifts:
        world = evaluation_world(run, config.split, None, shift, console)
        acting, key = Acting(world.env, policies.setting), jax.random.key(config.seed)
        walked = _episodes(world, config), world.params(0), acting, policies.spec, policies.priors
        traces.append(gap_traces(layouts, *walked, list(named.values()), priors, config.steps, key))
    # Steps at which an episode still runs at every shift.
    steps = min(int(own.running.any(axis=(0, 1)).sum()) for own in traces)
    traces = [own._replace(gap=own.gap[..., :steps], running=own.running[..., :steps]) for own in traces]
    courses = [mean_by_step(own, np.random.default_rng(config.seed)) for own in traces]
    tells = [auc_by_step(own, traces[0], np.random.default_rng(config.seed)) for own in traces[1:]]
    beliefs = {"updated": UPDATED, "frozen": FROZEN}
    panels = [
        {
            "setting": name,
            "lines": [
                {"shift": shift, "belief": belief, **_line(course, i, which)}
                for shift, course in zip(config.shifts, courses, strict=True)
                for belief, which in beliefs.items()
            ],
        }
        for i, name in enumerate(named)
    ]
    auc = [
        {"shift": shift, "lines": [{"setting": name, **_line(tell, i, UPDATED)} for i, name in enumerate(named)]}
        for shift, tell in zip(config.shifts[1:], tells, strict=True)
    ]
    running = [own.running.mean(axis=(0, 1)).tolist() for own in traces]
    return {"steps": list(range(steps)), "running": running, "panels": panels, "auc": auc}


def _line(course: Course, setting: int, belief: int) -> dict[str, list[float]]:
    return {name: getattr(course, name)[setting, belief].tolist() for name in ("mean", "low", "high")}
