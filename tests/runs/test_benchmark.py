"""Frozen benchmarks: checksums of homes and episodes, refusals, and scores that follow from the stored episodes."""

import csv
import gzip
import json
import re

import numpy as np
import pytest
import yaml
from rich.console import Console

import jaxnav
from jaxnav.cli.eval import main
from jaxnav.runs import benchmark as benchmarks
from jaxnav.runs.benchmark import checksum_track, compile_track, load_benchmark, run_benchmark

#: A manifest with few homes and episodes.
MANIFEST = {
    "split": "val",
    "scene_seed": 5,
    "num_episodes": 12,
    "episode_seed": 0,
    "shifts": [0.0, 1.0],
    "shift_by": "size",
    "tracks": {"rooms": {"world": "rooms", "num_scenes": 4, "checksums": ["", ""]}},
}


def turn_or_stop(observations):
    """Actions of an agent that turns right until the goal is detected, and then chooses Done."""
    episode_ids = np.arange(len(observations["goal"]))
    is_detected = observations["detections"][episode_ids, observations["goal"], 0] > 0.5
    return np.where(is_detected, jaxnav.DONE, jaxnav.ROTATE_RIGHT)


@pytest.fixture
def tiny_benchmark(monkeypatch, tmp_path):
    """Manifest file of a benchmark `tiny`, with the checksums of its homes."""
    manifest_file = tmp_path / "tiny.yaml"
    manifest_file.write_text(yaml.safe_dump(MANIFEST))
    monkeypatch.setitem(benchmarks.BENCHMARKS, "tiny", manifest_file)

    # The checksums of the compiled homes replace the empty ones.
    benchmark = load_benchmark("tiny")
    (track,) = benchmark.tracks
    checksums = []
    for shift in benchmark.shifts:
        compiled = compile_track(benchmark, track, shift, Console(quiet=True))
        checksums.append(checksum_track(benchmark, compiled))
    manifest = manifest_file.read_text()
    manifest_file.write_text(manifest.replace("checksums:\n    - ''\n    - ''", f"checksums: {checksums}"))
    return manifest_file


def read_scores(path):
    """Scores of a file, and the rows of the episodes that are stored beside it."""
    episodes_file = path.with_name(path.name.replace(".json", ".episodes.csv.gz"))
    with gzip.open(episodes_file, "rt") as file:
        return json.loads(path.read_text()), list(csv.DictReader(file))


@pytest.mark.slow
def test_scores_follow_from_the_stored_episodes(tiny_benchmark, tmp_path):
    scores = run_benchmark(turn_or_stop, "tiny")
    scores_file = tmp_path / "scores.json"
    scores.write(scores_file)
    stored_scores, episodes = read_scores(scores_file)
    assert stored_scores["rows"] == scores.rows
    assert {row["variant"] for row in scores.rows} == {"agent", "random", "frontier", "oracle"}

    for row in scores.rows:
        # A row counts 12 episodes at its shift; `mixed` counts the 24 episodes of both shifts.
        row_episodes = []
        for episode in episodes:
            is_shift = row["shift"] == "mixed" or float(episode["shift"]) == row["shift"]
            if episode["variant"] == row["variant"] and episode["track"] == row["track"] and is_shift:
                row_episodes.append(episode)
        assert len(row_episodes) == (24 if row["shift"] == "mixed" else 12)

        # SPL weighs each success by L* / max(L, L*), and `sr@20` counts successes of at most 20 actions.
        success = np.array([int(episode["success"]) for episode in row_episodes])
        length = np.array([int(episode["length"]) for episode in row_episodes])
        best_length = np.array([int(episode["best_length"]) for episode in row_episodes])
        assert row["sr"]["mean"] == pytest.approx(100.0 * success.mean())
        assert row["spl"]["mean"] == pytest.approx(
            100.0 * (success * best_length / np.maximum(length, best_length)).mean()
        )
        assert row["sr@20"]["mean"] == pytest.approx(100.0 * (success * (length <= 20)).mean())


