"""A report page made by hand: two agents in two episodes of the kitchen."""

import dataclasses

import numpy as np

from jaxnav.evaluation.statistics import Interval
from jaxnav.report.headline import Headline, KeyFigure
from jaxnav.report.page import Chart, Section, TextTable, render_report_page
from jaxnav.report.replays import BeliefFrames, ReplayEpisode, Replays, ReplayTrace, make_plan, pack_shares
from jaxnav.scenes.task import DONE, NUM_ACTIONS
from support import tiny_world as tiny

NUM_CATEGORIES = len(tiny.CATEGORIES)
#: Poses of scene 0: cells 0 to 3, heading 0.
POSES = tiny.POSES_PER_CELL * np.arange(4)


def trace_through(views, success=True):
    """A trace through views, given by their indices, that ends with Done."""
    num_steps = len(views)
    probabilities = np.full((num_steps, 3, NUM_ACTIONS), 0.1)
    probabilities[:, :, 0] = 0.5
    layout_weights = np.tile(np.linspace(0, 0.9, NUM_CATEGORIES), (num_steps, 1))
    return ReplayTrace(
        plan=0,
        views=list(views),
        actions=[0] * (num_steps - 1) + [DONE],
        success=success,
        gap=pack_shares(np.linspace(1, 0, num_steps)),
        weight=pack_shares(np.linspace(0.5, 0, num_steps)),
        layout=pack_shares(layout_weights),
        chances=pack_shares(probabilities),
    )


def example_replays(suffix=""):
    """Replays in which every name ends with `suffix`; the agents differ in the second episode."""
    scene = dataclasses.replace(tiny.KITCHEN, name=tiny.KITCHEN.name + suffix)
    short_trace = trace_through([0, 1, 2])

    # A longer trace, with a belief over two by three squares at two of its steps.
    beliefs = np.array([[[1.0, 0.5, 0.0], [0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0], [0.2, 0.4, 0.6]]])
    frames = BeliefFrames(steps=[1, 3], corner=(-12, -12), side=50, columns=3, shares=pack_shares(beliefs))
    long_trace = dataclasses.replace(trace_through([0, 1, 2, 3, 2], success=False), belief=frames)

    return Replays(
        shift=0.0,
        split="val",
        categories=[category + suffix for category in tiny.CATEGORIES],
        players=["layout" + suffix, "removed" + suffix],
        layouts=[0.0, 0.0],
        comparisons={"Removal" + suffix: (0, 1), "Other" + suffix: (1, 0)},
        thresholds=[None, 0.5],
        differ=[[0, 7], [7, 0]],
        evaluated=24,
        field_of_view=100.0,
        reach=500,
        plans=[make_plan(scene, tiny.BANK, 0, POSES)],
        episodes=[
            ReplayEpisode(0, 0, 3, [short_trace, short_trace]),
            ReplayEpisode(0, 1, 3, [short_trace, long_trace]),
        ],
    )


def example_page(suffix=""):
    """A page in which every text ends with `suffix`."""
    # A section with a table and a chart.
    rows = (("group" + suffix,), ("row" + suffix, "50.0 [40.0, 60.0]"))
    table = TextTable("Shift 0" + suffix, ("Variant" + suffix, "SR"), rows)
    chart = Chart('<svg viewBox="0 0 1 1"><rect width="1" height="1"/></svg>', "chart" + suffix)
    section = Section("Results" + suffix, "about" + suffix, (chart,), (table,), (table,), ("note" + suffix,))

    # The headline, a key figure at two shifts.
    values = {"Shift 0" + suffix: Interval(50.0, 40.0, 60.0), "Shift 1" + suffix: Interval(45.0)}
    figure = KeyFigure("figure" + suffix, "note" + suffix, "%", (0.0, 100.0), values)
    headline = Headline(("sentence" + suffix,), (figure,))

    return render_report_page(
        "title" + suffix, headline, {"Run": "run" + suffix}, [section, section], [example_replays(suffix)]
    )
