"""A log reaches sinks whole and once, also while it is written, and no sink is needed to train."""

import dataclasses
import json
import struct
import sys
import types

import pytest
from support.tiny_run import tiny_config

from jaxnav.__main__ import main
from jaxnav.errors import InputError
from jaxnav.runs import tracking
from jaxnav.runs.run import LOG_FILE, Run, claim_run_dir
from jaxnav.runs.tracking import send_log
from jaxnav.store.files import append_log_rows, truncate_log_after

MODULES = {"tensorboard": "tensorboardX", "wandb": "wandb"}


def row(step, arm="layout", seed=0, **values):
    return {"step": step, "arm": arm, "seed": seed, "env_steps": 128 * step} | values


@pytest.fixture
def run(tmp_path):
    """A run of one arm and two seeds that has just begun: 4 updates, a row of each seed for every one."""
    config = tiny_config(tmp_path / "tiny", arms=("layout",), chunk=1)
    claim_run_dir(config)
    return Run(config)


def log(run, *rows):
    append_log_rows(run.config.run_dir / LOG_FILE, rows)


@pytest.fixture
def sent(monkeypatch):
    """What reaches libraries that are not there: (library, series, step, name) to value, and what is closed."""
    numbers, closed = {}, []

    def take(library, series, step, name, value):
        assert (library, series, step, name) not in numbers  # nothing twice
        numbers[library, series, step, name] = value

    class Writer:
        def __init__(self, logdir):
            self.series = logdir.rsplit("/", 1)[1]

        def add_scalar(self, name, value, step):
            take("tensorboard", self.series, step, name, value)

        def close(self):
            closed.append(("tensorboard", self.series))

    class WandBRun:
        def __init__(self, **settings):
            self.told = settings

        def log(self, values, step):
            for name, value in values.items():
                take("wandb", self.told["name"], step, name, value)

        def finish(self):
            closed.append(("wandb", self.told["name"]))

    monkeypatch.setitem(sys.modules, "tensorboardX", types.SimpleNamespace(SummaryWriter=Writer))
    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(init=WandBRun))
    return numbers, closed


def test_send_log_sends_every_row_to_its_series(run, sent):
    numbers, closed = sent
    log(run, row(1, loss=0.5, val_success=None), row(1, seed=1, loss=0.25), row(2, loss=float("nan"), success=1.0))
    assert send_log(run, ("tensorboard", "wandb")) == 3
    expected = {("layout-0", 128, "loss"): 0.5, ("layout-1", 128, "loss"): 0.25, ("layout-0", 256, "success"): 1.0}
    assert numbers == {(library, *key): value for library in MODULES for key, value in expected.items()}
    assert sorted(closed) == [(library, f"layout-{seed}") for library in sorted(MODULES) for seed in (0, 1)]


def test_send_log_follows_a_resumed_run_to_its_end(run, sent, monkeypatch):
    """Killed after update 2 of 4 and resumed: the row after the checkpoint is dropped and written again, the same."""
    numbers, closed = sent
    log(run, row(1, loss=1.0), row(1, seed=1, loss=1.0), row(2, loss=2.0))
    path = run.config.run_dir / LOG_FILE
    parts = iter(
        [
            lambda: truncate_log_after(path, 1),
            lambda: log(run, row(2, loss=2.0), row(2, seed=1, loss=2.5)),
            lambda: path.write_bytes(path.read_bytes() + b'{"step": 3, "arm": "lay'),  # as it is being written
            lambda: [truncate_log_after(path, 2), log(run, row(3, loss=3.0), row(3, seed=1, loss=3.5))],
            lambda: log(run, row(4, loss=4.0), row(4, seed=1, loss=4.5)),
        ]
    )
    monkeypatch.setattr(tracking, "time", types.SimpleNamespace(sleep=lambda _: next(parts)()))
    assert send_log(run, ("tensorboard",), follow=True) == 8
    assert next(parts, None) is None
    by_seed = {seed: [value for key, value in numbers.items() if key[1] == f"layout-{seed}"] for seed in (0, 1)}
    assert by_seed == {0: [1.0, 2.0, 3.0, 4.0], 1: [1.0, 2.5, 3.5, 4.5]}
    assert len(closed) == 2


