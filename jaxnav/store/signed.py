"""JSON records with a digest, so that what is read is what was written."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError
from jaxnav.store.files import write_atomic

#: Key of the digest in a record. It guards against damage, not against forgery.
DIGEST = "digest"


def sign(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record as JSON gives it back, with its digest."""
    plain = json.loads(json.dumps(record, allow_nan=False))
    return plain | {DIGEST: _digest(plain)}


def verified(where: object, record: Mapping[str, Any], mend: str) -> dict[str, Any]:
    """Return a record without its digest.

    One without any was written by jaxnav 0.2.0 or earlier, and is taken as it is.

    Args:
      where: what the record is, for the message.
      record: as read.
      mend: what to do if it is damaged.

    Raises:
      InputError: the record does not have this digest.
    """
    plain = {name: value for name, value in record.items() if name != DIGEST}
    if DIGEST in record and record[DIGEST] != _digest(plain):
        raise InputError(f"{where}: is damaged or was changed by hand (its digest is another); {mend}")
    return plain


def write_signed(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record with its digest, whole or not at all.

    Raises:
      OSError: the file cannot be written; `path` is as it was.
    """
    write_atomic(path, (json.dumps(sign(record), indent=2) + "\n").encode())


def read_signed(path: Path, mend: str) -> dict[str, Any]:
    """Read a record, without its digest.

    Raises:
      InputError: the file is missing, no JSON object or damaged; names the file and the mend.
    """
    try:
        record = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {mend}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error}); {mend}") from error
    if not isinstance(record, dict):
        raise InputError(f"{path}: holds no JSON object; {mend}")
    return verified(path, record, mend)


def _digest(plain: Mapping[str, Any]) -> str:
    """Return 16 hexadecimal digits of the SHA-256 of a record."""
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]
