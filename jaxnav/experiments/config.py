"""Configuration of an experiment: which agents are trained in which worlds, and what is measured of them.

An experiment is a YAML file (`EXPERIMENTS` lists those that come with jaxnav) and a page template. `agent_runs` lists
the training runs that it implies; `part_settings` lists the settings that determine a measurement, by which results are
recognized and reused.
"""

import dataclasses
import fnmatch
import hashlib
import itertools
import json
import operator
import re
from pathlib import Path
from typing import Any, NamedTuple, get_args

from jaxnav.choices import Decoding, Form, ShiftKind, Split, Variant
from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.config_files import apply_values
from jaxnav.store.files import expand_home

#: Experiments that come with jaxnav, by name.
EXPERIMENTS = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.yaml"))}


#: Name of the layout-blind agents of a finished run, and their usual name in experiments.
LAYOUT_BLIND_AGENT = "anonymous"


@dataclasses.dataclass(frozen=True)
class ExperimentConfig:
    """Settings of an experiment. Finished training runs and results are reused.

    Attributes:
      title: title of the page.
      results: folder of the result files, with one subfolder per split. With `run`, the default is the subfolder
        `results` of the run directory.
      runs: folder of the training runs of the experiment.
      pages: pages to write, as YAML that maps each Markdown document to its template: a file, or one of the packaged
        templates account, claims, factors, instrument, methods, mixture, paper and study. With the option `--results`
        and without `--pages`, pages are written to the folder of the results.
      worlds: worlds by name, as YAML. Each maps settings of `jaxnav train` to the values of all runs in that world.
      folds: datasets that are divided into folds, as YAML that maps the name of a dataset to a list of its worlds. Each
        of these worlds evaluates one fold with agents trained on other scenes of the dataset. The measurements
        `mixture`, `handover` and `cde` evaluate all folds together, and divide the episodes among them.
      agents: agents by name, as YAML. Each maps settings of `jaxnav train` to the values of its runs. The key `against`
        lists agents to compare with: AGENT compares equal variants, AGENT/VARIANT always compares with that variant,
        such as `org/baseline`. The key `run` names a finished run to use instead of training one.
      left_out: patterns of WORLD-AGENT, such as `rooms-*`, of which no run is trained or measured.
      only: patterns of WORLD-AGENT, such as `rooms-*`, that are measured in this call, after training where it is
        missing. The pages show every agent that has results.
      measure: measurements by name (docs/experiments.md lists them). Each maps to a list of patterns of AGENT or
        WORLD-AGENT that are measured.
      groups: groups of agents by name, as YAML, for the measurement `groups`. Each has the keys `agents`, `variant` and
        `against`: the mean success of the agents in that variant is compared with another of their variants, or with
        one AGENT/VARIANT; with best actions, at the first layout shift.
      reference: layout-blind agents, against which the value and the cost of experience are measured. With `run`, the
        run directory of such agents (a run of `--method anonymous`); otherwise the name of one of the agents, by
        default `anonymous`.
      run: run directory of a finished run to measure. The experiment then trains nothing, and its results and pages are
        written to that directory.
      split: scenes to evaluate on.
      shifts: layout shifts, rising, each from 0 (as in training) to 1. The first is the reference of all changes.
      shift_by: categories that exchange their places under a shift. `size`: neighbours in size, drawn for each scene.
        `context`: the ones whose exchange misleads most, fitted to the training scenes and equal in all scenes.
      episodes: number of episodes, at least 1, at each layout shift.
      epsilon: thresholds of sTDE, each at least 0: experience is removed where the layout gap exceeds the threshold.
        The first is the one that is compared.
      form: rule by which sTDE removes experience. `paper` subtracts from the logits of the policy a share of the logits
        with scene and goal set to zero; the share is the excess of the layout gap over the threshold. `residual` does
        this without changing the scale of the logits. `switch` subtracts these logits completely where the gap exceeds
        the threshold. `mixture` mixes the probabilities of the decisions with and without experience, with the same
        share.
      decodings: rules that choose actions from logits, `argmax` (best actions) and `sample` (sampled actions). The
        measurements `mixture`, `handover` and `cde`, in which half of the episodes are in shifted homes, are repeated
        with each rule.
      removals: patterns of the removals that these measurements compare, such as `surprise, paper*`; all by default.
        Each rule of soft removal is named by its layout gap, form and threshold (`REMOVAL_RULES`).
      steps: number of steps, at least 1, over which the curves of the layout gap are recorded.
      seed: random seed of the episode lists and the sampled actions, from 0 to 2**32 - 1.
      base: settings of `jaxnav train` that all runs of the experiment share.
    """

    title: str = "Experiment"
    results: Path = Path("results/experiment")
    runs: Path = Path("runs/experiment")
    pages: dict[str, str] = dataclasses.field(default_factory=dict)
    worlds: dict[str, dict[str, Any]] = dataclasses.field(default_factory=lambda: {"rooms": {"world": "rooms"}})
    folds: dict[str, Any] = dataclasses.field(default_factory=dict)
    agents: dict[str, dict[str, Any]] = dataclasses.field(default_factory=lambda: {"main": {}})
    left_out: tuple[str, ...] = ()
    only: tuple[str, ...] = ("*",)
    measure: dict[str, Any] = dataclasses.field(default_factory=lambda: {"evaluation": ["*"]})
    groups: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    reference: str | None = None
    run: Path | None = None
    split: Split = "val"
    shifts: tuple[float, ...] = (0.0, 1.0)
    shift_by: ShiftKind = "size"
    episodes: int = 1000
    epsilon: tuple[float, ...] = (0.5,)
    form: Form = "residual"
    decodings: tuple[Decoding, ...] = ("sample",)
    removals: tuple[str, ...] = ("*",)
    steps: int = 80
    seed: int = 0
    base: RunConfig = RunConfig()

    @property
    def reference_agent(self) -> str:
        """Name of the layout-blind agents in an experiment that `check_experiment` completed."""
        return LAYOUT_BLIND_AGENT if self.reference is None else self.reference


