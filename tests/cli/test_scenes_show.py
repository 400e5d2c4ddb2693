"""The command `scenes show`: the scene and pose that are drawn, the name of the picture, and refusals."""

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
#: A scene of the training split, named `drawn`: cells from (0, 0) to (0, 1.5) m, and an unreachable one at (0.75, 0).
HALL = draw([".##."] + [".###"] * 6, ("Book", 0.0, 0.8, 2.5, *SMALL))
#: A scene of the validation split, whose name cannot be a file name.
VAL_SCENE = dataclasses.replace(draw(["..", ".."], ("Pan", 0.25, 0.9, 0.75, *SMALL)), name="a/b $x", split="val")


@pytest.fixture
def scene_file(tmp_path):
    """A scene file with `HALL` and `VAL_SCENE`."""
    path = tmp_path / "two.jsonl.gz"
    write_scenes(path, [HALL, VAL_SCENE])
    return path


def show(*arguments):
    """Run the command `scenes show`, and return its exit code."""
    return scenes_command.main(["show", *map(str, arguments)])


def test_scenes_show_writes_a_png_of_the_figure_size(scene_file, tmp_path, capsys):
    picture_path = tmp_path / "new" / "hall.png"
    assert show(scene_file, "--scene", "drawn", "--pose", 0, 1.5, -90, "--out", picture_path) == 0
    assert str(picture_path) in capsys.readouterr().err.replace("\n", "")

    # The picture has the pixels of the figure that the library draws.
    figure = scene_figure(HALL, TASK, view_from_pose(HALL, TASK, (0, 1.5, -90)))
    expected_size = tuple((figure.get_size_inches() * SCENE_DPI).astype(int))
    with Image.open(picture_path) as image:
        assert image.format == "PNG"
        assert image.size == expected_size
    assert [path.name for path in picture_path.parent.iterdir()] == ["hall.png"]


@pytest.mark.slow
def test_scenes_show_selects_by_name_number_or_the_first(scene_file, tmp_path, monkeypatch):
    # The only picture is named after the scene, and lies in the working directory.
    monkeypatch.chdir(tmp_path)
    pictures = {}
    for options in ((), ("--scene", "a/b $x"), ("--index", 1), ("--split", "val")):
        assert show(scene_file, *options) == 0
        picture_paths = sorted(tmp_path.glob("*.png"))
        assert len(picture_paths) == 1
        pictures[options] = (picture_paths[0].name, picture_paths[0].read_bytes())
        picture_paths[0].unlink()

    assert pictures[()][0] == "drawn.png"
    assert pictures["--scene", "a/b $x"][0] == "a_b__x.png"
    assert pictures["--scene", "a/b $x"] == pictures["--index", 1] == pictures["--split", "val"]

    # A generated world takes the options of a file, and a seed.
    assert show("apartments", "--index", 16, "--seed", 3, "--split", "test") == 0
    assert (tmp_path / "test-apartment-03-1.png").exists()


def test_scenes_show_writes_each_layout_shift_to_its_own_file(scene_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for shift in (0, 0.5, 1):
        assert show(scene_file, "--scene", "drawn", "--shift", shift) == 0
        assert f"drawn at layout shift {shift}, drawn by the rules of rooms" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.glob("*.png")) == [
        "drawn-shift-0.5.png",
        "drawn-shift-1.png",
        "drawn.png",
    ]


def test_scenes_show_warns_beyond_the_usual_number_of_scenes(scene_file, tmp_path, capsys):
    """A generated world has any number of scenes; training and evaluation use the first of them."""
    out_option = ("--out", tmp_path / "scene.png")
    for arguments, is_beyond in (
        (("rooms", "--index", 20), True),
        (("rooms", "--index", 19), False),
        ((scene_file,), False),
    ):
        assert show(*arguments, *out_option) == 0
        message = " ".join(capsys.readouterr().err.split())
        assert ("rooms has 20 scenes of val by default" in message) == is_beyond
        assert ("--worlds.num-val 21" in message) == is_beyond


@pytest.mark.slow
def test_scenes_show_refuses_bad_requests(scene_file, tmp_path, capsys):
    (tmp_path / "folder.png").mkdir()
    out_option = ("--out", tmp_path / "no.png")
    for arguments, message_parts in (
        # Files and scenes that do not exist.
        ((tmp_path / "no.jsonl.gz", *out_option), ("no.jsonl.gz", "check the path")),
        ((scene_file, "--scene", "drwan", *out_option), ("'drwan'", "did you mean drawn?")),
        ((scene_file, "--scene", "12345", *out_option), ("'12345'", "not one of the 2 scenes", "drawn, a/b $x")),
        ((scene_file, "--scene", "drawn", "--index", 0, *out_option), ("--scene, --index",)),
        ((scene_file, "--index", 2, *out_option), ("--index 2", "give 0 to 1")),
        ((scene_file, "--index", -1, *out_option), ("--index -1", "0 or more")),
        (("rooms", "--index", -1, *out_option), ("--index -1", "0 or more")),
        (("rooms", "--scene", "val-kichen-000", *out_option), ("val-kitchen-000",)),
        # Poses that no agent can have.
        ((scene_file, "--pose", 0.75, 0, 0, *out_option), ("no agent can stand there", "nearest place is 0 0")),
        ((scene_file, "--pose", "nan", 0, 0, *out_option), ("no agent can stand there",)),
        ((scene_file, "--pose", 0, 0, 30, *out_option), ("multiple of 45",)),
        # Files that cannot be written.
        ((scene_file, "--out", tmp_path / "a.gif"), ("ends in .png",)),
        ((scene_file, "--out", tmp_path / "folder.png"), ("folder.png", "cannot be written")),
    ):
        assert show(*arguments) == 2, arguments
        message = refusal(capsys)
        assert all(part in message for part in message_parts), message

    # The parser refuses a pose of the wrong shape.
    with pytest.raises(SystemExit):
        show(scene_file, "--pose", "0 0", *out_option)
    assert not (tmp_path / "no.png").exists()
