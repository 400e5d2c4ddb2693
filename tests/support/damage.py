"""Damage to files, drawn at random."""

import random
from collections.abc import Callable
from pathlib import Path


def _flipped(data: bytes, draw: random.Random) -> bytes:
    index = draw.randrange(len(data))
    return data[:index] + bytes([data[index] ^ 1 << draw.randrange(8)]) + data[index + 1 :]


def _cut(data: bytes, draw: random.Random) -> bytes:
    return data[: draw.randrange(len(data))]


def _zeroed(data: bytes, draw: random.Random) -> bytes:
    first = draw.randrange(len(data))
    length = min(draw.choice([1, 8, 512]), len(data) - first)
    return data[:first] + bytes(length) + data[first + length :]


def _moved(data: bytes, draw: random.Random) -> bytes:
    first, last = sorted(draw.choices(range(len(data)), k=2))
    return data[:first] + data[last:] + data[first:last]


def _line_lost(data: bytes, draw: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    del lines[draw.randrange(len(lines))]
    return b"".join(lines)


def _digit_changed(data: bytes, draw: random.Random) -> bytes:
    digit_indices = [index for index, byte in enumerate(data) if byte in b"0123456789"]
    index = draw.choice(digit_indices or range(len(data)))
    return data[:index] + str(draw.randrange(10)).encode() + data[index + 1 :]


KINDS: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flipped,
    _cut,
    _zeroed,
    _moved,
    _line_lost,
    _digit_changed,
)


def damage(folder: Path, draw: random.Random) -> Path:
    """Change one file below a folder at random, or remove it; return its path."""
    file = draw.choice(sorted(path for path in folder.rglob("*") if path.is_file() and path.stat().st_size))
    before = after = file.read_bytes()
    if draw.random() < 0.1:
        file.unlink()
        return file
    while after == before:
        after = draw.choice(KINDS)(before, draw)
    file.write_bytes(after)
    return file
