"""Pages of experiments: Markdown templates, filled from the result table by Jinja.

A template is Markdown with expressions such as `{{ table.find(world="rooms", run="org", ...) | f(".1f") }}`.
`render_page` gives it the experiment (`config`), the `split` that the page is about with its results (`table`), the
results of every split (`tables`), the agents, and the functions of this module. The summary of a page, between two
`<!-- reading -->` marks, is written by hand and kept.
"""

import dataclasses
import functools
import math
import re
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jinja2
import jinja2.meta
import jinja2.nodes

from jaxnav.errors import InputError
from jaxnav.evaluation.notes import MIN_OTHER_CATEGORIES_SHARE
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments.bench import best_epsilon
from jaxnav.experiments.config import AgentRun, ExperimentConfig, agent_runs, join_folds
from jaxnav.experiments.instrument import judge_shift
from jaxnav.experiments.scores import list_comparisons
from jaxnav.experiments.table import ResultTable, merge_fields
from jaxnav.experiments.trials import STDE_NAMES
from jaxnav.scenes.worlds import WORLDS
from jaxnav.store.files import write_atomic
from jaxnav.viz import require_plotting_packages

#: Packaged templates; its folder `parts` holds what several of them include.
PAGES = Path(__file__).parent / "pages"
READING_MARK = "<!-- reading -->"
#: Before and after the tables of a page that `jaxnav study` prints.
RESULT_MARK = "<!-- result -->"
#: Names that a template is given; see docs/experiments.md.
CONTEXT_NAMES = frozenset(("config", "split", "table", "tables", "runs", "summary", "missing", "figure"))


def check_page(document: Path, template: str) -> None:
    """Check that a page can be written.

    Raises:
      InputError: there is no such template, it has unknown names or no summary, it draws figures without the plotting
        packages, or the document exists and does not hold two reading marks.
    """
    # The names that the template takes from outside, found without filling it.
    loaded_template = _load_template(template)
    page_path = Path(loaded_template.filename or template)
    syntax_tree = loaded_template.environment.parse(page_path.read_text(encoding="utf-8"))
    names = jinja2.meta.find_undeclared_variables(syntax_tree) - loaded_template.environment.globals.keys()
    own_names = {name.name for name in syntax_tree.find_all(jinja2.nodes.Name) if name.ctx != "load"}
    unknown_names = sorted(names - own_names - CONTEXT_NAMES)
    if unknown_names:
        name = unknown_names[0]
        line = min(node.lineno for node in syntax_tree.find_all(jinja2.nodes.Name) if node.name == name)
        known_names = ", ".join(sorted(CONTEXT_NAMES))
        raise InputError(f"{page_path}, line {line}: {name!r} is unknown; pages have {known_names}")
    if "summary" not in names:
        raise InputError(f"{page_path}: give {{{{ summary }}}}; text written by hand is kept there")

    if "figure" in names:
        require_plotting_packages()
    if document.exists() and document.read_text(encoding="utf-8").count(READING_MARK) != 2:
        raise InputError(f"{document}: exists without two lines {READING_MARK}; give another document in `pages`")


