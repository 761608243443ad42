"""Damage for files and folders: what discs, networks, other programs and strangers do to them. One seed, one damage."""

from __future__ import annotations

import os
import re
import shutil
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

HOSTILE = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)
REALS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-300, 1e300, 1e38, 1e9, -1e9, 0.5)
NUMBERS = (
    *("nan", "inf", "-inf", "1e309", "-1", "0", "1e-300", "99999999999999999999", "4294967296", "0x10"),
    *("", "1.5", "-0", "9" * 400, "\u0661", "1_000", "true", "null", "[]", "{}"),
)
EVIL = f"{tempfile.gettempdir()}/duagc-fuzz-evil"  # nothing may write there
PATHS = (
    EVIL,
    "../../../evil",
    "/etc/passwd",
    "/dev/zero",
    "..",
    ".",
    "a\0b",
    "x" * 5000,
    "~",
    "con",
    "\n",
    "a/../../evil",
)
NAMES = ("..", "evil\nname", "-rf", "x" * 200, "name with  blanks", "\u202e.png", "*", "%s%n")
TEXT = re.compile(rb"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
WORDS = re.compile(rb"[\w./-]*\w[\w./-]*")
LARGEST = 1 << 22
Bytes = bytes


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes with one to four damages."""
    kinds = [truncate, flip, number, real, cut_out, repeat, insert, zero, swap]
    if _is_text(data):
        kinds += [text_number, text_other, text_word, text_line] * 5
    for _ in range(int(rng.choice([1, 1, 1, 2, 4]))):
        data = kinds[int(rng.integers(len(kinds)))](data, rng)[:LARGEST]
    return data


def _is_text(data: bytes) -> bool:
    head = data[:2000]
    return bool(head) and sum(32 <= c < 127 or c in (9, 10, 13) for c in head) > 0.95 * len(head)


def _place(data: bytes, rng: np.random.Generator) -> int:
    """Somewhere; the beginning and the end, where sizes and counts stand, come more often."""
    n = len(data)
    kind = rng.random()
    if kind < 0.4:
        return int(rng.integers(0, min(n, 256) + 1))
    if kind < 0.6:
        return int(rng.integers(max(0, n - 256), n + 1))
    return int(rng.integers(0, n + 1))


def truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.choice([1, 2, 8, 64]))):
        if out:
            out[min(_place(data, rng), len(out) - 1)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def number(data: bytes, rng: np.random.Generator) -> bytes:
    """A hostile integer of 1 to 8 bytes in either order."""
    value, size = int(rng.choice(np.array(HOSTILE, dtype=np.uint64))), int(rng.choice([1, 2, 4, 8]))
    order = "<" if rng.random() < 0.8 else ">"
    packed = struct.pack(order + "BHIQ"[(1, 2, 4, 8).index(size)], value & (256**size - 1))
    at = _place(data, rng)
    return data[:at] + packed + data[at + size :]


def real(data: bytes, rng: np.random.Generator) -> bytes:
    """A hostile number of 4 or 8 bytes with a fraction, where such a number may lie."""
    value, size = float(rng.choice(REALS)), int(rng.choice([4, 8]))
    with np.errstate(over="ignore"):
        packed = np.array(value, dtype=f"<f{size}").tobytes()
    at = _place(data, rng) // 4 * 4
    return data[:at] + packed + data[at + size :]


def cut_out(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at + int(rng.choice([1, 4, 30, 4000])) :]


def in_place(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage that keeps the length."""
    kinds = (flip, number, real, zero)
    return kinds[int(rng.integers(len(kinds)))](data, rng)[: len(data)].ljust(len(data), b"\0")


def repeat(data: bytes, rng: np.random.Generator) -> bytes:
    at, size = _place(data, rng), int(rng.choice([1, 8, 100, 5000]))
    return data[:at] + data[at : at + size] * int(rng.choice([2, 3, 50])) + data[at + size :]


def insert(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.bytes(int(rng.choice([1, 7, 100]))) + data[at:]


def zero(data: bytes, rng: np.random.Generator) -> bytes:
    at, size = _place(data, rng), int(rng.choice([4, 64, 4096]))
    return data[:at] + bytes(len(data[at : at + size])) + data[at + size :]


def swap(data: bytes, rng: np.random.Generator) -> bytes:
    """Two pieces in each other's place."""
    a, b = sorted((_place(data, rng), _place(data, rng)))
    size = min(int(rng.choice([1, 16, 1000])), b - a)
    return data[:a] + data[b : b + size] + data[a + size : b] + data[a : a + size] + data[b + size :]


def _replace_match(data: bytes, pattern: re.Pattern[bytes], new: str, rng: np.random.Generator) -> bytes:
    found = list(pattern.finditer(data))
    if not found:
        return data
    match = found[int(rng.integers(len(found)))]
    return data[: match.start()] + new.encode() + data[match.end() :]


def text_number(data: bytes, rng: np.random.Generator) -> bytes:
    return _replace_match(data, TEXT, str(rng.choice(NUMBERS)), rng)


def text_other(data: bytes, rng: np.random.Generator) -> bytes:
    """A number from elsewhere in the text: of the right kind, and wrong."""
    found = TEXT.findall(data)
    return _replace_match(data, TEXT, found[int(rng.integers(len(found)))].decode(), rng) if found else data


def text_word(data: bytes, rng: np.random.Generator) -> bytes:
    return _replace_match(data, WORDS, PATHS[int(rng.integers(len(PATHS)))], rng)


def text_line(data: bytes, rng: np.random.Generator) -> bytes:
    """A line that is missing, twice, or somewhere else."""
    lines = data.splitlines(keepends=True)
    a, b = (int(rng.integers(len(lines))) for _ in range(2)) if lines else (0, 0)
    kind = int(rng.integers(3))
    if lines:
        line = lines.pop(a) if kind != 1 else lines[a]
        if kind:
            lines.insert(b, line)
    return b"".join(lines)


def replace(path: Path, data: bytes) -> bool:
    """Put other bytes in a file; files of a copied folder are links to the seed."""
    path.unlink()
    path.write_bytes(data)
    return True


# --- folders ---------------------------------------------------------------------------------------------------------


def damage(root: Path, rng: np.random.Generator, special: Callable[[Path, np.random.Generator], bool]) -> str:
    """Damage one file below `root`, or its name; returns what was done. special: damage that the format suggests, done
    in most cases; False if it does not apply."""
    files = sorted(p for p in root.rglob("*") if p.is_file()) if root.is_dir() else [root]
    path = files[int(rng.integers(len(files)))]
    if rng.random() < 0.6 and special(path, rng):
        return f"special {path.name}"
    if rng.random() < 0.12 and root.is_dir():
        return _damage_name(root, path, rng)
    new = damaged(path.read_bytes(), rng)
    replace(path, new)
    return f"bytes {path.name}"


def _damage_name(root: Path, path: Path, rng: np.random.Generator) -> str:
    kind = int(rng.integers(9))
    if kind == 0:
        path.unlink()
    elif kind == 1:
        path.rename(path.with_name(NAMES[int(rng.integers(len(NAMES)))] + path.suffix))
    elif kind in (2, 3, 4):
        path.unlink()
        path.symlink_to(("/dev/zero", "/etc", path.name)[kind - 2])
    elif kind == 5:
        path.unlink()
        path.mkdir()
    elif kind == 6:
        path.unlink()
        os.mkfifo(path)
    elif kind == 7:
        shutil.copy(path, path.with_name("copy of " + path.name))
    else:
        numbers = re.search(r"\d+", path.name)
        new = re.sub(r"\d+", "9" * 30, path.name, count=1) if numbers else path.name + ".bak"
        path.rename(path.with_name(new))
    return f"name {kind} {path.name}"
