"""The course of the layout gap in every setting."""

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxnav.layout import SETTINGS, Setting
from jaxnav.runs.config import RunConfig
from jaxnav.runs.policies import Gap, Policies, gap_settings, load_policies
from jaxnav.runs.worlds import evaluation_world
from jaxnav.study.bench import layout_setting, study_episodes
from jaxnav.study.config import StudyConfig
from jaxnav.study.curves import AucLine, AucPanel, Belief, GapCourse, GapLine, GapPanel
from jaxnav.study.gap_statistics import auc_by_step, mean_by_step
from jaxnav.study.tracking import FROZEN, UPDATED, GapTraces, gap_traces
from jaxnav.training.calibration import layout_priors

BELIEFS: dict[Belief, int] = {"updated": UPDATED, "frozen": FROZEN}


def gap_course(run: RunConfig, config: StudyConfig, console: Console) -> GapCourse:
    """Measure the gap by step, and whether it shows shifts.

    Args:
      run: a finished run with the arm of the layout.
      config: of the study.
      console: shows the progress.

    Raises:
      InputError: the run is not finished, or its scenes fill more than one shard.
    """
    policies = load_policies(run)
    settings = _settings(policies)
    traces = shortest([_traces(run, config, shift, policies, settings, console) for shift in config.shifts])
    means = [mean_by_step(trace) for trace in traces]
    aucs = [auc_by_step(trace, traces[0]) for trace in traces[1:]]
    panels = [
        GapPanel(
            name,
            tuple(
                GapLine(shift, belief, mean.line(i, which))
                for shift, mean in zip(config.shifts, means, strict=True)
                for belief, which in BELIEFS.items()
            ),
        )
        for i, name in enumerate(settings)
    ]
    auc = [
        AucPanel(shift, tuple(AucLine(name, each.line(i, UPDATED)) for i, name in enumerate(settings)))
        for shift, each in zip(config.shifts[1:], aucs, strict=True)
    ]
    running = np.stack([trace.running.mean(axis=(0, 1)) for trace in traces])
    return GapCourse(tuple(range(running.shape[1])), running, tuple(panels), tuple(auc))


def _settings(policies: Policies) -> dict[str, Setting]:
    """Return the layout settings whose gaps are compared.

    Those that go by signs are left out where the run learned none.
    """
    by_gap = gap_settings(layout_setting(policies))
    gaps: tuple[Gap, ...] = ("evidence",) if policies.knowledge.signs is None else ("evidence", "learned", "overdue")
    others = {gap: by_gap[gap] for gap in gaps}
    return {"paper": SETTINGS["paper"], "released": SETTINGS["released"], "calibrated": by_gap["novelty"]} | others


def _traces(
    run: RunConfig,
    config: StudyConfig,
    shift: float,
    policies: Policies,
    settings: dict[str, Setting],
    console: Console,
) -> GapTraces:
    """Walk the episodes of one shift with the layout arm."""
    world = evaluation_world(run, config.split, None, shift, console)
    return gap_traces(
        policies.of("layout"),
        study_episodes(world, config),
        world.params(0),
        policies.acting(world),
        policies.knowledge,
        list(settings.values()),
        jnp.stack([layout_priors(policies.counts, setting) for setting in settings.values()]),
        config.steps,
        jax.random.key(config.seed),
    )


def shortest(traces: list[GapTraces]) -> list[GapTraces]:
    """Return the steps at which episodes run at every shift."""
    steps = min(int(trace.running.any(axis=(0, 1)).sum()) for trace in traces)
    return [trace._replace(gap=trace.gap[..., :steps], running=trace.running[..., :steps]) for trace in traces]