def render_page(
    document: Path, template: str, config: ExperimentConfig, tables: dict[str, ResultTable], missing: Sequence[str]
) -> str:
    """Fill a template, write the document, and return its text.

    Args:
      document: the Markdown file; its summary is kept, and its figures are in the folder `images` next to it.
      template: name of a packaged template, or a file.
      config: the experiment.
      tables: results by split.
      missing: names of the results that do not exist yet.

    Raises:
      InputError: see `check_page`, or a fault in the template, with its file and line.
    """
    check_page(document, template)
    summary = "\n\n"
    if document.exists():
        summary = document.read_text(encoding="utf-8").split(READING_MARK)[1]

    # Choices are made on `val`, so a page is about `val` where it is measured.
    split = "val" if "val" in tables else config.split
    context = {
        "config": config,
        "split": split,
        "table": tables.get(split, ResultTable([])),
        "tables": tables,
        "runs": _runs_with_results(config, tables.values()),
        "summary": READING_MARK + summary + READING_MARK,
        "missing": missing,
        "figure": functools.partial(_draw_figure, document),
    }
    try:
        text = _load_template(template).render(context)
    except InputError:
        raise
    except (jinja2.TemplateError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise InputError(f"{_fault_position(error, template)}: {type(error).__name__}: {error}") from error

    # Without its marks, the document would be refused the next time.
    if text.count(READING_MARK) != 2:
        raise InputError(f"template {template}: give {{{{ summary }}}} once; text written by hand is kept there")
    write_atomic(document, (text.strip() + "\n").encode())
    return text


def result_sections(text: str) -> str:
    """Parts of a page between two result marks, without the HTML tags that only a browser reads."""
    sections = "\n\n".join(section.strip() for section in text.split(RESULT_MARK)[1::2])
    return re.sub(r"</?span[^>]*>", "", sections.replace("<br>", " "))


def _load_template(template: str) -> jinja2.Template:
    """Load a packaged template by its name, or a file."""
    path = PAGES / f"{template}.md"
    if not path.exists():
        path = Path(template)
    loader = jinja2.FileSystemLoader([path.parent, PAGES, PAGES / "parts"])
    environment = jinja2.Environment(
        loader=loader,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        extensions=["jinja2.ext.do", "jinja2.ext.loopcontrols"],
    )
    environment.filters |= {"f": format_value, "plus_minus": format_with_std}
    environment.globals |= {
        "min_other_categories_share": MIN_OTHER_CATEGORIES_SHARE,
        "line": table_line,
        "header": table_header,
        "verdict": verdict,
        "best_epsilon": best_epsilon,
        "list_comparisons": list_comparisons,
        "judge_shift": judge_shift,
        "stde_fields": {name: {"variant": "stde", **options._asdict()} for name, options in STDE_NAMES.items()},
        "requested_steps": requested_steps,
        "max_trained_steps": max_trained_steps,
        "differ_only_in_layout": differ_only_in_layout,
        "difference_of_worlds": difference_of_worlds,
        "effect_cells": effect_cells,
        "merge": merge_fields,
        "shift_titles": shift_titles,
        "weights": format_weights,
    }
    try:
        return environment.get_template(path.name)
    except jinja2.TemplateNotFound as error:
        names = ", ".join(sorted(page.stem for page in PAGES.glob("*.md")))
        raise InputError(f"pages: {template!r} is neither a file nor one of {names}") from error
    except jinja2.TemplateSyntaxError as error:
        raise InputError(f"{_fault_position(error, template)}: {error.message}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no UTF-8 text") from error


def _fault_position(error: Exception, template: str) -> str:
    """File and line of a fault in a template, or in a template that it includes."""
    if isinstance(error, jinja2.TemplateSyntaxError):
        return f"{error.filename}, line {error.lineno}"
    # Jinja puts the lines of templates into the traceback; the innermost is at fault.
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.endswith(".py")]
    return f"{frames[-1].filename}, line {frames[-1].lineno}" if frames else template


def _runs_with_results(config: ExperimentConfig, tables: Iterable[ResultTable]) -> dict[str, dict[str, AgentRun]]:
    """Runs that have results on any split, by world and agent."""
    measured = set()
    for table in tables:
        for row in table.rows:
            # The name of a run that hands over to another begins with the name of its agent.
            measured.add((row.world, row.run.partition(",")[0]))
    all_runs = agent_runs(config)
    runs: dict[str, dict[str, AgentRun]] = {world: {} for world in (*config.folds, *config.worlds)}
    for run in all_runs + join_folds(config, all_runs):
        if (run.world, run.agent) in measured:
            runs[run.world][run.agent] = run
    return {world: world_runs for world, world_runs in runs.items() if world_runs}


