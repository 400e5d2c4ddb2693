"""Modules and names of version 0.2 and their successors: an old import is refused by a line that gives the new one.

`jaxnav/__init__.py` installs `OldNames` as a finder of modules. The finder refuses modules that were merged or renamed,
and lets modules that still exist refuse their old names; all other imports pass it by.
"""

from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType
from typing import Any

#: Modules that were merged or renamed in 0.3, by their path in the package.
MODULES = {
    "baselines.cell_sets": "baselines.frontier",
    "cli.compare": "cli.study",
    "cli.instrument": "cli.study",
    "cli.mixture": "cli.study",
    "cli.options": "cli.console",
    "env.build": "env.make",
    "env.types": "env.objectnav",
    "evaluation.accounting": "evaluation.report",
    "evaluation.inference": "evaluation.removal",
    "evaluation.metrics": "evaluation.grid",
    "evaluation.report_tables": "evaluation.report",
    "game.episode": "game.session",
    "game.keys": "game.terminal",
    "game.prepare": "game.session",
    "game.screen": "game.terminal",
    "policies.acting": "policies.agent_loop",
    "policies.category_maps": "policies.features",
    "policies.fused": "policies.network",
    "policies.learned_loss": "policies.adaptation",
    "policies.methods.anonymous": "policies.methods.rgb",
    "policies.methods.base": "policies.method",
    "policies.methods.graphs": "policies.methods.sp",
    "policies.methods.home": "policies.methods.semexp",
    "policies.methods.trail": "policies.methods.tpn",
    "policies.methods.zones": "policies.methods.hoz",
    "policies.pair": "policies.handover",
    "policies.perception": "policies.agent_loop",
    "policies.policy": "policies.network",
    "policies.semantic_map": "policies.methods.map_tracker",
    "policies.stream": "policies.network",
    "policies.streams": "policies.network",
    "report.content": "report.page",
    "report.gather": "report.measure",
    "report.plans": "report.replays",
    "report.players": "report.replays",
    "report.sections": "report.make",
    "runs.account": "runs.evaluate",
    "runs.check": "runs.config",
    "runs.directory": "runs.run",
    "runs.exported": "runs.loaded_policy",
    "runs.exports": "runs.policies",
    "runs.interrupts": "runs.train",
    "runs.logs": "runs.run",
    "runs.model_card": "runs.loaded_policy",
    "runs.overlay": "runs.config_files",
    "runs.packaged": "runs.policies",
    "runs.policy": "runs.loaded_policy",
    "runs.prepare": "runs.train",
    "runs.progress": "runs.train",
    "runs.replay": "runs.evaluate",
    "runs.stopwatch": "runs.train",
    "runs.updates": "runs.train",
    "scenes.exchange": "scenes.layout_shift",
    "scenes.files.importers.controller": "scenes.files.importers.ai2thor",
    "scenes.files.importers.habitat_episodes": "scenes.files.importers.habitat",
    "scenes.files.importers.polygons": "scenes.files.importers.assemble",
    "scenes.files.importers.procthor_names": "scenes.files.importers.procthor",
    "scenes.files.importers.procthor_objects": "scenes.files.importers.procthor",
    "scenes.files.importers.procthor_walls": "scenes.files.importers.procthor",
    "scenes.files.importers.replacements": "scenes.files.importers.ai2thor",
    "scenes.files.importers.scene_data": "scenes.files.importers.ai2thor",
    "scenes.files.importers.semantic_map": "scenes.files.importers.habitat",
    "scenes.files.record": "scenes.files.scene_file",
    "scenes.files.walls": "scenes.files.scene_file",
    "scenes.generate.arguments": "scenes.generate.room_shapes",
    "scenes.generate.floor_plans": "scenes.generate.homes",
    "scenes.generate.furnish": "scenes.generate.rooms",
    "scenes.generate.furnished_room": "scenes.generate.rooms",
    "scenes.generate.home": "scenes.generate.homes",
    "scenes.generate.rectangle": "scenes.generate.room_shapes",
    "scenes.generate.room_rules": "scenes.generate.rooms",
    "scenes.generate.spots": "scenes.generate.rooms",
    "scenes.sources": "scenes.worlds",
    "scenes.tables.detector": "scenes.tables.observation_row",
    "scenes.tables.ego_view": "scenes.tables.visibility",
    "scenes.tables.shard_workers": "scenes.tables.shards",
    "scenes.tables.sightings": "scenes.tables.visibility",
    "store.leaves": "store.checkpoint",
    "store.lock": "store.files",
    "store.manifest": "store.files",
    "store.runlog": "store.files",
    "store.signed": "store.files",
    "study": "experiments",
    "training.apply": "training.ppo",
    "training.collect": "training.ppo",
    "training.exchange": "training.calibration",
    "training.exploration": "training.calibration",
    "training.learner": "training.ppo",
    "training.loss": "training.ppo",
    "training.peers": "training.devices",
    "viz.figure": "viz.style",
    "viz.labels": "viz.scene",
    "viz.panel": "viz.episode",
    "viz.plan": "viz.scene",
    "viz.play": "viz.episode",
    "viz.search_map": "viz.search",
    "viz.view": "viz.scene",
}

