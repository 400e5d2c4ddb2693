"""The methods of this package by name, and how to find methods of other packages."""

import dataclasses
import difflib
import functools
import importlib
from importlib import metadata

from jaxnav.errors import InputError
from jaxnav.policies.method import Method
from jaxnav.policies.methods.belief import BELIEF
from jaxnav.policies.methods.eotp import EOTP
from jaxnav.policies.methods.hoz import HOZ
from jaxnav.policies.methods.org import ORG
from jaxnav.policies.methods.rgb import ANONYMOUS, RGB
from jaxnav.policies.methods.savn import SAVN
from jaxnav.policies.methods.semexp import SEMEXP
from jaxnav.policies.methods.sp import SP
from jaxnav.policies.methods.tpn import TPN
from jaxnav.policies.methods.vtnet import VTNET

#: The methods of this package.
METHODS = {method.name: method for method in (ANONYMOUS, BELIEF, EOTP, HOZ, ORG, RGB, SAVN, SEMEXP, SP, TPN, VTNET)}
#: Group of the entry points by which other packages announce their methods.
ENTRY_POINT_GROUP = "jaxnav.methods"


@functools.lru_cache
def find_method(name: str) -> Method:
    """Find a method by its name.

    Args:
      name: a key of `METHODS`, an entry point of the group `jaxnav.methods`, or `package.module:NAME`.

    Raises:
      InputError: there is no such method, its module cannot be imported, or it is no `Method`.
    """
    if name in METHODS:
        return METHODS[name]
    # Names without a path may be entry points of installed packages.
    if ":" not in name:
        return dataclasses.replace(find_method(_entry_point_path(name)), name=name)

    # A path names a module and an attribute of it; foreign modules may fail in any way.
    module_name, _, attribute = name.partition(":")
    try:
        method = getattr(importlib.import_module(module_name), attribute)
    except Exception as error:  # any exception that the foreign module raises
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"method {name!r}: cannot be imported ({reason}); install or fix its package") from error
    if not isinstance(method, Method):
        problem = f"is of type {type(method).__name__}, not jaxnav.Method"
        raise InputError(f"method {name!r}: {problem}; name a jaxnav.Method(Experience)")

    # Runs and exports store this name, so that the method is found again.
    return dataclasses.replace(method, name=name)


def method_label(name: str) -> str:
    """Return the name of a method as tables and titles print it, for example `ORG`.

    Args:
      name: a name that `find_method` accepts; of `package.module:NAME` only the last part is printed.
    """
    return name.rpartition(":")[2].upper()


def _entry_point_path(name: str) -> str:
    """Return the `package.module:NAME` that an entry point announces.

    Raises:
      InputError: there is no such entry point, or it announces a module instead of a method.
    """
    entry_points = {point.name: point for point in metadata.entry_points(group=ENTRY_POINT_GROUP)}
    if name in entry_points:
        path = entry_points[name].value
        if ":" not in path:
            raise InputError(f"method {name!r}: its entry point announces {path!r}; announce package.module:NAME")
        return path

    # Nothing has this name: suggest the closest one.
    method_names = [*METHODS, *entry_points]
    close_matches = difflib.get_close_matches(name, method_names, n=1)
    hint = f"did you mean {close_matches[0]!r}?" if close_matches else f"choose one of {', '.join(method_names)}"
    raise InputError(f"method {name!r}: is unknown; {hint} (give your own method as package.module:NAME)")
