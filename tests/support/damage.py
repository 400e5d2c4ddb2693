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
    first_index = draw.randrange(len(data))
    length = min(draw.choice([1, 8, 512]), len(data) - first_index)
    return data[:first_index] + bytes(length) + data[first_index + length :]


def _moved(data: bytes, draw: random.Random) -> bytes:
    first_index, last_index = sorted(draw.choices(range(len(data)), k=2))
    return data[:first_index] + data[last_index:] + data[first_index:last_index]


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
    data_before = data_after = file.read_bytes()
    if draw.random() < 0.1:
        file.unlink()
        return file
    while data_after == data_before:
        data_after = draw.choice(KINDS)(data_before, draw)
    file.write_bytes(data_after)
    return file
