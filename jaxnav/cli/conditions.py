"""The parts of the study: every trial at one shift of the layout, and the course of the gap."""

import dataclasses
import json
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxnav.cli.config import RunConfig
from jaxnav.cli.runs import Policies, load_policies
from jaxnav.cli.trainings import StudyConfig
from jaxnav.cli.worlds import CompiledWorld, evaluation_world
from jaxnav.errors import InputError
from jaxnav.evaluation.association import gain_by_similarity, success_by_similarity
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.evaluation.grid import evaluate_grid
from jaxnav.evaluation.report import Decoding, Form
from jaxnav.evaluation.similarity import scene_counts
from jaxnav.evaluation.tracking import FROZEN, UPDATED, Course, auc_by_step, gap_traces, mean_by_step
from jaxnav.evaluation.trials import CONTROLS, Results, Trial, trial_grid
from jaxnav.layout import SETTINGS, Setting
from jaxnav.policies.acting import Acting
from jaxnav.training.calibration import layout_priors

DECODINGS: tuple[Decoding, ...] = ("argmax", "sample")
FORMS: tuple[Form, ...] = ("residual", "paper")
#: The two uses of sTDE that controls are run for: the paper's threshold, and all there is to take out.
REFERENCES: tuple[tuple[float, Form], ...] = ((0.5, "residual"), (0.0, "paper"))


class Condition(NamedTuple):
    """Where policies are put to the test.

    Attributes:
      run: the run that has all trials, and whose scenes they are.
      others: by name, runs that have the main ones.
      shift: of the layout.
    """

    run: RunConfig
    others: dict[str, RunConfig]
    shift: float


def table(condition: Condition, config: StudyConfig, console: Console) -> dict[str, Any]:
    """Every trial of every run at one shift, and success against similarity."""
    run = condition.run
    world = evaluation_world(run, config.split, None, condition.shift, console)
    episodes = _episodes(world, config)
    policies, rows = load_policies(run), []

    def add(name: str, policies: Policies, gap: str, trials: Sequence[Trial]) -> Results:
        setting = gap_settings(policies.setting)[gap]
        results = _evaluate(world, episodes, policies, setting, trials, run.seeds, config.seed)
        for row in results.rows(config.seed):
            new = row["variant"] == "stde" or gap == "novelty"  # without sTDE the gap is of no effect
            rows.extend([{"training": name, "gap": gap, **row}] if new else [])
        return results

    epsilons = sorted({0.0, 0.5, 1.0, *(config.epsilon if config.split == "val" else (chosen(config)[0],))})
    own = add("main", policies, "novelty", [*_plain(), *_sweep(epsilons), *_controls()])
    add("main", policies, "novelty", [*_plain(), *_constants(own)])
    evidence = add("main", policies, "evidence", [*_plain(), *_sweep(epsilons), *_controls()])
    add("main", policies, "evidence", [*_plain(), *_constants(evidence)])
    add("main", policies, "clock", [*_plain(), *_sweep((0.0, 0.5))])
    for name, other in condition.others.items():
        loaded = load_policies(other, other.arms)
        if "baseline" not in other.arms:
            loaded = loaded._replace(params=jax.tree.map(lambda x: jnp.concatenate([x, x]), loaded.params))
        add(name, loaded, "novelty", [*_plain("baseline" in other.arms), *_sweep((0.0, 0.5))])
    # Rows that came more than once, for others to be compared with, are the same to the bit.
    rows = list({json.dumps(row): row for row in rows}.values())
    about = {"shift": condition.shift, "world": world.scenes[0].world, "scenes": len(episodes.scenes)}
    return about | {"episodes": len(episodes.goal), "rows": rows} | _similarity(world, episodes, policies, own, config)


