"""Exported parameters: a folder with `params.safetensors` and `policy.json`, readable with NumPy and safetensors."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from jaxnav.errors import InputError
from jaxnav.store.files import write_atomic

#: Version of the layout of the two files.
FORMAT_VERSION = 3

#: File that says what a policy is built from; it is written last.
POLICY_FILE = "policy.json"

_PARAMS = "params.safetensors"


def export_params(folder: Path, params: Mapping[str, Any], spec: Mapping[str, Any]) -> None:
    """Write parameters and what the policy is built from.

    An earlier export is replaced.

    `params.safetensors` has flat names, `a/b/kernel`. `policy.json` has `format_version`, `spec` and the SHA-256 of the
    parameters; it is written last, so an export cut short is refused by `load_params` instead of being mixed.

    Args:
      folder: made if missing.
      params: nested dict of arrays; names are strings without `/`.
      spec: JSON values.

    Raises:
      TypeError: a name in `params` is no string or holds `/`.
    """
    tensors = safetensors.numpy.save(_flatten(params))
    policy = {"format_version": FORMAT_VERSION, "params_sha256": hashlib.sha256(tensors).hexdigest(), "spec": spec}
    text = json.dumps(policy, indent=2) + "\n"
    write_atomic(folder / _PARAMS, tensors)
    write_atomic(folder / POLICY_FILE, text.encode())


def load_params(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Load the parameters and the spec of an export.

    The parameters are a nested dict of NumPy arrays.

    Raises:
      InputError: no export there, another format version, or files that do not belong together.
    """
    try:
        policy = json.loads((folder / POLICY_FILE).read_bytes())
        tensors = (folder / _PARAMS).read_bytes()
    except OSError as error:
        raise InputError(f"{folder}: not an exported policy ({error.strerror}: {error.filename}); export it") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{folder / POLICY_FILE}: not JSON ({error}); export the policy again") from error
    if not isinstance(policy, dict) or not {"format_version", "params_sha256", "spec"} <= policy.keys():
        raise InputError(
            f"{folder / POLICY_FILE}: lacks format_version, params_sha256 or spec; export the policy again"
        )
    if policy["format_version"] != FORMAT_VERSION:
        raise InputError(
            f"{folder / POLICY_FILE}: has format version {policy['format_version']!r}, this code reads version "
            f"{FORMAT_VERSION}; export the policy again"
        )
    if hashlib.sha256(tensors).hexdigest() != policy["params_sha256"]:
        raise InputError(f"{folder / _PARAMS}: does not belong to {POLICY_FILE} or is damaged; export the policy again")
    return _unflatten(safetensors.numpy.load(tensors)), policy["spec"]


def _flatten(params: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    flat = {}
    for name, value in params.items():
        if not isinstance(name, str) or "/" in name:
            raise TypeError(f"parameter name {name!r} under {prefix!r} must be a string without '/'")
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{name}/")
        else:
            flat[f"{prefix}{name}"] = np.asarray(value, order="C")
    return flat


def _unflatten(flat: Mapping[str, np.ndarray]) -> dict[str, Any]:
    params: dict[str, Any] = {}
    for name, value in flat.items():
        *folders, leaf = name.split("/")
        node = params
        for part in folders:
            node = node.setdefault(part, {})
        node[leaf] = value
    return params
