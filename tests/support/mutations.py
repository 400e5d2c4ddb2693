"""Changed copies of JSON values, texts and bytes, and changed records in files with a digest."""

import contextlib
import copy
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
    lambda children: st.lists(children, max_size=4) | st.dictionaries(st.text(max_size=2), children, max_size=2),
    max_leaves=6,
)


def changed(document: Any, *keys_and_value: Any) -> Any:
    """Return a copy with one value replaced; the arguments are the path of keys to it, and the new value."""
    *keys, last_key, value = keys_and_value
    changed_copy = copy.deepcopy(document)
    _follow_keys(changed_copy, keys)[last_key] = value
    return changed_copy


def without(document: Any, *keys: Any) -> Any:
    """Return a copy without one value; the arguments are the path of keys to it."""
    *parent_keys, last_key = keys
    changed_copy = copy.deepcopy(document)
    del _follow_keys(changed_copy, parent_keys)[last_key]
    return changed_copy


def _follow_keys(document: Any, keys: Sequence[Any]) -> Any:
    """Return the value at a path of keys."""
    node = document
    for key in keys:
        node = node[key]
    return node


@contextlib.contextmanager
def resigned(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the record of a file to be changed, and write it with a new digest, as another version of jaxnav would."""
    record = json.loads(path.read_text())
    del record[DIGEST_KEY]
    yield record
    write_json_with_digest(path, record)


def edited(document: Any, choose: Callable[[Sequence[Any]], Any], draw_value: Callable[[], Any]) -> Any:
    """Return a copy with one value deleted or replaced.

    Args:
      document: JSON value; an empty one is returned unchanged.
      choose: draws one of several options.
      draw_value: draws a replacement.
    """
    edited_copy = copy.deepcopy(document)
    node = edited_copy
    while node:
        key = choose(sorted(node, key=str) if isinstance(node, dict) else range(len(node)))

        # Four times in five, go on inside a value that has parts.
        if isinstance(node[key], dict | list) and node[key] and choose(range(5)):
            node = node[key]
            continue

        # Delete the value, or replace it.
        if choose([False, True]):
            del node[key]
        else:
            node[key] = draw_value()
        break
    return edited_copy


@st.composite
def mutated(draw: st.DrawFn, document: Any) -> Any:
    """Draw copies of a JSON value with one edit."""
    return edited(document, lambda options: draw(st.sampled_from(options)), lambda: draw(JSON_VALUES))


@st.composite
def mutated_text(draw: st.DrawFn, text: str) -> str:
    """Draw copies of a text with one edit: up to 20 characters are replaced by up to 6."""
    start = draw(st.integers(0, len(text)))
    end = min(start + draw(st.integers(0, 20)), len(text))
    return text[:start] + draw(st.text('[]{}",.:-#0123456789eNn\\u\n ', max_size=6)) + text[end:]


@st.composite
def mutated_bytes(draw: st.DrawFn, content: bytes) -> bytes:
    """Draw copies of bytes with one byte replaced, the end cut off, and up to 4 bytes added."""
    index = draw(st.integers(0, len(content) - 1))
    end = draw(st.integers(0, len(content)))
    new_byte = bytes([draw(st.integers(0, 255))])
    return content[:index] + new_byte + content[index + 1 : end] + draw(st.binary(max_size=4))
