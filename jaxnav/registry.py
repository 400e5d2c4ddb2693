"""What jaxnav offers by name: worlds, methods, policies, experiments, benchmarks, configurations, layout estimators.

`registered` collects the entries from the registries of the package (`WORLDS`, `METHODS`, `EXPERIMENTS` and others),
and their summaries from docstrings and files. The registries are imported in the functions that read them, so that
listing configurations does not import JAX.
"""

import re
import sys
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal

from jaxnav.choices import EstimatorName
from jaxnav.errors import InputError

#: Kinds of entries.
Kind = Literal["worlds", "methods", "policies", "experiments", "benchmarks", "configurations", "settings"]
#: An entry: `name`, `summary` and further fields of its kind, as JSON.
Entry = dict[str, Any]


def registered(kind: Kind | None = None) -> dict[Kind, list[Entry]]:
    """Return everything that has a name in jaxnav, by kind.

    Every entry is a dictionary with `name`, `summary` and further fields, and JSON represents it exactly:

    * `worlds`: `scenes` by split, the numbers of `categories` and `goals`, `train_step_limit`, `step_limit` and
      `large_step_limit` (of living rooms) in actions, and `total_steps` of a usual training;
    * `methods`: `hosts_layout`, true where the layout weights can enter, and `source`, which is `jaxnav` or the
      `package.module:NAME` of an entry point of the group `jaxnav.methods`;
    * `policies`: `method`, `world` and `arm` of each packaged policy;
    * `experiments`: `needs_run`, true where a finished run must be given; `scene_files` to import first; and the
      training that an experiment without any results does: training `runs`, `policies` in them, and environment
      `steps` of all policies;
    * `benchmarks`: `tracks` by name, and the number of `episodes` of each track at each layout shift;
    * `configurations`, `settings`: no further fields.

    Args:
      kind: one kind; None for all.

    Raises:
      InputError: unknown kind.
    """
    if kind is None:
        return {kind: list_entries() for kind, list_entries in _KINDS.items()}
    if kind not in _KINDS:
        raise InputError(f"{kind!r}: choose one of {', '.join(_KINDS)}")
    return {kind: _KINDS[kind]()}


def _list_worlds() -> list[Entry]:
    from jaxnav.scenes.worlds import WORLDS

    entries = []
    for name, world in WORLDS.items():
        entry = {
            "name": name,
            "summary": world.summary,
            "scenes": dict(world.counts),
            "categories": len(world.task.categories),
            "goals": len(world.task.goals or world.task.categories),
            "train_step_limit": world.train_step_limit,
            "step_limit": world.step_limit,
            "large_step_limit": world.large_step_limit,
            "total_steps": world.total_steps,
        }
        entries.append(entry)
    return entries


def _list_methods() -> list[Entry]:
    from importlib import metadata

    from jaxnav.policies.methods import ENTRY_POINT_GROUP, METHODS, find_method

    # A method of this package precedes an entry point of the same name, as in `find_method`.
    sources = {point.name: point.value for point in metadata.entry_points(group=ENTRY_POINT_GROUP)}
    sources |= dict.fromkeys(METHODS, "jaxnav")

    entries = []
    for name in sorted(sources):
        # An entry point may name a package that cannot be imported.
        try:
            method = find_method(name)
        except InputError as error:
            entries.append({"name": name, "summary": str(error), "hosts_layout": None, "source": sources[name]})
            continue
        module_doc = sys.modules[method.experience.__module__].__doc__ or ""
        summary = _described_options(module_doc).get(name) or _without_title(_first_line(module_doc))
        entry = {"name": name, "summary": summary, "hosts_layout": method.hosts_layout, "source": sources[name]}
        entries.append(entry)
    return entries


