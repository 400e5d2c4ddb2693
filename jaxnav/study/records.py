"""Records of the study's results, and how they are stored as JSON.

Every result file holds one record, a frozen dataclass: the trials of a run at one layout shift (`Condition`), the
layout gap step by step (`GapCurves`), removal of experience in a mixed population (`MixtureReport`), the effect of the
layout shift on a run (`InstrumentReport`), or one run of a method comparison (`RunScores`). `to_json` and `from_json`
convert between records and JSON.

JSON keys are field names, except where the metadata of a field says otherwise: `INLINE` merges the keys of its value
into those of the record, `OPTIONAL` omits None, and `json_key("from")` sets another key. An `Interval` has its own JSON
form.

SR, SPL, gains and their differences are in percent or percentage points and DTS in metres, unless stated otherwise.
"""

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeVar, Union

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table
from rich.text import Text

from jaxnav.causal import Form
from jaxnav.evaluation.removal import GapSource, InferenceConfig, RemovedLogits
from jaxnav.evaluation.report import UNTRAINED_VARIANTS, Decoding
from jaxnav.evaluation.statistics import Clusters, Interval, mean_interval, paired_difference, scene_clusters
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.runs.policies import GapName
from jaxnav.scenes.scene import floor_plan_name

# Records as JSON

RecordType = TypeVar("RecordType")

INLINE = types.MappingProxyType({"inline": True})
OPTIONAL = types.MappingProxyType({"optional": True})


def json_key(name: str) -> dict[str, str]:
    """Field metadata that sets the JSON key of a field."""
    return {"key": name}


