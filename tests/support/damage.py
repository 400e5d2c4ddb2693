"""Random damage to files."""

import random
from collections.abc import Callable
from pathlib import Path


def _flip_bit(data: bytes, rng: random.Random) -> bytes:
    index = rng.randrange(len(data))
    return data[:index] + bytes([data[index] ^ 1 << rng.randrange(8)]) + data[index + 1 :]


def _cut_end(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _zero_bytes(data: bytes, rng: random.Random) -> bytes:
    first_index = rng.randrange(len(data))
    length = min(rng.choice([1, 8, 512]), len(data) - first_index)
    return data[:first_index] + bytes(length) + data[first_index + length :]


def _move_to_end(data: bytes, rng: random.Random) -> bytes:
    first_index, last_index = sorted(rng.choices(range(len(data)), k=2))
    return data[:first_index] + data[last_index:] + data[first_index:last_index]


def _delete_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    del lines[rng.randrange(len(lines))]
    return b"".join(lines)


def _change_digit(data: bytes, rng: random.Random) -> bytes:
    """Replace a digit, or any byte if there are no digits, by a digit."""
    digit_indices = [index for index, byte in enumerate(data) if byte in b"0123456789"]
    index = rng.choice(digit_indices or range(len(data)))
    return data[:index] + str(rng.randrange(10)).encode() + data[index + 1 :]


KINDS: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flip_bit,
    _cut_end,
    _zero_bytes,
    _move_to_end,
    _delete_line,
    _change_digit,
)


def damage(folder: Path, rng: random.Random) -> Path:
    """Change or remove a random file below a folder, and return its path."""
    file = rng.choice(sorted(path for path in folder.rglob("*") if path.is_file() and path.stat().st_size))
    original_data = file.read_bytes()
    if rng.random() < 0.1:
        file.unlink()
        return file

    # Some changes have no effect, such as zeroing zeros; draw until one has.
    damaged_data = original_data
    while damaged_data == original_data:
        damaged_data = rng.choice(KINDS)(original_data, rng)
    file.write_bytes(damaged_data)
    return file
