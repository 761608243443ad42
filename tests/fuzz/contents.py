"""Damage to what files hold: messages, JSON, fields of Protocol Buffers, with sound frames around it."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from tests.fuzz.images import png_text
from tests.fuzz.mutate import HOSTILE, NUMBERS, PATHS, damaged, in_place, number, real


def content(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage to one message of any encoding, in half of the cases so that its frame stays sound."""
    kind = rng.random()
    if kind < 0.3:
        return damaged(data, rng)
    if data[:1] == b"{":
        return json_text(data, rng)
    at = data.find(b"\x89PNG")
    if kind < 0.5 and at >= 0:
        image = data[at:]
        return data[:at] + png_text(image, rng, keep=True)
    if kind < 0.75:
        return proto(data, rng)
    return in_place(data, rng)


def proto(data: bytes, rng: np.random.Generator, depth: int = 4) -> bytes:
    """Damage to one field of a message of Protocol Buffers, with right lengths around it; in place if it is none."""
    fields: list[tuple[bytes, bytes, bool]] = []  # tag, content, has a length
    at = 0
    try:
        while at < len(data):
            start = at
            tag, at = _varint(data, at)
            end = at
            if tag & 7 == 2:
                size, at = _varint(data, at)
                fields.append((data[start:end], data[at : at + size], True))
                at += size
            elif tag & 7 in (0, 1, 5):
                after = _varint(data, at)[1] if tag & 7 == 0 else at + (8 if tag & 7 == 1 else 4)
                fields.append((data[start:end], data[at:after], False))
                at = after
            else:
                return in_place(data, rng)
    except IndexError:
        return in_place(data, rng)
    if at != len(data) or not fields:
        return in_place(data, rng)
    victim, kind = int(rng.integers(len(fields))), rng.random()
    tag_bytes, inside, framed = fields[victim]
    if kind < 0.1:
        del fields[victim]
    elif kind < 0.2:
        fields.append(fields[victim])
    elif not framed:
        fields[victim] = tag_bytes, _hostile_scalar(inside, tag_bytes[0] & 7, rng), False
    elif kind < 0.7 and depth:
        fields[victim] = tag_bytes, proto(inside, rng, depth - 1), True
    else:
        fields[victim] = tag_bytes, damaged(inside, rng), True
    return b"".join(t + (_as_varint(len(c)) if f else b"") + c for t, c, f in fields)


def _hostile_scalar(old: bytes, wire: int, rng: np.random.Generator) -> bytes:
    if wire == 0:
        return _as_varint(int(HOSTILE[int(rng.integers(len(HOSTILE)))]))
    return (real if rng.random() < 0.5 else number)(old, rng)[: len(old)].ljust(len(old), b"\0")


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        value |= (data[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if data[at - 1] < 0x80:
            return value, at
        if shift > 63:
            raise IndexError


def _as_varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def json_text(data: bytes, rng: np.random.Generator) -> bytes:
    """A text of JSON with one value that is gone, another, or of another kind; bytes damaged if it is none."""
    try:
        tree = json.loads(data)
    except ValueError:
        return damaged(data, rng)
    places = list(_places(tree))
    if not places:
        return damaged(data, rng)
    holder, key = places[int(rng.integers(len(places)))]
    kind = int(rng.integers(6))
    if kind == 0:
        del holder[key]
    elif kind == 1:
        other, name = places[int(rng.integers(len(places)))]
        holder[key] = json.loads(json.dumps(other[name]))
    elif kind == 2 and isinstance(holder[key], str):
        holder[key] = damaged(holder[key].encode(), rng).decode(errors="replace")
    elif kind == 3:
        holder[key] = PATHS[int(rng.integers(len(PATHS)))]
    else:
        values = (
            *HOSTILE,
            -1,
            0.5,
            1e300,
            float("nan"),
            float("inf"),
            None,
            True,
            "",
            [],
            {},
            [[]],
            *NUMBERS,
        )
        holder[key] = values[int(rng.integers(len(values)))]
    return json.dumps(tree).encode()


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Every value below, as what holds it and its key there."""
    found: list[tuple[Any, Any]] = []
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        keys = node.keys() if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        for key in keys:
            found.append((node, key))
            waiting.append(node[key])
    return found
