"""What `scenes stats` tells, on drawn scenes with numbers worked out by hand and on the rooms of a finished run."""

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


def stats(capsys, *arguments):
    """The rows of the output, each as a list of its cells."""
    assert scenes_command.main(["stats", *map(str, arguments)]) == 0
    return [re.split(r"\s{2,}", line.strip()) for line in capsys.readouterr().out.splitlines()]


def row(rows, *start):
    """The rest of the first row that starts so."""
    return next(cells[len(start) :] for cells in rows if cells[: len(start)] == list(start))


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "drawn.jsonl.gz"
    write_scenes(path, [KITCHEN, BEDROOM])
    return path


def test_scenes_stats_prints_sizes_and_counts(file, capsys):
    rows = stats(capsys, file)
    # Scenes of train, val and test; cells; size; objects, of categories. -0.3 to 3.125 is 3.4 m, -0.125 to 1.25 1.4 m.
    assert row(rows, "kitchen") == ["1", "0", "0", "1 1 1 1 1", "3.4 x 1.4 m", "4", "3"]
    # Three cells are 0.75 m wide; two and the sofa behind them reach from -0.125 to 1.25 m.
    assert row(rows, "bed[room]") == ["0", "1", "0", "6 6 6 6 6", "0.8 x 1.4 m", "1", "0"]
    # Quartiles of 1 and 6 cells: 2.25, 3.5, 4.75. Medians: width (3.425 + 0.75) / 2, objects 2.5, of categories 1.5.
    assert row(rows, "all") == ["1", "1", "0", "1 2 4 5 6", "2.1 x 1.4 m", "2.5", "1.5"]
    assert row(rows, "Unknown types, which only block the sight: Sofa x 2") == []
    assert row(rows, "Scenes without a goal: plain") == []


def test_scenes_stats_prints_categories_and_path_lengths(file, capsys):
    rows = stats(capsys, file)
    # The books are 1 m straight ahead of heading 0 and in view from headings 0 and 45 degrees to either side (the view
    # is 50 degrees wide on each); 2, 3 and 4 further turns away the path is as much longer. From the 8 starts L* is
    # 1 1 1 2 2 3 3 4: the median is the fourth of them, the 95th percentile the eighth.
    assert row(rows, "Book") == ["50%", "2.00", "0.90 m", "2", "4"]
    # The stool is 14 degrees to the right: headings 0, 45 (31 to its left); not -45 (59). At 0.5 m it is too low to be
    # seen level at 45 degrees? Its offsets there are ahead 0.88, up -1.0: tan(50) 0.88 = 1.05, so it is seen.
    # From 0 45 90 135 180 225 270 315: 1 1 2 3 4 4 3 2; sorted 1 1 2 2 3 3 4 4.
    assert row(rows, "Chair") == ["50%", "1.00", "0.50 m", "2", "4"]
    assert any(cells[0].startswith("Categories in no scene: AlarmClock, Bowl,") for cells in rows)


def test_scenes_stats_prints_cooccurring_pairs(file, capsys):
    shown = stats(capsys, file)
    row_format, names = RowFormat(len(Task().categories)), Task().categories
    rows = np.concatenate([compile_scene(scene, Task()).rows for scene in (KITCHEN, BEDROOM)])
    seen = np.array(
        [[bool(present[names.index(name)]) for name in ("Book", "Chair")] for present in row_format.presence(rows)]
    )
    rare, other = sorted((0, 1), key=lambda k: seen[:, k].sum())
    given, base = seen[seen[:, rare], other].mean(), seen[:, other].mean()
    phi = np.corrcoef(seen.T)[0, 1]
    pair = [("Book", "Chair")[k] for k in (rare, other)]
    assert phi > 0.5
    assert row(shown, *pair) == [f"{given:.2f}", f"{base:.2f}", f"{phi:.2f}"]
    assert all(cells[:2] != pair[::-1] for cells in shown)


@pytest.mark.slow
def test_scenes_stats_selects_splits_worlds_and_generated_scenes(file, capsys):
    assert row(stats(capsys, file, "--split", "val"), "bed[room]")[:3] == ["0", "1", "0"]
    # A sofa is what houses look for.
    rows = stats(capsys, file, "--world", "houses")
    assert row(rows, "Sofa")[:3] == ["100%", "1.00", "0.40 m"]
    assert row(rows, "Scenes without a goal: none") == []
    assert row(stats(capsys, "apartments", "--split", "test"), "apartment")[:3] == ["0", "0", "15"]