def to_json(value: Any) -> Any:
    """Convert a record, or the value of a field, to JSON."""
    if isinstance(value, Interval):
        return value.to_json()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _record_to_json(value)
    if isinstance(value, np.ndarray):
        return [to_json(item) for item in value.tolist()]
    if isinstance(value, float) and math.isnan(value):
        return None
    if isinstance(value, Mapping):
        return {name: to_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    return value


def _record_to_json(record: Any) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for field in dataclasses.fields(record):
        field_value = getattr(record, field.name)
        is_omitted = field_value is None and field.metadata.get("optional")

        if field.metadata.get("inline"):
            data |= to_json(field_value)
        elif not is_omitted:
            data[_field_key(field)] = to_json(field_value)
    return data


def from_json(record_type: type[RecordType], data: Mapping[str, Any]) -> RecordType:
    """Read a record from JSON; unknown keys are ignored.

    Raises:
      KeyError: a key is missing.
    """
    return _decode(record_type, data)


def _decode(expected_type: Any, value: Any) -> Any:
    """Decode a JSON value as the type that a field is annotated with."""
    origin = typing.get_origin(expected_type)
    arguments = typing.get_args(expected_type)

    if value is None or expected_type is Any:
        return value
    if origin in (Union, types.UnionType):
        return _decode(arguments[0], value)  # X | None
    if origin is tuple:
        return tuple(_decode(arguments[0], item) for item in value)
    if origin is Mapping:
        return {name: _decode(arguments[1], item) for name, item in value.items()}
    if expected_type is np.ndarray:
        array = np.asarray(value)
        return array.astype(np.float64) if array.dtype == object else array  # null becomes NaN
    if expected_type is Interval:
        return Interval.from_json(value)
    if dataclasses.is_dataclass(expected_type):
        return _decode_record(expected_type, value)
    return value


def _decode_record(record_type: Any, data: Mapping[str, Any]) -> Any:
    fields = dataclasses.fields(record_type)
    field_types = _field_types(record_type)

    # An inline field reads its own keys from all those that no field of the record claims.
    claimed_keys = {_field_key(field) for field in fields}
    inline_data = {name: item for name, item in data.items() if name not in claimed_keys}

    field_values = {}
    for field in fields:
        field_key = _field_key(field)
        field_type = field_types[field.name]
        if field.metadata.get("inline"):
            field_values[field.name] = _decode(field_type, inline_data)
        elif field_key in data or not field.metadata.get("optional"):
            field_values[field.name] = _decode(field_type, data[field_key])
    return record_type(**field_values)


def _field_key(field: dataclasses.Field) -> str:
    return field.metadata.get("key", field.name)


@functools.cache
def _field_types(record_type: type) -> dict[str, Any]:
    return typing.get_type_hints(record_type)


# Trials: ways to use the policies of a run at inference

#: Gaps that are independent of the episode: `course` is the mean gap of all episodes at that time; `after` and `until`
#: are 1 after or until a step, and 0 at other times.
GapSchedule = Literal["course", "after", "until"]
#: Modification of sTDE by a control. The gap: that of another episode (`shuffled`), or `constant`, such that the weight
#: is its mean at every step. The removed logits: `zeros` or `noise`. The intervention: `random` instead of zero.
TrialControl = Literal["shuffled", "constant", "zeros", "noise", "random"]
TrialVariant = Literal["baseline", "layout", "tde", "stde"]


class StdeOptions(NamedTuple):
    """Threshold and form of sTDE."""

    epsilon: float
    form: Form


#: A step that no episode reaches.
NEVER = 2**30
SWEPT_FORMS: tuple[Form, ...] = ("residual", "paper")
#: The paper's threshold, and no threshold in the paper's form; both are evaluated with all gaps and controls.
PAPER_THRESHOLD = StdeOptions(0.5, "residual")
ZERO_THRESHOLD = StdeOptions(0.0, "paper")
STDE_OPTIONS: Mapping[str, StdeOptions] = {
    "sTDE (eps 0.5)": PAPER_THRESHOLD,
    "sTDE (eps 0, paper's form)": ZERO_THRESHOLD,
}


@dataclasses.dataclass(frozen=True)
class Trial:
    """One way to use the policies of a run.

    Attributes:
      variant: `baseline`, `layout`, `tde` or `stde`.
      decoding: of actions.
      epsilon, form: threshold and form of sTDE.
      control: modification of sTDE; None for sTDE itself.
      step: step of the schedules `after` and `until`.
      weight: weight of the control `constant`; ignored in comparisons of trials.
    """

    variant: TrialVariant
    decoding: Decoding = "argmax"
    epsilon: float | None = None
    form: Form | None = None
    control: TrialControl | GapSchedule | None = None
    step: int | None = dataclasses.field(default=None, metadata=OPTIONAL)
    weight: float = dataclasses.field(default=0.0, compare=False)

    def grid_cells(self, arms: Sequence[str], num_seeds: int) -> InferenceConfig:
        """Cells of the evaluation grid, leaves [S]; see `inference_grid`."""
        row = table_row(self.variant, self.epsilon, self.form, self.decoding)
        cells = inference_grid([row], arms, num_seeds)

        replaced = {}
        for name, value in self._control_settings().items():
            replaced[name] = jnp.broadcast_to(value, (num_seeds,))
        return cells.replace(**replaced)

    def _control_settings(self) -> dict[str, jax.Array]:
        """Fields of `InferenceConfig` that the control changes."""
        match self.control:
            case "shuffled":
                return {"gap_source": jnp.int32(GapSource.OTHER)}
            case "course":
                return {"gap_source": jnp.int32(GapSource.MEAN)}
            case "constant":
                return _given_gap(self.weight, 0, NEVER) | {"epsilon": jnp.float32(0.0)}
            case "after":
                return _given_gap(1.0, self._schedule_step, NEVER)
            case "until":
                return _given_gap(1.0, 0, self._schedule_step)
            case "zeros":
                return {"removed": jnp.int32(RemovedLogits.ZEROS)}
            case "noise":
                return {"removed": jnp.int32(RemovedLogits.NOISE)}
            case "random":
                return {"intervention": jnp.float32(1.0)}
            case None:
                return {}

    @property
    def _schedule_step(self) -> int:
        if self.step is None:
            raise ValueError(f"{self.control}: give its step")
        return self.step


def _given_gap(gap: float, begin: int, end: int) -> dict[str, jax.Array]:
    """Settings for a constant gap from step `begin` to before step `end`."""
    return {
        "gap_source": jnp.int32(GapSource.GIVEN),
        "given_gap": jnp.float32(gap),
        "gap_begin": jnp.int32(begin),
        "gap_end": jnp.int32(end),
    }


def trial_grid(trials: Sequence[Trial], arms: Sequence[str], num_seeds: int) -> InferenceConfig:
    """Cells of the evaluation grid for all trials, leaves [T S]."""
    cells = [trial.grid_cells(arms, num_seeds) for trial in trials]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *cells)


