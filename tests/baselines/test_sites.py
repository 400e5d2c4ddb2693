"""Sites of drawn scenes: views worked out by hand, detections and relations."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support.scenes import APARTMENTS, BOOK, FRIDGE, ROOMS, draw, maze_scene
from support.sites import find_perfect_sites

from jaxnav.baselines.sites import NUM_DISTANCE_BINS


def look_kind_by_site(sites, pose):
    """Kind of the look at each site in view, by horizon and distance bin."""
    viewed_sites, look_kind_by_site = sites.views.from_pose(pose)
    return dict(zip(viewed_sites.tolist(), look_kind_by_site.tolist(), strict=True))


def test_sites_in_view_of_a_single_cell():
    # One cell at the corner of a square of 1 m: the centres of its four sites lie 0.125 or 0.625 m off on each axis.
    # Looking along +z (heading 0), 50 degrees to each side: (0.125, 0.125) at 45 degrees is in view in the nearest bin,
    # (0.125, 0.625) in the next one, since it is 0.637 m away; (0.625, 0.125) is at 79 degrees; (0.625, 0.625) at 45
    # degrees is 0.884 m away. Looking the other way nothing is.
    sites = find_perfect_sites(draw([".###"] + ["####"] * 3))
    assert look_kind_by_site(sites, pose=0) == {0: 0, 2: 1, 3: 1}
    assert look_kind_by_site(sites, pose=1) == {
        0: NUM_DISTANCE_BINS,
        2: NUM_DISTANCE_BINS + 1,
        3: NUM_DISTANCE_BINS + 1,
    }
    assert look_kind_by_site(sites, pose=8) == {}


def test_sites_behind_walls_are_left_out():
    # A wall across a corridor of 3 m: what is behind it is a site only if one can stand there and look.
    row_marks = [".."] * 6 + ["##"] * 6
    wall_cells = [(6, 0), (6, 1)]
    open_sites = find_perfect_sites(draw(row_marks))
    closed_sites = find_perfect_sites(draw(row_marks, walls=wall_cells))
    assert open_sites.object_sites.shape[1] == 6
    assert closed_sites.object_sites.shape[1] == 4  # 0 to 1.5 m, and the square with the wall


def test_site_surroundings_of_floor_and_wall():
    row_marks = [".."] * 2 + ["##"] * 2
    wall_cells = [(2, 0), (2, 1), (3, 0), (3, 1)]
    sites = find_perfect_sites(draw(row_marks, walls=wall_cells))
    np.testing.assert_array_equal(sites.surroundings, [[1, 0], [0, 1], [1, 1]])


def test_objects_are_assigned_to_their_sites():
    sites = find_perfect_sites(
        draw(["...."] * 4, ("Book", 0.1, 0.8, 0.1, 0.1, 0.1, 0.1), ("Fridge", 0.6, 0.9, 0.6, 0.2, 0.2, 0.2))
    )
    np.testing.assert_array_equal(np.argwhere(sites.object_sites), [[BOOK, 0], [FRIDGE, 3]])


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999), rules=st.sampled_from([ROOMS, APARTMENTS]))
def test_detected_sites_are_at_or_near_objects(seed, rules):
    # Offsets are rounded to some centimetres, which may move a place to the next site.
    sites = find_perfect_sites(maze_scene(seed), rules)
    for pose, category in np.argwhere(sites.detected_site >= 0):
        detected_site = sites.detected_site[pose, category]
        nearby_sites = sites.relations[0, detected_site]
        nearby_sites[detected_site] = True
        assert (nearby_sites & sites.object_sites[category]).any()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999))
def test_site_relations_are_symmetric_and_nested(seed):
    near_sites, around_sites, in_one_place = find_perfect_sites(maze_scene(seed)).relations
    for relation in (near_sites, around_sites, in_one_place):
        np.testing.assert_array_equal(relation, relation.T)
        assert relation.diagonal().all()
    assert (around_sites >= near_sites).all()
