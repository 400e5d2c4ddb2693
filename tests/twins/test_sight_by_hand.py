"""Tests that lines of sight, success and detections of the twin are as worked out by hand.

Most scenes have a single standable cell, [0, 0]: the camera is at (0, 1.5, 0), and objects in front of it are at z > 0.
"""

import math

import numpy as np
import pytest
from support.scenes import APARTMENTS, BOOK, CHAIR, FRIDGE, HOUSES, SMALL, draw
from twins.environment import LOOK_DOWN, detected_categories, start_in_one_cell, start_twin
from twins.shapes import meets


@pytest.mark.parametrize(("offset", "is_detected"), [(1.19, True), (1.2, False), (-1.19, True), (-1.2, False)])
def test_detection_cone_of_rooms_is_50_degrees_to_every_side(offset, is_detected):
    # tan 50 = 1.19175, one metre ahead.
    lateral_book = ("Book", offset, 1.5, 1, *SMALL)
    vertical_book = ("Book", 0, 1.5 + offset, 1, *SMALL)
    assert (BOOK in detected_categories(start_in_one_cell(lateral_book))) == is_detected
    assert (BOOK in detected_categories(start_in_one_cell(vertical_book))) == is_detected


@pytest.mark.parametrize(
    ("right", "up", "is_detected"),
    [(0.82, 0, True), (-0.83, 0, False), (0, 0.61, True), (0, -0.61, True), (0, -0.63, False)],
)
def test_detection_cone_of_homes_is_wider_than_high(right, up, is_detected):
    # tan 39.5 = 0.8243 across and tan 31.75 = 0.6188 up, one metre ahead, around cameras at 1.5 and 0.88 m.
    for rules in (APARTMENTS, HOUSES):
        book = ("Book", right, rules.camera + up, 1, *SMALL)
        assert (BOOK in detected_categories(start_in_one_cell(book, rules=rules))) == is_detected


def test_detection_at_30_degrees_is_straight_ahead_of_its_heading():
    # Heading 1 of 12, f = (1/2, sqrt 3 / 2): for v = (1, sqrt 3), ahead = 1/2 + 3/2 = 2, right = 0.
    episode = start_in_one_cell(("Book", 1, 1.5, 3**0.5, *SMALL), heading=1, rules=APARTMENTS)
    [(ahead, right, _)] = episode.detections()[BOOK]
    assert (ahead, right) == pytest.approx((2.0, 0.0))


def test_detection_gives_offsets_ahead_and_right_of_the_heading():
    # Heading 2 faces +x, so the right hand points to -z: from [4, 0] at z = 1, v = (2, 0, -0.5).
    scene = draw(["."] * 5, ("Book", 2, 1.5, 0.5, *SMALL))
    [(ahead, right, apparent_size)] = start_twin(scene, cell=(4, 0), heading=2).detections()[BOOK]
    assert (ahead, right) == pytest.approx((2.0, 0.5))
    assert apparent_size == pytest.approx(0.6 / math.sqrt(4.25))

    # Heading 1, f = (0.7071, 0.7071): ahead = 1.5 x 0.7071, right = (2 + 0.5) x 0.7071 = 1.67 ahead > tan 50.
    assert detected_categories(start_twin(scene, cell=(4, 0), heading=1)) == set()

    # Heading 3, f = (0.7071, -0.7071): ahead = 2.5 x 0.7071, right = (-2 + 0.5) x 0.7071.
    [(ahead, right, _)] = start_twin(scene, cell=(4, 0), heading=3).detections()[BOOK]
    assert (ahead, right) == pytest.approx((2.5 * math.sqrt(0.5), -1.5 * math.sqrt(0.5)))


def test_detection_offsets_follow_the_origin_of_the_lattice():
    scene = draw(["..", ".."], ("Book", 3, 1.5, 2.5, *SMALL), origin=(2.75, -0.5))
    # Cell [1, 1] is at x = 3, z = -0.25.
    [(ahead, right, _)] = start_twin(scene, cell=(1, 1)).detections()[BOOK]
    assert (ahead, right) == pytest.approx((2.75, 0.0))


def test_detection_of_a_near_object_on_the_floor_needs_looking_down():
    # The book is 1 m ahead and 1.5 m below the camera. Level: rise -1.5 < -1.19. Pitched: depth .866 + .75 = 1.616,
    # rise .5 - 1.299 = -.799 > -1.926.
    episode = start_in_one_cell(("Book", 0, 0, 1, *SMALL))
    assert (detected_categories(episode), episode.successes()) == (set(), set())
    episode.step(LOOK_DOWN)
    assert (detected_categories(episode), episode.successes()) == ({BOOK}, {BOOK})
    [(ahead, right, _)] = episode.detections()[BOOK]
    assert (ahead, right) == pytest.approx((1.0, 0.0))  # in the level frame, not in the pitched frame