# Layout gap, step by step

#: A belief is updated by observations (eq. 4), or stays at the prior.
Belief = Literal["updated", "frozen"]


@dataclasses.dataclass(frozen=True, eq=False)
class Curve:
    """A statistic by step with its 95 % interval.

    Attributes:
      mean, low, high: float64 [..., T]; NaN where the statistic is undefined.
    """

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def from_intervals(cls, intervals: Sequence[Interval]) -> "Curve":
        """Make a curve from one interval per step."""
        bounds = [(interval.mean, interval.low, interval.high) for interval in intervals]
        return cls(*np.array(bounds, np.float64).T)

    def select(self, *index: int) -> "Curve":
        """Select one of several curves, leaves [T]."""
        return Curve(self.mean[index], self.low[index], self.high[index])

    def interval_at(self, step: int) -> Interval:
        """Interval of one step, from leaves [T]."""
        return Interval(float(self.mean[step]), float(self.low[step]), float(self.high[step]))


@dataclasses.dataclass(frozen=True)
class GapLine:
    """Mean gap at one layout shift."""

    shift: float
    belief: Belief
    curve: Curve = dataclasses.field(metadata=INLINE)


@dataclasses.dataclass(frozen=True)
class GapPanel:
    """Mean gaps of one estimator setting."""

    setting: str
    lines: tuple[GapLine, ...]


@dataclasses.dataclass(frozen=True)
class AucLine:
    """AUC of the gap of one estimator setting."""

    setting: str
    curve: Curve = dataclasses.field(metadata=INLINE)


@dataclasses.dataclass(frozen=True)
class AucPanel:
    """AUC by which the gap separates one shift from the first."""

    shift: float
    lines: tuple[AucLine, ...]

    def setting_curve(self, setting: str) -> Curve:
        """AUC of an estimator setting."""
        return next(line.curve for line in self.lines if line.setting == setting)


@dataclasses.dataclass(frozen=True, eq=False)
class GapCurves:
    """Layout gap D, step by step.

    Attributes:
      steps: [T].
      running: float64 [shifts, T], share of the episodes that are still running.
      panels: mean gaps (Fig. 6b), one panel per estimator setting.
      auc: one panel per shift except the first.
    """

    steps: tuple[int, ...]
    running: np.ndarray
    panels: tuple[GapPanel, ...]
    auc: tuple[AucPanel, ...]

    def mean_gap(self, setting: str, shift: float, belief: Belief) -> Curve:
        """Mean gap of an estimator setting at one shift."""
        panel = next(panel for panel in self.panels if panel.setting == setting)
        return next(line.curve for line in panel.lines if (line.shift, line.belief) == (shift, belief))

    def at_shifts(self, *shifts: float) -> "GapCurves":
        """Restrict the panels to some shifts."""
        panels = []
        for panel in self.panels:
            lines = tuple(line for line in panel.lines if line.shift in shifts)
            panels.append(GapPanel(panel.setting, lines))
        return dataclasses.replace(self, panels=tuple(panels))


# Trials of a run at one layout shift

StudyMetric = Literal["sr", "spl", "dts"]


