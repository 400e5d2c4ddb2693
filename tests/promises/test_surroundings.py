"""Environment variables, streams and settings of other programs have no effect, or are refused in one line."""

import contextlib
import itertools
import shutil

import gymnasium
import jax
import matplotlib as mpl
import pytest
from support.command_environments import COMMANDS, ENVIRONMENTS, find_fault, run_jaxnav, try_command
from support.refusals import assert_message_names
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
def enable_jax_setting(name):
    """Turn a setting of JAX on, as its environment variable does."""
    jax.config.update(name, True)
    yield
    jax.config.update(name, False)


@pytest.fixture
def x64_mode():
    with enable_jax_setting("jax_enable_x64"):
        yield


# JAX


@pytest.mark.usefixtures("x64_mode")
def test_python_functions_refuse_the_64_bit_mode_in_one_line(tmp_path):
    calls = (
        require_float32,
        lambda: jaxnav.load_policy("rooms-org"),
        lambda: jaxnav.train(tiny_config(tmp_path)),
    )
    for call in calls:
        with pytest.raises(InputError, match=r"JAX_ENABLE_X64: is on, but .* float32; unset it"):
            call()
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("x64_mode")
def test_commands_switch_the_64_bit_mode_off():
    assert run_command(lambda _: require_float32()) == 0


@pytest.fixture
def no_jit():
    with enable_jax_setting("jax_disable_jit"):
        yield


@pytest.mark.usefixtures("no_jit")
def test_commands_warn_and_compile_although_jit_is_disabled(capsys):
    jit_modes = []
    assert run_command(lambda _: jit_modes.append(jax.config.values["jax_disable_jit"])) == 0
    assert jit_modes == [False]
    assert "JAX_DISABLE_JIT is ignored" in capsys.readouterr().err


@pytest.mark.slow
def test_episode_command_warns_and_compiles_although_jit_is_disabled(tmp_path):
    # Without compilation an episode takes more than a minute.
    picture = tmp_path / "episode.png"
    exit_code, output = run_jaxnav("episode", "rooms-org", "--out", picture, JAX_DISABLE_JIT="1", timeout=120)
    assert exit_code == 0, output
    assert_message_names(output, "JAX_DISABLE_JIT is ignored", "from Python")


@pytest.mark.slow
def test_check_environment_passes_without_compilation():
    env, params = jaxnav.make("rooms")
    with jax.disable_jit():
        check_environment(env, params, num_envs=1, num_steps=1)


@pytest.mark.parametrize("error", [AssertionError(), RuntimeError("Unable to initialize backend 'x': y")])
def test_missing_backend_is_refused_in_one_line(error, monkeypatch, capsys):
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
def test_invalid_settings_of_jax_are_refused_in_one_line(name, value):
    # JAX reads its variables when it is imported, so each setting needs a process.
    exit_code, output = run_jaxnav("eval", "rooms-org", **{name: value})
    assert exit_code == 2
    assert_message_names(output, f"error: {name}={value}: ", "unset it")


def test_bug_is_not_reported_as_a_missing_backend():
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

    # The same figure with the default settings and with the changed one.
    pictures = []
    for settings in ({}, {name: value}):
        with mpl.rc_context(settings):
            save_figure(learning_figure(rows, None, "a title"), tmp_path / "a.png")
        pictures.append((tmp_path / "a.png").read_bytes())
    assert pictures[0] == pictures[1]
    assert pictures[0].startswith(b"\x89PNG")


# Forked processes


def test_forked_process_refuses_to_make_an_environment(monkeypatch):
    monkeypatch.setattr(gym.os, "getpid", lambda: -1)
    with pytest.raises(InputError, match="'async': JAX hangs in forked processes; omit the mode"):
        gymnasium.make("jaxnav.env.gym:jaxnav/rooms-v0")


# Streams and terminals


@pytest.mark.parametrize("columns", [1, 2, 5, 40])
def test_help_is_printed_at_any_width(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    assert "--run-dir" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("redirection", [">&-", "2>&-", "<&-", ">&- 2>&- <&-"])
def test_commands_run_with_closed_streams(redirection):
    exit_code, output = run_jaxnav("list", "worlds", redirection=redirection)
    assert exit_code == 0
    assert "Traceback" not in output


@pytest.mark.slow
def test_play_refuses_a_closed_input():
    exit_code, output = run_jaxnav("play", redirection="<&-")
    assert (exit_code, output.count("\n")) == (2, 1)
    assert "play: the input is not a terminal" in output


def test_characters_outside_a_streams_encoding_are_escaped():
    exit_code, output = run_jaxnav("list", "küche", PYTHONIOENCODING="ascii")
    assert exit_code == 2
    assert "k\\xfcche" in output


# The matrix of commands and environments; `python -m support.command_environments` in `tests` prints all of it

#: Each environment with one of the commands that take a second.
SHORT_CASES = list(zip(ENVIRONMENTS, itertools.cycle(["list", "list", "play"]), strict=False))
#: A command that computes, draws and writes; all remaining cases are exhaustive.
SLOW_CASES = [("no home", "show")]


def assert_command_ends_well(environment_name, command_name, folder):
    """Check that a command in an environment succeeds, or is refused in one line."""
    attempt = try_command(environment_name, command_name, folder)
    assert find_fault(environment_name, attempt, folder) is None, attempt.output


@pytest.mark.slow
@pytest.mark.parametrize(("environment_name", "command_name"), SHORT_CASES)
def test_short_command_ends_well_in_every_environment(environment_name, command_name, tmp_path):
    assert_command_ends_well(environment_name, command_name, tmp_path)


@pytest.mark.parametrize(
    ("environment_name", "command_name"),
    params_by_tier(itertools.product(ENVIRONMENTS, COMMANDS), slow=SLOW_CASES),
)
def test_every_command_ends_well_in_every_environment(environment_name, command_name, tmp_path, tmp_path_factory):
    if command_name in ("eval", "report"):
        shutil.copytree(finished_run(tmp_path_factory)[1], tmp_path / "finished")
    assert_command_ends_well(environment_name, command_name, tmp_path)
