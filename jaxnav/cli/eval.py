"""The eval command: evaluate a run, a policy or an agent, or print a finished evaluation again.

An evaluation is printed as a table, and written as JSON and as a CSV file with a row per episode.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from jaxnav.choices import (
    DEFAULT_COSTS,
    DEFAULT_EPSILONS,
    DEFAULT_REMOVALS,
    Costs,
    CounterfactualMemory,
    EstimatorName,
    Form,
    Removal,
    ShiftKind,
    Split,
    WorldName,
)
from jaxnav.cli.console import (
    make_result_console,
    name_evaluation,
    name_numbers,
    name_subject,
    parse_arguments,
    print_table,
    refuse_folder,
    refuse_unwritable,
    run_command,
    write_latest,
)
from jaxnav.errors import InputError
from jaxnav.plain_console import escape_control_chars
from jaxnav.store.files import expand_home

DESCRIPTION = "Evaluate a run, a policy or an agent of your own, or print a finished evaluation again."


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """Options of the eval command.

    Attributes:
      subject: a run directory, the folder of an exported policy, the name of a packaged policy, such as `rooms-org`, or
        an agent of your own as `package.module:AGENT`, which is shown beside Random, frontier search and the shortest
        path; or the JSON file of a finished evaluation (not of a benchmark) to print.
      split: scenes to evaluate on.
      scenes: scene file to use instead of the scenes of the run or of the generated world.
      world: generated world to use. The default is `rooms` for an agent, and the world of a run or a policy, whose
        categories and rules remain.
      shift: layout shift of the scenes, from 0 (as in training) to 1. The default is the shift of the run, and 0 for
        agents and policies and with `--scenes` or `--world`.
      shift_by: categories that exchange their places under a shift. `size`: neighbours in size, drawn for each scene.
        `context`: the ones whose exchange misleads most, fitted to the training scenes and equal in all scenes.
      episodes: number of fixed episodes, at least 1, balanced over room types and scenes.
      epsilon: thresholds of soft removal, each at least 0: experience is removed where the layout gap exceeds the
        threshold. All thresholds are evaluated in one compiled call.
      form: rules by which sTDE removes experience. `paper` subtracts from the logits of the policy a share of the
        counterfactual logits (see `removal`); the share is the excess of the layout gap over the threshold. `residual`
        does this without changing the scale of the logits. `switch` subtracts these logits completely where the gap
        exceeds the threshold. `mixture` mixes the probabilities of the decisions with and without experience, with the
        same share. The default is `residual` (`paper` for the method `belief` and with `--removal cde`), unless the
        layout estimator of the run sets another.
      removal: decisions that remain when experience is removed. `tde`, the total direct effect (equation 1):
        subtracts the counterfactual logits, in which scene and goal are zero and experience is not. `cde`, the
        controlled direct effect: leads to the decision of the same network without experience throughout the
        episode, for runs with `--ppo.experience` below 1. Each adds a row for complete removal and one for each
        threshold and rule.
      counterfactual_memory: memory from which the counterfactual logits are computed: the `factual` one, or one of
        their `own`, for runs with this option. The default is the one of the run.
      setting: layout estimator or layout gap to use instead of that of the run, for example `learned`, a gap that
        detects another layout; `jaxnav list settings` describes all. The default of runs is the estimator
        `calibrated` with the gap of equation 5.
      hold: keep the layout gap from falling within an episode. With `--form switch`, experience then stays removed for
        the rest of the episode once the gap exceeds the threshold.
      inner_steps: largest number of adaptation steps in an episode, at least 0, for methods that learn while they act
        (`jaxnav list methods` describes the methods). The default is the usual number of the method.
      costs: parts of the decisions whose cost is measured, by replacing them by those of other episodes throughout.
        `categories`: the categories other than the goal within experience, on a quarter of the episodes. `all`: every
        part, on all episodes. The shares of decisions that change are always measured.
      seed: random seed of the episode list and of sampled actions, from 0 to 4,294,967,295.
      benchmark: name of a frozen benchmark (`v2`, or `v1` with earlier views), which fixes homes, shifts, episodes and
        seeds; scores the subject on its tracks (docs/leaderboard.md).
      tracks: tracks of the benchmark, such as `rooms`. The default is all tracks with the categories of a policy, and
        all tracks for an agent.
      json: JSON file to write. The default is a name after the options, such as `eval-val-shift1-seed3.json`, in the
        run directory, where `latest-eval.txt` names the newest evaluation; for policies and agents, in the working
        directory, with the name of the subject.
      format: format in which the evaluation is printed.
    """

    subject: str
    split: Split = "val"
    scenes: Path | None = None
    world: WorldName | None = None
    shift: float | None = None
    shift_by: ShiftKind = "size"
    episodes: int = 1000
    epsilon: tuple[float, ...] = DEFAULT_EPSILONS
    form: tuple[Form, ...] | None = None
    setting: EstimatorName | None = None
    hold: bool = False
    inner_steps: int | None = None
    removal: tuple[Removal, ...] = DEFAULT_REMOVALS
    counterfactual_memory: CounterfactualMemory | None = None
    costs: Costs = DEFAULT_COSTS
    seed: int = 0
    benchmark: str | None = None
    tracks: tuple[str, ...] = ()
    json: Path | None = None
    format: Literal["table", "markdown", "json"] = "table"


def main(arguments: list[str] | None = None, prog: str = "jaxnav eval") -> int:
    """Run the command and return its exit code."""
    return run_command(_evaluate_or_print, lambda: parse_arguments(EvalConfig, arguments, prog, DESCRIPTION))


def _evaluate_or_print(config: EvalConfig, console: Console) -> None:
    """Evaluate a subject, or read the file of an evaluation, and print the report."""
    path = expand_home(config.subject)
    if path.is_file() or path.suffix == ".json":
        _print_report(_read_finished_report(config), config.format)
        return
    if config.benchmark is not None:
        _run_benchmark(config, console)
        return
    if config.tracks:
        raise InputError(f"--tracks {' '.join(config.tracks)}: names parts of a benchmark; add --benchmark")
    from jaxnav.runs.evaluate import evaluate

    # Find the file first: an evaluation takes minutes.
    target = _find_target(config)
    results = evaluate(
        config.subject,
        split=config.split,
        scenes=config.scenes,
        world=config.world,
        shift=config.shift,
        shift_by=config.shift_by,
        episodes=config.episodes,
        epsilon=config.epsilon,
        form=config.form,
        setting=config.setting,
        hold=config.hold,
        inner_steps=config.inner_steps,
        removal=config.removal,
        counterfactual_memory=config.counterfactual_memory,
        costs=config.costs,
        seed=config.seed,
        console=console,
    )

    # Write first, so that nothing is lost if the reader of a pipe ends; print also what cannot be written.
    try:
        with refuse_unwritable(target, "--json"):
            results.write(target)
            if config.json is None:
                write_latest("eval", target)
    finally:
        _print_report(results.report, config.format)
    num_compilations = results.report["compilations"]
    plural = "" if num_compilations == 1 else "s"
    compilation_text = f", {num_compilations} compilation{plural}" if num_compilations else ""
    num_episodes = len(results.episodes.goal)
    console.print(f"{num_episodes} episodes{compilation_text}; written to {target}")


#: Options that a benchmark fixes.
_FIXED_BY_BENCHMARK = ("split", "scenes", "world", "shift", "shift_by", "episodes", "seed", "format")
#: Options that say how a policy removes experience.
_POLICY_OPTIONS = (
    *("epsilon", "form", "setting", "hold", "inner_steps", "removal"),
    *("counterfactual_memory", "costs"),
)


def _run_benchmark(config: EvalConfig, console: Console) -> None:
    """Score the subject on a benchmark, print the scores and write them."""
    from jaxnav.runs.benchmark import load_benchmark, run_benchmark, scores_table

    # An evaluation takes minutes, so options and files are checked first.
    load_benchmark(str(config.benchmark))
    for name in _FIXED_BY_BENCHMARK:
        if getattr(config, name) != getattr(EvalConfig, name):
            raise InputError(
                f"--{name.replace('_', '-')}: is fixed by --benchmark {config.benchmark}; omit one of them"
            )
    policy_options = {}
    for name in _POLICY_OPTIONS:
        if getattr(config, name) != getattr(EvalConfig, name):
            policy_options[name] = getattr(config, name)
    target = _find_target(config)

    scores = run_benchmark(
        config.subject, str(config.benchmark), config.tracks or None, console=console, **policy_options
    )
    try:
        with refuse_unwritable(target, "--json"):
            scores.write(target)
    finally:
        print_table(make_result_console(), scores_table(scores.rows), num_key_columns=2)
    console.print(f"written to {target}")


def _read_finished_report(config: EvalConfig) -> dict[str, Any]:
    """Read the report of a finished evaluation, for which only `--format` is an option."""
    from jaxnav.evaluation.report import read_report

    report = read_report(expand_home(config.subject))
    for field in dataclasses.fields(config):
        if field.name not in ("subject", "format") and getattr(config, field.name) != field.default:
            option = f"--{field.name.replace('_', '-')}"
            raise InputError(f"{option}: {config.subject} is a finished evaluation; omit the option or give a run")
    return report


def _print_report(report: dict[str, Any], report_format: str) -> None:
    """Print a report on stdout: its table, paired differences, decision shares and notes."""
    from jaxnav.evaluation.report import (
        decision_share_table,
        difference_table,
        has_decision_shares,
        markdown_table,
        results_table,
    )

    if report_format == "json":
        print(escape_control_chars(json.dumps(report, indent=2), keep="\n"))
        return
    if report_format == "markdown":
        print(escape_control_chars(markdown_table(report), keep="\n"), end="")
        return

    result_console = make_result_console()
    print_table(result_console, results_table(report))
    if report["differences"]:
        print_table(result_console, difference_table(report), num_key_columns=2)
    if has_decision_shares(report):
        print_table(result_console, decision_share_table(report), num_key_columns=2)
    for note in report["notes"]:
        result_console.print(note)


def _find_target(config: EvalConfig) -> Path:
    """Return the JSON file to write, or raise an `InputError` before anything is evaluated."""
    from jaxnav.runs.policies import is_policy

    details = (
        None if config.shift is None else name_numbers("shift", [config.shift]),
        None if config.shift_by == EvalConfig.shift_by else f"by-{config.shift_by}",
        None if config.episodes == EvalConfig.episodes else f"episodes{config.episodes}",
        None if config.epsilon == EvalConfig.epsilon else name_numbers("epsilon", config.epsilon),
        None if config.form is None else "-".join(config.form),
        None if config.setting is None else f"setting-{config.setting}",
        "hold" if config.hold else None,
        None if config.inner_steps is None else f"inner{config.inner_steps}",
        None if config.removal == EvalConfig.removal else "-".join(config.removal),
        None if config.counterfactual_memory is None else f"{config.counterfactual_memory}-memory",
        None if config.costs == EvalConfig.costs else f"costs-{config.costs}",
        None if config.seed == EvalConfig.seed else f"seed{config.seed}",
    )
    # Results of a run lie in its directory; others in the working directory, with the name of the subject.
    folder = expand_home(config.subject)
    if config.benchmark is not None:
        # Scores lie in the working directory.
        command = f"benchmark-{config.benchmark}-{name_subject(config.subject)}"
        name = name_evaluation(command, "-".join(config.tracks) or "all", None, None, *details)
        target = config.json or Path(f"{name}.json")
        refuse_folder(target, "--json")
        return target
    command = "eval"
    is_agent = ":" in config.subject and not folder.exists()
    if is_agent or is_policy(config.subject):
        command = f"eval-{name_subject(config.subject)}"
        folder = Path()
    name = name_evaluation(command, config.split, config.world, config.scenes, *details)
    target = config.json or folder / f"{name}.json"
    refuse_folder(target, "--json")
    return target
