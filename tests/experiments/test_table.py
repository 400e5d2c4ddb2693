"""Rows of results: round trips through files, refusals of files, and look-ups in the table."""

import json
import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.intervals import bounds
from support.result_rows import make_curve, make_row

from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments.table import (
    KEY_FIELDS,
    Curve,
    ResultRow,
    ResultTable,
    has_part,
    read_part,
    read_settings,
    write_part,
)

SETTINGS = {"split": "val", "shifts": [0.0, 1.0], "run": {"method": "org", "seeds": 3}}


def write_and_read(path: Path, *rows: ResultRow) -> list[ResultRow]:
    write_part(path, SETTINGS, rows)
    return read_part(path)


def assert_same_number(number: float, expected_number: float) -> None:
    """Assert that a number read from a file equals the written one up to seven digits, with its sign."""
    if math.isnan(expected_number):
        assert math.isnan(number)
    else:
        assert number == pytest.approx(expected_number, rel=6e-7, abs=0.0)
        assert math.copysign(1.0, number) == math.copysign(1.0, expected_number)


def assert_same_row(row: ResultRow, expected_row: ResultRow) -> None:
    """Assert that a row read from a file has the fields of the written one and, up to seven digits, its value."""
    for name in (*KEY_FIELDS, "scenes"):
        assert getattr(row, name) == getattr(expected_row, name)
    value = row.value
    expected_value = expected_row.value
    assert type(value) is type(expected_value)

    # All numbers of an interval or curve are compared; the deviation follows from the seeds.
    if isinstance(expected_value, Interval) and isinstance(value, Interval):
        for name in ("mean", "low", "high"):
            assert_same_number(getattr(value, name), getattr(expected_value, name))
        assert value.seeds == pytest.approx(expected_value.seeds, rel=6e-7)
    elif isinstance(expected_value, Curve) and isinstance(value, Curve):
        for name in ("positions", "mean", "low", "high"):
            for number, expected_number in zip(getattr(value, name), getattr(expected_value, name), strict=True):
                assert_same_number(number, expected_number)


# Files


def test_intervals_and_curves_survive_a_file(tmp_path):
    rows = [
        make_row(Interval(62.5, 60.25, 64.75, 2.5, (60.0, 62.5, 65.0)), variant="stde", epsilon=0.5, shift=0.0),
        make_row(Interval(-1.25, -2.0, -0.5), variant="stde", reference="layout", shift=1.0, scenes=80),
        make_row(12345.0, metric="parameters"),
        make_row(make_curve(0.9, 0.5, math.nan, half_width=0.1), metric="gap", control="frozen"),
        make_row(make_curve(100.0, 50.0, 0.0), metric="running"),
    ]
    read_rows = write_and_read(tmp_path / "new" / "part.jsonl", *rows)
    assert len(read_rows) == len(rows)
    for read_row, row in zip(read_rows, rows, strict=True):
        assert_same_row(read_row, row)


def test_the_deviation_over_runs_is_computed_from_the_seeds(tmp_path):
    # 60, 62.5 and 65: sample variance (2.5^2 + 0 + 2.5^2) / 2 = 6.25. A single run has none.
    rows = [make_row(Interval(62.5, seeds=(60.0, 62.5, 65.0))), make_row(Interval(1.0, seeds=(1.0,)))]
    three_runs, single_run = write_and_read(tmp_path / "part.jsonl", *rows)
    assert isinstance(three_runs.value, Interval)
    assert isinstance(single_run.value, Interval)
    assert three_runs.value.std == 2.5
    assert math.isnan(single_run.value.std)


NUMBERS = st.floats(-1e9, 1e9, allow_subnormal=False)
INTERVALS = st.builds(
    Interval,
    NUMBERS,
    NUMBERS | st.just(math.nan),
    NUMBERS | st.just(math.nan),
    seeds=st.lists(NUMBERS, max_size=3).map(tuple),
)


def curve_through(points: list[tuple[float, float, float, float]]) -> Curve:
    """Curve through points of position, mean, low and high."""
    return Curve(*np.array(points, float).reshape(-1, 4).T)


