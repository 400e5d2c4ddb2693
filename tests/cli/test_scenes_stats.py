"""`scenes stats` on drawn scenes, with numbers worked out by hand, and on the rooms of a finished run."""

import dataclasses
import re

import numpy as np
import pytest
from support.commands import refusal
from support.scenes import SMALL, draw
from support.tiny_run import finished_run

from jaxnav.cli import scenes as scenes_command
from jaxnav.env.objectnav import OTHER_ROOM
from jaxnav.evaluation.similarity import cooccurrence_counts, scene_layout_gap, scene_layout_similarity
from jaxnav.runs.policies import load_policies
from jaxnav.runs.run import load_run_config
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.tables.compile import compile_bank, compile_scene
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import make_generated_scenes

# One cell, at the origin. x from -0.3 (book) to 0.875 (lattice), z from -0.125 (lattice) to 1.25 (chair).
KITCHEN = draw(
    [".###", "####", "####", "####"],
    ("Book", 0.0, 0.8, 1.0, *SMALL),
    ("Book", 0.0, 1.0, 1.0, *SMALL),
    ("Stool", 0.25, 0.5, 1.0, 0.5, 0.9, 0.5),
    ("Sofa", 3.0, 0.4, 0.5, 0.25, 0.8, 0.5),  # x up to 3.125
)
# Six cells; nothing that can be looked for.
BEDROOM = dataclasses.replace(
    draw(["...", "..."], ("Sofa", 0.25, 0.4, 1.0, 0.5, 0.8, 0.5)), name="plain", room_type="bed[room]", split="val"
)


def print_stats(capsys, *arguments):
    """Return the printed rows, each as a list of its cells."""
    assert scenes_command.main(["stats", *map(str, arguments)]) == 0
    return [re.split(r"\s{2,}", line.strip()) for line in capsys.readouterr().out.splitlines()]


def find_row(rows, *first_cells):
    """Return the further cells of the first row that begins with some cells."""
    num_cells = len(first_cells)
    return next(cells[num_cells:] for cells in rows if cells[:num_cells] == list(first_cells))


def gap_rows(rows):
    """Return the rows of the table of layout gaps."""
    start = next(index for index, cells in enumerate(rows) if cells[0].startswith("Layout priors of the run"))
    return rows[start:]


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "drawn.jsonl.gz"
    write_scenes(path, [KITCHEN, BEDROOM])
    return path


def test_scenes_stats_prints_sizes_and_counts(scene_file, capsys):
    rows = print_stats(capsys, scene_file)
    # Scenes of train, val and test; cells; size; objects, of categories. -0.3 to 3.125 is 3.4 m, -0.125 to 1.25 1.4 m.
    assert find_row(rows, "kitchen") == ["1", "0", "0", "1 1 1 1 1", "3.4 x 1.4 m", "4", "3"]
    # Three cells are 0.75 m wide; two and the sofa behind them reach from -0.125 to 1.25 m.
    assert find_row(rows, "bed[room]") == ["0", "1", "0", "6 6 6 6 6", "0.8 x 1.4 m", "1", "0"]
    # Quartiles of 1 and 6 cells: 2.25, 3.5, 4.75. Medians: width (3.425 + 0.75) / 2, objects 2.5, of categories 1.5.
    assert find_row(rows, "all") == ["1", "1", "0", "1 2 4 5 6", "2.1 x 1.4 m", "2.5", "1.5"]
    assert find_row(rows, "Unknown types, which only block the sight: Sofa x 2") == []
    assert find_row(rows, "Scenes without a goal: plain") == []