def test_detection_of_a_high_object_is_lost_looking_down():
    # The book is 1 m ahead and 1 m above the camera. Level: rise 1 < 1.19. Pitched: depth .866 - .5 = .366,
    # rise .5 + .866 = 1.366 > .436.
    high_book = ("Book", 0, 2.5, 1, *SMALL)
    assert detected_categories(start_in_one_cell(high_book)) == {BOOK}
    assert detected_categories(start_in_one_cell(high_book, horizon=1)) == set()


@pytest.mark.parametrize(
    ("height", "z", "is_detected"), [(1.86, 1, True), (1.87, 1, False), (0, 0.265, True), (0, 0.264, False)]
)
def test_detection_cone_looking_down_reaches_from_20_degrees_up_to_80_down(height, z, is_detected):
    # tan 20 = 0.364; 1.5 / tan 80 = 0.2645.
    episode = start_in_one_cell(("Book", 0, height, z, *SMALL), horizon=1)
    assert detected_categories(episode) == ({BOOK} if is_detected else set())


@pytest.mark.parametrize("horizon", [0, 1])
def test_objects_behind_or_straight_below_are_not_detected(horizon):
    book_behind = ("Book", 0, 1.5, -1, *SMALL)
    book_below = ("Book", 0, 0, 0, *SMALL)  # pitched: depth .75, rise -1.299 < -.894
    book_in_camera = ("Book", 0, 1.5, 0, *SMALL)  # depth 0
    for book in (book_behind, book_below, book_in_camera):
        assert detected_categories(start_in_one_cell(book, horizon=horizon)) == set()


# The line of sight

TARGET = ("Book", 0, 1, 2, *SMALL)  # the line of sight falls from 1.5 to 1 m and is 1.25 m high at z = 1


@pytest.mark.parametrize(
    ("blocker", "is_visible"),
    [
        ((0, 1, 1, 0.5, 2, 0.5), False),  # a wardrobe between camera and target
        ((0, 1.25, 1, 0.5, 1.5, 0.5), True),  # a hanging cupboard, underside at 0.5
        ((0, 1, 1, 0.25, 2, 0.5), True),  # a lamp: too narrow
        ((0, 1, 1, 0.5, 2, 0.25), True),  # too thin
        ((0, 0.5, 1, 0.5, 1, 0.5), True),  # opaque, but its top (1 m) is under the line (1.19 at z = 1.25)
        ((0, 0.61, 1, 0.5, 1.22, 0.5), False),  # top 1.22 is above 1.19
        ((0.5, 1, 1, 0.5, 2, 0.5), True),  # beside the line: x from 0.25
        ((0.25, 1, 1, 0.5, 2, 0.5), True),  # grazes the line with its face x = 0
        ((0.2499995, 1, 1, 0.5, 2, 0.5), True),  # 5e-7 m over the line: still grazing
        ((0.24999, 1, 1, 0.5, 2, 0.5), False),  # 1e-5 m over the line
        ((0, 1, 3, 0.5, 2, 0.5), True),  # behind the target
        ((0, 1, 2.2, 0.5, 2, 0.5), True),  # contains the target's centre (z from 1.95)
        ((0, 1, 2.25, 0.5, 2, 0.5), True),  # has the target's centre on its face
        ((0, 1, 0, 0.5, 2, 0.5), True),  # around the camera
        ((0, 1, 0.25, 0.5, 2, 0.5), True),  # the camera on the edge of its footprint
        ((0, 1, 0.35, 0.5, 2, 0.5), False),  # 0.1 m before the camera
    ],
)
def test_line_of_sight_is_blocked_by_opaque_boxes_between_camera_and_target(blocker, is_visible):
    episode = start_in_one_cell(TARGET, ("Wardrobe", *blocker))
    assert detected_categories(episode) == ({BOOK} if is_visible else set())


@pytest.mark.parametrize(("top", "is_visible"), [(0.8, True), (0.85, False)])
def test_box_lower_than_850_mm_hides_nothing(top, is_visible):
    # The line to the floor at z = 1.5 is 0.6 m high at z = 0.9, within the box, and goes on to z = 1.29.
    book = ("Book", 0, 0, 1.5, *SMALL)
    table = ("Table", 0, top / 2, 1.05, 0.3, top, 0.3)
    episode = start_in_one_cell(book, table, horizon=1)
    assert detected_categories(episode) == ({BOOK} if is_visible else set())


