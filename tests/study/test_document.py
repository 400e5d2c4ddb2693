"""The document and its figures follow the results."""

import dataclasses
import re
from typing import get_args

import pytest
from support import study_results

from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.study.claims import study_claims
from jaxnav.study.document import CONTROL_LABELS, READING_MARK, check_document, metrics_table, write_study_document
from jaxnav.study.figures import draw_study_figures
from jaxnav.study.records import TrialControl


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with results of both worlds, written up."""
    folder = tmp_path_factory.mktemp("study")
    study_results.write(folder / "results" / "val", study_results.parts(("main", "real")))
    draw_study_figures(folder / "results" / "val", folder / "docs" / "images" / "study")
    write_study_document(folder / "results", folder / "docs" / "study.md")
    return folder


@pytest.fixture(scope="module")
def text(folder):
    return (folder / "docs" / "study.md").read_text()


def section(text, title):
    """Return the lines of the first section of this title."""
    return text.split(f"# {title}\n", 1)[1].split("\n#", 1)[0]


def table(lines):
    """Return cells by the first cell of their row."""
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in lines.splitlines() if line.startswith("|")
    ]
    return {first: rest for first, *rest in rows}


@pytest.mark.slow
def test_every_image_that_is_named_is_drawn_and_no_other(folder, text):
    named = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert len(set(named)) == len(named) == 2 * 6
    drawn = {str(path.relative_to(folder / "docs")) for path in (folder / "docs").rglob("*.png")}
    assert set(named) == drawn


@pytest.mark.parametrize("text", ["", "My own notes.\n", f"{READING_MARK}\nOne line of two.\n"])
def test_a_document_that_is_none_of_the_studys_is_not_written_over(folder, tmp_path, text):
    document = tmp_path / "study.md"
    check_document(document)
    document.write_text(text)
    with pytest.raises(InputError, match=r"study.md: is there, without two lines <!-- reading -->; give another"):
        write_study_document(folder / "results", document)
    assert document.read_text() == text


def test_without_results_nothing_is_written(tmp_path):
    with pytest.raises(InputError, match=r"val: holds no results; run the study first"):
        write_study_document(tmp_path, tmp_path / "study.md")
    with pytest.raises(InputError, match=r"val: holds no results; run the study first"):
        draw_study_figures(tmp_path / "val", tmp_path / "images")
    assert not list(tmp_path.iterdir())


def test_what_is_written_by_hand_stays(folder, tmp_path):
    document = tmp_path / "study.md"
    write_study_document(folder / "results", document)
    before = document.read_text()
    assert before.count(READING_MARK) == 2
    head, _, tail = before.split(READING_MARK)
    document.write_text(f"{head}{READING_MARK}\nAs found:\n\n* | a table |\n{READING_MARK}{tail}")
    by_hand = document.read_text()
    write_study_document(folder / "results", document)
    assert document.read_text() == by_hand
    # Numbers follow the results, the text by hand does not.
    parts = study_results.parts(runs=("main",))
    changed = study_results.full_condition(1.0)
    rows = tuple(dataclasses.replace(row, sr=study_results.estimate(12.5)) for row in changed.rows)
    parts["main-shift1"] = dataclasses.replace(changed, rows=rows)
    study_results.write(tmp_path / "results" / "val", parts)
    write_study_document(tmp_path / "results", document)
    assert "\nAs found:\n\n* | a table |\n" in document.read_text()
    assert "| 12.5 ± 0.5 |" in document.read_text()


def test_both_worlds_have_their_sections(text):
    generated, real = text.index("## Generated rooms: 80 scenes"), text.index("## Scenes of the file: 80 scenes")
    assert generated < real
    assert text.count("### Claims") == text.count("### Controls") == 2
    # One factor at a time: of generated rooms alone.
    assert text.count("### How the parts are made") == 1
    assert "Test, touched once" not in text
    assert "3 seeds, 1,000,000 steps a policy, 1,000 episodes at each shift" in text


def test_the_claims_are_those_of_the_results(text):
    rows = table(section(text, "Claims"))
    expected = study_claims(study_results.results())
    assert list(rows)[2:] == [claim.text for claim in expected]
    assert rows["claim"] == ["effect", "least", "verdict"]
    assert [rows[claim.text][2] for claim in expected] == [claim.verdict for claim in expected]
    assert rows["The baseline loses from shift 0 to 1"] == ["+9.0 [+8.0, +10.0]", "2 SR points", "holds"]
    assert rows["The `evidence` gap does at step 20"] == ["+0.25 [+0.24, +0.26]", "0.05 AUC - 0.5", "holds"]


def test_table_1_holds_both_decodings_at_every_shift(text):
    best, sampled = section(text, "Table 1").split("Sampled actions:")
    assert section(text, "Table 1").count("**shift") == 4
    # The last shift's rows: 60 and the effect.
    assert table(best)["+ w + sTDE (eps 0, paper's form)"] == [
        "65.0 ± 0.5", "30.0 ± 0.5", "1.50 ± 0.50", "+5.0 [+4.0, +6.0]", "0.250",
    ]  # fmt: skip
    assert table(best)["baseline"][3] == ""
    assert table(sampled)["+ w"][3] == "+101.0 [+100.0, +102.0]"


def test_one_training_run_has_neither_spread_nor_interval():
    of_one = Interval(62.5, seeds=(62.5,))
    rows = tuple(
        dataclasses.replace(
            row, sr=of_one, difference=row.difference and dataclasses.replace(row.difference, sr=of_one)
        )
        for row in study_results.rows(1.0)
    )
    condition = dataclasses.replace(study_results.full_condition(1.0), rows=rows)
    cells = table("\n".join(metrics_table([condition], "argmax")))["+ w"]
    assert cells == ["62.5", "30.0 ± 0.5", "1.50 ± 0.50", "+62.5 [-]", "0.250"]


def test_every_control_is_there(text):
    assert set(CONTROL_LABELS) == {None, *get_args(TrialControl)}
    rows = table(section(text, "Controls"))
    # Two uses: two gaps with five controls and none each, and the clock; no zeros in the paper's form; header and rule.
    assert len(rows) == 2 * (2 * 6 + 1) - 2 + 2
    assert rows["sTDE (eps 0.5), gap `novelty`"] == ["+0.0 [-1.0, +1.0] (0.25)", "+2.0 [+1.0, +3.0] (0.25)"]
    assert rows["sTDE (eps 0.5), gap `novelty`, noise taken out"] == 2 * ["+0.2 [-0.8, +1.2] (0.25)"]
    # Zeros: with sampled actions, of which they are a control.
    zeros = rows["sTDE (eps 0.5), gap `novelty`, zeros taken out, sampled actions"]
    assert zeros == 2 * ["+100.2 [+99.2, +101.2] (0.25)"]
    assert rows["sTDE (eps 0.5), the released code's novelty clock"][1] == "+0.5 [-0.5, +1.5] (0.25)"


def test_other_runs_have_the_rows_they_have(text):
    lines = section(text, "How the parts are made: settings, counterfactual branch, one factor at a time")
    rows = table(lines)
    assert list(rows)[2] == "`main` baseline"  # the one to compare with comes first
    assert [cell.split(" (")[0] for cell in rows["`gate` + w"]] == ["63.0 ± 0.5", "61.0 ± 0.5"]
    assert rows["`gate` + w"][0].endswith("(+3.0 [+2.0, +4.0])")
    assert "`gate` baseline" in rows
    assert "`coin` baseline" not in rows
    assert "`coin` TDE" in rows
    assert not any("real" in name for name in rows)
    assert "All policies have 12,345 parameters." in lines


def test_the_gap_is_there_at_the_steps_that_there_are(text):
    lines = section(text, "Does the gap track the layout?")
    assert table(lines)["setting"] == ["0", "1", "5", "10", "20"]  # 30 steps
    assert table(lines)["`evidence`"][-1] == "0.75 [0.74, 0.76]"
    # 1 - step / 30.
    assert "Episodes that still run at these steps, shift 0: 100, 97, 83, 67, 33 %." in lines


def test_results_on_test_are_appended(tmp_path):
    study_results.write(tmp_path / "val", study_results.parts())
    conditions = {
        f"main-shift{shift:g}": study_results.full_condition(shift, chosen_epsilon=1.0)
        for shift in study_results.SHIFTS
    }
    study_results.write(tmp_path / "test", study_results.parts() | conditions)
    write_study_document(tmp_path, tmp_path / "study.md")
    rows = table(section((tmp_path / "study.md").read_text(), "Test, touched once"))
    assert rows["+ w + sTDE (eps 0.5)"][0] == "62.0 ± 0.5"
    assert rows["+ w + sTDE (eps 1, chosen)"][0] == "62.0 ± 0.5"
