"""The committed tables are those of the committed results, and these of the settings that come with the package."""

import dataclasses
import json
from pathlib import Path

import pytest

from jaxnav.cli.compare import parse_compare
from jaxnav.study.codec import from_json
from jaxnav.study.compare_config import CompareConfig, entries, entry_identity, frontier_identity, world_runs
from jaxnav.study.compare_report import Scores
from jaxnav.study.compare_tables import frontier_name, write_comparison
from jaxnav.study.results import is_written

ROOT = Path(__file__).parents[2]


def committed(config: CompareConfig) -> dict[str, Scores]:
    """The results that are there; those of other settings would be refused."""
    asked = {frontier_name(world): frontier_identity(config, run) for world, run in world_runs(config).items()}
    asked |= {entry.name: entry_identity(config, entry) for entry in entries(config)}
    paths = {name: ROOT / config.results / config.split / f"{name}.json" for name in asked}
    there = {name: path for name, path in paths.items() if path.exists()}
    assert all(is_written(path, asked[name]) for name, path in there.items())
    return {name: from_json(Scores, json.loads(path.read_text())) for name, path in there.items()}


@pytest.mark.parametrize("name", ["table2", "table3", "ablations"])
def test_a_committed_table_is_written_from_the_committed_results(name, tmp_path):
    config = parse_compare(["--config", name])
    found = committed(config)
    assert len(found) > 3
    text = (ROOT / config.document).read_text()
    (tmp_path / "page.md").write_text(text)
    write_comparison(dataclasses.replace(config, document=tmp_path / "page.md"), found)
    assert (tmp_path / "page.md").read_text() == text
