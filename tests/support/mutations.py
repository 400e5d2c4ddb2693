"""Changed copies of JSON values, texts and bytes, and changed records in signed files."""

import contextlib
import copy
import functools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from jaxnav.store.files import DIGEST_KEY, write_json_with_digest

JSON_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=4)
    | st.sampled_from([float("nan"), 1e308, 10**400, -1.0, "Floor", "\ud800"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=2), inner, max_size=2),
    max_leaves=6,
)


def changed(document: Any, *keys_and_value: Any) -> Any:
    """Return a copy with the value at some keys replaced."""
    copied = copy.deepcopy(document)
    *keys, last, value = keys_and_value
    functools.reduce(lambda node, key: node[key], keys, copied)[last] = value
    return copied


def without(document: Any, *keys: Any) -> Any:
    """Return a copy with the value at some keys deleted."""
    copied = copy.deepcopy(document)
    del functools.reduce(lambda node, key: node[key], keys[:-1], copied)[keys[-1]]
    return copied


@contextlib.contextmanager
def resigned(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the record in a signed file to be changed, and sign it again, as another version of the code would."""
    record = json.loads(path.read_text())
    del record[DIGEST_KEY]
    yield record
    write_json_with_digest(path, record)


def edited(document: Any, choose: Callable[[Sequence[Any]], Any], draw_value: Callable[[], Any]) -> Any:
    """Return a copy with one value deleted or replaced.

    Args:
      document: JSON value; an empty one is returned as it is.
      choose: draws one of several.
      draw_value: draws what takes the place of a value.
    """
    node = copied = copy.deepcopy(document)
    while node:
        key = choose(sorted(node, key=str) if isinstance(node, dict) else range(len(node)))
        if isinstance(node[key], dict | list) and node[key] and choose(range(5)):
            node = node[key]
            continue
        if choose([False, True]):
            del node[key]
        else:
            node[key] = draw_value()
        break
    return copied


@st.composite
def mutated(draw: st.DrawFn, document: Any) -> Any:
    """Draw copies of a JSON value with one edit."""
    return edited(document, lambda options: draw(st.sampled_from(options)), lambda: draw(JSON_VALUES))


@st.composite
def mutated_text(draw: st.DrawFn, text: str) -> str:
    """Draw copies of a text with one edit.

    Up to 20 characters are replaced by up to 6.
    """
    start = draw(st.integers(0, len(text)))
    end = min(start + draw(st.integers(0, 20)), len(text))
    return text[:start] + draw(st.text('[]{}",.:-#0123456789eNn\\u\n ', max_size=6)) + text[end:]


@st.composite
def mutated_bytes(draw: st.DrawFn, content: bytes) -> bytes:
    """Draw copies of bytes of which one is replaced, the end is cut off, and up to 4 are added."""
    index = draw(st.integers(0, len(content) - 1))
    end = draw(st.integers(0, len(content)))
    new_byte = bytes([draw(st.integers(0, 255))])
    return content[:index] + new_byte + content[index + 1 : end] + draw(st.binary(max_size=4))
