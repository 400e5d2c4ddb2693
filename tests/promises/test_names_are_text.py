"""Names from files, paths and command lines are escaped before they are shown.

Seen to fail: with a console that takes markup, `[/x]` in a path ends the commands with a `MarkupError`; without
`escape_control_chars` escapes reach the terminal; with figures that parse mathematics, `$` in the name of a scene file
ends the drawing of the learning curves.
"""

import ast
import contextlib
import dataclasses
import gzip
import io
import json
import os
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table
from support.scenes import SMALL, draw
from support.tiny_run import tiny_config

import jaxnav
from jaxnav.__main__ import COMMANDS, main
from jaxnav.cli.console import run_command
from jaxnav.errors import InputError
from jaxnav.plain_console import PlainConsole, escape_control_chars, to_plain_console
from jaxnav.runs.config import RunConfig
from jaxnav.runs.worlds import compile_evaluation_world
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes
from jaxnav.viz.learning import learning_figure

#: Markup, a colour, a bell, a new line, letters turned round, and mathematics without an end.
HOSTILE = "[/x][bold]\x1b[31m\x07\n\u202e$\\frac$"

#: Arguments of each command, with the hostile name in place of `@`.
HOSTILE_ARGUMENTS = {
    "train": [("--run-dir", "@", "--scenes", "@"), ("--config", "@"), ("--method", "@")],
    "eval": [("@",), ("@.json",), ("@", "--scenes", "@"), ("@", "--json", "@")],
    "sweep": [("@",), ("rooms-org", "--scenes", "@"), ("rooms-org", "--out", "@")],
    "report": [("@",), ("@", "--reference", "@"), ("@", "--out", "@")],
    "list": [("@",)],
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
    "completion": [("@",)],
    "help": [("@",)],
    "table": [("@",)],
    "no such command @": [()],
}


#: Unicode categories of characters that are not shown: controls, formats, surrogates and separators of lines.
HIDDEN_CATEGORIES = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def assert_escaped(output):
    """Check that an output contains no hidden character except new lines, and no traceback."""
    assert output
    assert "Traceback" not in output
    characters = output.replace("\n", "")
    assert not [char for char in characters if unicodedata.category(char) in HIDDEN_CATEGORIES]


def insert_hostile_name(words):
    return [word.replace("@", HOSTILE) for word in words]


# Command lines


def list_command_lines():
    """All words of each command line, with a hostile name still written as `@`."""
    command_lines = []
    for command, argument_lists in HOSTILE_ARGUMENTS.items():
        for arguments in argument_lists:
            command_lines.append((command, *arguments))
    return command_lines