def test_box_hides_neither_itself_nor_objects_inside():
    # The book is in the fridge, and the chair is right behind the fridge.
    fridge = ("Fridge", 0, 0.9, 1.2, 0.7, 1.8, 0.7)
    book = ("Book", 0, 1.2, 1.4, *SMALL)
    chair = ("Chair", 0, 0.8, 2, 0.4, 0.4, 0.4)
    assert detected_categories(start_in_one_cell(fridge, book, chair)) == {BOOK, FRIDGE}
    assert detected_categories(start_in_one_cell(book, chair)) == {BOOK, CHAIR}


@pytest.mark.parametrize("height", [0.2, 1.5, 2.4])
def test_wall_cell_blocks_sight_at_every_height(height):
    # Wall cell [8, 0]: z from 1.875 to 2.125.
    book = ("Book", 0, height, 3, *SMALL)
    assert detected_categories(start_in_one_cell(book)) == {BOOK}
    assert detected_categories(start_in_one_cell(book, walls=[(8, 0)])) == set()
    assert detected_categories(start_in_one_cell(book, walls=[(8, 1)])) == {BOOK}  # beside the line


def test_wall_cell_around_the_target_does_not_block_sight():
    # The book is 1.1 m ahead and 1.5 m down, 1.860 m away. The line of sight ends at z = 1.1 (1 - 0.3 / 1.860) = 0.923,
    # in cell [4, 0] (from 0.875).
    book = ("Book", 0, 0, 1.1, *SMALL)
    assert detected_categories(start_in_one_cell(book, walls=[(4, 0)], horizon=1)) == {BOOK}
    assert detected_categories(start_in_one_cell(book, walls=[(3, 0), (4, 0)], horizon=1)) == set()


@pytest.mark.parametrize(("z", "is_visible"), [(0.9, True), (0.95, False)])
def test_line_of_sight_ends_300_mm_before_the_target(z, is_visible):
    # Wall cell [3, 0] is z from 0.625 to 0.875; the line ends at 0.6 or 0.65.
    episode = start_in_one_cell(("Book", 0, 1.5, z, *SMALL), walls=[(3, 0)])
    assert detected_categories(episode) == ({BOOK} if is_visible else set())


def test_line_of_sight_shorter_than_300_mm_is_clear():
    # Wall cell [1, 0] is z from 0.125 to 0.375. With x = 0.14 the book stands beside the wall cell and in view.
    assert detected_categories(start_in_one_cell(("Book", 0.14, 1.5, 0.2, *SMALL), walls=[(1, 0)])) == {BOOK}


def test_line_of_sight_passes_between_two_diagonal_wall_cells():
    # The line x = z touches cells [1, 2] and [2, 1] only in their common corner (0.375, 0.375).
    book = ("Book", 1, 1.5, 1, *SMALL)
    assert detected_categories(start_in_one_cell(book, walls=[(1, 2), (2, 1)])) == {BOOK}
    assert detected_categories(start_in_one_cell(book, walls=[(2, 2)])) == set()


def has_sampled_point(start, end, centre, half_sizes):
    """True where one of 201 points along a segment lies inside a box."""
    points = np.linspace(start, end, 201)
    return bool((np.abs(points - centre) < half_sizes).all(axis=1).any())


def test_meets_agrees_with_points_sampled_along_the_segment():
    # A sampled point inside proves that segment and box meet. A segment that meets the box shrunk by 0.05 has a sampled
    # point inside the box.
    rng = np.random.default_rng(0)
    num_meetings = 0
    for _ in range(400):
        num_axes = rng.integers(2, 4)
        start, end, centre = rng.uniform(-1, 1, (3, num_axes)).tolist()
        half_sizes = rng.uniform(0.1, 0.6, num_axes).tolist()
        is_inside = has_sampled_point(start, end, centre, half_sizes)
        assert meets(start, end, centre, half_sizes) or not is_inside
        smaller_sizes = [half_size - 0.05 for half_size in half_sizes]
        assert is_inside or not meets(start, end, centre, smaller_sizes)
        num_meetings += is_inside
    assert 50 < num_meetings < 300


def test_meets_handles_segments_parallel_to_faces():
    # The segment is parallel to four of the faces.
    assert meets((0, 0, 0), (0, 0, 2), (0, 0, 1), (0.1, 0.1, 0.1))
    assert not meets((0, 0, 0), (0, 0, 2), (0.2, 0, 1), (0.1, 0.1, 0.1))