def test_send_log_closes_sinks_when_the_log_is_damaged(run, sent, monkeypatch):
    log(run, row(1, loss=0.5))

    def damage(_):
        (run.config.run_dir / LOG_FILE).write_text("nothing\n\n")

    monkeypatch.setattr(tracking, "time", types.SimpleNamespace(sleep=damage))
    with pytest.raises(InputError, match=r"metrics\.jsonl, line 1: not a JSON object"):
        send_log(run, ("wandb",), follow=True)
    assert sent[1] == [("wandb", "layout-0")]


@pytest.mark.parametrize("extra", MODULES)
def test_log_command_names_the_extra_of_a_missing_sink(run, extra, monkeypatch, capsys):
    log(run, row(1, loss=0.5))
    monkeypatch.setitem(sys.modules, MODULES[extra], None)
    assert main(["log", str(run.config.run_dir), "--to", extra]) == 2
    words = " ".join(capsys.readouterr().err.split())
    assert words == f"error: --to {extra}: needs {MODULES[extra]}; install it by: pip install 'jaxnav[{extra}]'"


def test_log_command_prints_the_number_of_rows(run, sent, capsys):
    log(run, row(1, loss=0.5))
    assert main(["log", str(run.config.run_dir), "--to", "tensorboard", "wandb"]) == 0
    assert capsys.readouterr().err.split()[:2] == ["1", "rows"]


# With the libraries themselves


def test_tensorboard_event_file_holds_the_log(run):
    """The records of a file: length uint64, its checksum, the event, its checksum; a second time replaces the first."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    run = Run(dataclasses.replace(run.config, seeds=1))
    log(run, row(1, loss=0.5, success=0.25), row(2, loss=0.125))
    for _ in range(2):
        send_log(run, ("tensorboard",))
    (file,) = (run.config.run_dir / "tensorboard" / "layout-0").iterdir()
    data, place, values = file.read_bytes(), 0, {}
    while place < len(data):
        (length,) = struct.unpack_from("<Q", data, place)
        event = event_pb2.Event.FromString(data[place + 12 : place + 12 + length])
        values |= {(event.step, value.tag): value.simple_value for value in event.summary.value}
        place += 16 + length
    assert values == {(128, "loss"): 0.5, (128, "success"): 0.25, (256, "loss"): 0.125}


def wandb_records(file):
    """The records of a file of wandb: LevelDB's log after 7 bytes, with blocks of 32 KiB."""
    data, place, parts = file.read_bytes(), 7, []
    while place < len(data):
        num_bytes = 32768 - place % 32768
        if num_bytes < 7:  # no room for a header: zeros
            place += num_bytes
            continue
        _, length, kind = struct.unpack_from("<IHB", data, place)
        parts.append(data[place + 7 : place + 7 + length])
        place += 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield b"".join(parts)
            parts = []


@pytest.mark.slow
def test_wandb_offline_file_holds_the_log(run, monkeypatch):
    wandb_internal_pb2 = pytest.importorskip("wandb.proto.wandb_internal_pb2")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    run = Run(dataclasses.replace(run.config, seeds=1))
    log(run, row(1, loss=0.5, success=0.25), row(2, loss=0.125))
    send_log(run, ("wandb",))
    (file,) = (run.config.run_dir / "wandb").glob("offline-run-*/*.wandb")
    values = {}
    for data in wandb_records(file):
        record = wandb_internal_pb2.Record.FromString(data)
        items = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}
        values |= {(items["_step"], name): value for name, value in items.items() if not name.startswith("_")}
    assert values == {(128, "loss"): 0.5, (128, "success"): 0.25, (256, "loss"): 0.125}


def test_send_log_ignores_repeated_sinks_and_refuses_none(run, sent):
    log(run, row(1, loss=0.5))
    assert send_log(run, ("tensorboard", "tensorboard")) == 1
    assert len(sent[0]) == 1
    with pytest.raises(InputError, match="names no sink; give tensorboard or wandb"):
        send_log(run, ())
