"""`send_log` sends every row of a log once to TensorBoard and wandb, also while the log is written."""

import dataclasses
import json
import struct
import sys
import types
from typing import Any, NamedTuple

import pytest
from support.refusals import assert_message_names
from support.tiny_run import tiny_config

from jaxnav.__main__ import main
from jaxnav.errors import InputError
from jaxnav.runs import tracking
from jaxnav.runs.run import LOG_FILE, Run, claim_run_dir
from jaxnav.runs.tracking import send_log
from jaxnav.store.files import append_log_rows, truncate_log_after

MODULES = {"tensorboard": "tensorboardX", "wandb": "wandb"}


def make_row(step, arm="layout", seed=0, **values):
    """Row of a log whose updates take 128 environment steps each."""
    return {"step": step, "arm": arm, "seed": seed, "env_steps": 128 * step} | values


@pytest.fixture
def run(tmp_path):
    """Run of one arm and two seeds that has just begun: its log gets a row per seed for each of 4 updates."""
    config = tiny_config(tmp_path / "tiny", arms=("layout",), chunk=1)
    claim_run_dir(config)
    return Run(config)


def append_rows(run, *rows):
    """Append rows to the log of a run."""
    append_log_rows(run.config.run_dir / LOG_FILE, rows)


class SinkRecord(NamedTuple):
    """Values that fake libraries receive.

    Attributes:
      values: (library, series, step, name) to value; a value that is sent twice fails the test.
      closed_series: (library, series) of each sink that is closed.
    """

    values: dict[tuple[str, str, int, str], float]
    closed_series: list[tuple[str, str]]


@pytest.fixture
def sink_record(monkeypatch) -> SinkRecord:
    """Record of the values that fake libraries in the place of tensorboardX and wandb receive."""
    record = SinkRecord({}, [])

    def record_value(library, series, step, name, value):
        assert (library, series, step, name) not in record.values
        record.values[library, series, step, name] = value

    class FakeWriter:
        def __init__(self, logdir):
            self.series = logdir.rsplit("/", 1)[1]

        def add_scalar(self, name, value, step):
            record_value("tensorboard", self.series, step, name, value)

        def close(self):
            record.closed_series.append(("tensorboard", self.series))

    class FakeWandbRun:
        def __init__(self, **settings: Any):
            self.series = settings["name"]

        def log(self, values, step):
            for name, value in values.items():
                record_value("wandb", self.series, step, name, value)

        def finish(self):
            record.closed_series.append(("wandb", self.series))

    monkeypatch.setitem(sys.modules, "tensorboardX", types.SimpleNamespace(SummaryWriter=FakeWriter))
    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(init=FakeWandbRun))
    return record


def test_send_log_sends_every_row_to_its_series(run, sink_record):
    append_rows(
        run,
        make_row(1, loss=0.5, val_success=None),
        make_row(1, seed=1, loss=0.25),
        make_row(2, loss=float("nan"), success=1.0),
    )
    assert send_log(run, ("tensorboard", "wandb")) == 3

    # Neither the missing nor the undefined value is sent.
    logged_values = {("layout-0", 128, "loss"): 0.5, ("layout-1", 128, "loss"): 0.25, ("layout-0", 256, "success"): 1.0}
    expected_values = {}
    for library in MODULES:
        for key, value in logged_values.items():
            expected_values[library, *key] = value
    assert sink_record.values == expected_values

    # The sink of each series is closed.
    expected_series = [
        ("tensorboard", "layout-0"),
        ("tensorboard", "layout-1"),
        ("wandb", "layout-0"),
        ("wandb", "layout-1"),
    ]
    assert sorted(sink_record.closed_series) == expected_series


def test_send_log_follows_a_resumed_run_to_its_end(run, sink_record, monkeypatch):
    """The run is killed after update 2 of 4: the row after its checkpoint is dropped and written again, unchanged."""
    log_file = run.config.run_dir / LOG_FILE
    append_rows(run, make_row(1, loss=1.0), make_row(1, seed=1, loss=1.0), make_row(2, loss=2.0))

    # Each time that `send_log` waits, one of these events changes the log.
    def drop_rows_after_checkpoint():
        truncate_log_after(log_file, 1)

    def write_second_update():
        append_rows(run, make_row(2, loss=2.0), make_row(2, seed=1, loss=2.5))

    def begin_third_update():
        log_file.write_bytes(log_file.read_bytes() + b'{"step": 3, "arm": "lay')

    def write_third_update():
        truncate_log_after(log_file, 2)
        append_rows(run, make_row(3, loss=3.0), make_row(3, seed=1, loss=3.5))

    def write_last_update():
        append_rows(run, make_row(4, loss=4.0), make_row(4, seed=1, loss=4.5))

    events = iter(
        [drop_rows_after_checkpoint, write_second_update, begin_third_update, write_third_update, write_last_update]
    )
    monkeypatch.setattr(tracking, "time", types.SimpleNamespace(sleep=lambda _: next(events)()))
    assert send_log(run, ("tensorboard",), follow=True) == 8
    assert next(events, None) is None

    # Every value has arrived once and in order.
    losses = {"layout-0": [], "layout-1": []}
    for (_, series, _, _), value in sink_record.values.items():
        losses[series].append(value)
    assert losses == {"layout-0": [1.0, 2.0, 3.0, 4.0], "layout-1": [1.0, 2.5, 3.5, 4.5]}
    assert len(sink_record.closed_series) == 2