@dataclasses.dataclass(frozen=True)
class PairedDifference:
    """Differences of a trial to another variant, paired on episodes."""

    to: TrialVariant
    sr: Interval
    spl: Interval
    dts: Interval


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrialRow:
    """Metrics of one trial.

    Attributes:
      gap: layout gap of sTDE; `novelty` for other variants.
      trial: the evaluated trial.
      mean_weight: weight of the removed logits, mean over all decisions.
      sr, spl, dts: metrics.
      difference: of `layout` to the baseline, of other variants to `layout`; None if the reference was not evaluated.
    """

    gap: GapName
    trial: Trial = dataclasses.field(metadata=INLINE)
    mean_weight: float
    sr: Interval
    difference: PairedDifference | None = dataclasses.field(default=None, metadata=OPTIONAL)
    spl: Interval
    dts: Interval

    def metric(self, name: StudyMetric) -> Interval:
        """One of the metrics."""
        return getattr(self, name)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Condition:
    """Trials of a run at one layout shift.

    Attributes:
      shift: layout shift.
      world: name of the world.
      scenes, episodes: number of scenes and of episodes.
      rows: one row per gap and trial.
      parameters: number of parameters of each policy.
      chosen: epsilon chosen on `val`; only on `test`.
    """

    shift: float
    world: str
    scenes: int
    rows: tuple[TrialRow, ...]
    episodes: int
    parameters: int
    chosen: float | None = dataclasses.field(default=None, metadata=OPTIONAL)

    def has_row(self, trial: Trial, gap: GapName = "novelty") -> bool:
        """True if the trial was evaluated with this gap."""
        return any(row.gap == gap and row.trial == trial for row in self.rows)

    def row(self, trial: Trial, gap: GapName = "novelty") -> TrialRow:
        """Row of a trial.

        Raises:
          KeyError: the trial was not evaluated with this gap.
        """
        for row in self.rows:
            if row.gap == gap and row.trial == trial:
                return row
        raise KeyError(f"no row of {trial} with gap {gap} at shift {self.shift:g}")

    def sr_difference(self, trial: Trial, gap: GapName = "novelty") -> Interval:
        """Paired difference in SR of a trial to its reference.

        Raises:
          KeyError: the trial or its reference was not evaluated.
        """
        difference = self.row(trial, gap).difference
        if difference is None:
            raise KeyError(f"{trial} is compared with nothing at shift {self.shift:g}")
        return difference.sr

    def rows_by_epsilon(self, form: Form) -> dict[float, TrialRow]:
        """Rows of sTDE with best actions, by epsilon."""
        by_epsilon = {}
        for row in self.rows:
            epsilon = row.trial.epsilon
            if epsilon is not None and row.gap == "novelty" and row.trial == Trial("stde", "argmax", epsilon, form):
                by_epsilon[epsilon] = row
        return by_epsilon


@dataclasses.dataclass(frozen=True, eq=False)
class SuccessBySimilarity:
    """Success against layout similarity (Fig. 4).

    There are P points, one per goal category and scene.

    Attributes:
      category, scene: int [P], indices.
      episodes: int [P].
      similarity: float64 [P], in [0, 1].
      success: float64 [P], success rate over episodes and seeds, 0 to 1.
      left_out: number of points without a similarity, because the scene or the prior shows the category with no other.
      pearson, spearman: correlation of success and similarity.
    """

    category: np.ndarray
    scene: np.ndarray
    episodes: np.ndarray
    similarity: np.ndarray
    success: np.ndarray
    left_out: int
    pearson: Interval
    spearman: Interval


@dataclasses.dataclass(frozen=True, eq=False)
class GainBySimilarity:
    """Gain of a variant against layout similarity (Fig. 5).

    There are C goal categories, over the episodes whose point (category, scene) has a similarity.

    Attributes:
      category: int [C], indices, rising.
      episodes: int [C].
      similarity: float64 [C], mean over the category's episodes, in [0, 1].
      baseline: float64 [C], SR of the baseline.
      gain: float64 [C], SR of the variant minus SR of the baseline.
      left_out: number of points (category, scene) without a similarity.
      slope: of gain on similarity, points per 0.1.
      pearson: correlation of gain and similarity.
      categories: [C], names.
    """

    category: np.ndarray
    episodes: np.ndarray
    similarity: np.ndarray
    baseline: np.ndarray
    gain: np.ndarray
    left_out: int
    slope: Interval
    pearson: Interval
    categories: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Gains:
    """Gains of the layout's weights and of sTDE over the baseline."""

    layout: GainBySimilarity
    stde: GainBySimilarity


