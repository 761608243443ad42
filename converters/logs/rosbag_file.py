"""Bags of ROS 1 (`.bag`) and ROS 2 (`.db3`, folders of `ros2 bag`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path, PosixPath
from typing import Any
from urllib.parse import quote

from duagc.converters.logs import foxglove
from duagc.converters.logs.bag_messages import messages
from duagc.converters.logs.entries import Entry, LogTopic, reason, sound_time
from duagc.converters.logs.ros_messages import RosMessages
from duagc.converters.logs.topic_types import as_one
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import check_file, read_text

LARGEST_CHUNK = 256 << 20  # bytes, unpacked; recorders write some megabytes


class RosBag:
    """A bag, read by rosbags. Types that a bag does not define are those of ROS, and of `definitions`."""

    def __init__(self, path: Path) -> None:
        """Open a bag and read what topics it has.

        Args:
            path: a file, or a folder of `ros2 bag`.

        Raises:
            DuagError: it is missing or broken.
        """
        from rosbags.rosbag1 import Reader as Reader1

        self.path = path
        hint = "; `rosbag reindex` mends one that was cut short" if path.suffix == ".bag" else ""
        wanted = f"a bag of ROS 1 or ROS 2{hint}"
        for file in _files_of(path) if path.is_dir() else [path]:
            check_file(file, wanted)
        with reading(path, wanted):
            self._reader = _opened(path)
            for reader in self._reader.readers:
                if isinstance(reader, Reader1):
                    _bound_chunks(reader)
        self._encoding = "cdr" if self._reader.is2 else "ros1"
        self._decoders: dict[tuple[str, str, str], RosMessages] = {}
        try:
            self.topics = self._topics()
        except BaseException:
            self.close()
            raise

    def _topics(self) -> dict[str, LogTopic]:
        found: dict[str, list[LogTopic]] = {}
        for c in self._reader.connections:
            connection = c.topic, c.msgtype, c.msgcount  # of a bag of ROS 2 they stand in its metadata
            if not all(map(isinstance, connection, (str, str, int))):
                raise DuagError(
                    f"{self.path}: found {connection}, expected a topic, its type and number of messages"
                )
            found.setdefault(c.topic, []).append(
                LogTopic(
                    c.topic,
                    _kind(c),
                    c.msgtype,
                    self._encoding,
                    c.msgcount,
                    remark=self._decoder(c).remark(c.digest or ""),
                )
            )
        return {topic: as_one(stated) for topic, stated in found.items()}

    def _decoder(self, connection: Any) -> RosMessages:
        """Of connections that define a type alike the same."""
        form, text = connection.msgdef
        key = connection.msgtype, form.name, text
        if key not in self._decoders:
            self._decoders[key] = RosMessages(
                connection.msgtype, self._encoding, text, is_idl=form.name == "IDL"
            )
        return self._decoders[key]

    def entries(self, topics: Sequence[str], heads: Sequence[str] = ()) -> Iterator[Entry]:
        """Messages of these topics in order of recording.

        Args:
            topics: their names.
            heads: those of which `header_ns` is all that will be asked; `data` may be cut behind it.

        Raises:
            DuagError: the bag is broken, or a message has no sound time.
        """
        read_whole = {
            c.topic
            for c in self._reader.connections
            if foxglove.plain_name(c.msgtype) in foxglove.ROS_TYPES  # their times may stand anywhere
        }
        heads = [topic for topic in heads if topic not in read_whole]
        with reading(self.path, "a sound bag of ROS 1 or ROS 2"):
            for connection, log_ns, raw in messages(self._reader, topics, heads):
                where, decoder = f"{self.path}: {connection.topic}", self._decoder(connection)
                read, header = (partial(f, raw, where) for f in (decoder.read, decoder.header_ns))
                time_ns = sound_time(log_ns, where)
                yield Entry(connection.topic, time_ns, None, raw, read, header, type=_kind(connection))

    def close(self) -> None:
        with reading(self.path, "a sound bag of ROS 1 or ROS 2"):  # a database may notice its damage only now
            self._reader.close()


def _files_of(folder: Path) -> list[Path]:
    """What of a folder of `ros2 bag` belongs to it: files that its metadata names."""
    metadata = folder / "metadata.yaml"
    lines = read_text(metadata, "the metadata of a bag of ROS 2").splitlines()
    named = {
        line.split(": ")[-1].strip().removeprefix("- ").strip("'\"").rpartition("/")[-1] for line in lines
    }
    return [metadata, *(file for file in sorted(folder.iterdir()) if file.name in named)]


class _UriPath(PosixPath):
    """A path that f-strings write as in a URI: rosbags opens databases by such."""

    def __format__(self, spec: str) -> str:
        return quote(str(self))


def _opened(path: Path) -> Any:
    """`AnyReader` of a bag; it takes no definitions: those that are broken, or not used, cost no other topic."""
    from rosbags.highlevel import AnyReader

    reader: Any = AnyReader([_UriPath(path) if set("#%?") & set(str(path)) else path])
    reader._open = partial(_open_without_types, reader)
    reader.open()
    return reader


def _open_without_types(reader: Any) -> None:
    for inner in reader.readers:
        reader.stack.enter_context(inner)
    reader.connections = [c for inner in reader.readers for c in inner.connections]


def _kind(connection: Any) -> str:
    """The type of the messages of a connection as `LogTopic` has it."""
    return foxglove.ROS_TYPES.get(foxglove.plain_name(connection.msgtype), connection.msgtype)


def _bound_chunks(reader: Any) -> None:
    """Let no chunk of a bag of ROS 1 unpack into more than memory."""
    import bz2

    import lz4.frame

    def bounded(unpack: Any) -> Any:
        opener = {
            bz2.decompress: bz2.BZ2Decompressor,
            lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor,
        }.get(unpack)
        if opener is None:
            return unpack

        def decompress(data: bytes) -> bytes:
            stream = opener()
            out = bytes(stream.decompress(data, LARGEST_CHUNK))
            if not stream.eof:
                raise ValueError(f"a chunk that is broken, or unpacks to more than {LARGEST_CHUNK} bytes")
            return out

        return decompress

    reader.chunks = {
        at: chunk._replace(decompressor=bounded(chunk.decompressor)) for at, chunk in reader.chunks.items()
    }


@contextmanager
def reading(path: Path, expected: str) -> Iterator[None]:
    """Turn whatever a reader stumbles over in a broken file into one line.

    Args:
        path: of the file, for the error.
        expected: what it should be, for the error.

    Raises:
        DuagError: the block raised an error of any other kind.
    """
    try:
        yield
    except (DuagError, GeneratorExit):
        raise
    except Exception as error:
        raise DuagError(f"{path}: {reason(error)}, expected {expected}") from error
