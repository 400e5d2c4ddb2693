"""Settings of a comparison of methods, and the runs that it takes."""

import dataclasses
import fnmatch
import itertools
import re
from pathlib import Path
from typing import Any, Literal, NamedTuple

from jaxnav.causal import Form
from jaxnav.errors import InputError
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.spec import Deciding
from jaxnav.runs.check import check
from jaxnav.runs.config import ARMS, Arm, RunConfig
from jaxnav.runs.directory import settings
from jaxnav.runs.overlay import apply_values
from jaxnav.study.config import check_shared


@dataclasses.dataclass(frozen=True)
class CompareConfig:
    """Describe a comparison; finished runs and results are kept.

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
    decisions: tuple[Deciding, ...] = ("fused", "streams")
    split: Literal["val", "test"] = "val"
    episodes: int = 1000
    epsilon: float = 0.5
    form: Form = "residual"
    seed: int = 0
    base: RunConfig = RunConfig()


class Entry(NamedTuple):
    """Name one run of a comparison.

    Attributes:
      world: a name of the comparison's worlds.
      method, decision: that are trained.
      run: its settings.
    """

    world: str
    method: str
    decision: Deciding
    run: RunConfig

    @property
    def name(self) -> str:
        """Return the name of its results."""
        return f"{self.world}-{self.method.replace(':', '-')}-{self.decision}"


#: Settings that the runs of a world may change, and those that the comparison gives to each run.
CHANGEABLE = ("world", "scenes", "worlds", "detector", "total_steps")
GIVEN = {"method": "methods", "decision": "decisions", "run_dir": "runs"}


def check_compare(config: CompareConfig) -> CompareConfig:
    """Return the same config if every setting and run is possible.

    Raises:
      InputError: names the first impossible setting.
    """
    check_shared(config.episodes, config.seed, config.base)
    for name in ("worlds", "methods", "decisions"):
        values = tuple(getattr(config, name))
        if not values or len(set(values)) < len(values):
            raise InputError(f"{name}: {', '.join(values) or 'empty'}: give one or more, each once")
    for world in config.worlds:
        if not re.fullmatch(r"\w+", world):
            raise InputError(f"worlds: {world!r}: is part of file names; give letters, digits and underscores")
    if unknown := set(config.ablations) - set(config.methods):
        raise InputError(f"ablations: {sorted(unknown)[0]!r} is none of the methods {', '.join(config.methods)}")
    compared = {*config.methods, *(each for group in config.ablations.values() for each in group)}
    if unknown := set(config.unlearned) - compared:
        raise InputError(f"unlearned: {sorted(unknown)[0]!r} is not compared; leave it out")
    if not 0.0 <= config.epsilon < float("inf"):
        raise InputError(f"epsilon: {config.epsilon}: give a number from 0 to below infinity")
    for name, place in GIVEN.items():
        if getattr(config.base, name) != getattr(RunConfig(), name):
            raise InputError(f"base.{name}: every run has its own; leave it out and give `{place}`")
    if not entries(config):
        raise InputError(f"left_out: {', '.join(config.left_out)}: leaves no run to compare; give fewer patterns")
    return config


def world_runs(config: CompareConfig) -> dict[str, RunConfig]:
    """Return the settings that all runs of each world share.

    Raises:
      InputError: a setting that is unknown, of another type, or that a world may not change.
    """
    runs = {}
    for world, changes in config.worlds.items():
        if refused := set(changes) - set(CHANGEABLE):
            mend = f"a world may change {', '.join(CHANGEABLE)}; what all runs share goes into `base`"
            raise InputError(f"worlds.{world}.{sorted(refused)[0]}: {mend}")
        runs[world] = apply_values(config.base, changes, Path(f"worlds.{world}"))
    return runs


def entries(config: CompareConfig) -> list[Entry]:
    """Return all runs of a comparison, world by world.

    Raises:
      InputError: an unknown method, or a run whose settings are impossible.
    """
    return [entry for entry in _possible(config) if not _is_left_out(config, entry)]


def left_out(config: CompareConfig) -> list[Entry]:
    """Return the runs that a comparison leaves out."""
    return [entry for entry in _possible(config) if _is_left_out(config, entry)]


def _is_left_out(config: CompareConfig, entry: Entry) -> bool:
    return any(fnmatch.fnmatchcase(entry.name, pattern) for pattern in config.left_out)


def _possible(config: CompareConfig) -> list[Entry]:
    """Return the runs of all worlds, methods and decisions."""
    groups = [(method, *config.ablations.get(method, ())) for method in config.methods]
    methods = dict.fromkeys(method for group in groups for method in group)
    found = []
    for world, shared in world_runs(config).items():
        for method, decision in itertools.product(methods, config.decisions):
            trained = _arms(method, decision)
            arms = tuple(arm for arm in shared.arms if arm in trained)
            if arms:
                steps = 1 if method in config.unlearned else shared.total_steps
                run = dataclasses.replace(shared, method=method, arms=arms, total_steps=steps)
                entry = Entry(world, method, decision, run)
                found.append(entry._replace(run=_run(entry, config.runs)))
    return found


def _arms(method: str, decision: Deciding) -> tuple[Arm, ...]:
    """Return the arms that are trained of a method."""
    if not find_method(method).hosts_layout:
        return ("baseline",) if decision == "fused" else ()
    return ARMS if decision == "fused" else ("layout",)


def _run(entry: Entry, folder: Path) -> RunConfig:
    """Return the settings of an entry's run, complete and possible."""
    try:
        return check(dataclasses.replace(entry.run, decision=entry.decision, run_dir=folder / entry.name))
    except InputError as error:
        raise InputError(f"{entry.name}: {error}") from error


def entry_identity(config: CompareConfig, entry: Entry) -> dict[str, Any]:
    """Return as JSON the settings that decide an entry's numbers."""
    names = ("split", "episodes", "epsilon", "form", "seed")
    return {name: getattr(config, name) for name in names} | {"run": settings(entry.run)}


def frontier_identity(config: CompareConfig, run: RunConfig) -> dict[str, Any]:
    """Return as JSON the settings that decide a searcher's numbers."""
    world = {name: value for name, value in settings(run).items() if name in CHANGEABLE and name != "total_steps"}
    return {name: getattr(config, name) for name in ("split", "episodes", "seed")} | {"run": world}
