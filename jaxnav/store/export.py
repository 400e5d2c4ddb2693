"""Exported policies: a folder with `params.safetensors` and `policy.json`, readable with NumPy and safetensors.

`export_params` writes the folder, `load_params` verifies and reads it.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from jaxnav.errors import InputError
from jaxnav.store.files import WRITTEN_BY_0_1, verify_digest, write_atomic, write_json_with_digest

#: Version of the format of the two files.
POLICY_FORMAT_VERSION = 3
_FORMAT_VERSION_OF_0_1 = 2

#: Largest difference of two equal exports, absolute and relative. Other hardware sums in another order, which changes
#: the last digits of float32.
TOLERANCE = 1e-5

#: File with all arrays of the policy: network parameters, layout priors and method knowledge.
PARAMS_FILE = "params.safetensors"
#: File that describes the policy; it is written last.
POLICY_FILE = "policy.json"


class _OtherVersionError(InputError):
    """Error about an export of another format version."""


def export_params(
    folder: Path,
    arrays: Mapping[str, Any],
    fields: Mapping[str, Any],
    complete_fields: Callable[[dict[str, Any]], dict[str, Any]] = dict,
) -> None:
    """Write the arrays of a policy and the fields that describe it.

    `params.safetensors` has flat names, `a/b/kernel`. `policy.json` has `format_version`, the fields as `spec`, the
    SHA-256 of the arrays and a digest of its own. Because `policy.json` is written last, `load_params` refuses an
    export that was cut short. An equal export stays, a damaged one is replaced, and a different one is refused.
    Exports are equal if all fields, names, shapes and dtypes are, and if all numbers differ by at most `TOLERANCE`.

    Args:
      folder: created if missing.
      arrays: nested dict of arrays; names are strings without `/`.
      fields: JSON values by name, such as the specification of the network.
      complete_fields: adds to the fields of an export those that an earlier version did not write, before exports are
        compared.

    Raises:
      InputError: the folder holds another export, or one of another format version.
      TypeError: a name in `arrays` is no string or contains `/`.
    """
    flat_arrays = _flatten(arrays)
    array_bytes = safetensors.numpy.save(flat_arrays)

    # An intact export is never overwritten.
    try:
        existing_policy = _read_policy(folder)
    except _OtherVersionError:
        raise
    except InputError:  # no export there, or a damaged one
        # The description has the digest of the arrays, so that both files are known to belong together.
        policy = {
            "format_version": POLICY_FORMAT_VERSION,
            "params_sha256": hashlib.sha256(array_bytes).hexdigest(),
            "spec": fields,
        }
        write_atomic(folder / PARAMS_FILE, array_bytes)
        write_json_with_digest(folder / POLICY_FILE, policy)
        return

    # Compare fields as JSON, in which tuples are lists.
    new_fields = json.loads(json.dumps(fields))
    has_equal_fields = complete_fields(existing_policy["spec"]) == complete_fields(new_fields)
    existing_arrays = safetensors.numpy.load_file(folder / PARAMS_FILE)
    if not (has_equal_fields and _are_close(existing_arrays, flat_arrays)):
        raise InputError(f"{folder}: holds another policy, which is not overwritten; move or remove the folder")


def _are_close(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray]) -> bool:
    """True if two exports have equal names, shapes and dtypes, and equal numbers within `TOLERANCE`."""
    if first.keys() != second.keys():
        return False
    for name, array in first.items():
        other_array = second[name]
        if array.shape != other_array.shape or array.dtype != other_array.dtype:
            return False
        # Integers and flags are exact.
        tolerance = TOLERANCE if np.issubdtype(array.dtype, np.inexact) else 0.0
        if not np.allclose(array, other_array, rtol=tolerance, atol=tolerance, equal_nan=True):
            return False
    return True


def load_params(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Load the arrays of an export, a nested dict of NumPy arrays, and its fields.

    Raises:
      InputError: no export there, another format version, or files that are damaged or do not belong together.
    """
    policy = _read_policy(folder)
    return _unflatten(safetensors.numpy.load_file(folder / PARAMS_FILE)), policy["spec"]


def _read_policy(folder: Path) -> dict[str, Any]:
    """Read `policy.json` and verify that the arrays belong to it.

    Raises:
      InputError: see `load_params`.
    """
    # Read the description, and compute the digest of the arrays.
    policy_path = folder / POLICY_FILE
    params_path = folder / PARAMS_FILE
    try:
        policy = json.loads(policy_path.read_bytes())
        with params_path.open("rb") as params_file:
            params_sha256 = hashlib.file_digest(params_file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{folder}: not an exported policy ({error.strerror}: {error.filename}); export it") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{policy_path}: not JSON ({error}); export the policy again") from error

    # Check the version before the digest: another version may compute it differently.
    if not isinstance(policy, dict) or not {"format_version", "params_sha256", "spec"} <= policy.keys():
        raise InputError(f"{policy_path}: lacks format_version, params_sha256 or spec; export the policy again")
    if policy["format_version"] == _FORMAT_VERSION_OF_0_1:
        raise _OtherVersionError(f"{policy_path}: {WRITTEN_BY_0_1}")
    if policy["format_version"] != POLICY_FORMAT_VERSION:
        raise _OtherVersionError(
            f"{policy_path}: has format version {policy['format_version']!r}, this code reads version "
            f"{POLICY_FORMAT_VERSION}; export the policy again"
        )

    # Both files must be intact and belong together.
    policy = verify_digest(policy_path, policy, "export the policy again")
    if params_sha256 != policy["params_sha256"]:
        raise InputError(f"{params_path}: does not belong to {POLICY_FILE} or is damaged; export the policy again")
    return policy


def _flatten(arrays: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    """Return nested arrays by flat names, `a/b/kernel`."""
    flat_arrays = {}
    for name, value in arrays.items():
        if not isinstance(name, str) or "/" in name:
            raise TypeError(f"parameter name {name!r} under {prefix!r} must be a string without '/'")
        if isinstance(value, Mapping):
            flat_arrays |= _flatten(value, f"{prefix}{name}/")
        else:
            flat_arrays[f"{prefix}{name}"] = np.asarray(value, order="C")
    return flat_arrays


def _unflatten(flat_arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return arrays with flat names as nested dicts."""
    arrays: dict[str, Any] = {}
    for flat_name, array in flat_arrays.items():
        # Create the missing dicts on the way to the leaf.
        *parent_names, leaf_name = flat_name.split("/")
        parent_node = arrays
        for parent_name in parent_names:
            parent_node = parent_node.setdefault(parent_name, {})
        parent_node[leaf_name] = array
    return arrays