#: Documented names that were renamed in 0.3, in modules that still exist or in those above.
NAMES = {
    "env.build.build": "env.make.build_environment",
    "env.make.build": "env.make.build_environment",
    "evaluation.grid.Outcome": "evaluation.grid.EpisodeOutcome",
    "evaluation.grid.act": "evaluation.grid.infer_and_act",
    "evaluation.grid.first_states": "evaluation.grid.start_states",
    "evaluation.inference.Inference": "evaluation.removal.InferenceConfig",
    "evaluation.inference.Inferred": "evaluation.removal.InferenceTrace",
    "evaluation.inference.gap_used": "evaluation.removal.select_gap",
    "evaluation.inference.remove": "evaluation.removal.apply_removal",
    "evaluation.playback.Trace": "evaluation.playback.EpisodeTrace",
    "evaluation.playback.play": "evaluation.playback.play_episodes",
    "features": "unpack_features",
    "gaps.Signs": "gaps.CooccurrenceEvidence",
    "layout.SETTINGS": "layout.ESTIMATORS",
    "layout.Setting": "layout.EstimatorConfig",
    "layout.named_setting": "layout.resolve_estimator",
    "evaluation.removal.counterfactual_logits": "policies.agent_loop.decide_counterfactually",
    "policies.acting.Acting": "policies.agent_loop.AgentLoop",
    "policies.acting.Taken": "policies.agent_loop.StepResult",
    "policies.acting.carried": "policies.agent_loop.policy_memory",
    "policies.agent_loop.decide": "policies.agent_loop.embed_and_decide",
    "policies.features.CONFIDENCE": "policies.features.CONFIDENCE_INDEX",
    "policies.features.features": "policies.features.unpack_features",
    "policies.methods.Adaptation": "policies.method.Adaptation",
    "policies.methods.Control": "policies.method.Control",
    "policies.methods.Experience": "policies.method.Experience",
    "policies.methods.Knowledge": "policies.method.Knowledge",
    "policies.methods.Percept": "policies.method.Percept",
    "policies.methods.Primitive": "policies.method.ActionControl",
    "policies.methods.Stage": "policies.method.Stage",
    "policies.methods.Tracker": "policies.method.Tracker",
    "policies.methods.graphs.graph_from_file": "policies.methods.sp.graph_from_file",
    "policies.pair.Pair": "policies.handover.HandoverPolicy",
    "policies.pathways.Memory": "policies.pathways.PolicyState",
    "policies.pathways.zero_experience": "policies.pathways.mask_experience",
    "policies.perception.Perceived": "policies.agent_loop.PerceptionState",
    "policies.streams.Streams": "policies.network.StreamsPolicy",
    "runs.directory.load_run": "runs.run.load_run_config",
    "runs.policies.read_export": "runs.policies.read_exported_policy",
    "runs.policy.Deliberation": "runs.loaded_policy.PolicyOutput",
    "scenes.scene.CELL": "scenes.scene.CELL_SIZE",
    "scenes.worlds.from_file": "scenes.worlds.load_scenes",
    "scenes.worlds.generated": "scenes.worlds.make_generated_scenes",
    "scenes.worlds.shifted": "scenes.worlds.shift_scenes",
    "training.apply.renewed": "training.ppo.reset_optimizer_if",
    "training.collect.collect": "training.ppo.collect_rollout",
    "training.collect.draw_coins": "training.ppo.sample_experience_dropout",
    "training.collect.zero_direct": "policies.pathways.mask_direct_pathways",
    "training.loss.advantages": "training.ppo.compute_advantages",
    "training.loss.replay": "training.ppo.replay_rollout",
    "viz.figure.save_figure": "viz.style.save_figure",
    "viz.plan.AGENT": "env.render.AGENT_COLOR",
    "viz.plan.draw_room": "viz.scene.draw_plan",
}


class OldNames(MetaPathFinder):
    """Finder that refuses modules and names of version 0.2."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: Any = None) -> ModuleSpec | None:
        """Find modules some of whose names changed; no other module is this finder's.

        Raises:
          ModuleNotFoundError: a module of 0.2; names its successor, and names that changed.
        """
        module = fullname.removeprefix("jaxnav.")
        if not fullname.startswith("jaxnav."):
            return None
        if module in MODULES:
            raise ModuleNotFoundError(f"{fullname} is jaxnav.{MODULES[module]} since 0.3{_list_names(module)}")
        spec = PathFinder.find_spec(fullname, path, target) if _old_names(module) else None
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _RefusingLoader(spec.loader.name, spec.loader.path)
        return spec


class _RefusingLoader(SourceFileLoader):
    """Loader of a module that refuses its old names."""

    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)

        def refuse(name: str) -> Any:
            refuse_old_name(module.__name__, name)
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")

        vars(module)["__getattr__"] = refuse


def refuse_old_name(module: str, name: str) -> None:
    """Raise for a name of 0.2 that a module no longer has.

    Args:
      module: `__name__` of the module.
      name: asked of it.

    Raises:
      ImportError: gives the new name.
    """
    new_name = NAMES.get(f"{module}.{name}".removeprefix("jaxnav."))
    if new_name is not None:
        raise ImportError(f"{module}.{name} is jaxnav.{new_name} since 0.3")


def _old_names(module: str) -> list[str]:
    """List the renamed names of a module, in full."""
    return [name for name in NAMES if name.rpartition(".")[0] == module]


def _list_names(module: str) -> str:
    """Describe the renamed names of a module, for a message."""
    described = []
    for old_name in _old_names(module):
        described.append(f"{old_name.rpartition('.')[2]} is {NAMES[old_name].rpartition('.')[2]}")
    return f" ({', '.join(described)})" if described else ""
