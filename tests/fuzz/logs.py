"""Damage to logs, MCAP, ROS 1 bags and ROS 2 databases: their frames and checksums are right, what they hold is not."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import zlib
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tests.fuzz.contents import content
from tests.fuzz.mutate import damaged, in_place, replace


@cache
def zstd_bomb(size: int) -> bytes:
    """A frame of zeros: blocks of one repeated byte, 128 KiB each."""
    count = size >> 17
    blocks = b"".join(
        struct.pack("<I", (1 << 17) << 3 | 2 | (i == count - 1))[:3] + b"\0" for i in range(count)
    )
    return struct.pack("<IBQ", 0xFD2FB528, 0b11100000, size) + blocks


@cache
def lz4_bomb(count: int) -> bytes:
    """A frame of `count` blocks of 4 MB of zeros."""
    kind = {"block_size": lz4.frame.BLOCKSIZE_MAX4MB, "block_linked": False, "store_size": False}
    one = lz4.frame.compress(bytes(4 << 20), **kind)
    return bytes(one[:7]) + bytes(one[7:-4]) * count + bytes(4)


def mcap_rewritten(path: Path, rng: np.random.Generator) -> bool:
    """The same log with right checksums and one thing wrong inside: a message, a schema, a topic, its metadata, times,
    a record in a chunk; or with a chunk that unpacks to 4 GB."""
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream)
            messages = list(reader.iter_messages(log_time_order=False))
            metadata = [(m.name, m.metadata) for m in reader.iter_metadata()]
            header = reader.get_header()
    except Exception:  # damaged already
        return False
    kind, victim = int(rng.integers(8)), int(rng.integers(len(messages)))
    packing = (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE)[int(rng.integers(3))]
    path.unlink()
    with path.open("wb") as stream:
        writer = Writer(stream, compression=packing, chunk_size=1 << 16, enable_data_crcs=True)
        writer.start(profile=header.profile, library=header.library)
        if kind == 7:
            _damage_chunks(writer, rng)
        for name, text in metadata:
            writer.add_metadata(name, text)
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for number, (schema, channel, message) in enumerate(messages):
            hit, data, times = number == victim, message.data, (message.log_time, message.publish_time)
            if schema and schema.id not in schemas:
                name, text = schema.name, schema.data
                if hit and kind == 1:
                    text = damaged(text, rng)
                schemas[schema.id] = writer.register_schema(name, schema.encoding, text)
            if channel.id not in channels:
                topic, stated = channel.topic, dict(channel.metadata)
                if kind == 2 and rng.random() < 0.3:
                    topic = damaged(topic.encode(), rng).decode(errors="replace")
                if kind == 3 and rng.random() < 0.5:
                    stated = {
                        key: damaged(v.encode(), rng).decode(errors="replace") for key, v in stated.items()
                    }
                new = schemas.get(channel.schema_id, 0)
                channels[channel.id] = writer.register_channel(topic, channel.message_encoding, new, stated)
            if hit and kind in (0, 5):
                data = content(data, rng)
            if hit and kind == 4:
                times = (0, 2**63) if rng.random() < 0.5 else (2**64 - 1, 0)
            writer.add_message(channels[channel.id], times[0], data, times[1], message.sequence)
        writer.finish()
    if kind == 6:
        _plant_bomb(path, rng)
    return True


def _damage_chunks(writer: Writer, rng: np.random.Generator) -> None:
    """Damage in every chunk that is written, before it is packed."""
    chunks: Any = vars(writer)["_Writer__chunk_builder"]
    end = chunks.end
    chunks.end = lambda: in_place(end(), rng)


def mcap_records(path: Path, rng: np.random.Generator) -> bool:
    """One record outside the chunks, most often of the index, and right checksums around it."""
    data = path.read_bytes()
    records, at = [], 8
    while at + 9 <= len(data) - 8:
        (size,) = struct.unpack_from("<Q", data, at + 1)
        records.append((data[at], data[at + 9 : at + 9 + size]))
        at += 9 + size
    places = [i for i, (kind, _) in enumerate(records) if kind != 6]
    if at != len(data) - 8 or not places:
        return False
    victim = places[int(rng.integers(len(places)))]
    kind, body = records[victim]
    records[victim] = kind, damaged(body, rng) if rng.random() < 0.2 else in_place(body, rng)
    out = bytearray(data[:8])
    for kind, body in records:
        if kind == 15 and any(body) and len(body) == 4:  # the end of the data
            body = struct.pack("<I", zlib.crc32(out))
        out += struct.pack("<BQ", kind, len(body)) + body
        if kind == 2 and len(body) == 20:  # the footer
            (start,) = struct.unpack_from("<Q", body)
            if start and body[16:] != bytes(4):
                struct.pack_into("<I", out, len(out) - 4, zlib.crc32(out[start:-4]))
    return replace(path, bytes(out) + data[-8:])


def _plant_bomb(path: Path, rng: np.random.Generator) -> None:
    """Replace the first chunk of a log by one that unpacks to 4 GB. The checksums of the file are left out."""
    data = path.read_bytes()
    at = 8
    while at < len(data) and data[at] != 6:
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    end = at + 9 + struct.unpack_from("<Q", data, at + 1)[0]
    zstd = rng.random() < 0.5
    size = (4 << 30) if rng.random() < 0.5 else 1 << 20
    packed = zstd_bomb(4 << 30) if zstd else lz4_bomb(600)
    name = b"zstd" if zstd else b"lz4"
    body = (
        struct.pack("<QQQII", 0, 2**40, size, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    )
    path.write_bytes(data[:at] + struct.pack("<BQ", 6, len(body)) + body + data[end:])


@cache
def bz2_bomb(count: int = 6600) -> bytes:
    """One stream of `count` blocks of 450 kB of zeros, each the same bits; blocks do not end with a byte."""
    one = bz2.compress(bytes(450_000))
    bits = "".join(f"{byte:08b}" for byte in one)
    block = bits[32 : bits.index(f"{0x177245385090:048b}")]  # the magic number of the end
    crc = 0
    for _ in range(count):
        crc = (crc << 1 & 0xFFFFFFFF | crc >> 31) ^ int(block[48:80], 2)
    whole = bits[:32] + block * count + f"{0x177245385090:048b}{crc:032b}"
    return int(whole.ljust(-(-len(whole) // 8) * 8, "0"), 2).to_bytes(-(-len(whole) // 8), "big")


def bag_bomb(path: Path, rng: np.random.Generator) -> bool:
    """The first chunk of a ROS 1 bag unpacks to 3 GB of zeros."""
    data = path.read_bytes()
    at = 13
    while at + 8 < len(data):
        (header,) = struct.unpack_from("<I", data, at)
        (size,) = struct.unpack_from("<I", data, at + 4 + header)
        if b"op=\x05" in data[at : at + 4 + header]:
            break
        at += 8 + header + size
    else:
        return False
    packed, name = (bz2_bomb(), b"bz2") if rng.random() < 0.7 else (lz4_bomb(600), b"lz4")
    fields = [b"op=\x05", b"compression=" + name, b"size=" + struct.pack("<I", 3_000_000_000)]
    head = b"".join(struct.pack("<I", len(f)) + f for f in fields)
    record = struct.pack("<I", len(head)) + head + struct.pack("<I", len(packed)) + packed
    end = at + 8 + header + size
    out = bytearray(data[:at] + record + data[end:])
    place = out.find(b"index_pos=") + 10
    (index,) = struct.unpack_from("<Q", out, place)
    struct.pack_into("<Q", out, place, index + len(record) - (end - at))
    return replace(path, bytes(out))


def _bag_records(data: bytes) -> list[tuple[bytes, bytes]]:
    """Header and data of the records of a ROS 1 bag, or of what a chunk of it unpacks to."""
    records, at = [], 0
    while at + 8 <= len(data):
        (header,) = struct.unpack_from("<I", data, at)
        (size,) = struct.unpack_from("<I", data.ljust(at + header + 8), at + 4 + header)
        records.append((data[at + 4 : at + 4 + header], data[at + 8 + header : at + 8 + header + size]))
        at += 8 + header + size
    return records


def _bag_packed(records: list[tuple[bytes, bytes]]) -> bytes:
    return b"".join(struct.pack("<I", len(h)) + h + struct.pack("<I", len(d)) + d for h, d in records)


PACKINGS: dict[bytes, tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]] = {
    b"none": (lambda data: data, lambda data: data),
    b"bz2": (bz2.decompress, bz2.compress),
    b"lz4": (lz4.frame.decompress, lz4.frame.compress),
}


def _fields(header: bytes) -> dict[bytes, tuple[int, int]]:
    """Where the values of a record's header begin and end."""
    found, at = {}, 0
    while at + 4 <= len(header):
        (size,) = struct.unpack_from("<I", header, at)
        name, _, _ = header[at + 4 : at + 4 + size].partition(b"=")
        found[name] = at + 5 + len(name), at + 4 + size
        at += 4 + size
    return found


