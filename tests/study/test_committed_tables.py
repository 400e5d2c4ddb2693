"""The committed tables are those of the committed results, and these of the settings that come with the package."""

import dataclasses
import json
from pathlib import Path

import pytest

from jaxnav.cli.study import parse_compare
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.local_policy import LocalPolicy
from jaxnav.runs.config import RunConfig
from jaxnav.study.compare_config import CompareConfig, compared_runs, frontier_identity, run_identity, world_run_configs
from jaxnav.study.compare_tables import frontier_name, write_comparison
from jaxnav.study.paper_tables import TABLE_2_AI2THOR
from jaxnav.study.records import RunScores, from_json
from jaxnav.study.results import has_record

ROOT = Path(__file__).parents[2]


def committed(config: CompareConfig) -> dict[str, RunScores]:
    """The results that are there; those of other settings would be refused."""
    asked = {frontier_name(world): frontier_identity(config, run) for world, run in world_run_configs(config).items()}
    asked |= {entry.name: run_identity(config, entry) for entry in compared_runs(config)}
    paths = {name: ROOT / config.results / config.split / f"{name}.json" for name in asked}
    existing = {name: path for name, path in paths.items() if path.exists()}
    assert all(has_record(path, asked[name]) for name, path in existing.items())
    return {name: from_json(RunScores, json.loads(path.read_text())) for name, path in existing.items()}


@pytest.mark.parametrize("name", ["table2", "table3", "ablations"])
def test_a_committed_table_is_written_from_the_committed_results(name, tmp_path):
    config = parse_compare(["--config", name])
    results = committed(config)
    assert len(results) > 3
    text = (ROOT / config.document).read_text()
    (tmp_path / "page.md").write_text(text)
    write_comparison(dataclasses.replace(config, document=tmp_path / "page.md"), results)
    assert (tmp_path / "page.md").read_text() == text


def test_table_2_has_the_methods_of_the_paper():
    config = parse_compare(["--config", "table2"])
    adapted = "jaxnav.policies.methods.eotp:ADAPTED"
    printed = {method for method, _ in TABLE_2_AI2THOR} - {"random"}
    assert set(config.methods) == printed | {"anonymous", adapted}
    runs = compared_runs(config)
    assert {entry.world for entry in runs} == {"rooms", "apartments"}
    # `anonymous` and `savn` host no layout, so have no streams; those of `ADAPTED` are left out.
    assert len(runs) == 2 * (2 * len(config.methods) - 3)
    assert {entry.decision for entry in runs if entry.method == adapted} == {"fused"}
    for entry in runs:
        assert (entry.run.method, entry.run.world, entry.run.seeds) == (entry.method, entry.world, 3)
        hosts = find_method(entry.method).hosts_layout
        assert entry.run.arms == (("layout",) if entry.decision == "streams" else ("baseline", "layout")[: 1 + hosts])
    for world in {entry.world for entry in runs}:  # the same steps for all
        assert (
            len({entry.run.total_updates * entry.run.steps_per_update for entry in runs if entry.world == world}) == 1
        )


def test_the_ablations_have_the_baseline_alone():
    config = parse_compare(["--config", "ablations"])
    runs = compared_runs(config)
    assert {world: sum(entry.world == world for entry in runs) for world in config.worlds} == {
        "rooms": 16,
        "apartments": 3,
    }
    assert {entry.method.rpartition(".")[2].partition(":")[0] for entry in runs if entry.world == "apartments"} == {
        "tpn"
    }
    assert {(entry.decision, entry.run.arms) for entry in runs} == {("fused", ("baseline",))}


def test_table_3_has_room_for_macro_steps():
    runs = {entry.method: entry.run for entry in compared_runs(parse_compare(["--config", "table3"]))}
    assert set(runs) == {"anonymous", "rgb", "semexp", "jaxnav.policies.methods.semexp:NEAREST"}
    nearest = runs["jaxnav.policies.methods.semexp:NEAREST"]
    for run in runs.values():  # the same for all that learn, at least two choices in every rollout
        assert (run.world, run.steps_per_update) == ("houses", RunConfig().steps_per_update)
        assert run.total_updates == (run.chunk if run is nearest else runs["rgb"].total_updates)
        assert run.ppo.rollout >= 2 * LocalPolicy.interval
