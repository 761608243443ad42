"""Damage to images: their chunks and segments have right lengths and checksums, what they hold is wrong."""

from __future__ import annotations

import struct
import zlib
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from tests.fuzz.mutate import damaged, in_place, replace


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png_bomb(width: int, height: int, depth: int, kind: int) -> bytes:
    """A small file that is a large image."""
    body = zeros_deflated(height * (width * (3 if kind == 2 else 1) * depth // 8 + 1))
    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


@cache
def zeros_deflated(size: int) -> bytes:
    """So many zeros as zlib packs them: the packed form of some of them, over and over."""
    part = zlib.compressobj(9)
    block = part.compress(bytes(1 << 20)) + part.flush(zlib.Z_FULL_FLUSH)
    rest = zlib.compressobj(9, wbits=-15)
    end = rest.compress(bytes(size % (1 << 20))) + rest.flush()
    return block[:2] + block[2:] * (size >> 20) + end + struct.pack(">HH", size % 65521, 1)


def image_bomb(path: Path, rng: np.random.Generator) -> bool:
    """A large image, or one of another kind."""
    kind = int(rng.integers(6))
    if kind < 2:
        side = 20_000 if rng.random() < 0.1 else 8_500  # both too large; the smaller one takes less time
        return replace(path, png_bomb(side, side, *((8, 2), (16, 0))[kind]))
    shape = ((1, 1, 3), (3, 5), (48, 64, 4), (2, 3000, 3))[kind - 2]
    image = rng.integers(0, 255, shape).astype(np.uint8 if rng.random() < 0.5 else np.uint16)
    return replace(path, cv2.imencode(".png", image)[1].tobytes())


def png_inside(path: Path, rng: np.random.Generator) -> bool:
    """A PNG whose chunks have right checksums."""
    data = path.read_bytes()
    return data.startswith(b"\x89PNG") and replace(path, png_text(data, rng))


def png_text(data: bytes, rng: np.random.Generator, keep: bool = False) -> bytes:
    """A PNG with one thing wrong and right checksums. keep: of the same length, whatever follows the image stays."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
        if chunks[-1][0] == b"IEND":
            break
    if not chunks:
        return in_place(data, rng)
    rest = data[at:]
    victim = int(rng.integers(len(chunks)))
    name, inside = chunks[victim]
    kind = 0 if keep else int(rng.integers(8))
    if kind < 3:
        chunks[victim] = name, in_place(inside, rng)
    elif kind == 3:
        chunks[victim] = name, damaged(inside, rng)
    elif kind == 4:
        del chunks[victim]
    elif kind == 5:
        chunks.insert(int(rng.integers(len(chunks))), chunks[victim])
    elif kind == 6:
        chunks = [(n, zlib.compress(damaged(_inflated(c), rng)) if n == b"IDAT" else c) for n, c in chunks]
    else:
        bomb = b"name\0\0" + zeros_deflated(64 << 20)
        more = (
            (b"zTXt", bomb),
            (b"iCCP", bomb),
            (b"PLTE", bytes(768)),
            (b"tRNS", bytes(300)),
            (b"eXIf", rng.bytes(40)),
        )
        chunks.insert(1, more[int(rng.integers(len(more)))])
    return data[:8] + b"".join(_chunk(*chunk) for chunk in chunks) + rest


def _inflated(data: bytes) -> bytes:
    try:
        return zlib.decompressobj().decompress(data, 1 << 24)
    except zlib.error:
        return data


def jpeg_inside(path: Path, rng: np.random.Generator) -> bool:
    """A JPEG with damage in one of its segments, or with a larger size, another number of channels, a turn."""
    data = path.read_bytes()
    segments, at = [], 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        (size,) = struct.unpack_from(">H", data, at + 2)
        segments.append((data[at : at + 2], data[at + 4 : at + 2 + size]))
        at += 2 + size
    if not segments:
        return False
    victim, kind = int(rng.integers(len(segments))), int(rng.integers(4))
    marker, inside = segments[victim]
    if kind == 0:
        segments[victim] = marker, damaged(inside, rng)[:65533]
    elif kind == 1:
        turn = (
            b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0"
            + bytes([int(rng.integers(10))])
            + bytes(7)
        )
        segments.insert(0, (b"\xff\xe1", turn))
    elif kind == 2:
        frame = [
            (m, struct.pack(">BHH", 8, *rng.choice([0, 1, 7, 8, 4000, 65535], 2)) + c[5:])
            for m, c in segments
        ]
        segments = [f if m[1] in (0xC0, 0xC2) else (m, c) for f, (m, c) in zip(frame, segments, strict=True)]
    else:
        segments[victim] = marker, in_place(inside, rng)
    packed = b"".join(m + struct.pack(">H", len(c) + 2) + c for m, c in segments)
    return replace(path, data[:2] + packed + data[at:])
