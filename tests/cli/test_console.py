"""Parts shared by all commands: the cache of compiled programs, memory after compilations, and printed tables."""

import ctypes
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest
from rich.table import Table
from support.commands import contents

from jaxnav.__main__ import main
from jaxnav.cli import console
from jaxnav.cli.console import make_result_console, print_table, run_command
from jaxnav.errors import InputError
from jaxnav.plain_console import PlainConsole

#: Settings of JAX that commands or tests change; they are restored after each test.
CACHE_SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_enable_compilation_cache",
)


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """An empty home folder, and JAX without a folder for compiled programs; its settings are restored at the end."""
    monkeypatch.setenv("HOME", str(tmp_path))
    settings_before = {name: jax.config.values[name] for name in CACHE_SETTINGS}
    jax.config.update("jax_compilation_cache_dir", None)
    yield tmp_path
    for name, value in settings_before.items():
        jax.config.update(name, value)


def cache_folder_of_command():
    """Folder in which JAX keeps compiled programs while a command runs."""
    cache_folders = []
    assert run_command(lambda _: cache_folders.append(jax.config.values["jax_compilation_cache_dir"])) == 0
    return cache_folders[0]


def test_compilation_cache_is_in_the_user_cache_folder(home, capsys):
    folder = cache_folder_of_command()
    assert folder == str(home / ".cache" / "jaxnav" / "xla")
    assert Path(folder).is_dir()
    assert jax.config.values["jax_persistent_cache_min_compile_time_secs"] == 0.2
    assert capsys.readouterr().err == ""


def test_compilation_cache_respects_a_configured_folder(home):
    jax.config.update("jax_compilation_cache_dir", str(home / "other"))
    assert cache_folder_of_command() == str(home / "other")
    assert contents(home) == {}


def test_disabled_compilation_cache_writes_nothing(home):
    jax.config.update("jax_enable_compilation_cache", False)
    assert cache_folder_of_command() is None
    assert not any(home.iterdir())


def test_console_reports_a_cache_folder_that_cannot_be_made(home, capsys):
    (home / ".cache").write_text("a file")
    assert cache_folder_of_command() is None
    error = capsys.readouterr().err
    assert error.startswith("warning: compiled programs are not kept: ")
    assert error.count("\n") == 1


def test_console_reports_a_cache_folder_that_cannot_be_written(home, capsys, monkeypatch):
    monkeypatch.setattr("os.access", lambda *_: False)
    assert cache_folder_of_command() is None
    assert str(home / ".cache" / "jaxnav" / "xla") in capsys.readouterr().err


def record_trims(monkeypatch, function_names, seconds):
    """Arguments of all calls of `malloc_trim` after a compilation, for a C library with the named functions."""
    trim_calls = []
    c_functions = dict.fromkeys(function_names, trim_calls.append)
    monkeypatch.setattr(ctypes, "CDLL", lambda _: SimpleNamespace(**c_functions))

    # Report a compilation and another event of the given duration to the listeners of the console.
    listeners = []
    monkeypatch.setattr(jax.monitoring, "register_event_duration_secs_listener", listeners.append)
    console._trim_memory_after_compiling.__wrapped__()
    for listener in listeners:
        listener("/jax/core/compile/backend_compile_duration", seconds, fun_name="f")
        listener("/jax/checkpoint/write/duration_secs", seconds)
    return trim_calls


@pytest.mark.parametrize(("seconds", "expected"), [(2.0, [0]), (0.1, [])])
def test_long_compilation_trims_the_heap(monkeypatch, seconds, expected):
    assert record_trims(monkeypatch, ["malloc_trim"], seconds) == expected


def test_heap_is_not_trimmed_without_glibc(monkeypatch):
    assert record_trims(monkeypatch, [], 2.0) == []


def test_jax_reports_compilations_to_listeners(monkeypatch):
    trim_calls = []
    monkeypatch.setattr(ctypes, "CDLL", lambda _: SimpleNamespace(malloc_trim=trim_calls.append))
    monkeypatch.setattr(console, "_LONG_COMPILATION_S", 0.0)
    console._trim_memory_after_compiling.__wrapped__()
    jax.jit(lambda x: x * 3 + 1)(2)
    assert set(trim_calls) == {0}


# Tables


def make_wide_table():
    """A table that needs 122 columns."""
    table = Table("Variant", "SR (%)", "SPL (%)", "DTS (m)", "SR within 20, 50 (%)", "Wrong Done (%)")
    table.add_section()
    table.add_row("rooms val, argmax decoding", style="bold")
    table.add_row(
        "+ w + sTDE (eps=0.5), switch", "62.4 [60.1, 64.7]", "22.1 [20.0, 24.2]", "1.23 [1.10, 1.36]", "20, 45", "3"
    )
    return table


@pytest.mark.parametrize("width", [60, 80, 100, 200])
def test_print_table_fits_the_console_and_breaks_no_cell(width, capsys):
    print_table(PlainConsole(width=width), make_wide_table())
    output = capsys.readouterr().out
    assert max(map(len, output.splitlines())) <= width
    for cell in ("62.4 [60.1, 64.7]", "22.1 [20.0, 24.2]", "1.23 [1.10, 1.36]", "20, 45", "Variant", "Wrong"):
        assert cell in output
    # Each part of the table names its rows.
    num_parts = output.count("Variant")
    assert output.count("+ w + sTDE") == num_parts
    assert (num_parts == 1) == (width >= 200)


def test_print_table_repeats_all_key_columns(capsys):
    print_table(PlainConsole(width=72), make_wide_table(), num_key_columns=2)
    output = capsys.readouterr().out
    assert output.count("62.4 [60.1, 64.7]") == output.count("Variant") > 1


def test_result_console_does_not_wrap_in_a_pipe(monkeypatch, capsys):
    monkeypatch.delenv("COLUMNS", raising=False)
    make_result_console().print(100 * "word ")
    assert len(capsys.readouterr().out.splitlines()) == 1
    monkeypatch.setenv("COLUMNS", "3")
    make_result_console().print(100 * "word ")
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 40


# Commands that compile


@pytest.mark.parametrize(
    ("words", "function"),
    [
        (["train"], "runs.train.train"),
        (["eval", "RUN"], "runs.evaluate.evaluate"),
        (["sweep", "rooms-org"], "runs.sweep.sweep_shifts"),
        (["study", "account"], "experiments.driver.run_experiment"),
        (["report", "RUN"], "runs.run.Run.open"),
        (["episode", "RUN"], "viz.episode.play_episode"),
        (["export", "RUN"], "runs.export.export_policy_of_run"),
        (["scenes", "stats", "rooms"], "evaluation.scene_statistics.compute_scene_statistics"),
    ],
)
def test_commands_keep_compiled_programs_when_their_work_begins(words, function, home, monkeypatch, capsys):
    cache_folders = []

    def stop(*_, **__):
        cache_folders.append(jax.config.values["jax_compilation_cache_dir"])
        raise InputError("this is as far as the test goes")

    monkeypatch.chdir(home)
    monkeypatch.setattr("jaxnav.experiments.driver.check_measurements", lambda config: config)
    monkeypatch.setattr(f"jaxnav.{function}", stop)
    assert main(words) == 2
    assert "this is as far as the test goes" in capsys.readouterr().err
    assert cache_folders == [str(home / ".cache" / "jaxnav" / "xla")]
