"""A page made by hand: two agents in two episodes of a drawn room."""

import dataclasses

import numpy as np

from jaxnav.report.page import Chart, Section, TextTable, render_page
from jaxnav.report.replays import ReplayEpisode, Replays, ReplayTrace, make_plan, pack_shares
from jaxnav.scenes.task import DONE, NUM_ACTIONS
from support import tiny_world as tiny

CATEGORIES = len(tiny.CATEGORIES)
#: Poses of scene 0: cells 0 to 3, heading 0.
POSES = tiny.POSES_PER_CELL * np.arange(4)


def course(views, success=True):
    """A course through views that ends with Done."""
    steps = len(views)
    chances = np.full((steps, 3, NUM_ACTIONS), 0.1)
    chances[:, :, 0] = 0.5
    return ReplayTrace(
        views=list(views),
        actions=[0] * (steps - 1) + [DONE],
        success=success,
        gap=pack_shares(np.linspace(1, 0, steps)),
        weight=pack_shares(np.linspace(0.5, 0, steps)),
        layout=pack_shares(np.tile(np.linspace(0, 0.9, CATEGORIES), (steps, 1))),
        chances=pack_shares(chances),
    )


def replays(name=""):
    """Replays whose names all end with `name`; the agents differ in the second episode."""
    scene = dataclasses.replace(tiny.KITCHEN, name=tiny.KITCHEN.name + name)
    same, other = course([0, 1, 2]), course([0, 1, 2, 3, 2], success=False)
    return Replays(
        shift=0.0,
        split="val",
        categories=[category + name for category in tiny.CATEGORIES],
        players=["layout" + name, "removed" + name],
        comparisons={"Removal" + name: (0, 1), "Other" + name: (1, 0)},
        thresholds=[None, 0.5],
        differ=[[0, 7], [7, 0]],
        evaluated=24,
        field_of_view=100.0,
        reach=500,
        plans=[make_plan(scene, tiny.BANK, 0, POSES)],
        episodes=[ReplayEpisode(0, 0, 3, [same, same]), ReplayEpisode(0, 1, 3, [same, other])],
    )


def page(name=""):
    """A page whose every text ends with `name`."""
    table = TextTable(
        "Shift 0" + name, ("Variant" + name, "SR"), (("group" + name,), ("row" + name, "50.0 [40.0, 60.0]"))
    )
    chart = Chart('<svg viewBox="0 0 1 1"><rect width="1" height="1"/></svg>', "chart" + name)
    section = Section("Results" + name, "about" + name, (chart,), (table,), (table,), ("note" + name,))
    return render_page("title" + name, {"Run": "run" + name}, [section, section], [replays(name)])
