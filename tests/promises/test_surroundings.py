"""Environment variables, streams and settings of other programs are inputs: they do not matter, or get one line."""

import contextlib
import itertools
import shutil

import gymnasium
import jax
import matplotlib as mpl
import pytest
from support.refusals import assert_message_names
from support.surroundings import COMMANDS, ENVIRONMENTS, find_fault, run_jaxnav, try_command
from support.tiers import params_by_tier
from support.tiny_run import finished_run, tiny_config

import jaxnav
from jaxnav.__main__ import main
from jaxnav.cli.console import run_command
from jaxnav.env import gym
from jaxnav.env.testing import check_environment
from jaxnav.errors import InputError
from jaxnav.training.devices import require_float32
from jaxnav.viz.learning import learning_figure
from jaxnav.viz.style import save_figure


@contextlib.contextmanager
def turned_on(setting):
    """Turn a setting of JAX on, as its environment variable does."""
    jax.config.update(setting, True)
    yield
    jax.config.update(setting, False)


@pytest.fixture
def x64():
    with turned_on("jax_enable_x64"):
        yield


# JAX


@pytest.mark.usefixtures("x64")
def test_python_refuses_the_64_bit_mode_in_one_line(tmp_path):
    calls = (
        require_float32,
        lambda: jaxnav.load_policy("rooms-org"),
        lambda: jaxnav.train(tiny_config(tmp_path)),
    )
    for call in calls:
        with pytest.raises(InputError, match=r"JAX_ENABLE_X64: is on, but .* float32; unset it"):
            call()
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("x64")
def test_commands_leave_the_64_bit_mode():
    assert run_command(lambda _: require_float32()) == 0


@pytest.fixture
def no_jit():
    with turned_on("jax_disable_jit"):
        yield


@pytest.mark.usefixtures("no_jit")
def test_commands_ignore_that_nothing_shall_be_compiled(capsys):
    modes = []
    assert run_command(lambda _: modes.append(jax.config.values["jax_disable_jit"])) == 0
    assert modes == [False]
    assert "JAX_DISABLE_JIT is ignored" in capsys.readouterr().err


@pytest.mark.slow
def test_commands_compile_with_a_warning_where_jax_is_told_not_to(tmp_path):
    # An episode takes more than a minute where nothing is compiled.
    picture = tmp_path / "episode.png"
    returncode, output = run_jaxnav("episode", "rooms-org", "--out", picture, JAX_DISABLE_JIT="1", timeout=120)
    assert returncode == 0, output
    assert_message_names(output, "JAX_DISABLE_JIT is ignored", "from Python")


@pytest.mark.slow
def test_environment_is_checked_without_compilation():
    env, params = jaxnav.make("rooms")
    with jax.disable_jit():
        check_environment(env, params, num_envs=1, num_steps=1)


@pytest.mark.parametrize("error", [AssertionError(), RuntimeError("Unable to initialize backend 'x': y")])
def test_a_missing_backend_is_one_line(error, monkeypatch, capsys):
    def fail(*_):
        raise error

    monkeypatch.setenv("JAX_PLATFORMS", "x")
    monkeypatch.setattr(jax, "devices", fail)
    assert run_command(fail) == 2
    assert_message_names(capsys.readouterr().err, "error: JAX_PLATFORMS=x: ", "no such device", "unset it")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value"),
    [("JAX_ENABLE_X64", "maybe"), ("JAX_DEFAULT_MATMUL_PRECISION", "exact"), ("JAX_NUM_CPU_DEVICES", "many")],
)
def test_impossible_settings_of_jax_are_one_line(name, value):
    # JAX reads its variables when it is imported, so each needs a process of its own.
    returncode, output = run_jaxnav("eval", "rooms-org", **{name: value})
    assert returncode == 2
    assert_message_names(output, f"error: {name}={value}: ", "unset it")


def test_a_bug_is_not_taken_for_a_missing_backend():
    def fail(_):
        raise AssertionError("a bug")

    with pytest.raises(AssertionError, match="a bug"):
        run_command(fail)


# Figures


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["text.usetex: True", "savefig.format: pdf", "savefig.dpi: 7", "font.size: 99"])
def test_figures_do_not_depend_on_matplotlibrc(setting, tmp_path):
    rows = [{"arm": "layout", "env_steps": steps, "success": 0.5} for steps in (1, 2)]
    name, value = setting.split(": ")
    pictures = []
    for settings in ({}, {name: value}):
        with mpl.rc_context(settings):
            save_figure(learning_figure(rows, None, "a title"), tmp_path / "a.png")
        pictures.append((tmp_path / "a.png").read_bytes())
    assert pictures[0] == pictures[1]
    assert pictures[0].startswith(b"\x89PNG")


# Forked processes


def test_an_environment_is_refused_in_a_forked_process(monkeypatch):
    monkeypatch.setattr(gym.os, "getpid", lambda: -1)
    with pytest.raises(InputError, match="'async': JAX hangs in forked processes; omit the mode"):
        gymnasium.make("jaxnav.env.gym:jaxnav/rooms-v0")


# Streams and terminals


@pytest.mark.parametrize("columns", [1, 2, 5, 40])
def test_help_ends_at_any_width(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    assert "--run-dir" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("redirection", [">&-", "2>&-", "<&-", ">&- 2>&- <&-"])
def test_commands_run_with_closed_streams(redirection):
    code, output = run_jaxnav("list", "worlds", redirection=redirection)
    assert code == 0
    assert "Traceback" not in output


@pytest.mark.slow
def test_play_refuses_a_closed_input():
    code, output = run_jaxnav("play", redirection="<&-")
    assert (code, output.count("\n")) == (2, 1)
    assert "play: the input is not a terminal" in output


def test_characters_that_a_stream_lacks_are_escaped():
    code, output = run_jaxnav("list", "küche", PYTHONIOENCODING="ascii")
    assert code == 2
    assert "k\\xfcche" in output


# The matrix: commands by environments; `python -m support.surroundings` in `tests` prints the whole

#: Each environment once; only commands that take a second.
SAMPLE = list(zip(ENVIRONMENTS, itertools.cycle(["list", "list", "play"]), strict=False))
#: A command that computes, draws and writes; all others are exhaustive.
COMPUTING = [("no home", "show")]


def check(environment_name, command_name, folder):
    """Check that a command in an environment ends well or with one line."""
    attempt = try_command(environment_name, command_name, folder)
    assert find_fault(environment_name, attempt, folder) is None, attempt.output


@pytest.mark.slow
@pytest.mark.parametrize(("environment_name", "command_name"), SAMPLE)
def test_surroundings_by_a_sample(environment_name, command_name, tmp_path):
    check(environment_name, command_name, tmp_path)


@pytest.mark.parametrize(
    ("environment_name", "command_name"),
    params_by_tier(itertools.product(ENVIRONMENTS, COMMANDS), slow=COMPUTING),
)
def test_surroundings_of_every_command(environment_name, command_name, tmp_path, tmp_path_factory):
    if command_name in ("eval", "report"):
        shutil.copytree(finished_run(tmp_path_factory)[1], tmp_path / "finished")
    check(environment_name, command_name, tmp_path)
