"""What a checkpoint says about itself."""

import json
from collections.abc import Mapping
from importlib import metadata
from typing import Any

from jaxnav.errors import InputError

#: Raised whenever the layout of the stored state changes in a way that older code cannot read.
FORMAT_VERSION = 1

_PACKAGES = ("jaxnav", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


def make_manifest(config: Mapping[str, Any]) -> dict[str, Any]:
    """Make the manifest of a run.

    It holds `format_version`, `config` and package `versions`, as JSON gives them back.

    Args:
      config: nested mapping of JSON values; tuples become lists.
    """
    manifest = {"format_version": FORMAT_VERSION, "config": config, "versions": _versions()}
    return json.loads(json.dumps(manifest))


def check_manifest(where: object, saved: Any, expected: Mapping[str, Any]) -> None:
    """Refuse a checkpoint of another format version or config.

    Package versions may differ.

    Args:
      where: the checkpoint, for the message.
      saved: what the checkpoint holds as its manifest.
      expected: the manifest of the run that wants to go on from it.

    Raises:
      InputError: another format version, no manifest at all, or another config; names the keys and both values.
    """
    if not isinstance(saved, dict) or "format_version" not in saved:
        raise InputError(f"{where}: holds no manifest, so it is no jaxnav checkpoint; choose another run directory")
    if saved["format_version"] != expected["format_version"]:
        raise InputError(
            f"{where}: has format version {saved['format_version']!r}, this code reads version "
            f"{expected['format_version']!r}; use the jaxnav that wrote it ({saved.get('versions', {}).get('jaxnav')})"
        )
    if different := differences(saved["config"], expected["config"]):
        raise InputError(
            f"{where}: was saved under another config (saved != asked for): {'; '.join(different)}; "
            "restore these values or choose another run directory"
        )


def differences(a: Mapping[str, Any], b: Mapping[str, Any], prefix: str = "") -> list[str]:
    """List where two nested mappings differ.

    `"train.lr: 0.1 != 0.2"` per dotted key, `(absent)` for a missing one.
    """
    lines = []
    for key in sorted(a.keys() | b.keys()):
        left, right = a.get(key, _ABSENT), b.get(key, _ABSENT)
        if isinstance(left, Mapping) and isinstance(right, Mapping):
            lines += differences(left, right, f"{prefix}{key}.")
        elif left != right:
            lines.append(f"{prefix}{key}: {left!r} != {right!r}")
    return lines


class _Absent:
    def __repr__(self) -> str:
        return "(absent)"


_ABSENT = _Absent()


def _versions() -> dict[str, str]:
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"  # run from a source tree
    return versions
