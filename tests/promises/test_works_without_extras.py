"""Without matplotlib and pillow everything but the pictures works."""

import subprocess
import sys
from pathlib import Path

import pytest

from jaxnav.__main__ import COMMANDS

WITHOUT = "import sys; sys.modules['matplotlib'] = sys.modules['PIL'] = None\n"
REFUSAL = "error: pictures need matplotlib and pillow; install them with: pip install 'jaxnav[viz]'\n"

HELP = """
from jaxnav.__main__ import main
def helped(*arguments):
    try:
        return main([*arguments, "--help"])
    except SystemExit as exit:
        return exit.code
print([name for name in ALL if helped(*name.split()) != 0], file=sys.stderr)
"""
IMPORT = """
import jaxnav
for name in jaxnav.__all__:
    getattr(jaxnav, name)
print("imported", file=sys.stderr)
"""


def without_pictures(script, folder):
    """Run a script where matplotlib and PIL cannot be imported."""
    command = [sys.executable, "-c", WITHOUT + script]
    environment = {"PYTHONPATH": str(Path(__file__).parents[2])}
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, env=environment)


@pytest.mark.slow
def test_every_name_and_help_works_without_extras(tmp_path):
    commands = [*COMMANDS, *(f"scenes {name}" for name in ("import", "show", "stats"))]
    done = without_pictures(IMPORT + HELP.replace("ALL", repr(commands)), tmp_path)
    assert (done.returncode, done.stderr) == (0, "imported\n[]\n")


#: Commands that draw.
DRAWING_COMMANDS = ["episode run", "report run", "scenes show rooms", "study study_rooms"]


@pytest.mark.slow
@pytest.mark.parametrize("command", DRAWING_COMMANDS)
def test_drawing_command_is_refused_without_extras(tmp_path, command):
    script = f"from jaxnav.__main__ import main\nsys.exit(main({command.split()}))"
    done = without_pictures(script, tmp_path)
    assert (done.returncode, done.stderr) == (2, REFUSAL)
    assert not list(tmp_path.iterdir())