POINTS = st.tuples(NUMBERS, *3 * [NUMBERS | st.just(math.nan)])
CURVES = st.lists(POINTS, max_size=3).map(curve_through)
ROWS = st.builds(
    ResultRow,
    **dict.fromkeys(("world", "run", "metric"), st.text(min_size=1, max_size=4)),
    **dict.fromkeys(("variant", "decoding", "gap", "form", "control", "category", "reference"), st.text(max_size=4)),
    shift=st.none() | st.floats(0, 1),
    epsilon=st.none() | st.floats(0, 1),
    value=INTERVALS | CURVES,
    scenes=st.integers(0, 200),
)


@settings(max_examples=60)
@given(st.lists(ROWS, max_size=4))
def test_any_rows_survive_a_file(rows):
    with tempfile.TemporaryDirectory() as folder:
        read_rows = write_and_read(Path(folder) / "part.jsonl", *rows)
    for read_row, row in zip(read_rows, rows, strict=True):
        # A curve without any lower bound is stored without bounds.
        if isinstance(row.value, Curve) and np.isnan(row.value.low).all():
            row.value.high[:] = math.nan
        assert_same_row(read_row, row)


def test_fields_that_all_rows_share_are_written_once(tmp_path):
    path = tmp_path / "part.jsonl"
    write_part(path, {}, [make_row(float(number), metric=f"metric{number}") for number in range(3)])
    head, *row_objects = map(json.loads, path.read_text().splitlines())
    assert head["shared"] == {"world": "rooms", "run": "main"}
    assert row_objects == [{"metric": f"metric{number}", "mean": number} for number in range(3)]


@pytest.mark.parametrize("means", [(-0.0, 0.0), (0.0, -0.0), (-0.0, -0.0)])
def test_zero_keeps_its_sign(tmp_path, means):
    path = tmp_path / "part.jsonl"
    interval_row = make_row(means[0], metric="a")
    curve_row = make_row(make_curve(means[1]), metric="b")
    read_interval_row, read_curve_row = write_and_read(path, interval_row, curve_row)
    assert_same_row(read_interval_row, interval_row)
    assert_same_row(read_curve_row, curve_row)

    # Rows whose zeros have different signs do not share the mean.
    rows = [make_row(mean, metric=str(mean)) for mean in means]
    for read_row, row in zip(write_and_read(path, *rows), rows, strict=True):
        assert_same_row(read_row, row)


def test_fields_keep_all_digits_so_that_rows_are_found_by_them(tmp_path):
    shift = 1 / 3
    table = ResultTable(write_and_read(tmp_path / "part.jsonl", make_row(1 / 3, shift=shift)))
    assert table.find(world="rooms", run="main", metric="sr", shift=shift).mean == 0.3333333


def test_undefined_rows_are_left_out(tmp_path):
    undefined_curve = make_curve(math.nan, math.nan)
    rows = write_and_read(
        tmp_path / "part.jsonl",
        make_row(math.nan, metric="undefined"),
        make_row(1.0, metric="defined"),
        make_row(undefined_curve, metric="curve"),
    )
    assert [row.metric for row in rows] == ["defined", "curve"]
    assert_same_row(rows[1], make_row(undefined_curve, metric="curve"))


def test_a_file_without_rows_is_a_part(tmp_path):
    path = tmp_path / "part.jsonl"
    assert write_and_read(path) == []
    assert has_part(path, SETTINGS)


def test_a_file_has_only_the_results_of_its_settings(tmp_path):
    path = tmp_path / "part.jsonl"
    assert not has_part(path, SETTINGS)
    write_part(path, SETTINGS, [make_row()])
    assert has_part(path, SETTINGS)
    assert not has_part(path, SETTINGS | {"split": "test"})
    assert not has_part(path, SETTINGS | {"run": {"method": "org", "seeds": 4}})

    # Readers may require some of the settings.
    assert len(read_part(path, {"split": "val"})) == 1
    assert read_part(path, {"split": "test"}) == []
    assert read_part(path, {"episodes": 1}) == []

    # Earlier versions shifted by size, and their files do not tell the kind of the shift.
    assert len(read_part(path, {"shift_by": "size"})) == 1
    assert read_part(path, {"shift_by": "context"}) == []