def _list_policies() -> list[Entry]:
    from jaxnav.runs.policies import PACKAGED_POLICIES, config_for_policy, list_packaged_policies

    entries = []
    for name in list_packaged_policies():
        # The model card states the success of the policy.
        config = config_for_policy(name)
        card = (PACKAGED_POLICIES / name / "README.md").read_text(encoding="utf-8")
        success = re.search(r"\* \*\*(Success .*?)\*\*: (.*?)(?:, the mean|$)", card, re.MULTILINE)
        summary = f"{success[1]}: {success[2]}" if success else ""
        entry = {
            "name": name,
            "summary": summary,
            "method": config.method,
            "world": config.world,
            "arm": config.arms[0],
        }
        entries.append(entry)
    return entries


def _list_experiments() -> list[Entry]:
    from jaxnav.experiments.config import EXPERIMENTS, ExperimentConfig, agent_runs
    from jaxnav.runs.config_files import apply_yaml

    entries = []
    for name in EXPERIMENTS:
        experiment = apply_yaml(ExperimentConfig(), name, EXPERIMENTS)
        configs = [run.config for run in agent_runs(experiment)]
        num_policies = 0
        num_steps = 0
        for config in configs:
            policies_of_run = config.seeds * len(config.arms)
            num_policies += policies_of_run
            num_steps += policies_of_run * config.total_updates * config.steps_per_update
        entry = {
            "name": name,
            "summary": experiment.title,
            "needs_run": not experiment.agents,
            "scene_files": sorted({str(config.scenes) for config in configs if config.scenes}),
            "runs": len(configs),
            "policies": num_policies,
            "steps": num_steps,
        }
        entries.append(entry)
    return entries


def _list_benchmarks() -> list[Entry]:
    from jaxnav.runs.benchmark import BENCHMARKS, load_benchmark

    # The first line of a manifest is a comment that describes it.
    entries = []
    for name, path in BENCHMARKS.items():
        benchmark = load_benchmark(name)
        entry = {
            "name": name,
            "summary": _first_line(path.read_text(encoding="utf-8")).removeprefix("#").strip(),
            "tracks": [track.name for track in benchmark.tracks],
            "episodes": benchmark.num_episodes,
        }
        entries.append(entry)
    return entries


def _list_configurations() -> list[Entry]:
    from jaxnav.runs.config_files import CONFIGS

    # The first line of a file is a comment that describes it.
    entries = []
    for name, path in CONFIGS.items():
        comment = _first_line(path.read_text(encoding="utf-8")).removeprefix("#")
        entries.append({"name": name, "summary": comment.strip()})
    return entries


def _list_settings() -> list[Entry]:
    from jaxnav import layout

    # The documentation of the estimators describes them and the measures of the gap.
    descriptions = _described_options(layout.EstimatorConfig.__doc__ or "") | _described_options(layout.__doc__ or "")
    entries = []
    for name in typing.get_args(EstimatorName):
        entries.append({"name": name, "summary": descriptions.get(name, "")})
    return entries


_KINDS: Mapping[Kind, Callable[[], list[Entry]]] = {
    "worlds": _list_worlds,
    "methods": _list_methods,
    "policies": _list_policies,
    "experiments": _list_experiments,
    "benchmarks": _list_benchmarks,
    "configurations": _list_configurations,
    "settings": _list_settings,
}


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0]


def _without_title(line: str) -> str:
    """Drop the title of a docstring's first line: "ORG: the object relation graph." becomes "The object ..."."""
    title, colon, summary = line.partition(": ")
    text = summary if colon and " " not in title else line
    return text[:1].upper() + text[1:]


def _described_options(docstring: str) -> dict[str, str]:
    """Find the options that a docstring lists as "`name`: description", each with its first sentence."""
    # A description goes on over lines that are indented at least as far and begin no other option.
    descriptions = {}
    for match in re.finditer(r"^( *)`(\w+)`: (.+(?:\n\1 *(?!`\w+`:)[^\s].*)*)", docstring, re.MULTILINE):
        description = " ".join(match[3].split())
        first_sentence = re.split(r"(?<=\.) ", description)[0]
        descriptions[match[2]] = first_sentence[:1].upper() + first_sentence[1:]
    return descriptions
