"""The page with the paper's tables says what the results say, and judges orderings by hand-made ones."""

from pathlib import Path

import numpy as np
import pytest

from jaxnav.errors import InputError
from jaxnav.study.paper_tables import TABLE_1, TABLE_2_AI2THOR, TABLE_2_ROBOTHOR, TABLE_3, write_paper_tables
from jaxnav.study.records import AgentScores, RunScores
from jaxnav.study.results import write_record

ROOT = Path(__file__).parents[2]
SCENES = tuple(f"val-kitchen-{number:05d}" for number in range(8))


def scores(**success):
    """Results of three seeds in eight scenes of ten episodes: successes by scene, of all seeds or of each."""
    wiggle = np.array([[0.0, 0.1, 0.2, 0.3, 0.3, 0.2, 0.1, 0.0]] * 3)  # no scene is like another
    lines = [
        AgentScores(variant, "argmax", *(np.reshape(level, (-1, 1)) * share + wiggle for share in (1.0, 0.5, 0.1)))
        for variant, level in success.items()
    ]
    return RunScores(SCENES, ("kitchen",) * 8, np.full(8, 10), tuple(lines))


def page(tmp_path, **results):
    """The page, and its table of orderings, of results by name with _ for -."""
    for name, result in results.items():
        write_record(tmp_path / "val" / f"{name.replace('_', '-')}.json", {}, result)
    write_paper_tables(tmp_path / "page.md", tmp_path / "val")
    text = (tmp_path / "page.md").read_text()
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith(("| rooms: ", "| gains"))]
    return text, {row[0]: row[1:] for row in rows}


def test_the_committed_page_is_written_from_the_committed_results(tmp_path):
    committed = (ROOT / "docs" / "paper_tables.md").read_text()
    (tmp_path / "page.md").write_text(committed)
    write_paper_tables(tmp_path / "page.md", ROOT / "results" / "tables" / "val")
    assert (tmp_path / "page.md").read_text() == committed


def test_methods_of_other_settings_are_not_compared(tmp_path):
    """Method and arms may differ, and worlds, and what is not on the page; steps may not."""
    nearest = {"episodes": 8, "run": {"total_steps": 1}}
    write_record(tmp_path / "val" / "houses-semexp-NEAREST-fused.json", nearest, scores(baseline=6.0))
    one = {"episodes": 9, "run": {"method": "rgb", "arms": ["baseline"], "total_steps": 5}}
    other = {"episodes": 9, "run": {"method": "org", "arms": ["layout"], "total_steps": 5}}
    for name, study in (("rooms-rgb-fused", one), ("rooms-org-fused", other), ("houses-rgb-fused", {"episodes": 8})):
        write_record(tmp_path / "val" / f"{name}.json", study, scores(baseline=6.0))
    write_paper_tables(tmp_path / "page.md", tmp_path / "val")
    other["run"]["total_steps"] = 6
    write_record(tmp_path / "val" / "rooms-org-fused.json", other, scores(baseline=6.0))
    message = r"rooms-rgb-fused.json: was .* than rooms-org-fused.json \(run.total_steps: 5 != 6\); compare both"
    with pytest.raises(InputError, match=message):
        write_paper_tables(tmp_path / "page.md", tmp_path / "val")


def test_orderings_are_judged_by_their_intervals(tmp_path):
    """6 of 10 with rgb, 8 with ORG, 8.5 with w: 2 and 0.5 episodes of ten are 20 and 5 points.

    Seeds differ with HOZ alone: its three seeds gain -10, 0 and 10 points by w.
    """
    _, rows = page(
        tmp_path,
        rooms_rgb_fused=scores(random=0.5, baseline=6.0),
        rooms_org_fused=scores(baseline=8.0, layout=8.5, tde=9.0, stde=8.1),
        rooms_hoz_fused=scores(baseline=8.0, layout=(7.0, 8.0, 9.0)),
    )
    # The paper's, of the methods that ran: (66.53 + 70.38) / 2 - 59.06 = 9.395.
    assert rows["rooms: methods over `rgb` (2 of 6)"] == ["+9.4", "+20.0 [+20.0, +20.0]", "holds"]
    # RGB, ORG and HOZ are learned: (6 + 8 + 8) / 3 = 7.33 of 10 on average, less 0.5.
    assert rows["rooms: methods over Random (3 of 8)"][1:] == ["+68.3 [+68.3, +68.3]", "holds"]
    assert rows["rooms: `org` + w over `org`"] == ["+4.9", "+5.0 [+5.0, +5.0]", "holds"]
    assert rows["rooms: `org` + w + sTDE over `org`"] == ["+8.5", "+1.0 [+1.0, +1.0]", "too small to matter"]
    assert rows["rooms: `org` + w over `org` + w + TDE"] == ["+2.2", "-5.0 [-5.0, -5.0]", "refuted"]
    assert rows["rooms: `hoz` + w over `hoz`"][2] == "cannot be told"
    assert rows["rooms: `eotp` + w over `eotp`"] == ["-", "-", "not run"]
    assert rows["gains of hosts: apartments over rooms"][2] == "not run"


def test_gains_of_worlds_are_compared_by_both_intervals(tmp_path):
    """Hosts gain 10 points in apartments and 5 in rooms, SemExp 0 in houses."""
    gains = {"rooms_org": (8.0, 8.5), "apartments_org": (5.0, 6.0), "houses_semexp": (7.0, 7.0)}
    text, rows = page(tmp_path, **{f"{name}_fused": scores(baseline=a, stde=b) for name, (a, b) in gains.items()})
    # The paper's, of the host that ran: 9.63 - 8.32.
    assert rows["gains of hosts: apartments over rooms"] == ["+1.3", "+5.0 [+5.0, +5.0]", "holds"]
    # 8.32 - 1.61, and 5 - 0.
    assert rows["gains: hosts in rooms over `semexp` in houses"] == ["+6.7", "+5.0 [+5.0, +5.0]", "holds"]
    # 7 of 10 episodes and the wiggle's mean, 1.2 / 8: 71.5 %, half of it and a tenth for SPL and DTS.
    assert "| `semexp` | 65.35 | 33.52 | 1.56 | 71.5 [" in text


@pytest.mark.parametrize(
    ("table", "gains"),
    [
        (TABLE_2_AI2THOR, {"eotp": 4.01, "org": 8.32, "vtnet": 5.15, "hoz": 4.67}),
        (TABLE_2_ROBOTHOR, {"eotp": 8.53, "org": 9.63, "vtnet": 9.91, "hoz": 9.86}),
        (TABLE_3, {"semexp": 1.61}),
    ],
)
def test_the_papers_numbers_add_up_to_the_gains_that_it_prints(table, gains):
    computed = {host: table[host, "stde"].sr - table[host, "baseline"].sr for host in gains}
    assert computed == pytest.approx(gains, abs=1e-6)


def test_the_papers_tables_have_all_rows():
    assert [len(table) for table in (TABLE_1, TABLE_2_AI2THOR, TABLE_2_ROBOTHOR, TABLE_3)] == [4, 13, 13, 4]