def bag_inside(path: Path, rng: np.random.Generator) -> bool:
    """One record of a ROS 1 bag, most often one inside a chunk, which is packed again."""
    data = path.read_bytes()
    records = _bag_records(data[13:])
    chunks = [i for i, (header, _) in enumerate(records) if b"op=\x05" in header]
    inside = rng.random() < 0.75
    victim = chunks[int(rng.integers(len(chunks)))] if chunks and inside else int(rng.integers(len(records)))
    header, body = records[victim]
    fields = _fields(header)
    name = header[slice(*fields.get(b"compression", (0, 0)))]
    if inside and name in PACKINGS:
        unpack, pack = PACKINGS[name]
        inner = _bag_records(unpack(body))
        place = int(rng.integers(len(inner)))
        inner[place] = _damaged_record(*inner[place], rng)
        whole = _bag_packed(inner)
        at, _ = fields[b"size"]
        records[victim] = header[:at] + struct.pack("<I", len(whole)) + header[at + 4 :], pack(whole)
    else:
        records[victim] = _damaged_record(header, body, rng)
    shift = len(records[victim][1]) - len(body) + len(records[victim][0]) - len(header)
    start = 13 + len(_bag_packed(records[:victim]))
    for i, (header, body) in enumerate(records):
        for name in {b"index_pos", b"chunk_pos"} & _fields(header).keys() if i != victim else ():
            at, end = _fields(header)[name]
            (position,) = struct.unpack_from("<Q", header, at)
            moved = (position + shift if position > start else position) % 2**64
            records[i] = header[:at] + struct.pack("<Q", moved) + header[end:], body
    return replace(path, data[:13] + _bag_packed(records))