def test_scenes_stats_prints_the_layout_gap_to_the_priors_of_a_run(tmp_path_factory, tmp_path, capsys):
    _, run_dir = finished_run(tmp_path_factory)
    capsys.readouterr()
    kitchen, bath = make_generated_scenes("rooms", "val", 8)[0], make_generated_scenes("rooms", "val", 8)[3]
    apartment = dataclasses.replace(make_generated_scenes("rooms", "val", 8)[4], room_type="apartment")
    write_scenes(tmp_path / "a.jsonl.gz", [kitchen, apartment, bath])
    rows = stats(capsys, tmp_path / "a.jsonl.gz", "--run", run_dir)
    start = next(i for i, cells in enumerate(rows) if cells[0].startswith("Layouts against"))
    run = load_run_config(run_dir)
    priors = np.asarray(load_policies(run).knowledge.layout)[
        [0, OTHER_ROOM, 3]
    ]  # kitchens are the first room type, baths the last
    counts = cooccurrence_counts(compile_bank([kitchen, apartment, bath], run.task))
    gaps, likeness = scene_layout_gap(counts, priors), scene_layout_similarity(counts, priors)
    for name, which in {"kitchen": [0], "apartment": [1], "bathroom": [2], "all": [0, 1, 2]}.items():
        measured = [gaps[which], likeness[which]]
        means = [np.mean(values) for values in measured]
        quartiles = [np.quantile(values, (0.25, 0.5, 0.75)) for values in measured]
        texts = [" ".join(f"{q:.2f}" for q in three) for three in quartiles]
        expected = [str(len(which)), f"{means[0]:.2f}", texts[0], f"{means[1]:.2f}", texts[1]]
        assert row(rows[start:], name) == expected
    assert len(set(gaps.round(6))) == 3


def test_scenes_stats_prints_no_gap_without_cooccurrence(tmp_path_factory, file, capsys):
    _, run_dir = finished_run(tmp_path_factory)
    alone = dataclasses.replace(KITCHEN, types=KITCHEN.types[:1], boxes=KITCHEN.boxes[:1])
    alone = dataclasses.replace(alone, yaws=alone.yaws[:1], parents=alone.parents[:1])
    # A false alarm has a chance of 0.5 % at each of the 16 poses and categories: the name decides whether there is one.
    together = {
        name: cooccurrence_counts(compile_bank([dataclasses.replace(alone, name=name)], Task())).any()
        for name in "abcde"
    }
    quiet = next(name for name, seen in together.items() if not seen)
    write_scenes(file, [dataclasses.replace(alone, name=quiet)])
    capsys.readouterr()
    rows = stats(capsys, file, "--run", run_dir)
    start = next(i for i, cells in enumerate(rows) if cells[0].startswith("Layouts against"))
    assert row(rows[start:], "kitchen") == ["0"]


def test_scenes_stats_shift_exchanges_places_of_a_file(file, capsys):
    plain, shifted = (stats(capsys, file, *options) for options in ((), ("--shift", "1")))
    # Two books and a stool: who is in half of the scenes, how many, how high. Undersides stay at 0.5, 0.7 and 0.05 m;
    # half of the stool's height of 0.9 m, and of the books' 0.6 m, comes on top.
    assert row(plain, "Book")[:3] == ["50%", "2.00", "0.90 m"]
    assert row(shifted, "Chair")[:3] == ["50%", "2.00", "1.05 m"]
    assert row(plain, "Chair")[:3] == ["50%", "1.00", "0.50 m"]
    assert row(shifted, "Book")[:3] == ["50%", "1.00", "0.35 m"]


def test_scenes_stats_refuses_missing_files_splits_and_runs(tmp_path, tmp_path_factory, file, capsys):
    _, run_dir = finished_run(tmp_path_factory)
    for arguments, words in (
        ((tmp_path / "no.jsonl.gz",), ("no.jsonl.gz", "check the path")),
        ((file, "--split", "test"), ("no scene of split 'test'", "train, val")),
        (("rooms", "--shift", "2"), ("shift 2.0", "from 0 to 1")),
        ((file, "--run", tmp_path), ("holds no run",)),
        ((file, "--run", run_dir, "--world", "rooms"), ("--world, --run", "leave --world out")),
    ):
        assert scenes_command.main(["stats", *map(str, arguments)]) == 2
        message = refusal(capsys)
        assert all(word in message for word in words), message