#: Settings of the evaluation, which all results of an experiment share.
EVALUATION_SETTINGS = ("split", "shifts", "episodes", "epsilon", "form", "decodings", "steps", "seed")
#: Settings of an agent that are not settings of its run.
AGENT_SETTINGS = ("against", "run")


class AgentRun(NamedTuple):
    """The training run of an agent in a world.

    Attributes:
      world: name of the world in the experiment.
      agent: name of the agent.
      config: settings of the run.
      against: names of the agents with which it is compared.
      is_external: True if the run was given as a finished one, and is not trained by the experiment.
      folds: runs of all folds, if this stands for an agent in a dataset; `config` is that of the first.
    """

    world: str
    agent: str
    config: RunConfig
    against: tuple[str, ...] = ()
    is_external: bool = False
    folds: tuple["AgentRun", ...] = ()

    @property
    def name(self) -> str:
        """Name of the run in its folder."""
        return self.selector.replace(":", "-")

    @property
    def selector(self) -> str:
        """WORLD-AGENT, which the patterns of `only`, `left_out` and `measure` select."""
        return f"{self.world}-{self.agent}"

    @property
    def fold_runs(self) -> tuple["AgentRun", ...]:
        """Runs of all folds; the run itself without any."""
        return self.folds or (self,)


def check_experiment(config: ExperimentConfig) -> ExperimentConfig:
    """Return the experiment if every setting is valid, with the agents of `run` and `reference` filled in.

    Raises:
      InputError: names the first invalid setting.
    """
    config = _with_finished_runs(config)

    if not config.agents:
        raise InputError("agents: none; give --run RUN, a finished run, or agents to train")
    if config.reference_agent not in config.agents and config.reference is not None:
        raise InputError(
            f"reference: {config.reference!r} is none of the agents; next to --run RUN, give the run directory of "
            "layout-blind agents"
        )

    # Numbers of the evaluation; the first shift is the reference of every comparison, so it must be the smallest.
    shifts = config.shifts
    is_rising = all(itertools.starmap(operator.lt, itertools.pairwise(shifts)))
    if not (shifts and is_rising and shifts[0] >= 0.0 and shifts[-1] <= 1.0):
        raise InputError(f"shifts: {shifts}: give numbers from 0 to 1, rising")
    if not (config.epsilon and all(0.0 <= epsilon < float("inf") for epsilon in config.epsilon)):
        raise InputError(f"epsilon: {config.epsilon}: give numbers from 0 to below infinity")
    for name in ("steps", "episodes"):
        if getattr(config, name) < 1:
            raise InputError(f"{name}: {getattr(config, name)}: give at least 1")
    if not 0 <= config.seed < 2**32:
        raise InputError(f"seed: {config.seed}: give a whole number from 0 to 2**32 - 1")
    if not config.decodings:
        raise InputError("decodings: empty: give one or more")

    # Names become parts of file names, and a slash separates an agent from its variant.
    for field in ("worlds", "folds", "agents"):
        for name in getattr(config, field):
            if not re.fullmatch(r"[\w.+:-]+", name):
                raise InputError(
                    f"{field}: {name!r}: is part of file names; give letters, digits and the characters . _ + : -"
                )
    _check_folds(config)
    for measurement, patterns in config.measure.items():
        if not isinstance(patterns, list) or not all(isinstance(pattern, str) for pattern in patterns):
            raise InputError(f"measure.{measurement}: {patterns}: give a list of agents, or ['*']")
    for agent, agent_settings in config.agents.items():
        _check_references(config, f"agents.{agent}.against", agent_settings.get("against", []))
    for name, group in config.groups.items():
        if name in config.agents:
            raise InputError(f"groups.{name}: an agent is called so too; give another name")
        _check_group(config, f"groups.{name}", group)

    # Listing the runs checks the settings of each.
    runs = agent_runs(config)
    if not any(matches_any(run.selector, config.only) for run in runs):
        raise InputError("worlds, agents, only and left_out: select no run; give others")
    for measurement, patterns in config.measure.items():
        if not patterns:
            raise InputError(f"measure.{measurement}: {patterns} match no agent; give others")
        for pattern in patterns:
            if not any(_is_measured(run, (pattern,)) for run in runs):
                raise InputError(f"measure.{measurement}: {pattern!r} matches no agent; give another")
    _check_seeds(runs)
    _check_agents_of_folds(config, runs)
    for run in runs:
        if not isinstance(run.config.devices, int | None):
            raise InputError(f"{run.name}: devices is {run.config.devices}; one process trains all runs: give a number")
    run_names = [run.name for run in runs]
    for name in run_names:
        if run_names.count(name) > 1:
            raise InputError(f"worlds and agents: two runs are called {name}; give other names")
    return config