def _damaged_record(header: bytes, body: bytes, rng: np.random.Generator) -> tuple[bytes, bytes]:
    kind = rng.random()
    if kind < 0.25:
        return in_place(header, rng), body
    return header, damaged(body, rng) if kind < 0.35 else in_place(body, rng)


STATEMENTS = (
    "update messages set timestamp = -1",
    "update messages set timestamp = 9223372036854775807 where id = 2",
    "update messages set timestamp = 'text' where id = 3",
    "update messages set data = null where id = 2",
    "update messages set data = 'text' where id = 2",
    "update messages set data = zeroblob(50000000) where id = 2",
    "update messages set topic_id = 99",
    "update topics set type = 'sensor_msgs/msg/Nothing'",
    "update topics set type = '../../evil'",
    "update topics set name = '/../../evil'",
    "update topics set serialization_format = 'json'",
    "update topics set offered_qos_profiles = '!!python/object:os.system'",
    "delete from topics where id = 1",
    "drop table messages",
    "alter table messages rename column data to dada",
)


def database(path: Path, rng: np.random.Generator) -> bool:
    """Rows of a ROS 2 bag that no recorder writes."""
    data = path.read_bytes()
    replace(path, data)
    try:
        with closing(sqlite3.connect(path)) as base, base:
            base.execute(STATEMENTS[int(rng.integers(len(STATEMENTS)))])
    except sqlite3.Error:
        return False
    return True


def database_rows(path: Path, rng: np.random.Generator) -> bool:
    """One message of a ROS 2 bag."""
    replace(path, path.read_bytes())
    try:
        with closing(sqlite3.connect(path)) as base, base:
            rows = base.execute("select id, data from messages").fetchall()
            row, data = rows[int(rng.integers(len(rows)))]
            base.execute("update messages set data = ? where id = ?", (content(data, rng), row))
    except (sqlite3.Error, TypeError, ValueError):
        return False
    return True
