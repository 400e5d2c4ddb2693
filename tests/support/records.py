"""Signed records, changed as by another version of the code."""

import contextlib
import json

from jaxnav.store.files import DIGEST_KEY, write_json_with_digest


@contextlib.contextmanager
def resigned(path):
    """Yield the record in a file to be changed, and sign it again."""
    record = json.loads(path.read_text())
    del record[DIGEST_KEY]
    yield record
    write_json_with_digest(path, record)