@dataclasses.dataclass(frozen=True, eq=False)
class SceneEffects:
    """Gain in SR of one variant over another, scene by scene.

    Attributes:
      scenes, rooms: [N], names of the sampled scenes and of their room types.
      episodes: int [N], at least 1.
      gain: float64 [S, N], points, summed over the scene's episodes, by training run.
    """

    scenes: tuple[str, ...]
    rooms: tuple[str, ...]
    episodes: np.ndarray
    gain: np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True)
class FullCondition(Condition):
    """All trials of a run at one shift, and their relation to layout similarity.

    Attributes:
      similarity, gains: data of Figs. 4 and 5.
      effects: of sTDE at the paper's threshold on the layout's weights; None in results of version 0.1.
    """

    similarity: SuccessBySimilarity
    gains: Gains
    effects: SceneEffects | None = dataclasses.field(default=None, metadata=OPTIONAL)


# Removal of experience in a mixed population

#: One interval per layout shift.
IntervalsByShift = tuple[Interval, ...]


@dataclasses.dataclass(frozen=True)
class ControlComparison:
    """Gain of a removal over one of its controls.

    Attributes:
      weight: mean weight of the control, at each shift.
      gained: removal minus control over all episodes, by metric, in percentage points.
    """

    weight: tuple[float, ...]
    gained: Mapping[str, Interval]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RemovalReport:
    """Effect of one way to remove experience.

    Effects are by metric and in percentage points, shares in percent.

    Attributes:
      name: removal rule.
      weight: mean weight of the removed logits, at each shift.
      change: difference to the same policies without removal, at each shift.
      mixture: the same difference over all episodes.
      left: share of the lead over the agent without experience that remains, at each shift. Of a value this share is
        kept; of a cost 100 minus this share is recovered. NaN where the interval of the lead includes 0.
      compared: comparison with each control, by name; None for a control.
    """

    name: str
    weight: tuple[float, ...]
    change: Mapping[str, IntervalsByShift]
    mixture: Mapping[str, Interval]
    left: Mapping[str, IntervalsByShift]
    compared: Mapping[str, ControlComparison] | None = dataclasses.field(default=None, metadata=OPTIONAL)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MixtureReport:
    """Value and cost of a run's experience, and the effect of every removal.

    Attributes:
      run: name of the run.
      decoding: of actions.
      world: name of the world.
      shifts: layout shifts, one part of the population each.
      scenes, episodes: number of scenes and of episodes at each shift.
      length: median length of the episodes without removal, at each shift.
      without: metrics of agents that cannot know any layout, at each shift.
      agent: metrics of the run's agent without removal, at each shift.
      lead: `agent` minus `without`, at each shift.
      removals: one report per removal.
      heir: name of the run that removal hands over to; None if removal leaves the run's own direct effect.
    """

    run: str
    decoding: Decoding
    world: str
    shifts: tuple[float, ...]
    scenes: int
    episodes: int
    length: tuple[float, ...]
    without: Mapping[str, IntervalsByShift]
    agent: Mapping[str, IntervalsByShift]
    lead: Mapping[str, IntervalsByShift]
    removals: tuple[RemovalReport, ...]
    heir: str | None = dataclasses.field(default=None, metadata=OPTIONAL)

    def removal(self, name: str) -> RemovalReport:
        """Report of a removal.

        Raises:
          KeyError: no removal has this name.
        """
        for removal in self.removals:
            if removal.name == name:
                return removal
        raise KeyError(f"{self.run}: no removal {name!r}")


# Report of the instrument: how the layout shift changes difficulty and success