@pytest.mark.slow
def test_homes_that_differ_from_the_manifest_are_refused(tiny_benchmark):
    checksum = load_benchmark("tiny").tracks[0].checksums[1]
    tiny_benchmark.write_text(tiny_benchmark.read_text().replace(checksum, "0" * 16))
    with pytest.raises(jaxnav.InputError, match="tiny, track rooms: the homes at shift 1 differ"):
        run_benchmark(turn_or_stop, "tiny")


def test_checksum_covers_tables_and_episodes(tiny_benchmark):
    benchmark = load_benchmark("tiny")
    (track,) = benchmark.tracks
    compiled = compile_track(benchmark, track, 0.0, Console(quiet=True))
    assert checksum_track(benchmark, compiled) == track.checksums[0]

    # The tables of the two shifts differ.
    assert len(set(track.checksums)) == 2

    # Another number of episodes gives another checksum of unchanged tables.
    longer_manifest = tiny_benchmark.read_text().replace("num_episodes: 12", "num_episodes: 13")
    tiny_benchmark.write_text(longer_manifest)
    assert checksum_track(load_benchmark("tiny"), compiled) != track.checksums[0]


#: Checksums of the tracks of every benchmark, at shifts 0 and 1.
CHECKSUMS = {
    "v1": {
        "rooms": ("5793264d4cc97200", "8914c5a76c4432c4"),
        "apartments": ("a4cb85187202557e", "7f3b1100a2a6b9cb"),
        "houses": ("06403312f8ffd70e", "3e5c52342847c96d"),
    },
    "v2": {
        "rooms": ("5793264d4cc97200", "8914c5a76c4432c4"),
        "apartments": ("53374ad45ef53bba", "3441466bbf1dda3e"),
        "houses": ("43c915505d2a1542", "63aef00b07f80e3a"),
    },
}


@pytest.mark.parametrize("version", CHECKSUMS)
def test_benchmarks_are_frozen(version):
    benchmark = load_benchmark(version)
    settings = (benchmark.split, benchmark.scene_seed, benchmark.num_episodes, benchmark.episode_seed)
    assert settings == ("test", 4101, 1000, 0)
    assert {track.name: track.checksums for track in benchmark.tracks} == CHECKSUMS[version]


@pytest.mark.exhaustive
@pytest.mark.parametrize("version", CHECKSUMS)
@pytest.mark.parametrize("name", ["rooms", "apartments", "houses"])
def test_homes_of_benchmarks_match_the_checksums_of_their_manifests(name, version):
    benchmark = load_benchmark(version)
    (track,) = [track for track in benchmark.tracks if track.name == name]
    for shift, checksum in zip(benchmark.shifts, track.checksums, strict=True):
        compiled = compile_track(benchmark, track, shift, Console(quiet=True))
        assert checksum_track(benchmark, compiled) == checksum


def test_policies_are_refused_on_tracks_with_other_categories():
    with pytest.raises(jaxnav.InputError, match=r"rooms-org.*other categories.*houses"):
        run_benchmark("rooms-org", tracks=["houses"])


@pytest.mark.parametrize(
    ("options", "message_pattern"),
    [
        (["--benchmark", "v3"], "benchmark 'v3'.*v1"),
        (["--benchmark", "v2", "--tracks", "gardens"], "track 'gardens'.*rooms, apartments, houses"),
        (["--benchmark", "v2", "--shift", "1"], "--shift.*fixed"),
        (["--tracks", "rooms"], "--tracks rooms.*--benchmark"),
    ],
)
def test_impossible_options_are_refused(options, message_pattern, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["rooms-org", *options]) == 2
    assert re.search(message_pattern, capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_command_prints_and_writes_the_scores_of_a_policy(tiny_benchmark, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["rooms-org", "--benchmark", "tiny"]) == 0
    printed = capsys.readouterr().out
    assert "SR, shift 0" in printed
    assert "SR, mixed" in printed
    scores, episodes = read_scores(tmp_path / "benchmark-tiny-rooms-org-all.json")
    assert (scores["benchmark"], scores["subject"]) == ("tiny", "rooms-org")
    assert {row["variant"] for row in scores["rows"]} >= {"layout", "tde", "stde", "random", "oracle"}
    assert len({episode["scene"] for episode in episodes}) == 4
