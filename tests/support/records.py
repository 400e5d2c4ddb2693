"""Signed records, changed as by another version of the code."""

import contextlib
import json

from jaxnav.store.signed import DIGEST, write_signed


@contextlib.contextmanager
def resigned(path):
    """Yield the record in a file to be changed, and sign it again."""
    record = json.loads(path.read_text())
    del record[DIGEST]
    yield record
    write_signed(path, record)