Measure = Literal[
    "best_length",
    "random_sr",
    "frontier_sr",
    "frontier_steps",
    "start_distance",
    "goal_detected",
    "done_succeeds",
    "layout_gap",
    "layout_similarity",
    "baseline_argmax_sr",
    "baseline_sample_sr",
    "without_argmax_sr",
    "without_sample_sr",
    "without_argmax_wrong",
    "without_sample_wrong",
]
#: Title and number of decimals of each row of the table.
MEASURES: Mapping[Measure, tuple[str, int]] = {
    "best_length": ("Shortest path L* (actions)", 2),
    "random_sr": ("Random SR (%)", 2),
    "frontier_sr": ("Frontier search SR (%)", 1),
    "frontier_steps": ("Frontier search, actions", 1),
    "start_distance": ("Distance to the goal at the start (m)", 2),
    "goal_detected": ("Goal detected where it is in view (%)", 1),
    "done_succeeds": ("Done succeeds where the goal is detected (%)", 1),
    "layout_gap": ("Layout gap to the prior, KL (nats)", 3),
    "layout_similarity": ("Layout similarity to the prior, cosine", 3),
    "baseline_argmax_sr": ("Baseline SR, argmax (%)", 1),
    "baseline_sample_sr": ("Baseline SR, sampled (%)", 1),
    "without_argmax_sr": ("SR without experience, argmax (%)", 1),
    "without_sample_sr": ("SR without experience, sampled (%)", 1),
    "without_argmax_wrong": ("Wrong Done without experience, argmax (%)", 1),
    "without_sample_wrong": ("Wrong Done without experience, sampled (%)", 1),
}
#: Measures of difficulty, which the shift must not change.
DIFFICULTY_MEASURES: tuple[Measure, ...] = ("best_length", "random_sr", "frontier_sr", "start_distance")
#: Measures that may differ between categories, but that the shift must not change in any of them.
CATEGORY_MEASURES: tuple[Measure, ...] = ("goal_detected", "done_succeeds")
BASELINE_MEASURES: tuple[Measure, ...] = ("baseline_argmax_sr", "baseline_sample_sr")
#: Measures of agents that cannot know any layout, and that a shift therefore cannot mislead.
NO_EXPERIENCE_MEASURES: tuple[Measure, ...] = (
    "without_argmax_sr",
    "without_sample_sr",
    "without_argmax_wrong",
    "without_sample_wrong",
)
#: Largest change at which difficulty counts as matched: percent, or points in the mean over categories.
MATCH_TOLERANCE = 5.0
#: Points of SR that the baseline must lose at least.
MIN_BASELINE_LOSS = 8.0
#: Points of SR that agents without experience must not lose.
MAX_LOSS_WITHOUT_EXPERIENCE = 2.0


@dataclasses.dataclass(frozen=True)
class ShiftMeasures:
    """Measures of the instrument at one layout shift."""

    shift: float
    scenes: int
    episodes: int
    measures: Mapping[Measure, Interval] = dataclasses.field(metadata=INLINE)


@dataclasses.dataclass(frozen=True)
class MeasureChange:
    """Change of a measure between two layout shifts.

    Attributes:
      measure: name of the measure.
      start, end: layout shifts.
      change: size of the change.
      holds: True if the change is one that an instrument needs.
    """

    measure: Measure
    start: float = dataclasses.field(metadata=json_key("from"))
    end: float = dataclasses.field(metadata=json_key("to"))
    change: Interval = dataclasses.field(metadata=INLINE)
    holds: bool


@dataclasses.dataclass(frozen=True, kw_only=True)
class InstrumentReport:
    """Effect of the layout shift on difficulty and success.

    Attributes:
      run: settings of the run as JSON.
      shifts: measures at each shift.
      matched: changes of difficulty, in percent, from the first shift to every other one.
      categories: absolute changes of the measures by category, in points, mean over categories.
      discriminating: losses of the baseline, in points, from the first shift to the last.
      without: losses of agents without experience, in points; an additional wrong Done is a loss, too.
    """

    run: Mapping[str, Any] | None = dataclasses.field(default=None, metadata=OPTIONAL)
    shifts: tuple[ShiftMeasures, ...]
    matched: tuple[MeasureChange, ...]
    categories: tuple[MeasureChange, ...] | None = dataclasses.field(default=None, metadata=OPTIONAL)
    discriminating: tuple[MeasureChange, ...]
    without: tuple[MeasureChange, ...] | None = dataclasses.field(default=None, metadata=OPTIONAL)


