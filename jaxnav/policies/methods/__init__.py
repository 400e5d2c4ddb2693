"""The methods by name, and how to find those of other packages."""

import difflib
import functools
import importlib
from importlib import metadata

from jaxnav.errors import InputError
from jaxnav.policies.methods.anonymous import ANONYMOUS
from jaxnav.policies.methods.base import (
    Adaptation,
    Control,
    Experience,
    Knowledge,
    Method,
    Percept,
    Primitive,
    Stage,
    Tracker,
)
from jaxnav.policies.methods.eotp import EOTP
from jaxnav.policies.methods.hoz import HOZ
from jaxnav.policies.methods.org import ORG
from jaxnav.policies.methods.rgb import RGB
from jaxnav.policies.methods.savn import SAVN
from jaxnav.policies.methods.semexp import SEMEXP
from jaxnav.policies.methods.sp import SP
from jaxnav.policies.methods.tpn import TPN
from jaxnav.policies.methods.vtnet import VTNET

__all__ = [
    "METHODS",
    "Adaptation",
    "Control",
    "Experience",
    "Knowledge",
    "Method",
    "Percept",
    "Primitive",
    "Stage",
    "Tracker",
    "find_method",
]

#: The methods of this package.
METHODS = {
    "anonymous": ANONYMOUS,
    "eotp": EOTP,
    "hoz": HOZ,
    "org": ORG,
    "rgb": RGB,
    "savn": SAVN,
    "semexp": SEMEXP,
    "sp": SP,
    "tpn": TPN,
    "vtnet": VTNET,
}
#: Entry points of this group name the methods of other packages.
GROUP = "jaxnav.methods"


@functools.lru_cache
def find_method(name: str) -> Method:
    """Return the method of a name.

    Args:
      name: a key of `METHODS`, an entry point of the group `jaxnav.methods`, or `package.module:NAME`.

    Raises:
      InputError: there is no such method, its module cannot be imported, or it is no `Method`.
    """
    if name in METHODS:
        return METHODS[name]
    if ":" in name:
        module, _, attribute = name.partition(":")
        try:
            method = getattr(importlib.import_module(module), attribute)
        except Exception as error:  # whatever another's module raises
            reason = f"{type(error).__name__}: {error}"
            raise InputError(f"method {name!r}: cannot be imported ({reason}); install or mend its package") from error
    else:
        points = {point.name: point for point in metadata.entry_points(group=GROUP)}
        if name not in points:
            known = [*METHODS, *points]
            near = difflib.get_close_matches(name, known, n=1)
            mend = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(known)}"
            raise InputError(f"method {name!r}: is unknown; {mend} (others go by package.module:NAME)")
        return find_method(points[name].value)
    if not isinstance(method, Method):
        raise InputError(f"method {name!r}: is {type(method).__name__}, no jaxnav Method; make it Method(Experience)")
    return method
