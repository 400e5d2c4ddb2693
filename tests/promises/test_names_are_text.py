"""A name that comes from a file, a path or a command line is shown as text, whatever it holds.

Seen to fail: with a console that takes markup, `[/x]` in a path ends the commands with a `MarkupError`; without
`escape_control_chars` escapes reach the terminal; with figures that parse mathematics, `$` in the name of a scene file
ends the drawing of the learning curves.
"""

import contextlib
import dataclasses
import gzip
import json
import os
import subprocess
import sys
import unicodedata

import pytest
from rich.table import Table
from support.scenes import SMALL, draw

from jaxnav.__main__ import COMMANDS, main
from jaxnav.cli.console import PlainConsole, escape_control_chars, run_command
from jaxnav.errors import InputError
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes
from jaxnav.viz.learning import learning_figure

#: Markup, a colour, a bell, a new line, letters turned round, and mathematics without an end.
HOSTILE = "[/x][bold]\x1b[31m\x07\n\u202e$\\frac$"

#: What each command is given besides a hostile name, in place of `@`.
GIVEN = {
    "train": [("--run-dir", "@", "--scenes", "@"), ("--config", "@"), ("--method", "@")],
    "eval": [("@",), ("@", "--scenes", "@"), ("@", "--json", "@")],
    "report": [("@",), ("@", "--beside", "@"), ("@", "--out", "@")],
    "export": [("@",), ("@", "--policy", "@")],
    "episode": [("@",), ("@", "--scenes", "@")],
    "play": [("--scenes", "@"), ("--goal", "@"), ("--policy", "@")],
    "log": [("@", "--to", "tensorboard")],
    "study": [("@",), ("--config", "@"), ("account", "--run", "@"), ("table2", "--only", "@")],
    "scenes": [
        ("stats", "@"),
        ("show", "@"),
        ("import", "procthor", "@", "@"),
        ("import", "scenes", "@", "@.jsonl.gz"),
    ],
    "table": [("@",)],
    "no such command @": [()],
}


def assert_harmless(output):
    assert output
    assert "Traceback" not in output
    hidden = {"Cc", "Cf", "Cs", "Zl", "Zp"}
    assert not [char for char in output.replace("\n", "") if unicodedata.category(char) in hidden]


@pytest.mark.parametrize(
    ("name", "given"), [(name, given) for name, lines in GIVEN.items() for given in lines], ids=lambda value: str(value)
)
def test_every_command_escapes_hostile_names(name, given, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = [word.replace("@", HOSTILE) for word in (name, *given)]
    try:
        code = main(arguments)
    except SystemExit as end:  # from the parser
        code = end.code
    assert code == 2
    assert_harmless("".join(capsys.readouterr()))


@pytest.mark.parametrize(
    "words",
    [
        ("train", "--no-such@"),
        ("train", "--seed=@"),
        ("eval", "a", "--split=@"),
        ("study", "account", "--seed=@"),
        ("table", "a", "--no-such@"),
        ("scenes", "stats", "a", "--run", "b", "@"),
        ("scenes", "import", "@"),
    ],
)
def test_parser_errors_escape_hostile_options(words, capsys):
    with pytest.raises(SystemExit) as end:
        main([word.replace("@", HOSTILE) for word in words])
    assert end.value.code == 2
    assert_harmless(output := "".join(capsys.readouterr()))
    assert "[/x]" in output


def test_help_escapes_hostile_defaults(tmp_path, capsys):
    config = tmp_path / "run.yaml"
    config.write_text(json.dumps({"scenes": f"rooms{HOSTILE}.jsonl.gz"}))
    with pytest.raises(SystemExit) as end:
        main(["train", "--config", str(config), "--help"])
    assert end.value.code == 0
    assert_harmless(output := capsys.readouterr().out)
    assert "[/x]" in output


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals here")
def test_parser_error_on_a_terminal_keeps_its_colours():
    """What a parser adds for a terminal is not taken for a part of a name."""
    ours, theirs = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "jaxnav", "table", "a", "--no-such"], stdout=theirs, stderr=theirs
    )
    os.close(theirs)
    output = b""
    with contextlib.suppress(OSError):  # the other end is closed
        while part := os.read(ours, 4096):
            output += part
    assert process.wait() == 2
    assert b"--no-such" in output
    assert b"\\x1b" not in output


def test_hostile_arguments_cover_every_command():
    assert set(COMMANDS) <= set(GIVEN)


@pytest.fixture
def scene_file(tmp_path):
    """A scene file whose every text is hostile."""
    room = draw(["....", "...."], (HOSTILE, 0.25, 0.8, 0.0, *SMALL), ("Book", 0.75, 0.8, 0.0, *SMALL))
    scenes = [
        dataclasses.replace(room, name=f"{HOSTILE} {split}", room_type=HOSTILE, split=split, world=HOSTILE)
        for split in ("train", "val")
    ]
    write_scenes(tmp_path / "rooms.jsonl.gz", scenes)
    return tmp_path / "rooms.jsonl.gz"


@pytest.mark.filterwarnings("ignore:Glyph")
@pytest.mark.parametrize(
    "given",
    [
        ("stats",),
        ("stats", "--split", "val"),
        ("show", "--scene", "none"),
        ("show", "--index", "0", "--out", "a.png"),
        ("import", "scenes"),
    ],
    ids=str,
)
def test_scenes_command_escapes_hostile_names_in_a_file(given, scene_file, monkeypatch, capsys):
    monkeypatch.chdir(scene_file.parent)
    command, *options = given
    target = ["out.jsonl.gz"] if command == "import" else []
    form = [options.pop(0)] if command == "import" else []
    assert main(["scenes", command, *form, str(scene_file), *target, *options]) in (0, 2)
    output = capsys.readouterr()
    assert_harmless(output.out + output.err)


def test_console_escapes_lines_tables_and_titles(capsys):
    table = Table("[/x]", title=HOSTILE)
    table.add_row(HOSTILE, style="bold")
    console = PlainConsole(width=120)
    console.print(f"{HOSTILE} :smile:", style="bold")
    console.print(table)
    output = capsys.readouterr().out
    assert_harmless(output)
    assert output.startswith(r"[/x][bold]\x1b[31m\x07\n\u202e$\frac$ :smile:")


def test_refusal_of_a_hostile_name_is_one_line(capsys):
    def refused(_):
        raise InputError(f"{HOSTILE}: mend it")

    assert run_command(refused) == 2
    output = capsys.readouterr().err
    assert_harmless(output)
    assert output.count("\n") == 1


def test_escape_control_chars_keeps_letters_of_any_language():
    assert escape_control_chars("Küche, 台所, кухня, 🍳, ́") == "Küche, 台所, кухня, 🍳, ́"
    assert escape_control_chars("a\nb\x1bc", keep="\n") == "a\nb\\x1bc"


@pytest.mark.filterwarnings("ignore:Glyph")  # an escape is drawn as a box
def test_figure_title_accepts_unbalanced_mathematics():
    row = {"arm": "layout", "env_steps": 1, "success": 0.5}
    learning_figure([row], None, f"ORG in {HOSTILE}")


def test_read_scenes_refuses_a_lone_surrogate(scene_file):
    text = gzip.decompress(scene_file.read_bytes()).replace(b"\\u202e", b"\\ud800")
    scene_file.write_bytes(text)
    with pytest.raises(InputError, match=r"name is .*, which holds half a character; write the whole one"):
        read_scenes(scene_file)