GOOD_HEAD = '{"settings": {}, "versions": {}, "format": 4, "shared": {"world": "rooms", "run": "org"}}\n'


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n",
        b"\xff\xfe\x00",
        b"[]\n",
        b"3\n",
        b'{"format": 4}\n',
        b'{"settings": 3, "versions": {}, "format": 4, "shared": {}}\n',
        GOOD_HEAD[:-4].encode(),
        *(GOOD_HEAD.encode() + line for line in (b"{", b"7", b"[]", b'{"metric": "sr"}', b'{"mean": 5}')),
        *(GOOD_HEAD.encode() + line for line in (b'{"metric": "sr", "mean": "x"}', b'{"metric": "sr", "mean": [1]}')),
        GOOD_HEAD.encode() + b'{"metric": "gap", "positions": [0, 1], "mean": ["x", "y"]}',
        GOOD_HEAD.encode() + b'{"metric": "gap", "positions": 0, "mean": 1}',
    ],
)
def test_a_damaged_file_is_refused_by_its_name(tmp_path, content):
    path = tmp_path / "part.jsonl"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"part\.jsonl"):
        read_part(path)
    assert not has_part(path, {})


def test_a_file_of_another_format_is_neither_read_nor_called_damaged(tmp_path):
    """Only damaged files may be measured again and replaced."""
    path = tmp_path / "part.jsonl"
    path.write_text(GOOD_HEAD.replace(": 4", ": 3"))
    for read_file in (read_part, read_settings):
        with pytest.raises(InputError, match=r"part\.jsonl: holds no results of format 4; move it away"):
            read_file(path)


# The table


TABLE = ResultTable(
    [
        make_row(60.0, variant="baseline", shift=0.0, scenes=80),
        make_row(50.0, variant="baseline", shift=1.0, scenes=40),
        make_row(10.0, variant="layout", shift=0.0, reference="baseline"),
        make_row(70.0, variant="layout", shift=0.0),
        make_row(make_curve(0.9, 0.7, 0.5, half_width=0.1), metric="gap"),
        make_row(5.0, run="hoz"),
    ]
)


def test_rows_are_found_by_all_of_their_fields():
    fields = {"world": "rooms", "run": "main", "metric": "sr"}
    assert TABLE.find(fields, variant="layout", shift=0.0).mean == 70.0
    assert TABLE.find(fields, variant="layout", shift=0.0, reference="baseline").mean == 10.0
    assert TABLE.find(fields, run="hoz").mean == 5.0  # the later field counts

    # Fields that are not given must be empty, but the first two rows have a shift.
    assert not TABLE.has(fields, variant="baseline")
    assert math.isnan(TABLE.find(fields, variant="baseline").mean)

    # A curve is found by `has`, but is no interval.
    assert TABLE.has(fields, metric="gap")
    assert math.isnan(TABLE.find(fields, metric="gap").mean)


def test_rows_with_equal_fields_must_have_equal_values():
    # Experiments that share a folder may share results, such as those of frontier search. The scenes are not compared.
    table = ResultTable([make_row(1.0, scenes=80), make_row(1.0, scenes=40)])
    assert table.find(world="rooms", run="main", metric="sr").mean == 1.0
    with pytest.raises(InputError, match="main"):
        ResultTable([make_row(1.0), make_row(2.0)])


def test_rows_are_selected_by_some_of_their_fields():
    baselines = TABLE.where({"variant": "baseline"}, world="rooms")
    assert [row.shift for row in baselines.rows] == [0.0, 1.0]
    assert TABLE.where(variant="tde").rows == ()
    assert TABLE.distinct("variant", run="main") == ["baseline", "layout", ""]
    assert TABLE.distinct("shift", variant="layout", metric="sr") == [0.0]
    assert TABLE.num_scenes(variant="baseline") == 80
    assert TABLE.num_scenes(variant="baseline", shift=1.0) == 40


def test_a_curve_is_read_at_a_position():
    fields = {"world": "rooms", "run": "main", "metric": "gap"}
    assert TABLE.curve(fields).mean.tolist() == [0.9, 0.7, 0.5]
    interval = TABLE.find_at(2, fields)
    assert bounds(interval) == pytest.approx((0.5, 0.4, 0.6))

    # Values are undefined behind the end, in missing rows, and in rows without a curve.
    assert math.isnan(TABLE.find_at(3, fields).mean)
    assert math.isnan(TABLE.find_at(0, fields, run="hoz").mean)
    assert math.isnan(TABLE.find_at(0, fields, run="hoz", metric="sr").mean)
    with pytest.raises(KeyError):
        TABLE.curve(fields, run="hoz", metric="sr")


def test_a_misspelt_field_is_refused():
    for method in (TABLE.find, TABLE.where, TABLE.has, TABLE.curve):
        with pytest.raises(KeyError, match="wrold"):
            method(wrold="rooms")