def test_wall_cells_follow_the_origin_of_the_lattice():
    # Cell [0, 0] is at (2.75, -0.5), wall cell [4, 0] at z = 0.5, and cell [4, 1] beside the line.
    book = ("Book", 2.75, 1.5, 1.5, *SMALL)
    rows = [".#"] + ["##"] * 8
    blocked_scene = draw(rows, book, walls=[(4, 0)], origin=(2.75, -0.5))
    clear_scene = draw(rows, book, walls=[(4, 1)], origin=(2.75, -0.5))
    assert detected_categories(start_twin(blocked_scene)) == set()
    assert detected_categories(start_twin(clear_scene)) == {BOOK}


# Success, detection


@pytest.mark.parametrize(("z", "goals"), [(1.5, {BOOK}), (1.5 + 5e-10, {BOOK}), (1.51, set())])
def test_success_in_rooms_is_within_1500_mm_in_the_plane(z, goals):
    # The centre at z = 1.5 and 0.9 m above the floor is 1.62 m from the camera, but 1.5 m in the plane.
    episode = start_in_one_cell(("Book", 0, 0.9, z, *SMALL))
    assert episode.successes() == goals
    assert detected_categories(episode) == {BOOK}


@pytest.mark.parametrize(("z", "goals"), [(1.0, {BOOK}), (1.01, set())])
def test_success_in_apartments_is_within_1_m(z, goals):
    assert start_in_one_cell(("Book", 0, 1.5, z, *SMALL), rules=APARTMENTS).successes() == goals


@pytest.mark.parametrize(
    ("sides", "last_detected_z", "first_missed_z"),
    [
        ((0.4, 0.2, 0.36), 3.16, 3.17),  # size sqrt(0.4 x 0.36) = 0.37947, range 3.1623
        ((0.05, 0.05, 0.01), 1.5 + 5e-10, 1.51),  # 0.05 / 0.12 < 1.5
        ((1.0, 0.2, 1.0), 5.0, 5.01),  # 1 / 0.12 > 5
    ],
)
def test_detection_range_follows_from_the_size(sides, last_detected_z, first_missed_z):
    assert detected_categories(start_in_one_cell(("Book", 0, 1.5, last_detected_z, *sides))) == {BOOK}
    assert detected_categories(start_in_one_cell(("Book", 0, 1.5, first_missed_z, *sides))) == set()


@pytest.mark.parametrize(("z", "apparent_size"), [(2.0, 0.3), (0.2, 2.4)])
def test_apparent_size_is_bounded_near_the_camera(z, apparent_size):
    # 0.6 / 2, and 0.6 / max(0.2, 0.25).
    episode = start_in_one_cell(("Book", 0, 1.5, z, *SMALL))
    assert episode.detections()[BOOK] == [pytest.approx((z, 0.0, apparent_size))]


def test_detections_hold_the_nearest_visible_instance_and_equally_near_ones():
    # The distance of the near book is sqrt(0.5^2 + 1) = sqrt(1.25) = 1.118.
    far_book = ("Book", 0, 1.5, 3, *SMALL)
    near_book = ("Book", 0.5, 1.5, 1, 0.2, 0.2, 0.2)
    near_detection = pytest.approx((1.0, 0.5, 0.2 / math.sqrt(1.25)))
    assert start_in_one_cell(far_book, near_book).detections()[BOOK] == [near_detection]

    # A wardrobe at x from 0.1 to 0.6, z from 0.25 to 0.55 hides the near book.
    wardrobe = ("Wardrobe", 0.35, 1, 0.4, 0.5, 2, 0.3)
    episode = start_in_one_cell(far_book, near_book, wardrobe)
    assert episode.detections()[BOOK] == [pytest.approx((3.0, 0.0, 0.2))]

    # Two books are equally near.
    left_book = ("Book", -0.5, 1.5, 1, *SMALL)
    left_detection = pytest.approx((1.0, -0.5, 0.6 / math.sqrt(1.25)))
    detections = start_in_one_cell(near_book, left_book).detections()[BOOK]
    assert sorted(detections) == [left_detection, near_detection]


def test_success_counts_any_instance_and_types_are_mapped_by_name():
    # A stool counts as a chair, and a vase belongs to no category. The book is too far for success.
    stool = ("Stool", 0, 1.5, 1, *SMALL)
    book = ("Book", 0, 1.5, 3, *SMALL)
    vase = ("Vase", 0, 1.5, 1, *SMALL)
    episode = start_in_one_cell(stool, book, vase)
    assert episode.successes() == {CHAIR}
    assert detected_categories(episode) == {BOOK, CHAIR}
