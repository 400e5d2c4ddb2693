"""Cases of a test in three tiers: fast, slow and exhaustive."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def params_by_tier(cases: Iterable[Any], *, fast: Collection[Any] = (), slow: Collection[Any] = ()) -> list[Any]:
    """Make parameters of a test from its cases: those in `fast` have no mark, and those in neither are exhaustive.

    Args:
      cases: all cases; a tuple has several arguments of the test.
      fast: cases of the fast tests.
      slow: cases of the slow tests.
    """
    params = []
    for case in cases:
        arguments = case if isinstance(case, tuple) else (case,)
        if case in fast:
            params.append(pytest.param(*arguments))
        else:
            params.append(pytest.param(*arguments, marks=pytest.mark.slow if case in slow else pytest.mark.exhaustive))
    return params