def instrument_console_table(report: InstrumentReport) -> Table:
    """Make a table for a terminal with one column per shift."""
    table = Table("Layout shift", *(f"{column.shift:g}" for column in report.shifts))
    table.add_row("Scenes", *(str(column.scenes) for column in report.shifts))
    table.add_row("Episodes", *(str(column.episodes) for column in report.shifts))
    for row in measure_rows(report):
        table.add_row(*map(Text, row))  # brackets in a Text are not markup
    return table


def measure_rows(report: InstrumentReport) -> list[tuple[str, ...]]:
    """Title and intervals of every measure in the report."""
    rows = []
    for measure, (title, digits) in MEASURES.items():
        if measure in report.shifts[0].measures:
            intervals = [f"{column.measures[measure]:.{digits}f}" for column in report.shifts]
            rows.append((title, *intervals))
    return rows


def instrument_verdicts(report: InstrumentReport) -> list[str]:
    """Lines that tell whether the shift is an instrument, criterion by criterion."""
    first_shift = report.shifts[0].shift

    # Difficulty must not change with the shift, neither overall nor by category.
    lines = [f"Difficulty matched (within {MATCH_TOLERANCE:g} % of shift {first_shift:g})?"]
    for change in report.matched:
        lines.append(_verdict(change, f"shift {change.end:g}: {change.change:+.1f} %"))
    if report.categories is not None:
        lines.append(f"Categories matched (change at most {MATCH_TOLERANCE:g} points in the mean over categories)?")
        for change in report.categories:
            lines.append(_verdict(change, f"shift {change.end:g}: {change.change:.1f} points"))

    # Agents with experience must lose success by the shift, agents without any must not.
    lines.append(f"Discriminating (at least {MIN_BASELINE_LOSS:g} points lost, the interval clear of 0)?")
    lines += _loss_verdicts(report.discriminating)
    if report.without is not None:
        lines.append(f"No loss without experience (fewer than {MAX_LOSS_WITHOUT_EXPERIENCE:g} points)?")
        lines += _loss_verdicts(report.without)
    return lines


def _loss_verdicts(changes: tuple[MeasureChange, ...]) -> list[str]:
    lines = []
    for change in changes:
        description = f"shift {change.start:g} to {change.end:g}: {change.change:.1f} points lost"
        lines.append(_verdict(change, description))
    return lines


def _verdict(change: MeasureChange, description: str) -> str:
    title, _ = MEASURES[change.measure]
    return f"  {'yes' if change.holds else 'NO':3}  {title}, {description}"


# Comparison of methods

#: Agents without training: those of an evaluation, and frontier search.
UNTRAINED_AGENTS = (*UNTRAINED_VARIANTS, "frontier")
METRIC_SCALE: Mapping[StudyMetric, float] = {"sr": 100.0, "spl": 100.0, "dts": 1.0}


@dataclasses.dataclass(frozen=True, eq=False)
class AgentScores:
    """Metrics of one agent, scene by scene.

    Attributes:
      variant: as in an evaluation, or `frontier`.
      decoding: of actions.
      sr, spl: float64 [S, N], sums over the episodes of each scene, by training run; 0 to 1 per episode.
      dts: float64 [S, N], sums as above, in metres.
    """

    variant: str
    decoding: Decoding
    sr: np.ndarray
    spl: np.ndarray
    dts: np.ndarray