def _draw_figure(document: Path, name: str, table: ResultTable, shifts: Sequence[float], fields: dict[str, Any]) -> str:
    """Draw a figure into the folder `images/DOCUMENT` next to a document, and return its path there."""
    from jaxnav.experiments.figures import FIGURES
    from jaxnav.viz.style import save_figure

    image = Path("images") / document.stem / f"{name}.png"
    (document.parent / image).parent.mkdir(parents=True, exist_ok=True)
    save_figure(FIGURES[name](table, shifts, fields), document.parent / image)
    return image.as_posix()


# Functions of templates


def format_value(value: Interval | float, spec: str) -> str:
    """Format an interval or a number; `-` if it is undefined."""
    if isinstance(value, float) and math.isnan(value):
        return "-"
    return f"{value:{spec}}"


def format_with_std(value: Interval, digits: int = 1) -> str:
    """Format a mean and, with several seeds, their standard deviation; `-` if it is undefined."""
    mean = format_value(value.mean, f".{digits}f")
    return mean if math.isnan(value.std) else f"{mean} ± {value.std:.{digits}f}"


def table_line(*cells: Any) -> str:
    """Make a line of a Markdown table; a cell may be a list of cells."""
    words: list[str] = []
    for cell in cells:
        words += map(str, cell) if isinstance(cell, list | tuple) else [str(cell)]
    return f"| {' | '.join(words)} |"


def table_header(*titles: Any, text_columns: int = 1) -> str:
    """Make the two lines above a Markdown table; all columns but the first `text_columns` are right-aligned."""
    title_line = table_line(*titles)
    num_columns = title_line.count(" | ") + 1
    return f"{title_line}\n| {' | '.join(['---'] * text_columns + ['---:'] * (num_columns - text_columns))} |"


def verdict(effect: Interval, min_effect: float) -> str:
    """Verdict on a claim that an effect is above 0.

    An interval below 0 refutes the claim; one below `min_effect`, the least effect that would matter, excludes such an
    effect, whatever its own sign; one above 0 confirms the claim; all others leave it open.
    """
    if math.isnan(effect.mean):
        return "not measured"
    if effect.high < 0:
        return "refuted"
    if effect.high < min_effect:
        return "excluded"
    return "holds" if effect.low > 0 else "inconclusive"


def difference_of_worlds(first: Interval, second: Interval) -> Interval:
    """Difference of effects in independent worlds; bounds are added, so the interval is wider than needed."""
    return Interval(first.mean - second.mean, first.low - second.high, first.high - second.low)


def shift_titles(shifts: Iterable[float]) -> list[str]:
    """Titles of the columns of layout shifts."""
    return [f"shift {shift:g}" for shift in shifts]


def effect_cells(table: ResultTable, fields: dict[str, Any], shifts: Iterable[float]) -> list[str]:
    """Effect on SR against the layout weights, and mean weight, one cell per shift."""
    cells = []
    for shift in shifts:
        effect = table.find(**fields, shift=shift, reference="layout", metric="sr")
        weight = table.find(**fields, shift=shift, metric="weight")
        cells.append(f"{effect:+.1f} ({format_value(weight.mean, '.2f')})")
    return cells


def format_weights(table: ResultTable, fields: dict[str, Any], shifts: Iterable[float]) -> str:
    """Mean weights of a removal at some shifts."""
    weights = [table.find(**fields, shift=shift, metric="weight").mean for shift in shifts]
    return ", ".join(format_value(weight, ".2f") for weight in weights)


def requested_steps(run: AgentRun) -> int:
    """Environment steps that a run was asked for; whole chunks may be more."""
    return run.config.total_steps or WORLDS[run.config.world].total_steps


def max_trained_steps(runs: Iterable[AgentRun]) -> int:
    """Environment steps of the longest training among runs."""
    return max(run.config.total_updates * run.config.steps_per_update for run in runs)


def differ_only_in_layout(run: AgentRun, other: AgentRun) -> bool:
    """True if two runs have the same settings, apart from their arms and the layout that these are given."""
    given = other.config
    return dataclasses.replace(run.config, run_dir=given.run_dir, arms=given.arms, layout=given.layout) == given
