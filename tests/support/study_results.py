"""Results of a study with numbers that differ plainly."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.statistics import Interval
from jaxnav.runs.policies import GapName
from jaxnav.study.records import (
    BASELINE_MEASURES,
    DIFFICULTY_MEASURES,
    MEASURES,
    STDE_OPTIONS,
    AucLine,
    AucPanel,
    Belief,
    Condition,
    Curve,
    FullCondition,
    GainBySimilarity,
    Gains,
    GapCurves,
    GapLine,
    GapPanel,
    InstrumentReport,
    MeasureChange,
    PairedDifference,
    SceneEffects,
    ShiftMeasures,
    SuccessBySimilarity,
    Trial,
    TrialControl,
    TrialRow,
    to_json,
)
from jaxnav.study.results import StudyResults, WorldResults, condition_name

RUNS = ("main", "coin", "gate")
SHIFTS, EPSILONS = (0.0, 1.0), (0.0, 0.5, 1.0)
STEPS = 30
STUDY = {"shifts": list(SHIFTS), "episodes": 1000, "base": {"seeds": 3, "total_steps": 1_000_000}}
Part = Condition | InstrumentReport | GapCurves


def interval(mean: float, half: float = 1.0) -> Interval:
    return Interval(mean, mean - half, mean + half)


def effect(mean: float) -> Interval:
    return Interval(mean, mean - 1.0, mean + 1.0, 0.5)


def estimate(mean: float) -> Interval:
    return Interval(mean, mean - 1.0, mean + 1.0, 0.5, (mean - 1.0, mean, mean + 1.0))


def row(trial: Trial, gain: float | None, gap: GapName = "novelty") -> TrialRow:
    """Return a row with this difference in SR."""
    to = "baseline" if trial.variant == "layout" else "layout"
    return TrialRow(
        gap=gap,
        trial=trial,
        mean_weight=0.25,
        sr=estimate(60.0 + (gain or 0.0)),
        spl=estimate(30.0),
        dts=estimate(1.5),
        difference=None if gain is None else PairedDifference(to, effect(gain), effect(0.0), effect(0.0)),
    )


def rows(shift: float, run: str = "main") -> list[TrialRow]:
    """Return every row of a run at one shift.

    `main` gains nothing by sTDE at shift 0, 2 points at shift 1, 5 without a threshold. `coin` has the layout arm
    alone. Sampled effects are 100 more, to tell them apart.
    """
    table = [] if run == "coin" else [row(Trial("baseline"), None)]
    table += [row(Trial("layout"), 3.0 - 2 * shift), row(Trial("tde"), -6.0 + shift)]
    if run != "main":
        return table + [row(Trial("stde", "argmax", *use), 2.0 * shift) for use in STDE_OPTIONS.values()]
    table += [row(Trial("baseline", "sample"), None)]
    table += [row(Trial("layout", "sample"), 101.0), row(Trial("tde", "sample"), 95.0)]
    for epsilon in EPSILONS:
        table.append(row(Trial("stde", "argmax", epsilon, "residual"), 2.0 * shift))
        table.append(row(Trial("stde", "argmax", epsilon, "paper"), 5.0 * shift))
    controls: tuple[TrialControl, ...] = ("constant", "shuffled", "noise", "random")
    gaps: tuple[GapName, ...] = ("novelty", "evidence")
    for use in STDE_OPTIONS.values():
        table.append(row(Trial("stde", "sample", *use), 100.0))
        table.append(row(Trial("stde", "argmax", *use), 0.5 * shift, "clock"))
        table.append(row(Trial("stde", "argmax", *use), 4.0 * shift, "evidence"))
        table.append(row(Trial("stde", "sample", *use), 4.0 * shift + 100.0, "evidence"))
        for gap in gaps:
            table += [row(Trial("stde", "argmax", *use, control), 0.25, gap) for control in controls]
            table.append(row(Trial("stde", "sample", *use, "zeros"), 100.25, gap))
    return table


def success(pearson: float) -> SuccessBySimilarity:
    return SuccessBySimilarity(
        category=np.array([0, 1]),
        scene=np.array([0, 1]),
        episodes=np.array([4, 6]),
        similarity=np.array([0.4, 0.8]),
        success=np.array([0.5, 0.75]),
        left_out=1,
        pearson=interval(pearson, 0.1),
        spearman=interval(pearson, 0.2),
    )


def gain(slope: float) -> GainBySimilarity:
    return GainBySimilarity(
        category=np.array([0, 1]),
        episodes=np.array([4, 6]),
        similarity=np.array([0.4, 0.8]),
        baseline=np.array([50.0, 70.0]),
        gain=np.array([6.0, 1.0]),
        left_out=1,
        slope=interval(slope, 0.25),
        pearson=interval(-0.5, 0.1),
        categories=("Book", "Chair"),
    )


def effects(shift: float) -> SceneEffects:
    """Return effects of three runs in four scenes.

    They are 1, 2, 2 and 3 points times the shift in every run, over five episodes a scene.
    """
    return SceneEffects(
        scenes=("a", "b", "c", "d"),
        rooms=("kitchen",) * 4,
        episodes=np.full(4, 5),
        gain=np.tile(5.0 * shift * np.array([1.0, 2.0, 2.0, 3.0]), (3, 1)),
    )


def condition(shift: float, run: str = "main") -> Condition:
    table = tuple(rows(shift, run))
    return Condition(shift=shift, world="rooms", scenes=80, rows=table, episodes=1000, parameters=12_345)


def full_condition(shift: float, chosen_epsilon: float | None = None) -> FullCondition:
    return FullCondition(
        shift=shift,
        world="rooms",
        scenes=80,
        rows=tuple(rows(shift)),
        episodes=1000,
        parameters=12_345,
        chosen=chosen_epsilon,
        similarity=success(0.3 - 0.2 * shift),
        gains=Gains(gain(-1.5 - shift), gain(-1.5 - shift)),
        effects=effects(shift),
    )


def band(mean: np.ndarray, half: float = 0.01) -> Curve:
    return Curve(mean, mean - half, mean + half)


def line(start: float, end: float) -> Curve:
    """Return a line from step 0 through step 20."""
    return band(start + (end - start) * np.arange(STEPS) / 20)


def course() -> GapCurves:
    """Return a gap that falls from 0.9 at step 0.

    It is 0.2 at step 20, or 0.8 if frozen.
    `evidence` shows the shift, eq. 5 does not.
    """
    settings = ("paper", "released", "calibrated", "evidence")
    ends: dict[Belief, float] = {"updated": 0.2, "frozen": 0.8}
    lines = [GapLine(shift, belief, line(0.9 - 0.1 * shift, end)) for shift in SHIFTS for belief, end in ends.items()]
    aucs = [AucLine(setting, line(0.5, 0.75 if setting == "evidence" else 0.5)) for setting in settings]
    return GapCurves(
        steps=tuple(range(STEPS)),
        running=np.stack([1.0 - np.arange(STEPS) / STEPS for _ in SHIFTS]),
        panels=tuple(GapPanel(setting, tuple(lines)) for setting in settings),
        auc=tuple(AucPanel(shift, tuple(aucs)) for shift in SHIFTS[1:]),
    )


def instrument(loss: float = 9.0) -> InstrumentReport:
    """Return a report in which sampled actions lose 12 points."""
    measures = {shift: dict.fromkeys(MEASURES, interval(10.0 + shift, 0.5)) for shift in SHIFTS}
    losses = zip(BASELINE_MEASURES, (loss, 12.0), strict=True)
    return InstrumentReport(
        shifts=tuple(ShiftMeasures(shift, 80, 1000, measures[shift]) for shift in SHIFTS),
        matched=tuple(
            MeasureChange(name, SHIFTS[0], SHIFTS[-1], interval(0.5, 0.25), True) for name in DIFFICULTY_MEASURES
        ),
        discriminating=tuple(MeasureChange(name, SHIFTS[0], SHIFTS[-1], interval(loss), True) for name, loss in losses),
    )


def world_results() -> WorldResults:
    return WorldResults(tuple(full_condition(shift) for shift in SHIFTS), instrument(), course())


def results(worlds: tuple[str, ...] = ("main",), runs: tuple[str, ...] = RUNS) -> StudyResults:
    """Return the results of some worlds and runs."""
    names = sorted({*runs, *worlds}, key=lambda name: (name != "main", name))
    conditions = {
        name: tuple(condition(shift, "main" if name in worlds else name) for shift in SHIFTS) for name in names
    }
    return StudyResults(SHIFTS, 1000, 3, 1_000_000, {world: world_results() for world in worlds}, conditions)


def parts(worlds: tuple[str, ...] = ("main",), runs: tuple[str, ...] = RUNS) -> dict[str, Part]:
    """Return the parts of the results by name."""
    records: dict[str, Part] = {condition_name(run, shift): condition(shift, run) for run in runs for shift in SHIFTS}
    for world in worlds:
        records |= {condition_name(world, shift): full_condition(shift) for shift in SHIFTS}
        records |= {f"instrument-{world}": instrument(), f"gap-{world}": course()}
    return records


def write(folder: Path, records: Mapping[str, Part], study: Mapping = STUDY) -> None:
    """Write parts as files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, record in records.items():
        (folder / f"{name}.json").write_text(json.dumps({"study": study, **to_json(record)}))


def episodes_in(
    scene: Sequence[int] | np.ndarray,
    goal: Sequence[int] | np.ndarray | None = None,
    room: Sequence[int] | None = None,
    names: tuple[str, ...] | None = None,
    best_length: int | np.ndarray = 1,
) -> EpisodeList:
    """Return episodes in these scenes.

    Scenes are of one room type unless `room` [N] says otherwise.
    """
    scene = np.asarray(scene, np.int32)
    rooms = np.zeros(scene.max() + 1, int) if room is None else np.array(room)
    return EpisodeList(
        scene=scene,
        goal=np.zeros(len(scene), np.int32) if goal is None else np.asarray(goal, np.int32),
        pose=np.ones(len(scene), np.int32),
        best_length=np.full(len(scene), best_length, np.int32),
        room=rooms[scene],
        rooms=("bedroom", "kitchen"),
        scenes=tuple(f"room{i:02}" for i in range(scene.max() + 1)) if names is None else names,
    )
