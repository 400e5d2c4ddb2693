"""Tests that the tables of the performance pages show the stored results."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def load_benchmark(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def table() -> ModuleType:
    return load_benchmark("table")


@pytest.mark.parametrize("name", ["performance.md", "performance_details.md"])
def test_pages_show_the_stored_results(table, name):
    (document,) = [path for path in table.DOCUMENTS if path.name == name]
    page = document.read_text()
    assert page.count("<!-- table") >= 5
    assert table.fill_page(page) == page


def test_a_changed_table_is_noticed(table):
    page = table.DOCUMENTS[0].read_text()
    changed_page = page.replace("jaxnav, baseline", "jaxnav, base")
    assert table.fill_page(changed_page) == page


def test_marks_name_columns_and_numbers(table, tmp_path, monkeypatch):
    (tmp_path / "speed.json").write_text(
        '{"machine": {}, "old": {"rate": 12345678, "time_s": 0.123456}, "new": {"rate": 2000, "time_s": true}}'
    )
    monkeypatch.setattr(table, "RESULTS", tmp_path)

    # A table with one renamed column, and a number in the text.
    page = "<!-- table speed: time_s=time; rate -->\n<!-- end -->\nRate <!-- value speed.old.rate -->?<!-- end -->.\n"
    assert table.fill_page(page).splitlines()[1:-2] == [
        "|  | time | rate |",
        "| --- | ---: | ---: |",
        "| old | 0.123 | 12.3 M |",
        "| new | yes | 2,000 |",
    ]
    assert "-->12.3 M<!-- end -->." in table.fill_page(page)


def test_the_page_on_devices_shows_the_stored_results():
    simulate = load_benchmark("simulate")
    page = simulate.DOCUMENT.read_text()
    assert "| hosts |" in page
    assert simulate.fill_page(page) == page
