"""Sites of drawn scenes: what is in view by hand, and that detections point at objects."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support.scenes import APARTMENTS, BOOK, CATEGORIES, FRIDGE, ROOMS, draw, maze_scene

from jaxnav.baselines.sites import NUM_DISTANCE_BINS, find_sites
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import Task


def sites_of(scene, rules=ROOMS):
    task = Task(CATEGORIES, rules=rules, detector=PERFECT_DETECTOR)
    return find_sites(scene, task, compile_scene(scene, task).rows)


def look_kinds(sites, pose):
    """How each site in view is looked at."""
    return dict(zip(*(part.tolist() for part in sites.views.from_pose(pose)), strict=True))


def test_looks_of_a_single_cell():
    # One cell at the corner of a square of 1 m: the centres of its four sites lie 0.125 or 0.625 m off on each axis.
    # Looking along +z (heading 0), 50 degrees to each side: (0.125, 0.125) at 45 degrees is in view in the nearest bin,
    # (0.125, 0.625) in the next one, since it is 0.637 m away; (0.625, 0.125) is at 79 degrees; (0.625, 0.625) at 45
    # degrees is 0.884 m away. Looking the other way nothing is.
    sites = sites_of(draw([".###"] + ["####"] * 3))
    assert look_kinds(sites, pose=0) == {0: 0, 2: 1, 3: 1}
    assert look_kinds(sites, pose=1) == {0: NUM_DISTANCE_BINS, 2: NUM_DISTANCE_BINS + 1, 3: NUM_DISTANCE_BINS + 1}
    assert look_kinds(sites, pose=8) == {}


def test_walls_hide_sites():
    # A wall across a corridor of 3 m: what is behind it is a site only if one can stand there and look.
    rows, walls = [".."] * 6 + ["##"] * 6, [(6, 0), (6, 1)]
    open_corridor, closed = sites_of(draw(rows)), sites_of(draw(rows, walls=walls))
    assert open_corridor.object_sites.shape[1] == 6
    assert closed.object_sites.shape[1] == 4  # 0 to 1.5 m, and the square with the wall


def test_surroundings_of_floor_and_wall():
    rows, walls = [".."] * 2 + ["##"] * 2, [(2, 0), (2, 1), (3, 0), (3, 1)]
    sites = sites_of(draw(rows, walls=walls))
    np.testing.assert_array_equal(sites.surroundings, [[1, 0], [0, 1], [1, 1]])


def test_objects_stand_at_their_sites():
    sites = sites_of(
        draw(["...."] * 4, ("Book", 0.1, 0.8, 0.1, 0.1, 0.1, 0.1), ("Fridge", 0.6, 0.9, 0.6, 0.2, 0.2, 0.2))
    )
    np.testing.assert_array_equal(np.argwhere(sites.object_sites), [[BOOK, 0], [FRIDGE, 3]])


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999), rules=st.sampled_from([ROOMS, APARTMENTS]))
def test_detections_point_at_objects(seed, rules):
    # Offsets are rounded to some centimetres, which may move a place to the next site.
    sites = sites_of(maze_scene(seed), rules)
    for pose, category in np.argwhere(sites.detected_site >= 0):
        near = sites.relations[0, sites.detected_site[pose, category]]
        near[sites.detected_site[pose, category]] = True
        assert (near & sites.object_sites[category]).any()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999))
def test_relations_are_symmetric_and_nested(seed):
    near, around, shared = sites_of(maze_scene(seed)).relations
    for relation in (near, around, shared):
        np.testing.assert_array_equal(relation, relation.T)
        assert relation.diagonal().all()
    assert (around >= near).all()