@pytest.mark.parametrize("words", list_command_lines(), ids=str)
def test_every_command_escapes_hostile_names(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    try:
        exit_code = main(insert_hostile_name(words))
    except SystemExit as parser_exit:
        exit_code = parser_exit.code
    assert exit_code == 2
    assert_escaped("".join(capsys.readouterr()))


def test_hostile_arguments_cover_every_command():
    assert set(COMMANDS) <= set(HOSTILE_ARGUMENTS)


@pytest.mark.parametrize(
    "words",
    [
        ("train", "--no-such@"),
        ("train", "--seed=@"),
        ("eval", "a", "--split=@"),
        ("study", "account", "--seed=@"),
        ("list", "--no-such@"),
        ("scenes", "stats", "a", "--run", "b", "@"),
        ("scenes", "import", "@"),
    ],
)
def test_parser_errors_escape_hostile_options(words, capsys):
    with pytest.raises(SystemExit) as parser_exit:
        main(insert_hostile_name(words))
    assert parser_exit.value.code == 2
    output = "".join(capsys.readouterr())
    assert_escaped(output)
    assert "[/x]" in output


def test_help_escapes_hostile_defaults(tmp_path, capsys):
    config_file = tmp_path / "run.yaml"
    config_file.write_text(json.dumps({"scenes": f"rooms{HOSTILE}.jsonl.gz"}))
    with pytest.raises(SystemExit) as parser_exit:
        main(["train", "--config", str(config_file), "--help"])
    assert parser_exit.value.code == 0
    output = capsys.readouterr().out
    assert_escaped(output)
    assert "[/x]" in output


def read_until_closed(descriptor):
    """Return all bytes from a pseudo terminal; reading from it fails when the process has closed its end."""
    output = b""
    with contextlib.suppress(OSError):
        chunk = os.read(descriptor, 4096)
        while chunk:
            output += chunk
            chunk = os.read(descriptor, 4096)
    return output


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals here")
def test_parser_error_on_a_terminal_has_no_escapes():
    """The escape sequences that a parser adds for a terminal are removed, not printed as parts of a name."""
    # A refused command, whose output goes to a pseudo terminal.
    controller, terminal = os.openpty()
    command = [sys.executable, "-m", "jaxnav", "eval", "a", "--no-such"]
    process = subprocess.Popen(command, stdout=terminal, stderr=terminal)
    os.close(terminal)
    output = read_until_closed(controller)
    assert process.wait() == 2

    # The error names the option, without an escape sequence.
    assert b"--no-such" in output
    assert b"\\x1b" not in output


# Scene files, tables and figures


@pytest.fixture
def scene_file(tmp_path):
    """A scene file in which name, room type, world and an object's type are hostile."""
    room = draw(["....", "...."], (HOSTILE, 0.25, 0.8, 0.0, *SMALL), ("Book", 0.75, 0.8, 0.0, *SMALL))
    room = dataclasses.replace(room, room_type=HOSTILE, world=HOSTILE)
    scenes = []
    for split in ("train", "val"):
        scenes.append(dataclasses.replace(room, name=f"{HOSTILE} {split}", split=split))
    write_scenes(tmp_path / "rooms.jsonl.gz", scenes)
    return tmp_path / "rooms.jsonl.gz"


@pytest.mark.filterwarnings("ignore:Glyph")
@pytest.mark.parametrize(
    "words",
    [
        ("stats", "FILE"),
        ("stats", "FILE", "--split", "val"),
        ("show", "FILE", "--scene", "none"),
        ("show", "FILE", "--index", "0", "--out", "a.png"),
        ("import", "scenes", "FILE", "out.jsonl.gz"),
    ],
    ids=str,
)
def test_scenes_command_escapes_hostile_names_in_a_file(words, scene_file, monkeypatch, capsys):
    monkeypatch.chdir(scene_file.parent)
    arguments = ["scenes"]
    for word in words:
        arguments.append(str(scene_file) if word == "FILE" else word)
    assert main(arguments) in (0, 2)
    assert_escaped("".join(capsys.readouterr()))


def test_console_escapes_lines_tables_and_titles(capsys):
    table = Table("[/x]", title=HOSTILE)
    table.add_row(HOSTILE, style="bold")
    console = PlainConsole(width=120)
    console.print(f"{HOSTILE} :smile:", style="bold")
    console.print(table)
    output = capsys.readouterr().out
    assert_escaped(output)
    assert output.startswith(r"[/x][bold]\x1b[31m\x07\n\u202e$\frac$ :smile:")


# Consoles of a caller


def hostile_console(**options):
    """Return a console that takes markup, as `rich.console.Console()` does, and the stream to which it prints."""
    stream = io.StringIO()
    return Console(file=stream, width=500, **options), stream


def test_to_plain_console_prints_literally_to_the_console_of_a_caller():
    console, stream = hostile_console(record=True)
    plain_console = to_plain_console(console)
    plain_console.print(f"{HOSTILE} :smile: 12", style="red")
    expected = r"[/x][bold]\x1b[31m\x07\n\u202e$\frac$ :smile: 12" + "\n"
    assert stream.getvalue() == expected
    assert console.export_text() == expected
    assert to_plain_console(plain_console) is plain_console

    # The console of the caller still takes markup.
    console.print("[bold]x[/bold]")
    assert stream.getvalue().endswith("\nx\n")


def test_to_plain_console_stays_quiet(capsys):
    for console in (None, Console(quiet=True)):
        to_plain_console(console).print("x")
    assert "".join(capsys.readouterr()) == ""


def takes_any_console(function):
    """True if a function has an argument `console` that need not be a plain console."""
    for argument in (*function.args.args, *function.args.kwonlyargs):
        annotation = "" if argument.annotation is None else ast.unparse(argument.annotation)
        if argument.arg == "console" and "PlainConsole" not in annotation:
            return True
    return False


def list_console_functions():
    """Yield module, name and source of every function that takes any console, except in `jaxnav.cli`."""
    package_folder = Path(jaxnav.__file__).parent
    for module in package_folder.rglob("*.py"):
        if module.parent.name == "cli":
            continue
        for node in ast.walk(ast.parse(module.read_text())):
            if isinstance(node, ast.FunctionDef) and takes_any_console(node):
                yield module.name, node.name, ast.unparse(node)


def test_every_function_prints_literally_to_the_console_of_a_caller():
    # `show_activity` prints `Text`, which has no markup.
    functions = [function for function in list_console_functions() if function[1] != "show_activity"]
    assert len(functions) > 10
    for module, name, source in functions:
        assert "to_plain_console(" in source or "console.print(" not in source, f"{module}: {name}"


@pytest.mark.filterwarnings("ignore:Glyph")
def test_compiling_a_world_prints_the_name_of_its_file_literally(scene_file):
    console, stream = hostile_console()
    config = RunConfig(world="rooms")
    with contextlib.suppress(InputError):
        compile_evaluation_world(config, "val", scene_file, None, console)
    assert_escaped(stream.getvalue())


@pytest.mark.slow
def test_training_and_evaluation_print_the_run_directory_literally(tmp_path):
    config = tiny_config(tmp_path)
    config = dataclasses.replace(config, run_dir=tmp_path / "[" / "x]", seeds=1, arms=("layout",))
    console, stream = hostile_console()
    run = jaxnav.train(config, console)
    assert f"{config.run_dir}: done in" in stream.getvalue()
    jaxnav.evaluate(run, episodes=2, console=console)


def test_refusal_of_a_hostile_name_is_one_line(capsys):
    def refuse(_):
        raise InputError(f"{HOSTILE}: mend it")

    assert run_command(refuse) == 2
    output = capsys.readouterr().err
    assert_escaped(output)
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
    with pytest.raises(InputError, match=r"name is .*half a character; write"):
        read_scenes(scene_file)
