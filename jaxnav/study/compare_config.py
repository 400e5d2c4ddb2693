"""Settings of a comparison of methods, and the runs and agents that it compares.

`CompareConfig` holds the settings of `jaxnav compare`. `compared_runs` lists the training runs that they imply, and
`agent_comparisons` the pairs of agents whose paired differences the document prints.
"""

import dataclasses
import fnmatch
import itertools
import re
from pathlib import Path
from typing import Any, Literal, NamedTuple

from jaxnav.causal import Form
from jaxnav.errors import InputError
from jaxnav.policies.method import ActionControl
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.spec import DecisionKind
from jaxnav.runs.config import ARMS, Arm, RunConfig, check_config
from jaxnav.runs.config_files import apply_values
from jaxnav.runs.run import run_settings
from jaxnav.study.config import check_shared_settings


@dataclasses.dataclass(frozen=True)
class CompareConfig:
    """Settings of a comparison; finished runs and results are kept.

    Attributes:
      title: of the document.
      results: folder of the results, one JSON file for each world, method and decision.
      document: Markdown file written from the results.
      paper: Markdown file with the paper's Tables 1 to 3 beside all results in the folder; None for none.
      runs: folder of the training runs.
      worlds: by name, the settings that the runs in it change: some of `world`, `scenes`, `worlds`, `detector` and
        `total_steps`.
      methods: that are compared.
      ablations: of a method, the methods that it is compared with besides.
      left_out: patterns of names of runs, `world-method-decision` as their results are called, that are not compared;
        the document names them.
      unlearned: of all of them, those that act by nothing that is learned; they are trained for one chunk.
      decisions: how pathways become logits. With `streams` the layout's policies alone are trained, of the methods that
        host the layout.
      split: scenes to evaluate on.
      episodes: in each world.
      epsilon: threshold of sTDE, named before anything is evaluated; the paper's is 0.5.
      form: how sTDE combines the logits, named before as well.
      seed: of episode lists and sampled actions.
      base: settings that all runs share.
    """

    title: str = "Table 2: methods without and with the layout"
    results: Path = Path("results/tables")
    document: Path = Path("docs/table2.md")
    paper: Path | None = None
    runs: Path = Path("runs/table2")
    worlds: dict[str, dict[str, Any]] = dataclasses.field(
        default_factory=lambda: {name: {"world": name} for name in ("rooms", "apartments")}
    )
    methods: tuple[str, ...] = tuple(METHODS)
    ablations: dict[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    unlearned: tuple[str, ...] = ()
    decisions: tuple[DecisionKind, ...] = ("fused", "streams")
    split: Literal["val", "test"] = "val"
    episodes: int = 1000
    epsilon: float = 0.5
    form: Form = "residual"
    seed: int = 0
    base: RunConfig = RunConfig()


#: Settings that the runs of a world may change.
WORLD_SETTINGS = ("world", "scenes", "worlds", "detector", "total_steps")
#: Settings of a run that the comparison sets itself, and its own setting for each.
OWN_SETTINGS = {"method": "methods", "decision": "decisions", "run_dir": "runs"}
#: Labels of the variants of a run.
VARIANT_LABELS = {"baseline": "", "layout": " + w", "stde": " + w + sTDE"}
#: Labels of table rows: the variants, and random choices for methods whose choices are not actions.
ROW_LABELS = {**VARIANT_LABELS, "random": ", random choices"}
#: The method whose agents cannot know any layout.
NO_EXPERIENCE_METHOD = "anonymous"
#: Improvements within a run: a variant and its reference.
VARIANT_COMPARISONS = (("layout", "baseline"), ("stde", "layout"), ("stde", "baseline"))


class ComparedRun(NamedTuple):
    """One run of a comparison.

    Attributes:
      world: name of one of the comparison's worlds.
      method, decision: trained method, and how its pathways become logits.
      run: settings of the run.
    """

    world: str
    method: str
    decision: DecisionKind
    run: RunConfig

    @property
    def name(self) -> str:
        """Name of its results."""
        return f"{self.world}-{self.method.replace(':', '-')}-{self.decision}"


class ComparedAgent(NamedTuple):
    """One row of a world's table.

    Attributes:
      method, decision: of its run.
      variant: a key of `ROW_LABELS`.
    """

    method: str
    decision: DecisionKind
    variant: str

    def __str__(self) -> str:
        return run_label(self.method, self.decision) + ROW_LABELS[self.variant]


def check_compare(config: CompareConfig) -> CompareConfig:
    """Validate a comparison and return it unchanged.

    Raises:
      InputError: names the first impossible setting.
    """
    check_shared_settings(config.episodes, config.seed, config.base)

    # Lists must hold different entries, and names of worlds become parts of file names.
    for name in ("worlds", "methods", "decisions"):
        values = tuple(getattr(config, name))
        if not values or len(set(values)) < len(values):
            raise InputError(f"{name}: {', '.join(values) or 'empty'}: give one or more, each once")
    for world in config.worlds:
        if not re.fullmatch(r"\w+", world):
            raise InputError(f"worlds: {world!r}: is part of file names; give letters, digits and underscores")

    # Settings of single methods must name methods of the comparison.
    unknown_methods = sorted(set(config.ablations) - set(config.methods))
    if unknown_methods:
        raise InputError(f"ablations: {unknown_methods[0]!r} is none of the methods {', '.join(config.methods)}")
    unknown_methods = sorted(set(config.unlearned) - set(_compared_methods(config)))
    if unknown_methods:
        raise InputError(f"unlearned: {unknown_methods[0]!r} is not compared; leave it out")

    if not 0.0 <= config.epsilon < float("inf"):
        raise InputError(f"epsilon: {config.epsilon}: give a number from 0 to below infinity")
    for name, own_setting in OWN_SETTINGS.items():
        if getattr(config.base, name) != getattr(RunConfig(), name):
            raise InputError(f"base.{name}: every run has its own; leave it out and give `{own_setting}`")

    # Listing the runs also checks the settings of each.
    if not compared_runs(config):
        raise InputError(f"left_out: {', '.join(config.left_out)}: leaves no run to compare; give fewer patterns")
    return config


# Runs


def compared_runs(config: CompareConfig) -> list[ComparedRun]:
    """List the runs of a comparison, world by world.

    Raises:
      InputError: an unknown method, or a run whose settings are impossible.
    """
    return [run for run in _possible_runs(config) if not _is_left_out(config, run)]


def left_out_runs(config: CompareConfig) -> list[ComparedRun]:
    """List the runs that a comparison leaves out."""
    return [run for run in _possible_runs(config) if _is_left_out(config, run)]


def world_run_configs(config: CompareConfig) -> dict[str, RunConfig]:
    """Settings that all runs of each world share.

    Raises:
      InputError: a setting that is unknown, of another type, or that a world may not change.
    """
    runs = {}
    for world, changes in config.worlds.items():
        refused_settings = sorted(set(changes) - set(WORLD_SETTINGS))
        if refused_settings:
            advice = f"a world may change {', '.join(WORLD_SETTINGS)}; what all runs share goes into `base`"
            raise InputError(f"worlds.{world}.{refused_settings[0]}: {advice}")
        runs[world] = apply_values(config.base, changes, Path(f"worlds.{world}"))
    return runs


def run_identity(config: CompareConfig, compared_run: ComparedRun) -> dict[str, Any]:
    """Settings that determine the results of a run, as JSON."""
    identity = {name: getattr(config, name) for name in ("split", "episodes", "epsilon", "form", "seed")}
    return identity | {"run": run_settings(compared_run.run)}


def frontier_identity(config: CompareConfig, run: RunConfig) -> dict[str, Any]:
    """Settings that determine the results of frontier search, as JSON."""
    world_settings = {}
    for name, value in run_settings(run).items():
        if name in WORLD_SETTINGS and name != "total_steps":
            world_settings[name] = value
    identity = {name: getattr(config, name) for name in ("split", "episodes", "seed")}
    return identity | {"run": world_settings}


def _possible_runs(config: CompareConfig) -> list[ComparedRun]:
    """List the runs of all worlds, methods and decisions, including those that are left out."""
    methods = _compared_methods(config)
    runs = []
    for world, shared in world_run_configs(config).items():
        for method, decision in itertools.product(methods, config.decisions):
            trained_arms = _trained_arms(method, decision)
            arms = tuple(arm for arm in shared.arms if arm in trained_arms)
            if not arms:
                continue
            total_steps = 1 if method in config.unlearned else shared.total_steps
            run = dataclasses.replace(shared, method=method, arms=arms, total_steps=total_steps)
            runs.append(_with_complete_settings(ComparedRun(world, method, decision, run), config.runs))
    return runs


def _compared_methods(config: CompareConfig) -> list[str]:
    """List every method once, ablations after the method that they belong to."""
    methods: dict[str, None] = {}
    for method in config.methods:
        methods |= dict.fromkeys((method, *config.ablations.get(method, ())))
    return list(methods)


def _trained_arms(method: str, decision: DecisionKind) -> tuple[Arm, ...]:
    if not find_method(method).hosts_layout:
        return ("baseline",) if decision == "fused" else ()
    return ARMS if decision == "fused" else ("layout",)


def _with_complete_settings(compared_run: ComparedRun, folder: Path) -> ComparedRun:
    """Add the decision and the directory to the settings of a run, and check them."""
    run = dataclasses.replace(compared_run.run, decision=compared_run.decision, run_dir=folder / compared_run.name)
    try:
        return compared_run._replace(run=check_config(run))
    except InputError as error:
        raise InputError(f"{compared_run.name}: {error}") from error


def _is_left_out(config: CompareConfig, compared_run: ComparedRun) -> bool:
    return any(fnmatch.fnmatchcase(compared_run.name, pattern) for pattern in config.left_out)


# Agents


def agent_comparisons(config: CompareConfig) -> list[tuple[ComparedAgent, ComparedAgent]]:
    """List every agent with each of its references."""
    first_decision, *other_decisions = config.decisions
    pairs = []
    for method in config.methods:
        # Value of experience: the method against agents that cannot know any layout.
        if method != NO_EXPERIENCE_METHOD and NO_EXPERIENCE_METHOD in config.methods:
            reference = ComparedAgent(NO_EXPERIENCE_METHOD, "fused", "baseline")
            pairs.append((ComparedAgent(method, "fused", "baseline"), reference))

        # Variants within a run, and decisions against the first.
        for decision, (variant, reference_variant) in itertools.product(config.decisions, VARIANT_COMPARISONS):
            reference = ComparedAgent(method, decision, reference_variant)
            pairs.append((ComparedAgent(method, decision, variant), reference))
        for decision, variant in itertools.product(other_decisions, VARIANT_LABELS):
            reference = ComparedAgent(method, first_decision, variant)
            pairs.append((ComparedAgent(method, decision, variant), reference))

        # Random choices, where these differ from random actions.
        if not chooses_actions(method):
            for decision, variant in itertools.product(config.decisions, VARIANT_LABELS):
                reference = ComparedAgent(method, decision, "random")
                pairs.append((ComparedAgent(method, decision, variant), reference))

        # Ablations of the method.
        ablations = config.ablations.get(method, ())
        for ablation, decision, variant in itertools.product(ablations, config.decisions, VARIANT_LABELS):
            reference = ComparedAgent(ablation, decision, variant)
            pairs.append((ComparedAgent(method, decision, variant), reference))
    return pairs


def run_label(method: str, decision: DecisionKind) -> str:
    """Name of a run as printed."""
    method_label = f"`{method.rpartition('.')[2]}`"
    return method_label if decision == "fused" else f"{method_label}, {decision}"


def chooses_actions(method: str) -> bool:
    """True if the choices of the policy are the actions themselves."""
    return find_method(method).control == ActionControl()
