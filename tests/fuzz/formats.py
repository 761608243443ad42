"""Damage that a format suggests: checksums, lengths and packing are right, what they hold is not.

Without it nearly every damaged file ends at the first checksum, and nothing behind that is ever tried.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.fuzz.contents import json_text
from tests.fuzz.images import image_bomb, jpeg_inside, png_inside, png_text
from tests.fuzz.logs import bag_bomb, bag_inside, database, database_rows, mcap_records, mcap_rewritten
from tests.fuzz.mutate import damaged, in_place, replace

Special = Callable[[Path, np.random.Generator], bool]


def any_special(path: Path, rng: np.random.Generator) -> bool:
    """What suits the extension; False if nothing does, or if the file is none of its kind any more."""
    kinds: dict[str, tuple[Special, ...]] = {
        ".png": (image_bomb, *[png_inside] * 9),
        ".jpg": (image_bomb, *[jpeg_inside] * 9),
        ".mcap": (mcap_rewritten, mcap_rewritten, mcap_rewritten, mcap_records),
        ".bag": (bag_bomb, *[bag_inside] * 24),
        ".db3": (database, database_rows, database_rows),
        ".json": (json_inside,),
        ".glb": (glb_inside,),
        ".ply": (ply_inside,),
    }
    suffix = path.suffix.lower().replace("jpeg", "jpg")
    if suffix not in kinds or path.is_symlink():
        return False
    choices = kinds[suffix]
    return choices[int(rng.integers(len(choices)))](path, rng)


def json_inside(path: Path, rng: np.random.Generator) -> bool:
    """One value of a JSON file."""
    return replace(path, json_text(path.read_bytes(), rng))


def glb_inside(path: Path, rng: np.random.Generator) -> bool:
    """A binary glTF file with right lengths: one value of its JSON, something in its arrays, or in an image."""
    data = path.read_bytes()
    if len(data) < 20 or data[:4] != b"glTF":
        return False
    (size,) = struct.unpack_from("<I", data, 12)
    text, blob = data[20 : 20 + size], data[28 + size :]
    kind = rng.random()
    image = blob.find(b"\x89PNG")
    if kind < 0.55:
        text = json_text(text, rng)
    elif kind < 0.75 and image >= 0:
        blob = blob[:image] + png_text(blob[image:], rng, keep=True)
    else:
        blob = in_place(blob, rng)
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return replace(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def ply_inside(path: Path, rng: np.random.Generator) -> bool:
    """A PLY file with damage to its header alone, or to its rows alone."""
    header, end, rows = path.read_bytes().partition(b"end_header\n")
    if not end:
        return False
    if rng.random() < 0.4:
        return replace(path, damaged(header, rng) + end + rows)
    return replace(path, header + end + in_place(rows, rng))
