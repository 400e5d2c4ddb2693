"""Everything that a run learns before training, stored in its directory.

A run learns layout prior, layout estimator and method knowledge once (`save_preparation`) and reads them whenever its
command is repeated (`load_preparation`). Other hardware would learn them with other last digits.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.layout import EstimatorConfig
from jaxnav.policies.method import Knowledge
from jaxnav.policies.network import Params
from jaxnav.runs.policies import knowledge_from_arrays, knowledge_to_arrays
from jaxnav.store.export import POLICY_FILE, export_params, load_params
from jaxnav.store.files import check_manifest
from jaxnav.training.calibration import Exploration

#: Folder of a run directory with everything learned before training.
PREPARATION_DIR = "knowledge"


class Preparation(NamedTuple):
    """Everything that a run learns before training.

    Attributes:
      exploration: counts from random walks.
      estimator_config: calibrated layout estimator.
      knowledge: layout priors, method knowledge and co-occurrence evidence.
      fitted_params: parameters of each seed, for methods that are fitted (`Method.fit`); empty for all others.
    """

    exploration: Exploration
    estimator_config: EstimatorConfig
    knowledge: Knowledge
    fitted_params: tuple[Params, ...] = ()


def save_preparation(run_dir: Path, preparation: Preparation, manifest: Mapping[str, Any]) -> None:
    """Store a preparation in a run directory; a damaged one is replaced.

    Args:
      run_dir: directory of the run.
      preparation: everything learned before training.
      manifest: manifest of the run, see `make_manifest`.
    """
    arrays = knowledge_to_arrays(preparation.knowledge)
    arrays["exploration"] = jax.device_get(preparation.exploration)._asdict()
    if preparation.fitted_params:
        seed_params = {}
        for seed, params in enumerate(preparation.fitted_params):
            seed_params[str(seed)] = jax.device_get(params)
        arrays["fitted"] = seed_params
    fields = {"manifest": manifest, "estimator": dataclasses.asdict(preparation.estimator_config)}
    export_params(run_dir / PREPARATION_DIR, arrays, fields)


def has_preparation(run_dir: Path) -> bool:
    """True where a preparation was stored, intact or damaged."""
    return (run_dir / PREPARATION_DIR / POLICY_FILE).exists()


def load_preparation(run_dir: Path, manifest: Mapping[str, Any]) -> Preparation | None:
    """Load the preparation of a run; None if it is damaged.

    Args:
      run_dir: directory of a run for which `has_preparation` is true.
      manifest: manifest of the run that resumes.

    Raises:
      InputError: the preparation was learned with other settings or in other scenes.
    """
    folder = run_dir / PREPARATION_DIR
    try:
        arrays, fields = load_params(folder)
        stored_manifest = fields["manifest"]
        exploration = Exploration(**jax.tree.map(jnp.asarray, arrays["exploration"]))
        estimator_config = EstimatorConfig(**fields["estimator"])
        knowledge = knowledge_from_arrays(arrays)
        seed_params = arrays.get("fitted", {})
        fitted_params = tuple(jax.tree.map(jnp.asarray, seed_params[str(seed)]) for seed in range(len(seed_params)))
    except (KeyError, TypeError, ValueError):  # an `InputError` is a `ValueError`
        return None
    check_manifest(folder, stored_manifest, manifest)
    return Preparation(exploration, estimator_config, knowledge, fitted_params)