@dataclasses.dataclass(frozen=True)
class TrainingSummary:
    """Cost and convergence of the training of a run.

    Attributes:
      budget: environment steps of each policy, by purpose.
      wall_s: seconds of the run, all arms and seeds together.
      course: val success in percent before the last quarter and at the end; None if it was not measured.
      notes: caveats for the reader of the tables.
    """

    budget: Mapping[str, int]
    wall_s: float
    course: tuple[float, ...] | None
    notes: tuple[str, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class RunScores:
    """Results of a run, or of agents without training.

    All episodes of a scene have equal weight, so sums by scene suffice for means and intervals over episodes.

    Attributes:
      scenes, rooms: [N], names of the sampled scenes and of their room types.
      episodes: int [N], episodes in each scene, at least 1.
      lines: scores of each agent and decoding.
      training: of the run; None without training.
    """

    scenes: tuple[str, ...]
    rooms: tuple[str, ...]
    episodes: np.ndarray
    lines: tuple[AgentScores, ...]
    training: TrainingSummary | None = dataclasses.field(default=None, metadata=OPTIONAL)

    def find_agent(self, variant: str, decoding: Decoding) -> AgentScores | None:
        """Scores of an agent, or None if it was not evaluated.

        Agents without training are evaluated once and found with either decoding.
        """
        for agent in self.lines:
            if agent.variant == variant and (variant in UNTRAINED_AGENTS or agent.decoding == decoding):
                return agent
        return None

    def clusters(self) -> Clusters:
        """Floor plans of the episodes, scene by scene."""
        plans = np.array([floor_plan_name(name) for name in self.scenes])
        return scene_clusters(np.repeat(plans, self.episodes), np.repeat(self.rooms, self.episodes))

    def metric_interval(self, agent: AgentScores, metric: StudyMetric) -> Interval:
        """Metric of an agent; SR and SPL in percent."""
        is_trained = agent.variant not in UNTRAINED_AGENTS
        return mean_interval(self._episode_values(agent, metric), self.clusters(), trained=is_trained)

    def metric_difference(
        self, agent: AgentScores, reference_run: "RunScores", reference: AgentScores, metric: StudyMetric
    ) -> Interval:
        """Metric of an agent minus that of a reference, paired on the episodes.

        Args:
          agent: one of these results.
          reference_run: results of the reference in the same episodes; these results if both are the same networks.
          reference: one of those results.
          metric: SR and SPL are in percentage points.
        """
        # Baselines are trained separately from the other variants; an untrained reference has no networks of its own.
        has_untrained_reference = reference.variant in UNTRAINED_AGENTS
        has_baseline = "baseline" in (agent.variant, reference.variant)
        is_same_run = self is reference_run and (has_untrained_reference or not has_baseline)

        reference_values = reference_run._episode_values(reference, metric)
        agent_values = self._episode_values(agent, metric)
        return paired_difference(reference_values, agent_values, self.clusters(), same_runs=is_same_run)

    def _episode_values(self, agent: AgentScores, metric: StudyMetric) -> np.ndarray:
        """Values [S, E] whose means and intervals are those of the episodes.

        The first episode of each scene has the sum of its scene and all others 0, so that whole numbers stay exact.
        """
        scene_sums = METRIC_SCALE[metric] * getattr(agent, metric)
        values = np.zeros((len(scene_sums), self.episodes.sum()))
        first_episodes = np.cumsum(self.episodes) - self.episodes
        values[:, first_episodes] = scene_sums
        return values


class AgentResult(NamedTuple):
    """Scores of one agent together with the results that they belong to."""

    run: RunScores
    agent: AgentScores

    def interval(self, metric: StudyMetric) -> Interval:
        """Metric of the agent; SR and SPL in percent."""
        return self.run.metric_interval(self.agent, metric)

    def difference(self, reference: "AgentResult", metric: StudyMetric) -> Interval:
        """Metric of the agent minus that of a reference in the same episodes."""
        return self.run.metric_difference(self.agent, reference.run, reference.agent, metric)


def find_result(run: RunScores | None, variant: str, decoding: Decoding) -> AgentResult | None:
    """Result of an agent, or None if the run or the agent was not evaluated."""
    agent = run.find_agent(variant, decoding) if run is not None else None
    return AgentResult(run, agent) if run is not None and agent is not None else None