def test_scenes_stats_prints_categories_and_path_lengths(scene_file, capsys):
    rows = print_stats(capsys, scene_file)
    # The books are 1 m straight ahead of heading 0 and in view from headings 0 and 45 degrees to either side (the view
    # is 50 degrees wide on each); 2, 3 and 4 further turns away the path is as much longer. From the 8 starts L* is
    # 1 1 1 2 2 3 3 4: the median is the fourth of them, the 95th percentile the eighth.
    assert find_row(rows, "Book") == ["50%", "2.00", "0.90 m", "2", "4"]
    # The stool is 14 degrees to the right: headings 0, 45 (31 to its left); not -45 (59). At 0.5 m it is too low to be
    # seen level at 45 degrees? Its offsets there are ahead 0.88, up -1.0: tan(50) 0.88 = 1.05, so it is seen.
    # From 0 45 90 135 180 225 270 315: 1 1 2 3 4 4 3 2; sorted 1 1 2 2 3 3 4 4.
    assert find_row(rows, "Chair") == ["50%", "1.00", "0.50 m", "2", "4"]
    assert any(cells[0].startswith("Categories in no scene: AlarmClock, Bowl,") for cells in rows)


def test_scenes_stats_prints_cooccurring_pairs(scene_file, capsys):
    printed_rows = print_stats(capsys, scene_file)

    # In which poses book and chair are seen, bool [poses, 2].
    task = Task()
    row_format = RowFormat(len(task.categories))
    observation_rows = np.concatenate([compile_scene(scene, task).rows for scene in (KITCHEN, BEDROOM)])
    pair_indices = [task.categories.index(name) for name in ("Book", "Chair")]
    is_seen = np.array([present[np.array(pair_indices)] for present in row_format.presence(observation_rows)]).astype(
        bool
    )

    # The rarer one comes first: P(other | rarer), P(other) and the correlation phi.
    rarer, other = np.argsort(is_seen.sum(axis=0), kind="stable")
    conditional = is_seen[is_seen[:, rarer], other].mean()
    marginal = is_seen[:, other].mean()
    phi = np.corrcoef(is_seen.T)[0, 1]
    assert phi > 0.5
    pair = [("Book", "Chair")[index] for index in (rarer, other)]
    assert find_row(printed_rows, *pair) == [f"{conditional:.2f}", f"{marginal:.2f}", f"{phi:.2f}"]
    assert all(cells[:2] != pair[::-1] for cells in printed_rows)


def test_scenes_stats_omits_pairs_of_categories_in_no_scene(tmp_path, capsys):
    """A category without an object is detected by false alarms alone."""
    scene_file = tmp_path / "houses.jsonl.gz"
    houses = make_generated_scenes("houses", "val", 2)
    write_scenes(scene_file, [houses[0], houses[1]])
    rows = print_stats(capsys, scene_file, "--world", "rooms")
    (absent_line,) = (cells[0] for cells in rows if cells[0].startswith("Categories in no scene:"))
    start = next(index for index, cells in enumerate(rows) if cells[0].startswith("Detected together"))
    pair_names = {name for cells in rows[start + 2 :] if len(cells) == 5 for name in cells[:2]}
    assert pair_names
    assert not {name for name in pair_names if f"{name}," in absent_line or absent_line.endswith(name)}


@pytest.mark.slow
def test_scenes_stats_selects_splits_worlds_and_generated_scenes(scene_file, capsys):
    assert find_row(print_stats(capsys, scene_file, "--split", "val"), "bed[room]")[:3] == ["0", "1", "0"]
    # A sofa is what houses look for.
    rows = print_stats(capsys, scene_file, "--world", "houses")
    assert find_row(rows, "Sofa")[:3] == ["100%", "1.00", "0.40 m"]
    assert find_row(rows, "Scenes without a goal: none") == []
    assert find_row(print_stats(capsys, "apartments", "--split", "test"), "apartment")[:3] == ["0", "0", "15"]