def _check_folds(config: ExperimentConfig) -> None:
    """Check that folds are worlds of the experiment, each of one dataset."""
    all_folds: list[str] = []
    for dataset, folds in config.folds.items():
        if not isinstance(folds, list) or not folds:
            raise InputError(f"folds.{dataset}: {folds!r}: give a list of worlds")
        if dataset in config.worlds:
            raise InputError(f"folds.{dataset}: a world is called so too; give another name")
        for fold in folds:
            if fold not in config.worlds:
                raise InputError(
                    f"folds.{dataset}: {fold!r} is none of the worlds; choose from {', '.join(config.worlds)}"
                )
        all_folds += folds
    # Scenes of a fold that is listed twice would count twice.
    if len(set(all_folds)) < len(all_folds):
        raise InputError("folds: a world is listed twice; give each once")


def _check_agents_of_folds(config: ExperimentConfig, runs: list[AgentRun]) -> None:
    """Check that an agent is trained in all folds of a dataset, or in none."""
    trained = {(run.world, run.agent) for run in runs}
    for dataset, folds in config.folds.items():
        for agent in config.agents:
            missing_folds = [fold for fold in folds if (fold, agent) not in trained]
            if 0 < len(missing_folds) < len(folds):
                raise InputError(
                    f"left_out: {agent} is left out in {', '.join(missing_folds)} of folds.{dataset}; leave it out in "
                    "all folds of a dataset, or in none"
                )