def gap_settings(setting: Setting) -> dict[str, Setting]:
    """The ways to measure the gap for policies of one setting: none of them changes the layout's weights.

    `clock` is what the released code's gap comes to: all at once when something new is seen, then gone in steps.
    """
    return {
        "novelty": setting,
        "evidence": dataclasses.replace(setting, gap="evidence"),
        "clock": dataclasses.replace(setting, gap="clock", passes=SETTINGS["released"].passes),
    }


def chosen(config: StudyConfig) -> tuple[float, str]:
    """Epsilon and form of the greatest SR on `val` at the first shift, sampled actions, eq. 5's gap.

    Raises:
      InputError: the study has not been done on `val`.
    """
    path = config.results / "val" / f"main-shift{config.shifts[0]:g}.json"
    if not path.exists():
        raise InputError(f"{path}: is missing; run the study with --split val first, epsilon is chosen there")
    rows = [row for row in json.loads(path.read_text())["rows"] if _is_sweep(row)]
    best = max(rows, key=lambda row: row["sr"]["mean"])
    return best["epsilon"], best["form"]


def _is_sweep(row: dict[str, Any]) -> bool:
    wanted = {"training": "main", "gap": "novelty", "variant": "stde", "decoding": "sample", "control": None}
    return all(row[key] == value for key, value in wanted.items())


def _plain(baseline: bool = True) -> Iterator[Trial]:
    for decoding in DECODINGS:
        if baseline:
            yield Trial("baseline", decoding)
        yield from (Trial("layout", decoding), Trial("tde", decoding))


def _sweep(epsilons: Sequence[float]) -> Iterator[Trial]:
    for decoding in DECODINGS:
        for form in FORMS:
            yield from (Trial("stde", decoding, epsilon, form) for epsilon in epsilons)


def _controls() -> Iterator[Trial]:
    for decoding in DECODINGS:
        for epsilon, form in REFERENCES:
            yield from (
                Trial("stde", decoding, epsilon, form, control) for control in CONTROLS if control != "constant"
            )


def _constants(results: Results) -> Iterator[Trial]:
    for decoding in DECODINGS:
        for epsilon, form in REFERENCES:
            weight = results.mean_weight(Trial("stde", decoding, epsilon, form))
            yield Trial("stde", decoding, epsilon, form, "constant", weight)


def _episodes(world: CompiledWorld, config: StudyConfig) -> EpisodeList:
    if len(world.banks) > 1:
        raise InputError("study: takes as many scenes of a split as fit into one shard; give more --shard-scenes")
    return episode_list(world.banks[0], config.episodes, config.seed)


def _evaluate(
    world: CompiledWorld,
    episodes: EpisodeList,
    policies: Policies,
    setting: Setting,
    trials: Sequence[Trial],
    num_seeds: int,
    seed: int,
) -> Results:
    trials = list(dict.fromkeys(trials))
    outcome, _ = evaluate_grid(
        trial_grid(trials, num_seeds),
        policies.params,
        [(episodes, world.params(0))],
        Acting(world.env, setting),
        policies.spec,
        policies.priors,
        jax.random.key(seed),
    )
    outcome = jax.tree.map(lambda leaf: leaf.reshape(len(trials), num_seeds, -1), outcome)
    return Results(trials, outcome, episodes.best_length, episodes.room)


def _similarity(
    world: CompiledWorld, episodes: EpisodeList, policies: Policies, results: Results, config: StudyConfig
) -> dict[str, Any]:
    """Figures 4 and 5: success, and what is gained on it, against the layout's similarity to the prior."""
    bank = world.banks[0]
    room = np.asarray(world.params(0).room)[: len(bank.names)]
    about = episodes, scene_counts(bank), np.asarray(policies.counts, np.float64)[room]
    baseline = results.success(Trial("baseline", "sample"))
    found = success_by_similarity(baseline, *about, np.random.default_rng(config.seed))
    gains = {}
    for name, trial in {"layout": Trial("layout", "sample"), "stde": Trial("stde", "sample", *REFERENCES[0])}.items():
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
