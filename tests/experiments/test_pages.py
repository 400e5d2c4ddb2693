"""Pages: verdicts, lines of tables, preserved summaries, custom templates, and the claims of packaged templates."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from support.intervals import bounds
from support.processes import REPOSITORY
from support.result_rows import make_interval, make_row

from jaxnav.cli.study import parse_study
from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments.config import ExperimentConfig
from jaxnav.experiments.pages import (
    READING_MARK,
    RESULT_MARK,
    check_page,
    difference_of_worlds,
    effect_cells,
    format_value,
    format_weights,
    format_with_std,
    render_page,
    result_sections,
    table_header,
    table_line,
    verdict,
)
from jaxnav.experiments.table import Curve, ResultRow, ResultTable

AGENTS = {"main": {}, "anonymous": {"method": "anonymous", "arms": ["baseline"]}}
CONFIG = ExperimentConfig(title="A title", agents=AGENTS)


def render(folder: Path, template: str, *rows: ResultRow, config: ExperimentConfig = CONFIG) -> str:
    """Text of the page `page.md` of these results on `val`."""
    return render_page(folder / "page.md", template, config, {"val": ResultTable(rows)}, [])


def render_custom(folder: Path, body: str, *rows: ResultRow) -> str:
    """Text of a page by a custom template, `custom.md`; the body begins in its second line."""
    template = folder / "custom.md"
    template.write_text("{{ summary }}\n" + body)
    return render(folder, str(template), *rows)


def read_lines(text: str) -> dict[str, list[str]]:
    """Cells of all Markdown tables by the first cell of their line; the first of equal names counts."""
    cells_by_name: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line.startswith("|"):
            name, *cells = [cell.strip() for cell in line.strip("|").split("|")]
            cells_by_name.setdefault(name, cells)
    return cells_by_name


# Functions of templates


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        # The verdict depends on the bounds alone; the mean is deliberately outside them.
        (Interval(5.0, 0.5, 3.0), "holds"),
        (Interval(5.0, 2.5, 3.0), "holds"),
        (Interval(5.0, 0.5, 1.5), "excluded"),  # positive, but too small
        (Interval(5.0, -1.0, 1.5), "excluded"),
        (Interval(5.0, -4.0, -1.0), "refuted"),
        (Interval(5.0, -4.0, 0.0), "excluded"),  # 0 is within the interval
        (Interval(5.0, -1.0, 2.5), "inconclusive"),
        (Interval(5.0, 0.0, 2.5), "inconclusive"),
        (Interval(5.0, -1.0, 2.0), "inconclusive"),  # the least effect is within the interval, too
        (Interval(5.0), "inconclusive"),  # no bounds
        (Interval(math.nan), "not measured"),
    ],
)
def test_a_verdict_compares_the_interval_with_zero_and_the_least_effect(effect, expected):
    assert verdict(effect, min_effect=2.0) == expected


def test_undefined_values_are_dashes():
    undefined_value = Interval(math.nan)
    assert format_value(undefined_value, "+.1f") == "-"
    assert format_value(math.nan, ".1f") == "-"
    assert format_with_std(undefined_value) == "-"
    assert effect_cells(ResultTable([]), {"world": "rooms"}, [0.0]) == ["- (-)"]
    assert format_weights(ResultTable([]), {"world": "rooms"}, [0.0, 1.0]) == "-, -"


def test_values_show_their_interval_or_their_deviation():
    # The deviation of 60, 62.5 and 65 is 2.5.
    interval = Interval(62.5, 60.25, 64.75, 2.5, (60.0, 62.5, 65.0))
    assert format_value(interval, ".1f") == "62.5 [60.2, 64.8]"
    assert format_with_std(interval) == "62.5 ± 2.5"
    assert format_with_std(Interval(62.5, seeds=(62.5,)), digits=2) == "62.50"  # a single run has no deviation


def test_lines_have_a_cell_for_each_column():
    assert table_line("a", ["b", 2], ("c",), 3.5) == "| a | b | 2 | c | 3.5 |"
    title_line, rule_line = table_header("", ["SR", "SPL"], "DTS").splitlines()
    assert title_line.count("|") == rule_line.count("|") == 5
    assert rule_line.split("|")[1:-1] == [" --- ", " ---: ", " ---: ", " ---: "]


def test_a_difference_of_worlds_adds_both_widths():
    # 10 [8, 12] and 5 [4, 7]: 8 - 7 = 1 and 12 - 4 = 8.
    difference = difference_of_worlds(Interval(10.0, 8.0, 12.0), Interval(5.0, 4.0, 7.0))
    assert bounds(difference) == (5.0, 1.0, 8.0)


# Documents


@pytest.mark.parametrize("content", ["", "My own notes.\n", f"{READING_MARK}\nOne mark of two.\n"])
def test_a_document_that_is_no_page_is_not_overwritten(tmp_path, content):
    document = tmp_path / "page.md"
    document.write_text(content)
    with pytest.raises(InputError, match=r"page\.md"):
        check_page(document, "factors")
    with pytest.raises(InputError, match=r"page\.md"):
        render(tmp_path, "factors")
    assert document.read_text() == content


def test_a_page_keeps_its_summary(tmp_path):
    body = "SR: {{ table.find(world='rooms', run='main', metric='sr') | f('.1f') }}\n"
    render_custom(tmp_path, body, make_row(50.0))
    document = tmp_path / "page.md"
    head, _, tail = document.read_text().split(READING_MARK)

    # Text between the marks is copied, even if it looks like a template.
    summary = "\nAs found:\n\n* | a table |\n* {{ table }} {% if %}\n"
    document.write_text(head + READING_MARK + summary + READING_MARK + tail)
    render_custom(tmp_path, body, make_row(12.5))
    assert document.read_text().split(READING_MARK)[1] == summary
    assert "SR: 12.5 [-]" in document.read_text()

    # Equal results give an equal document.
    content = document.read_bytes()
    render_custom(tmp_path, body, make_row(12.5))
    assert document.read_bytes() == content


def test_a_page_is_written_into_a_new_folder(tmp_path):
    template = tmp_path / "custom.md"
    template.write_text("# {{ config.title }}\n{{ summary }}")
    document = tmp_path / "new" / "docs" / "page.md"
    text = render_page(document, str(template), CONFIG, {}, [])
    assert document.read_text().strip() == text.strip()
    assert text.startswith("# A title")


# Custom templates


def test_a_custom_template_has_the_experiment_and_its_results(tmp_path):
    body = """{% import "macros.md" as m %}
{{ header("agent", shift_titles(config.shifts)) }}
{% for world, agents in runs.items() %}
{% for agent in agents %}
{% set cells = [] %}
{% for shift in config.shifts %}
{% do cells.append(table.find(world=world, run=agent, shift=shift, metric="sr") | f(".1f")) %}
{% endfor %}
{{ line(m.label(agent), cells) }}
{% endfor %}
{% endfor %}
"""
    # The table has no line for agents without results.
    text = render_custom(tmp_path, body, make_row(make_interval(50.0), shift=0.0), make_row(40.0, shift=1.0))
    cells = read_lines(text)
    assert cells["agent"] == ["shift 0", "shift 1"]
    assert cells["`main`"] == ["50.0 [49.0, 51.0]", "40.0 [-]"]
    assert "`anonymous`" not in cells


def test_a_template_may_include_templates_of_its_folder(tmp_path):
    (tmp_path / "part.md").write_text("An included {{ config.title }}.")
    assert "An included A title." in render_custom(tmp_path, '{% include "part.md" %}')


def test_a_template_may_draw_figures(tmp_path):
    steps = np.array([0.0, 1.0])
    curve = Curve(steps, steps, steps, steps)
    row = make_row(curve, variant="paper", shift=1.0, control="updated", metric="gap auc")
    fields = '{"world": "rooms", "run": "main"}'
    text = render_custom(tmp_path, f'![AUC]({{{{ figure("auc", table, config.shifts, {fields}) }}}})', row)
    (image,) = re.findall(r"!\[AUC\]\((.*)\)", text)
    assert (tmp_path / image).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "line",
    [
        "{% if %}",
        "{% for agent in runs %}",
        "{{ unknown_name }}",
        "{{ config.unknown_setting }}",
        "{{ runs.rooms.unknown_agent.config }}",
        "{{ table.find(unknown_field=1) }}",
        "{{ table.num_scenes(world='nowhere') }}",
        "{{ 1 / 0 }}",
        "{{ 'word' + 1 }}",
        "{{ 5.0 | f('nonsense') }}",
        "{{ figure('unknown figure', table, config.shifts, {}) }}",
        "{% include 'unknown.md' %}",
    ],
)
def test_a_fault_in_a_template_is_one_error_with_file_and_line(tmp_path, line):
    with pytest.raises(InputError, match=r"custom\.md, line 4") as refusal:
        render_custom(tmp_path, f"A line.\n\n{line}\n", make_row())
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "page.md").exists()


@pytest.mark.parametrize("line", ["{% if %}", "{{ unknown_name }}"])
def test_a_fault_in_an_included_template_names_its_file(tmp_path, line):
    (tmp_path / "part.md").write_text(f"A line.\n{line}\n")
    with pytest.raises(InputError, match=r"part\.md, line 2"):
        render_custom(tmp_path, '{% include "part.md" %}')


def test_unknown_binary_and_bare_templates_are_refused(tmp_path):
    # The message lists the packaged ones.
    with pytest.raises(InputError, match=r"unknown.*factors.*study"):
        check_page(tmp_path / "page.md", "unknown")
    (tmp_path / "binary.md").write_bytes(b"\xff\xfe{{ summary }}")
    with pytest.raises(InputError, match=r"binary\.md"):
        check_page(tmp_path / "page.md", str(tmp_path / "binary.md"))

    # A template needs the summary, because a page without one could not be written again.
    (tmp_path / "bare.md").write_text("No summary.\n")
    with pytest.raises(InputError, match=r"bare\.md.*summary"):
        render(tmp_path, str(tmp_path / "bare.md"))
    assert not (tmp_path / "page.md").exists()


# Claims of the study

NUM_STEPS = 30
PAPER_STDE = {"variant": "stde", "decoding": "argmax", "epsilon": 0.5, "form": "residual"}
ZERO_STDE = {"variant": "stde", "decoding": "argmax", "epsilon": 0.0, "form": "paper"}


def make_course(start: float, at_step_20: float) -> Curve:
    """Line through its values at steps 0 and 20, with bounds at a distance of 0.01."""
    steps = np.arange(NUM_STEPS, dtype=float)
    mean = start + (at_step_20 - start) * steps / 20
    return Curve(steps, mean, mean - 0.01, mean + 0.01)


def study_rows() -> list[ResultRow]:
    """Results of all claims of the study: the effects differ, and most bounds are at a distance of 1 point."""
    to_layout = {"reference": "layout", "shift": 1.0}
    rows = [
        make_row(make_interval(9.0), shift=1.0, reference="first shift", metric="baseline_argmax_sr"),
        make_row(make_interval(3.0), variant="layout", decoding="argmax", shift=0.0, reference="baseline"),
        make_row(make_interval(1.0), variant="layout", decoding="argmax", shift=1.0, reference="baseline"),
        make_row(make_interval(2.0), **PAPER_STDE, gap="novelty", **to_layout),
        make_row(make_interval(5.0), **ZERO_STDE, gap="novelty", **to_layout),
        make_row(make_interval(4.0), **ZERO_STDE, gap="evidence", **to_layout),
        make_row(make_interval(2.0, 0.5), **PAPER_STDE, gap="novelty", reference="layout", metric="sr growth"),
        make_row(make_interval(-6.0), variant="tde", decoding="argmax", shift=0.0, reference="layout"),
        make_row(make_interval(0.3, 0.1), variant="baseline", shift=0.0, metric="sr by similarity, pearson"),
        make_row(make_interval(-2.5, 0.25), **PAPER_STDE, shift=1.0, metric="gain by similarity, slope"),
    ]

    # Gaps fall from 0.9 to 0.2, or to 0.8 where the belief is frozen. `evidence` shows the shift, eq. 5 does not.
    gaps = {"updated": make_course(0.9, 0.2), "frozen": make_course(0.9, 0.8)}
    aucs = {"calibrated": make_course(0.5, 0.5), "evidence": make_course(0.5, 0.75)}
    for belief, curve in gaps.items():
        for shift in (0.0, 1.0):
            rows.append(make_row(curve, variant="calibrated", control=belief, shift=shift, metric="gap"))
    for setting, curve in aucs.items():
        rows.append(make_row(curve, variant=setting, control="updated", shift=1.0, metric="gap auc"))
    no_bounds = np.full(NUM_STEPS, math.nan)
    running_share = 100 - 100 * np.arange(NUM_STEPS) / NUM_STEPS
    running = Curve(np.arange(NUM_STEPS, dtype=float), running_share, no_bounds, no_bounds)
    rows.append(make_row(running, shift=0.0, metric="running"))

    # Experience is worth 8 points as trained and costs 7 if shifted, of which removal recovers 3.
    sampled = {"decoding": "sample"}
    lead = {"variant": "without removal", "reference": "layout-blind agents"}
    rows.append(make_row(make_interval(8.0), **sampled, **lead, shift=0.0))
    rows.append(make_row(make_interval(-7.0), **sampled, **lead, shift=1.0))
    rows.append(make_row(make_interval(3.0), **sampled, variant="TDE", reference="without removal", shift=1.0))
    for shift in (0.0, 1.0):
        rows.append(make_row(50.0, **sampled, variant="layout-blind agents", shift=shift))
        rows.append(make_row(50.0, **sampled, variant="without removal", shift=shift))
        rows.append(make_row(20.0, **sampled, variant="without removal", shift=shift, metric="length"))
    return rows


#: Words of a claim, its effect with the half width of its interval, and its verdict.
CLAIMS = [
    ("baseline loses", 9.0, 1.0, "holds"),
    ("w improves the baseline at shift 0", 3.0, 1.0, "holds"),
    ("w improves the baseline at shift 1", 1.0, 1.0, "inconclusive"),  # from 0 to 2
    ("sTDE (epsilon 0.5) improves w", 2.0, 1.0, "holds"),
    ("sTDE (paper's form, epsilon 0) improves", 5.0, 1.0, "holds"),
    ("sTDE with the `evidence` gap", 4.0, 1.0, "holds"),
    ("grows with the shift", 2.0, 0.5, "holds"),
    ("Hard TDE loses", 6.0, 1.0, "holds"),  # the effect is -6, and the claim is a loss
    ("Success rises", 0.3, 0.1, "holds"),
    ("where the similarity is low", 2.5, 0.25, "holds"),  # -2.5 points per 0.1 more similarity
    ("gap is below 0.5", 0.3, 0.01, "holds"),  # 0.5 - 0.2
    ("Without updates of the belief", 0.3, 0.01, "holds"),  # 0.8 - 0.5
    ("eq. 5 detects shift 1 at step 0", 0.0, 0.01, "excluded"),  # an AUC of 0.5 is chance
    ("eq. 5 detects shift 1 at step 20", 0.0, 0.01, "excluded"),
    ("The `evidence` gap detects", 0.25, 0.01, "holds"),
    ("Experience has a value", 8.0, 1.0, "holds"),
    ("Experience has a cost", 7.0, 1.0, "holds"),
    ("Hard TDE gains success", 3.0, 1.0, "holds"),
]


def find_claim(text: str, words: str) -> list[str]:
    """Effect, least effect and verdict of the claim with these words."""
    claims = text.split("### Claims")[1].split("###")[0]
    (cells,) = [cells for name, cells in read_lines(claims).items() if words in name]
    return cells


@pytest.fixture(scope="module")
def study_page(tmp_path_factory) -> str:
    return render(tmp_path_factory.mktemp("study"), "study", *study_rows())


@pytest.mark.parametrize(("words", "mean", "half_width", "expected"), CLAIMS)
def test_the_effect_of_a_claim_has_the_claimed_sign(study_page, words, mean, half_width, expected):
    effect, _, claim_verdict = find_claim(study_page, words)
    numbers = [float(number) for number in re.findall(r"[-+]?[0-9.]+", effect)]

    # Points of success have one decimal on the page, correlations, gaps and AUCs have two.
    tolerance = 0.051 if mean >= 1 else 0.0051
    assert numbers == pytest.approx([mean, mean - half_width, mean + half_width], abs=tolerance)
    assert claim_verdict == expected


def test_the_study_has_no_further_claims(study_page):
    claims = study_page.split("### Claims")[1].split("###")[0]
    assert len(read_lines(claims)) == len(CLAIMS) + 2  # header and rule


@pytest.mark.slow
def test_a_claim_without_results_has_the_verdict_of_no_effect(tmp_path):
    rows = [row for row in study_rows() if row.metric != "sr growth" and row.variant != "tde"]
    text = render(tmp_path, "study", *rows)
    for words in ("grows with the shift", "Hard TDE loses"):
        effect, _, claim_verdict = find_claim(text, words)
        assert (effect, claim_verdict) == ("-", "not measured")


def test_the_gap_is_shown_at_the_steps_that_episodes_reach(study_page):
    gaps = study_page.split("### Does the gap detect the shift?")[1].split("###")[0]
    cells = read_lines(gaps)
    assert cells["setting"] == ["step 0", "step 1", "step 5", "step 10", "step 20"]  # 30 steps
    assert cells["`evidence`"][-1] == "0.75 [0.74, 0.76]"
    assert "100, 97, 83, 67, 33 %" in gaps  # 1 - step / 30


def test_epsilon_is_chosen_on_val_and_applied_on_test(tmp_path):
    # On `val`, epsilon 0.75 has the greatest SR at the first shift; on `test` it would be 0.25.
    tables = {}
    for split, success in (("val", {0.25: 60.0, 0.75: 70.0}), ("test", {0.25: 50.0, 0.75: 40.0})):
        rows = study_rows()
        for epsilon, sr in success.items():
            rows.append(make_row(sr, **{**PAPER_STDE, "epsilon": epsilon}, gap="novelty", shift=0.0))
        tables[split] = ResultTable(rows)
    text = render_page(tmp_path / "page.md", "study", CONFIG, tables, [])
    test_section = text.split("## Split `test`")[1]
    epsilon_lines = [line for line in test_section.splitlines() if "chosen)" in line]
    assert len(epsilon_lines) == 2  # at both shifts
    assert "0.75" in epsilon_lines[0]
    assert "40.0" in epsilon_lines[0]


@pytest.mark.slow
@pytest.mark.parametrize("template", ["methods", "factors"])
@pytest.mark.parametrize("split", ["val", "test"])
def test_pages_compare_both_splits_and_judge_gains_on_test(tmp_path, template, split):
    # w gains 5 points on `val`; on `test` it loses 3.
    agents = {"anonymous": {"method": "anonymous", "arms": ["baseline"]}, "org": {"against": ["anonymous"]}}
    if template == "factors":
        agents = {"base": {"arms": ["baseline"]}, "org": {"arms": ["layout"], "against": ["base/baseline"]}}
    reference = {"methods": "baseline", "factors": "base/baseline"}[template]
    tables = {}
    for name, effect in (("val", make_interval(5.0)), ("test", make_interval(-3.0))):
        rows = [*make_agent_rows("rooms", "org", layout=70.0 + effect.mean)]
        rows.append(make_effect("rooms", "org", "layout", reference, effect))
        tables[name] = ResultTable(rows)
    config = ExperimentConfig(agents=agents, shifts=(0.0,), split=split)
    text = render_page(tmp_path / "page.md", template, config, tables, [])
    parts = text.split("Split `test`, evaluated once")
    assert len(parts) == 2

    # All other tables are about `val`, whichever split was measured last.
    assert "of the split `val`" in parts[0]
    assert "+5.0" in parts[0]
    assert "-3.0" not in parts[0]
    test_lines = [line for line in parts[1].splitlines() if "-3.0 [-4.0, -2.0]" in line]
    assert len(test_lines) == 1
    assert "refuted" in test_lines[0]

    # A page of one split has no such section.
    text = render_page(tmp_path / "page.md", template, config, {split: tables[split]}, [])
    assert "evaluated once" not in text
    assert f"of the split `{split}`" in text


# Removal in a mixed population


def mixture_rows(world: str) -> list[ResultRow]:
    """Results of one world, where experience has a value of 6 points and a cost of 4, and those of TDE."""
    sampled = {"world": world, "decoding": "sample"}
    rows = []
    for shift, lead in ((0.0, 6.0), (1.0, -4.0)):
        for metric in ("sr", "spl", "sr@40"):
            fields = {**sampled, "shift": shift, "metric": metric}
            rows.append(make_row(50.0, **fields, variant="layout-blind agents"))
            rows.append(make_row(50.0 + lead, **fields, variant="without removal"))
            lead_fields = {"variant": "without removal", "reference": "layout-blind agents"}
            rows.append(make_row(lead, **fields, **lead_fields))
        rows.append(make_row(20.0, **sampled, shift=shift, variant="without removal", metric="length"))

        # TDE keeps a third of the value and leaves a quarter of the cost; SPL has no defined share.
        share = 33.0 if shift == 0.0 else 25.0
        rows.append(make_row(1.0, **sampled, shift=shift, variant="TDE", metric="weight"))
        for metric in ("sr", "spl", "sr@40"):
            tde = {**sampled, "variant": "TDE", "shift": shift}
            rows.append(make_row(lead * (share / 100 - 1), **tde, reference="without removal", metric=metric))
            if metric != "spl":
                rows.append(make_row(share, **tde, metric=f"{metric} remaining"))
    return rows


def test_removal_keeps_value_and_recovers_cost(tmp_path):
    text = render(tmp_path, "mixture", *mixture_rows("rooms"))
    value = read_lines(text.split("### Value and cost of experience")[1])["its value (or cost)"]
    assert value == ["+6.0 [-]"] * 3 + ["-4.0 [-]"] * 3

    # Each metric has a table of weights, changes at the shifts and over the mixture, and shares if they are defined.
    removal_section = text.split("### Every removal")[1]
    for title, shares in (("SR within 40 actions", ["33", "75"]), ("SR", ["33", "75"]), ("SPL", [])):
        weights, *cells = read_lines(removal_section.split(f"**{title}**")[1])["TDE"]
        assert weights == "1.00, 1.00"
        assert cells[:3] == ["-4.0 [-]", "+3.0 [-]", "-"]  # the results have no row over the mixture
        assert [cell.split()[0] for cell in cells[3:]] == shares


def test_a_world_may_be_measured_on_a_single_split(tmp_path):
    config = ExperimentConfig(worlds={"rooms": {}, "apartments": {"world": "apartments"}}, agents={"main": {}})
    tables = {
        "val": ResultTable([*mixture_rows("rooms"), *mixture_rows("apartments")]),
        "test": ResultTable(mixture_rows("rooms")),
    }
    text = render_page(tmp_path / "page.md", "mixture", config, tables, [])
    titles = [line for line in text.splitlines() if line.startswith("## ") and "," in line]
    assert [title.split(":")[0] for title in titles] == ["## rooms, val", "## apartments, val", "## rooms, test"]


def test_methods_page_of_agents_that_choose_goals_only_has_no_row_of_random_actions(tmp_path):
    config = ExperimentConfig(worlds={"houses": {"world": "houses"}}, agents={"semexp": {"method": "semexp"}})
    text = render(tmp_path, "methods", *make_agent_rows("houses", "semexp", baseline=60.0), config=config)
    assert read_lines(text)["`semexp`"]
    assert "Random" not in read_lines(text)


# The paper's tables


def render_paper(folder: Path, *rows: ResultRow) -> str:
    return render(folder, "paper", *rows, config=parse_study(["table2"]))


def make_agent_rows(world: str, run: str, **sr: float) -> list[ResultRow]:
    """SR of the variants of an agent with best actions."""
    rows = []
    for variant, value in sr.items():
        stde = {"epsilon": 0.5, "form": "residual"} if variant == "stde" else {}
        rows.append(make_row(value, world=world, run=run, variant=variant, decoding="argmax", shift=0.0, **stde))
    return rows


def make_effect(world: str, run: str, variant: str, reference: str, effect: Interval, metric: str = "sr") -> ResultRow:
    stde = {"epsilon": 0.5, "form": "residual"} if variant == "stde" and run != "hosts" else {}
    fields = {"variant": variant, "decoding": "argmax", "reference": reference, "shift": 0.0, **stde}
    return make_row(effect, world=world, run=run, metric=metric, **fields)


@pytest.fixture(scope="module")
def ordering_cells(tmp_path_factory) -> dict[str, list[str]]:
    """Cells of the orderings of three agents in rooms, by the name of the ordering."""
    rows = [
        *make_agent_rows("rooms", "rgb", baseline=60.0),
        *make_agent_rows("rooms", "org", baseline=80.0),
        *make_agent_rows("rooms", "hoz", baseline=80.0),
        make_effect("rooms", "methods", "baseline", "rgb/random", make_interval(68.0)),
        make_effect("rooms", "structured methods", "baseline", "rgb/baseline", make_interval(20.0)),
        make_effect("rooms", "org", "layout", "baseline", make_interval(5.0)),
        make_effect("rooms", "org", "stde", "baseline", make_interval(0.5)),
        make_effect("rooms", "org", "tde", "layout", make_interval(5.0)),
        make_effect("rooms", "hoz", "layout", "baseline", make_interval(1.0, 3.0)),
    ]
    return read_lines(render_paper(tmp_path_factory.mktemp("orderings"), *rows))


def test_orderings_are_judged_by_their_intervals(ordering_cells):
    # The paper's means are over the methods that were run: (66.53 + 70.38) / 2 - 59.06 = 9.395, and
    # (59.06 + 66.53 + 70.38) / 3 - 4.68 = 60.643.
    cells = ordering_cells
    assert cells["rooms: structured methods over `rgb` (2 of 6)"] == ["+9.4", "+20.0 [+19.0, +21.0]", "-", "holds"]
    assert cells["rooms: methods over Random (3 of 8)"] == ["+60.6", "+68.0 [+67.0, +69.0]", "-", "holds"]

    # Gains of ORG in the paper: 71.40 - 66.48 in Table 1, 74.85 - 66.53 in Table 2, and 71.40 - 69.24.
    assert cells["rooms: `org` + w over `org`"] == ["+4.9", "+5.0 [+4.0, +6.0]", "-", "holds"]
    assert cells["rooms: `org` + w + sTDE over `org`"][1:] == ["+0.5 [-0.5, +1.5]", "-", "excluded"]
    assert cells["rooms: `org` + w over `org` + w + TDE"] == ["+2.2", "-5.0 [-6.0, -4.0]", "-", "refuted"]
    assert cells["rooms: `hoz` + w over `hoz`"][1:] == ["+1.0 [-2.0, +4.0]", "-", "inconclusive"]


def test_orderings_have_a_column_of_effects_on_spl(tmp_path):
    changes = {"sr": -5.0, "spl": -3.0}
    spl_rows = []
    for metric, mean in changes.items():
        spl_rows.append(make_effect("rooms", "org", "tde", "layout", make_interval(mean), metric))
    spl_cells = read_lines(render_paper(tmp_path, *make_agent_rows("rooms", "org", baseline=80.0), *spl_rows))
    assert spl_cells["rooms: `org` + w over `org` + w + TDE"][2] == "+3.0 [+2.0, +4.0]"


def test_orderings_without_results_have_no_verdict(ordering_cells):
    assert ordering_cells["rooms: `eotp` + w over `eotp`"][1:] == ["-", "-", "not run"]
    for name in ("apartments: all", "gains of hosts: apartments over rooms"):
        assert ordering_cells[name][-1] == "not run"


def make_share(run: str, variant: str, share: float) -> ResultRow:
    """Share of the decisions that other categories change."""
    fields = {"variant": variant, "decoding": "argmax", "shift": 0.0, "metric": "share of other_categories"}
    return make_row(make_interval(share), run=run, **fields)


def test_hosts_with_idle_experience_have_no_verdict(tmp_path):
    effects = [make_effect("rooms", run, "layout", "baseline", make_interval(5.0)) for run in ("org", "hoz")]
    # The share of the arm with w decides: ORG is just below 5 %, HOZ at 5 %.
    shares = [make_share("org", "baseline", 20.0), make_share("org", "layout", 4.9), make_share("hoz", "layout", 5.0)]
    cells = read_lines(render_paper(tmp_path, *effects, *shares))
    assert cells["rooms: `hoz` + w over `hoz`"][-2:] == ["5.0 [4.0, 6.0]", "holds"]
    idle_cells = cells['<span class="idle">rooms: `org` + w over `org`</span>']
    assert "4.9 [3.9, 5.9]" in idle_cells[-2]
    assert "experience is idle" in idle_cells[-1]


@pytest.fixture(scope="module")
def split_tables() -> dict[str, ResultTable]:
    """Results of both splits."""
    # On `val` w gains 5 points and hard TDE loses 4; on `test` w loses 3 and hard TDE 2. HOZ has no results on `test`.
    shares = [make_share("org", "layout", 20.0), make_share("hoz", "layout", 20.0)]
    val_rows = [
        *make_agent_rows("rooms", "org", layout=75.0),
        make_effect("rooms", "org", "layout", "baseline", make_interval(5.0)),
        make_effect("rooms", "org", "tde", "layout", make_interval(-4.0)),
        make_effect("rooms", "hoz", "layout", "baseline", make_interval(5.0)),
    ]
    test_rows = [
        *make_agent_rows("rooms", "org", layout=71.0),
        make_effect("rooms", "org", "layout", "baseline", make_interval(-3.0)),
        make_effect("rooms", "org", "tde", "layout", make_interval(-2.0)),
    ]
    return {"val": ResultTable(val_rows + shares), "test": ResultTable(test_rows)}


@pytest.fixture(scope="module")
def split_page(split_tables, tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("splits") / "page.md"
    return render_page(path, "paper", parse_study(["table2"]), split_tables, [])


def test_orderings_on_the_test_split_stand_next_to_those_on_val(split_page):
    orderings, rest = split_page.split("### On the split `test`, evaluated once")
    test_section, _ = rest.split("## The three tables")

    # Verdicts are about `test`. In the paper w gains 71.40 - 66.48 points, and w is 71.40 - 69.24 points above TDE.
    cells = read_lines(test_section)
    assert cells["rooms: `org` + w over `org`"] == [
        "+4.9",
        "+5.0 [+4.0, +6.0]",
        "-3.0 [-4.0, -2.0]",
        "20.0 [19.0, 21.0]",
        "refuted",
    ]
    assert cells["rooms: `org` + w over `org` + w + TDE"] == [
        "+2.2",
        "+4.0 [+3.0, +5.0]",
        "+2.0 [+1.0, +3.0]",
        "",
        "holds",
    ]
    assert "`hoz`" not in test_section
    assert read_lines(orderings)["rooms: `org` + w over `org`"][-1] == "holds"


def test_sr_on_the_test_split_is_the_last_column_of_a_world_in_the_three_tables(split_page):
    paper_tables = split_page.split("## The three tables")[1]
    table_1 = read_lines(paper_tables.split("###")[1])
    assert [cell.partition(" ")[0] for cell in table_1["`org` + w"][-4:]] == ["75.0", "-", "-", "71.0"]


def test_pages_without_results_on_the_test_split_have_neither_its_section_nor_its_column(split_tables, tmp_path):
    tables = {"val": split_tables["val"]}
    text = render_page(tmp_path / "page.md", "paper", parse_study(["table2"]), tables, [])
    assert "evaluated once" not in text
    assert "test: SR" not in text


def test_idle_experience_has_no_verdict_on_the_test_split(tmp_path):
    agents = {"anonymous": {"method": "anonymous", "arms": ["baseline"]}, "org": {"against": ["anonymous"]}}
    config = ExperimentConfig(agents=agents, shifts=(0.0,))
    rows = [
        *make_agent_rows("rooms", "org", baseline=60.0, layout=65.0),
        make_effect("rooms", "org", "baseline", "anonymous/baseline", make_interval(10.0)),
        make_effect("rooms", "org", "layout", "baseline", make_interval(5.0)),
    ]
    tables = {"val": ResultTable([*rows, make_share("org", "layout", 2.0)]), "test": ResultTable(rows)}
    text = render_page(tmp_path / "page.md", "methods", config, tables, [])
    cells = read_lines(text.split("evaluated once")[1].split("</details>")[0])
    assert cells["`org` over `anonymous`"][-1] == "holds"
    assert cells["`org` + w over `org`"][-1] == '<span class="idle">experience is idle</span>'


def test_methods_with_idle_experience_have_no_verdict(tmp_path):
    agents = {
        "anonymous": {"method": "anonymous", "arms": ["baseline"]},
        "org": {"against": ["anonymous"]},
        "hoz": {"method": "hoz", "against": ["anonymous"]},
    }
    config = ExperimentConfig(agents=agents, shifts=(0.0,), reference="anonymous")
    rows = make_agent_rows("rooms", "anonymous", baseline=50.0)
    for run, share in (("org", 2.0), ("hoz", 12.0)):
        rows += [
            *make_agent_rows("rooms", run, baseline=60.0, layout=65.0),
            make_effect("rooms", run, "baseline", "anonymous/baseline", make_interval(10.0)),
            make_effect("rooms", run, "layout", "baseline", make_interval(5.0)),
            make_share(run, "layout", share),
        ]
    section = render(tmp_path, "methods", *rows, config=config).split("### Verdicts")[1].split("###")[0]
    cells = read_lines(section)
    assert cells["`hoz`"][:2] == ["+10.0 [+9.0, +11.0]<br>**holds**", "+5.0 [+4.0, +6.0]<br>**holds**"]
    assert cells["`hoz`"][-1] == "12.0 [11.0, 13.0]"

    # The lead over layout-blind agents has a verdict nevertheless.
    lead, effect_of_weights, *_ = cells["`org`"]
    assert lead == "+10.0 [+9.0, +11.0]<br>**holds**"
    assert effect_of_weights == '<span class="idle">+5.0 [+4.0, +6.0]</span>'


@pytest.mark.slow
def test_claims_of_the_study_on_idle_experience_have_no_verdict(tmp_path):
    # The share of the arm with w decides: 4 %. The loss of the baseline is a claim about neither w nor sTDE.
    shares = [make_share("main", "baseline", 20.0), make_share("main", "layout", 4.0)]
    text = render(tmp_path, "study", *study_rows(), *shares)
    assert find_claim(text, "w improves the baseline at shift 1")[-1] == "experience is idle"
    assert find_claim(text, "sTDE (epsilon 0.5) improves w at shift 1")[-1] == "experience is idle"
    assert find_claim(text, "The baseline loses success")[-1] != "experience is idle"
    assert "decide 20.0 [19.0, 21.0] % of the decisions of the baseline and 4.0 [3.0, 5.0] %" in text

    # With 12 % all claims have verdicts.
    text = render(tmp_path, "study", *study_rows(), shares[0], make_share("main", "layout", 12.0))
    assert "experience is idle" not in text


@pytest.mark.parametrize("template", ["methods", "factors"])
@pytest.mark.parametrize(("reference", "row_reference"), [("org", "org/layout"), ("org/baseline", "org/baseline")])
def test_agents_are_compared_with_an_agent_or_with_one_of_its_variants(tmp_path, template, reference, row_reference):
    agents = {"org": {}, "hoz": {"method": "hoz", "arms": ["layout"], "against": [reference]}}
    config = ExperimentConfig(agents=agents, shifts=(0.0,))
    rows = [
        *make_agent_rows("rooms", "org", baseline=50.0, layout=55.0),
        *make_agent_rows("rooms", "hoz", layout=60.0),
        make_effect("rooms", "hoz", "layout", row_reference, make_interval(10.0)),
    ]
    text = render(tmp_path, template, *rows, config=config)
    comparisons = [line for line in text.splitlines() if line.startswith("| `hoz`") and "over `org`" in line]
    assert any("+10.0 [+9.0, +11.0]" in line and "holds" in line for line in comparisons), text


def test_training_costs_without_times_or_of_a_fit_have_no_nan(tmp_path):
    agents = {"org": {}, "belief": {"method": "belief"}}
    config = ExperimentConfig(agents=agents, shifts=(0.0,))
    rows = make_agent_rows("rooms", "org", baseline=50.0)
    rows.append(make_row(102400.0, world="rooms", run="belief", metric="searches (steps)"))
    text = render(tmp_path, "methods", *rows, config=config)
    cost = read_lines(text.split("Cost of training")[1])
    assert cost["`belief`"][3] == "102,400"
    assert cost["`org`"][4] == "-"
    assert "nan" not in text


def test_study_without_its_main_agent_has_a_page(tmp_path):
    config = ExperimentConfig(agents={"main": {}, "streams": {"decision": "streams", "arms": ["layout"]}})
    text = render(tmp_path, "study", *make_agent_rows("rooms", "streams", layout=50.0), config=config)
    assert "### Claims" not in text


def test_agents_of_factors_have_their_decision_share(tmp_path):
    agents = {
        "base": {"arms": ["baseline"]},
        "w": {"arms": ["layout"], "against": ["base/baseline"]},
        "gate+w": {"arms": ["layout"], "done_gate": True, "against": ["w/layout"]},
    }
    config = ExperimentConfig(agents=agents, shifts=(0.0,))
    rows = [
        *make_agent_rows("rooms", "base", baseline=50.0),
        *make_agent_rows("rooms", "w", layout=60.0),
        *make_agent_rows("rooms", "gate+w", layout=70.0),
        make_effect("rooms", "w", "layout", "base/baseline", make_interval(10.0)),
        make_effect("rooms", "gate+w", "layout", "w/layout", make_interval(10.0)),
    ]
    shares = [make_share("base", "baseline", 3.0), make_share("w", "layout", 8.0)]
    cells = read_lines(render(tmp_path, "factors", *rows, *shares, config=config))
    assert cells["`base`"][-1] == "3.0 [2.0, 4.0]"
    assert cells["`w`"][-1] == "8.0 [7.0, 9.0]"
    assert cells["`w` over `base`"][0] == "holds"

    # Below 5 %, an effect of nothing but the layout has no verdict; the effect of another part has one.
    idle_shares = [make_share(agent, agents[agent]["arms"][0], 4.0) for agent in agents]
    cells = read_lines(render(tmp_path, "factors", *rows, *idle_shares, config=config))
    assert "experience is idle" in cells["`w` over `base`"][0]
    assert cells["`gate+w` over `w`"][0] == "holds"

    # Earlier results have no shares, and their table has no such column.
    assert len(read_lines(render(tmp_path, "factors", *rows, config=config))["`w`"]) == len(cells["`w`"]) - 1


def test_gains_of_worlds_are_compared_by_their_intervals(tmp_path):
    rows = [
        make_effect("apartments", "hosts", "stde", "baseline", make_interval(10.0)),
        make_effect("rooms", "hosts", "stde", "baseline", make_interval(5.0)),
        make_effect("houses", "semexp", "stde", "baseline", make_interval(0.0)),
    ]
    cells = read_lines(render_paper(tmp_path, *rows))

    # The widths of 1 add up to 2. The paper's hosts gain (8.53 + 9.63 + 9.91 + 9.86) / 4 = 9.4825 in RoboTHOR and
    # (4.01 + 8.32 + 5.15 + 4.67) / 4 = 5.5375 in AI2-THOR, its SemExp 1.61.
    assert cells["gains of hosts: apartments over rooms"] == ["+3.9", "+5.0 [+3.0, +7.0]", "-", "holds"]
    assert cells["gains: hosts in rooms over `semexp` in houses"] == ["+3.9", "+5.0 [+3.0, +7.0]", "-", "holds"]


def test_scenes_of_a_dataset_have_columns_next_to_those_of_the_paper(tmp_path):
    rows = [*make_agent_rows("rooms", "org", baseline=90.0), *make_agent_rows("ithor", "org", baseline=88.0)]
    effect = make_effect("ithor", "org", "layout", "baseline", make_interval(1.0, 3.0))
    text = render_paper(tmp_path, *rows, effect)
    cells = read_lines(text.split("### Table 2: AI2-THOR")[1].split("###")[0])
    assert cells["`org`"] == ["66.53", "39.00", "0.54", "90.0 [-]", "-", "-", "88.0 [-]", "-", "-"]

    # The ordering has a verdict in these scenes, too, next to the gain of the paper's Table 1: 71.40 - 66.48.
    assert read_lines(text)["ithor: `org` + w over `org`"] == ["+4.9", "+1.0 [-2.0, +4.0]", "-", "inconclusive"]

    # Datasets without results have neither columns nor lines.
    assert len(read_lines(text.split("### Table 2: RoboTHOR")[1].split("###")[0])["`org`"]) == 6
    assert not any(name.startswith("robothor") for name in read_lines(text))


@pytest.mark.parametrize(
    ("title", "num_lines", "gains"),
    [
        ("Table 2: AI2-THOR", 13, {"eotp": 4.01, "org": 8.32, "vtnet": 5.15, "hoz": 4.67}),
        ("Table 2: RoboTHOR", 13, {"eotp": 8.53, "org": 9.63, "vtnet": 9.91, "hoz": 9.86}),
        ("Table 3: Gibson", 4, {"semexp": 1.61}),
    ],
)
def test_the_papers_numbers_add_up_to_the_gains_that_it_prints(tmp_path, title, num_lines, gains):
    section = render_paper(tmp_path).split(f"### {title}")[1].split("##")[0]
    cells = read_lines(section)
    assert len(cells) == num_lines + 2  # header and rule
    for host, gain in gains.items():
        paper_gain = float(cells[f"`{host}` + w + sTDE"][0]) - float(cells[f"`{host}`"][0])
        assert paper_gain == pytest.approx(gain, abs=1e-6)


def test_result_sections_are_the_parts_between_the_marks():
    text = f"head\n{RESULT_MARK}\nfirst\n{RESULT_MARK}\nbetween\n{RESULT_MARK}\nsecond\n{RESULT_MARK}\ntail"
    assert result_sections(text) == "first\n\nsecond"
    assert result_sections("no marks") == ""


def test_result_sections_have_no_html_tags():
    cells = '| <span class="idle">+5.0 [+4.0, +6.0]</span> | +1.0 [-1.0, +3.0]<br>**inconclusive** |'
    text = f"{RESULT_MARK}\n{cells}\n{RESULT_MARK}"
    assert result_sections(text) == "| +5.0 [+4.0, +6.0] | +1.0 [-1.0, +3.0] **inconclusive** |"


@pytest.mark.parametrize("name", ["table2", "table3", "study", "claims", "belief", "few_scenes", "ladder", "ablations"])
def test_stored_experiments_print_a_table(name):
    """`jaxnav study NAME` prints the main results of each page that is stored."""
    for page in parse_study([name]).pages:
        sections = result_sections((REPOSITORY / page).read_text(encoding="utf-8"))
        assert "| --- |" in sections
        assert "</" not in sections