def _check_seeds(runs: list[AgentRun]) -> None:
    """Check that agents that are compared with an untrained variant of others have as many seeds."""
    from jaxnav.evaluation.report import UNTRAINED_VARIANTS

    seeds = {(run.world, run.agent): run.config.seeds for run in runs}
    for run in runs:
        for reference in run.against:
            agent, _, variant = reference.partition("/")
            num_seeds = seeds.get((run.world, agent), run.config.seeds)
            if variant in UNTRAINED_VARIANTS and num_seeds != run.config.seeds:
                raise InputError(
                    f"{run.name}: has {run.config.seeds} seeds, and {agent}, with whose variant {variant} it is "
                    f"compared, has {num_seeds}; give equally many seeds"
                )


def _check_references(config: ExperimentConfig, key: str, references: Any) -> None:
    """Check a list of AGENT or AGENT/VARIANT."""
    if not isinstance(references, list):
        raise InputError(f"{key}: {references!r}: give a list of agents, or of AGENT/VARIANT")
    for reference in references:
        agent, has_variant, variant = str(reference).partition("/")
        if agent not in config.agents:
            raise InputError(f"{key}: {agent!r} is none of the agents")
        if has_variant and variant not in get_args(Variant):
            raise InputError(f"{key}: {variant!r} is unknown; choose from {', '.join(get_args(Variant))}")


def _check_group(config: ExperimentConfig, key: str, group: dict[str, Any]) -> None:
    """Check a group of agents and what it is compared with."""
    if set(group) != {"agents", "variant", "against"}:
        raise InputError(f"{key}: gives {', '.join(group) or 'nothing'}; give agents, variant and against")
    if not group["agents"]:
        raise InputError(f"{key}.agents: empty: give one or more")
    _check_references(config, f"{key}.agents", group["agents"])

    # The reference is another variant of the group, or AGENT/VARIANT.
    for name in ("variant", "against"):
        agent, is_other_agent, variant = str(group[name]).rpartition("/")
        if variant not in get_args(Variant) or (is_other_agent and name == "variant"):
            raise InputError(f"{key}.{name}: {group[name]!r} is unknown; choose from {', '.join(get_args(Variant))}")
        if is_other_agent:
            _check_references(config, f"{key}.{name}", [agent])


def _with_finished_runs(config: ExperimentConfig) -> ExperimentConfig:
    """Replace the agents by the finished run, and by the layout-blind run `reference`, if `run` is given."""
    from jaxnav.runs.run import load_run_config

    if config.run is None:
        return config

    # Agents of the experiment would be lost silently.
    default = ExperimentConfig()
    if config.agents and config.agents != default.agents:
        raise InputError(f"run: {config.run}: the experiment already has agents; give an experiment without agents")

    # The world is that of the run, unless it is changed; results and page are kept in the run's folder.
    base = load_run_config(config.run)
    agents: dict[str, dict[str, Any]] = {"main": {"run": str(config.run)}}
    if config.reference is not None:
        agents[LAYOUT_BLIND_AGENT] = {"run": config.reference}
    run_world = {base.scenes.stem.partition(".")[0] if base.scenes else base.world: {}}
    return dataclasses.replace(
        config,
        agents=agents,
        reference=None,
        worlds=run_world if config.worlds == default.worlds else config.worlds,
        base=dataclasses.replace(base, devices=None),
        results=config.run / "results" if config.results == default.results else config.results,
        pages={str(config.run / Path(document).name): template for document, template in config.pages.items()},
    )


def agent_runs(config: ExperimentConfig) -> list[AgentRun]:
    """List the runs of an experiment, world by world.

    Raises:
      InputError: a run whose settings are unknown or impossible.
    """
    runs = []
    for world, world_changes in config.worlds.items():
        for agent in config.agents:
            if not matches_any(f"{world}-{agent}", config.left_out):
                runs.append(_agent_run(config, world, world_changes, agent))
    return runs