def test_scenes_stats_prints_the_layout_gap_to_the_priors_of_a_run(tmp_path_factory, tmp_path, capsys):
    _, run_dir = finished_run(tmp_path_factory)
    capsys.readouterr()

    # A kitchen, a scene of a room type that the run does not know, and a bathroom.
    rooms = make_generated_scenes("rooms", "val", 8)
    scenes = [rooms[0], dataclasses.replace(rooms[4], room_type="apartment"), rooms[3]]
    scene_file = tmp_path / "a.jsonl.gz"
    write_scenes(scene_file, scenes)
    printed_rows = gap_rows(print_stats(capsys, scene_file, "--run", run_dir))

    # Kitchens are the first room type, bathrooms the last.
    config = load_run_config(run_dir)
    priors = np.asarray(load_policies(config).knowledge.priors)[[0, OTHER_ROOM, 3]]
    counts = cooccurrence_counts(compile_bank(scenes, config.task))
    gaps = scene_layout_gap(counts, priors)
    similarities = scene_layout_similarity(counts, priors)

    # The number of scenes, then mean and quartiles of the gap and of the similarity.
    scene_indices = {"kitchen": [0], "apartment": [1], "bathroom": [2], "all": [0, 1, 2]}
    for room_type, indices in scene_indices.items():
        expected_cells = [str(len(indices))]
        for values in (gaps[indices], similarities[indices]):
            quartiles = np.quantile(values, (0.25, 0.5, 0.75))
            expected_cells += [f"{np.mean(values):.2f}", " ".join(f"{quartile:.2f}" for quartile in quartiles)]
        assert find_row(printed_rows, room_type) == expected_cells
    assert len(set(gaps.round(6))) == 3


def test_scenes_stats_prints_no_gap_without_cooccurrence(tmp_path_factory, scene_file, capsys):
    _, run_dir = finished_run(tmp_path_factory)
    one_object = dataclasses.replace(
        KITCHEN,
        types=KITCHEN.types[:1],
        boxes=KITCHEN.boxes[:1],
        yaws=KITCHEN.yaws[:1],
        parents=KITCHEN.parents[:1],
    )

    # A false alarm has a chance of 0.5 % at each of the 16 poses and categories: the name decides whether there is one.
    candidates = [dataclasses.replace(one_object, name=name) for name in "abcde"]
    quiet_scene = next(scene for scene in candidates if not cooccurrence_counts(compile_bank([scene], Task())).any())
    write_scenes(scene_file, [quiet_scene])
    capsys.readouterr()
    printed_rows = gap_rows(print_stats(capsys, scene_file, "--run", run_dir))
    assert find_row(printed_rows, "kitchen") == ["0"]


def test_scenes_stats_shift_exchanges_places_of_a_file(scene_file, capsys):
    plain = print_stats(capsys, scene_file)
    shifted = print_stats(capsys, scene_file, "--shift", "1")
    # Two books and a stool: who is in half of the scenes, how many, how high. Undersides stay at 0.5, 0.7 and 0.05 m;
    # half of the stool's height of 0.9 m, and of the books' 0.6 m, comes on top.
    assert find_row(plain, "Book")[:3] == ["50%", "2.00", "0.90 m"]
    assert find_row(shifted, "Chair")[:3] == ["50%", "2.00", "1.05 m"]
    assert find_row(plain, "Chair")[:3] == ["50%", "1.00", "0.50 m"]
    assert find_row(shifted, "Book")[:3] == ["50%", "1.00", "0.35 m"]


def test_scenes_stats_refuses_missing_files_splits_and_runs(tmp_path, tmp_path_factory, scene_file, capsys):
    _, run_dir = finished_run(tmp_path_factory)
    for arguments, words in (
        ((tmp_path / "no.jsonl.gz",), ("no.jsonl.gz", "check the path")),
        ((scene_file, "--split", "test"), ("no scene of split 'test'", "train, val")),
        (("rooms", "--shift", "2"), ("shift 2.0", "from 0 to 1")),
        ((scene_file, "--run", tmp_path), ("holds no run",)),
        ((scene_file, "--run", run_dir, "--world", "rooms"), ("--world, --run", "the run has a world")),
    ):
        assert scenes_command.main(["stats", *map(str, arguments)]) == 2
        message = refusal(capsys)
        assert all(word in message for word in words), message
