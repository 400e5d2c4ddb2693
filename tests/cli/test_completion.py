"""Scripts that complete commands in a shell; the script of bash is also run where bash is installed."""

import shutil
import subprocess

import pytest

from jaxnav.__main__ import COMMANDS, main
from jaxnav.cli.completion import list_command_types, make_script
from jaxnav.experiments.config import EXPERIMENTS

#: fish passes a script as one argument of a process, which Linux limits to 128 KiB.
MAX_SCRIPT_BYTES = 120 * 1024


@pytest.fixture(scope="module")
def bash_script(tmp_path_factory):
    """The script of bash, in a file."""
    path = tmp_path_factory.mktemp("completion") / "jaxnav"
    path.write_text(make_script("bash"))
    return path


def complete(script, *words: str) -> set[str]:
    """Return the completions that bash offers for the last word of a command line."""
    quoted_words = " ".join(f"'{word}'" for word in ("jaxnav", *words))
    # Call the function that the script registers for `jaxnav`.
    code = f"""
source {script}
COMP_WORDS=({quoted_words}); COMP_CWORD={len(words)}; COMPREPLY=()
function=$(complete -p jaxnav | sed 's/.*-F \\([^ ]*\\) .*/\\1/')
$function
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    process = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert process.stderr == ""
    return set(process.stdout.split())


def test_completion_covers_every_command():
    assert list(list_command_types()) == list(COMMANDS)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_a_script(shell, capsys):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert len(script.encode()) < MAX_SCRIPT_BYTES
    for word in ("--worlds.num-train", "--from-controller", "table2"):
        assert word in script


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["tr"], {"train"}),
        (["train", "--ppo.ga"], {"--ppo.gamma", "--ppo.gae-lambda"}),
        (["train", "--world", "h"], {"houses"}),
        (["scenes", "s"], {"show", "stats"}),
        (["scenes", "import", "--from"], {"--from-controller"}),
        (["study", "table"], {"table2", "table3"}),
        (["study", "account", "--refer"], {"--reference"}),
        (["help", "comp"], {"completion"}),
        # Nothing of jaxnav fits, so that bash completes file names.
        (["eval", "runs/a"], set()),
    ],
)
def test_bash_completes_commands_options_and_choices(words, expected, bash_script):
    assert complete(bash_script, *words) == expected


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_bash_completes_all_experiments(bash_script):
    assert set(EXPERIMENTS) <= complete(bash_script, "study", "")