def matches_any(name: str, patterns: tuple[str, ...]) -> bool:
    """True if a name matches one of several patterns, in which `*` stands for any letters."""
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _agent_run(config: ExperimentConfig, world: str, world_changes: dict[str, Any], agent: str) -> AgentRun:
    """Settings of one run: the base, changed by the world, then by the agent."""
    agent_settings = config.agents[agent]
    against = tuple(agent_settings.get("against", ()))
    changes = {setting: value for setting, value in agent_settings.items() if setting not in AGENT_SETTINGS}
    name = f"{world}-{agent}".replace(":", "-")

    # The settings of a finished run are fixed, but for its world.
    if "run" in agent_settings:
        from jaxnav.runs.run import load_run_config

        if changes:
            raise InputError(f"agents.{agent}: is a finished run; remove its settings {', '.join(changes)}")
        run_config = load_run_config(expand_home(agent_settings["run"]))
        run_config = apply_values(run_config, world_changes, Path(f"worlds.{world}"))
        return AgentRun(world, agent, run_config, against, is_external=True)

    # The scenes of finished results need not exist any more; whoever trains reads them first.
    world_config = apply_values(config.base, world_changes, Path(f"worlds.{world}"))
    run_config = apply_values(world_config, changes, Path(f"agents.{agent}"))
    scenes = run_config.scenes
    checked_scenes = scenes if scenes is None or scenes.exists() else None
    try:
        run_config = check_config(dataclasses.replace(run_config, run_dir=config.runs / name, scenes=checked_scenes))
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    run_config = dataclasses.replace(run_config, scenes=scenes)
    return AgentRun(world, agent, run_config, against)


def measured_runs(config: ExperimentConfig, measurement: str) -> list[AgentRun]:
    """List the runs of which a measurement is taken now."""
    patterns = tuple(config.measure[measurement])
    runs = []
    for run in agent_runs(config):
        if _is_measured(run, patterns) and matches_any(run.selector, config.only):
            runs.append(run)
    return runs


def _is_measured(run: AgentRun, patterns: tuple[str, ...]) -> bool:
    """True if the agent of a run, or its world and agent, match one of the patterns of a measurement."""
    return matches_any(run.agent, patterns) or matches_any(run.selector, patterns)


def join_folds(config: ExperimentConfig, runs: list[AgentRun]) -> list[AgentRun]:
    """Replace the runs of an agent in the folds of a dataset by one that stands for all of them."""
    # A dataset is measured as a whole, even if `only` selects a single fold.
    run_by_name = {(run.world, run.agent): run for run in agent_runs(config)}
    dataset_by_fold = {fold: dataset for dataset, folds in config.folds.items() for fold in folds}
    joined: dict[tuple[str, str], AgentRun] = {}
    for run in runs:
        dataset = dataset_by_fold.get(run.world)
        if dataset is None:
            joined[run.world, run.agent] = run
            continue
        fold_runs = tuple(run_by_name[fold, run.agent] for fold in config.folds[dataset])
        joined[dataset, run.agent] = fold_runs[0]._replace(world=dataset, folds=fold_runs)
    return list(joined.values())


def evaluation_settings(config: ExperimentConfig) -> dict[str, Any]:
    """Return the settings of the evaluation as JSON."""
    settings = {}
    for name in EVALUATION_SETTINGS:
        value = getattr(config, name)
        settings[name] = list(value) if isinstance(value, tuple) else value
    if config.shift_by != "size":  # results of earlier versions have no such setting
        settings["shift_by"] = config.shift_by
    return settings


def part_settings(config: ExperimentConfig, run: AgentRun, references: list[AgentRun]) -> dict[str, Any]:
    """Return the settings that determine the results of a run, as JSON.

    Args:
      config: the experiment.
      run: the measured run.
      references: the runs with which it is compared.
    """
    from jaxnav.runs.run import comparable_settings

    settings = evaluation_settings(config) | {"run": comparable_settings(run.config)}
    if run.folds:
        settings["folds"] = {fold.world: digest_settings(comparable_settings(fold.config)) for fold in run.folds}
    if references:
        digests = {}
        for reference in references:
            reference_name = reference.name if run.folds else reference.agent
            digests[reference_name] = digest_settings(comparable_settings(reference.config))
        settings["references"] = digests
    return settings


def digest_settings(settings: dict[str, Any]) -> str:
    """Digest of settings, equal for equal settings."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