def test_send_log_closes_sinks_when_the_log_is_damaged(run, sink_record, monkeypatch):
    append_rows(run, make_row(1, loss=0.5))

    def damage_log(_):
        (run.config.run_dir / LOG_FILE).write_text("nothing\n\n")

    monkeypatch.setattr(tracking, "time", types.SimpleNamespace(sleep=damage_log))
    with pytest.raises(InputError, match=r"metrics\.jsonl, line 1: not a JSON object"):
        send_log(run, ("wandb",), follow=True)
    assert sink_record.closed_series == [("wandb", "layout-0")]


def test_send_log_ignores_repeated_sinks_and_requires_one(run, sink_record):
    append_rows(run, make_row(1, loss=0.5))
    assert send_log(run, ("tensorboard", "tensorboard")) == 1
    assert len(sink_record.values) == 1
    with pytest.raises(InputError, match="give tensorboard or wandb"):
        send_log(run, ())


@pytest.mark.parametrize("extra", MODULES)
def test_log_command_names_the_extra_of_a_missing_sink(run, extra, monkeypatch, capsys):
    append_rows(run, make_row(1, loss=0.5))
    monkeypatch.setitem(sys.modules, MODULES[extra], None)
    assert main(["log", str(run.config.run_dir), "--to", extra]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert_message_names(message, f"error: --to {extra}: ", MODULES[extra], f"pip install 'jaxnav[{extra}]'")


def test_log_command_prints_the_number_of_rows(run, sink_record, capsys):
    append_rows(run, make_row(1, loss=0.5))
    assert main(["log", str(run.config.run_dir), "--to", "tensorboard", "wandb"]) == 0
    assert capsys.readouterr().err.split()[:2] == ["1", "rows"]
    assert len(sink_record.values) == 2


# With the libraries themselves

#: Values of a log of two rows, by environment step and name.
LOGGED_VALUES = {(128, "loss"): 0.5, (128, "success"): 0.25, (256, "loss"): 0.125}


@pytest.fixture
def logged_run(run):
    """Run of one seed whose log holds `LOGGED_VALUES`."""
    one_seed_run = Run(dataclasses.replace(run.config, seeds=1))
    append_rows(one_seed_run, make_row(1, loss=0.5, success=0.25), make_row(2, loss=0.125))
    return one_seed_run


def test_tensorboard_event_file_holds_the_log(logged_run):
    """A record holds the length as uint64, its checksum of 4 bytes, the event, and a checksum of 4 bytes."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")

    # The second file replaces the first.
    for _ in range(2):
        send_log(logged_run, ("tensorboard",))
    (event_file,) = (logged_run.config.run_dir / "tensorboard" / "layout-0").iterdir()

    # Read record after record: 12 bytes of header, the event, 4 bytes of checksum.
    data = event_file.read_bytes()
    offset = 0
    values = {}
    while offset < len(data):
        (length,) = struct.unpack_from("<Q", data, offset)
        event = event_pb2.Event.FromString(data[offset + 12 : offset + 12 + length])
        for value in event.summary.value:
            values[event.step, value.tag] = value.simple_value
        offset += 16 + length
    assert values == LOGGED_VALUES


def read_wandb_records(path):
    """Yield the records of a wandb file, which has 7 bytes before a log of LevelDB in blocks of 32 KiB."""
    data = path.read_bytes()
    offset = 7
    parts = []
    while offset < len(data):
        # A block ends with zeros where less than the 7 bytes of a header are left.
        block_rest = 32768 - offset % 32768
        if block_rest < 7:
            offset += block_rest
            continue

        # A record is complete with a part of kind 1, a full record, or of kind 4, the last part.
        _, length, kind = struct.unpack_from("<IHB", data, offset)
        parts.append(data[offset + 7 : offset + 7 + length])
        offset += 7 + length
        if kind in (1, 4):
            yield b"".join(parts)
            parts = []


@pytest.mark.slow
def test_wandb_offline_file_holds_the_log(logged_run, monkeypatch):
    wandb_internal_pb2 = pytest.importorskip("wandb.proto.wandb_internal_pb2")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    send_log(logged_run, ("wandb",))

    # Names that begin with an underscore are those of wandb itself.
    (wandb_file,) = (logged_run.config.run_dir / "wandb").glob("offline-run-*/*.wandb")
    values = {}
    for data in read_wandb_records(wandb_file):
        record = wandb_internal_pb2.Record.FromString(data)
        items = {}
        for item in record.history.item:
            items[item.key or item.nested_key[0]] = json.loads(item.value_json)
        for name, value in items.items():
            if not name.startswith("_"):
                values[items["_step"], name] = value
    assert values == LOGGED_VALUES
