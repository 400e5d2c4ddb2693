"""The command `scenes show`: which scene and pose it draws, where to, and what it refuses."""

import dataclasses

import pytest
from PIL import Image
from support.commands import refusal
from support.scenes import SMALL, draw

from jaxnav.cli import scenes as scenes_command
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import Task
from jaxnav.viz.scene import SCENE_DPI, scene_figure, view_from_pose

TASK = Task(detector=PERFECT_DETECTOR)
# Cells (0, 0) to (0, 1.5) m and, with no way there, one at (0.75, 0).
HALL = draw([".##."] + [".###"] * 6, ("Book", 0.0, 0.8, 2.5, *SMALL))
OTHER = dataclasses.replace(draw(["..", ".."], ("Pan", 0.25, 0.9, 0.75, *SMALL)), name="a/b $x", split="val")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "two.jsonl.gz"
    write_scenes(path, [HALL, OTHER])
    return path


def show(*arguments):
    return scenes_command.main(["show", *map(str, arguments)])


def test_scenes_show_writes_a_png_of_the_figure_size(file, tmp_path, capsys):
    out = tmp_path / "new" / "hall.png"
    assert show(file, "--scene", "drawn", "--pose", 0, 1.5, -90, "--out", out) == 0
    assert str(out) in capsys.readouterr().err.replace("\n", "")
    size = scene_figure(HALL, TASK, view_from_pose(HALL, TASK, (0, 1.5, -90))).get_size_inches()
    with Image.open(out) as image:
        assert image.format == "PNG"
        assert image.size == tuple((size * SCENE_DPI).astype(int))
    assert [path.name for path in out.parent.iterdir()] == ["hall.png"]


@pytest.mark.slow
def test_scenes_show_selects_by_name_number_or_the_first(file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    pictures = {}
    for options in ((), ("--scene", "a/b $x"), ("--index", 1), ("--split", "val")):
        assert show(file, *options) == 0
        written = sorted(tmp_path.glob("*.png"))
        assert len(written) == 1  # named after the scene, in the working directory
        pictures[options] = (written[0].name, written[0].read_bytes())
        written[0].unlink()
    assert pictures[()][0] == "drawn.png"
    assert pictures["--scene", "a/b $x"][0] == "a_b__x.png"
    assert pictures["--scene", "a/b $x"] == pictures["--index", 1] == pictures["--split", "val"]
    assert show("apartments", "--index", 16, "--seed", 3, "--split", "test") == 0
    assert (tmp_path / "test-apartment-03-1.png").exists()


def test_scenes_show_writes_each_layout_shift_to_its_own_file(file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for shift in (0, 0.5, 1):
        assert show(file, "--scene", "drawn", "--shift", shift) == 0
        assert f"drawn at layout shift {shift}, drawn by the rules of rooms" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.glob("*.png")) == [
        "drawn-shift-0.5.png",
        "drawn-shift-1.png",
        "drawn.png",
    ]


def test_scenes_show_warns_beyond_the_usual_number_of_scenes(file, tmp_path, capsys):
    """A generated world has any number of scenes; training and evaluation use the first of them."""
    out = ("--out", tmp_path / "scene.png")
    for arguments, is_beyond in ((("rooms", "--index", 20), True), (("rooms", "--index", 19), False), ((file,), False)):
        assert show(*arguments, *out) == 0
        message = " ".join(capsys.readouterr().err.split())
        assert ("rooms has 20 scenes of val by default" in message) == is_beyond
        assert ("--worlds.num-val 21" in message) == is_beyond


@pytest.mark.slow
def test_scenes_show_refuses_bad_requests(file, tmp_path, capsys):
    (tmp_path / "folder.png").mkdir()
    out = ("--out", tmp_path / "no.png")
    for arguments, words in (
        ((tmp_path / "no.jsonl.gz", *out), ("no.jsonl.gz", "check the path")),
        ((file, "--scene", "drwan", *out), ("'drwan'", "did you mean drawn?")),
        ((file, "--scene", "12345", *out), ("'12345'", "not one of the 2 scenes", "drawn, a/b $x")),
        ((file, "--scene", "drawn", "--index", 0, *out), ("--scene, --index",)),
        ((file, "--index", 2, *out), ("--index 2", "give 0 to 1")),
        ((file, "--index", -1, *out), ("--index -1", "0 or more")),
        (("rooms", "--index", -1, *out), ("--index -1", "0 or more")),
        (("rooms", "--scene", "val-kichen-000", *out), ("val-kitchen-000",)),
        ((file, "--pose", 0.75, 0, 0, *out), ("no agent can stand there", "nearest place is 0 0")),
        ((file, "--pose", "nan", 0, 0, *out), ("no agent can stand there",)),
        ((file, "--pose", 0, 0, 30, *out), ("multiple of 45",)),
        ((file, "--out", tmp_path / "a.gif"), ("ends in .png",)),
        ((file, "--out", tmp_path / "folder.png"), ("folder.png", "cannot be written")),
    ):
        assert show(*arguments) == 2, arguments
        message = refusal(capsys)
        assert all(word in message for word in words), message
    with pytest.raises(SystemExit):
        show(file, "--pose", "0 0", *out)
    assert not (tmp_path / "no.png").exists()
