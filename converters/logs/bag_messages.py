"""The messages of a bag without reading more of it than is asked for; what rosbags does where that cannot be.

rosbags reads a chunk, or a row of the database, whole to give one message of it, and a look at the headers of a
long bag costs as much as reading it. Here a message of a chunk that is not compressed is read by its place in the file,
and a row of a database is opened as a file is.
"""

from __future__ import annotations

import heapq
import itertools
import os
from collections.abc import Collection, Iterator
from typing import Any

HEAD_BYTES = 64  # more than the stamp of a header needs
AHEAD = 256  # messages
Raw = tuple[Any, int, bytes]  # connection, time of recording in ns, bytes


def messages(reader: Any, topics: Collection[str], heads: Collection[str]) -> Iterator[Raw]:
    """Messages of some topics in the order of their times; of those of `heads` the first bytes are enough.

    Args:
        reader: `AnyReader` of one bag or folder.
        topics: their names.
        heads: names of those topics whose messages may be cut behind the header.

    Yields:
        Connection, time of recording (ns) and bytes of each message.

    Raises:
        ValueError: the index leads to a message of another topic.
    """
    connections = [c for c in reader.connections if c.topic in topics]
    if not connections:
        return
    [inner] = reader.readers
    storages = _databases(inner) if reader.is2 else []
    if storages:
        yield from heapq.merge(*(_of_database(s, connections, heads) for s in storages), key=lambda m: m[1])
    elif not reader.is2 and all(_is_plain(chunk) for chunk in inner.chunks.values()):
        yield from _of_bag(inner, connections, heads)
    else:
        for message in reader.messages(connections=connections):
            if message[0] not in connections:
                raise ValueError(
                    f"the index leads to a message of {message[0].topic}, not of {sorted(topics)}"
                )
            yield message


def _is_plain(chunk: Any) -> bool:
    from rosbags.rosbag1.reader import decompressors

    return bool(chunk.decompressor is decompressors["none"])


def _of_bag(reader: Any, connections: list[Any], heads: Collection[str]) -> Iterator[Raw]:
    from rosbags.rosbag1.reader import Header, ReaderError, RecordType, read_bytes, read_uint32

    stream = reader.bio
    known = {c.id: c for c in connections}
    entries = heapq.merge(*(reader.indexes[number] for number in sorted(known)))
    for time_ns, position, offset in _announced(reader, entries) if heads else entries:
        chunk = reader.chunks[position]
        stream.seek(chunk.datapos + offset)
        while (header := Header.read(stream)).get_uint8("op") == RecordType.CONNECTION:
            stream.seek(read_uint32(stream), os.SEEK_CUR)
        size = read_uint32(stream)
        connection = known[header.get_uint32("conn")]
        if header.get_uint8("op") != RecordType.MSGDATA or header.get_time("time") != time_ns:
            raise ReaderError("the index leads to no message of its time")
        if stream.tell() + size > chunk.datapos + chunk.datasize:
            raise ReaderError(f"a message of {size} bytes leads out of its chunk")
        size = min(size, HEAD_BYTES) if connection.topic in heads else size
        yield connection, time_ns, read_bytes(stream, size)


def _announced(reader: Any, entries: Iterator[Any]) -> Iterator[Any]:
    """Entries of the index; the system is asked for some in advance, and a disk answers many questions at a time."""
    while some := list(itertools.islice(entries, AHEAD)):
        for entry in some:
            place = reader.chunks[entry.chunk_pos].datapos + entry.offset
            os.posix_fadvise(reader.bio.fileno(), place, 1024, os.POSIX_FADV_WILLNEED)
        yield from some


def _databases(reader: Any) -> list[Any]:
    """The SQLite files of a bag of ROS 2; none if it is of another kind, or its messages are compressed."""
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    storage = reader.storage
    found = getattr(storage, "storages", [storage])
    packed = storage.metadata.compression_mode == "message"
    return [] if packed or not all(isinstance(s, Sqlite3Reader) for s in found) else list(found)


def _of_database(storage: Any, connections: list[Any], heads: Collection[str]) -> Iterator[Raw]:
    named = {(c.topic, c.msgtype): c for c in connections}
    rows = [(c.id, named.get((c.topic, c.msgtype))) for c in storage.connections]
    known = {number: connection for number, connection in rows if connection}
    if not known:
        return
    places = ",".join("?" * len(known))
    query = f"SELECT rowid, topic_id, timestamp FROM messages WHERE topic_id IN ({places}) ORDER BY timestamp, rowid"
    blob = None
    for row, number, time_ns in storage.dbconn.execute(query, tuple(known)):
        if blob is None:
            blob = storage.dbconn.blob_open("main", "messages", "data", row, False)
        else:
            blob.reopen(row)
        connection = known[number]
        yield connection, time_ns, blob.read(HEAD_BYTES if connection.topic in heads else blob.length())
    if blob is not None:
        blob.close()
