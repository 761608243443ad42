"""Bags of ROS 1 (`.bag`) and ROS 2 (`.db3`, folders of `ros2 bag`)."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path, PosixPath
from typing import Any
from urllib.parse import quote

from duagc.converters.logs import foxglove
from duagc.converters.logs.bag_messages import messages
from duagc.converters.logs.definitions import of_ros2
from duagc.converters.logs.entries import Entry, InvalidMessage, LogTopic, sound_time, stamp_ns
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import check_file, read_text
from duagc.pipeline.messages.parts import NANOSECONDS

_READ = {
    "builtin_interfaces": "Time",
    "std_msgs": "Header",
    "geometry_msgs": "Point Pose PoseStamped PoseWithCovariance PoseWithCovarianceStamped Quaternion Transform "
    "TransformStamped Vector3",
    "nav_msgs": "Odometry",
    "sensor_msgs": "CameraInfo CompressedImage Image Imu PointCloud2 PointField RegionOfInterest",
    "tf2_msgs": "TFMessage",
}
READ_TYPES = {f"{package}/msg/{name}" for package, names in _READ.items() for name in names.split()}
LONGEST_FRAME = 4096  # letters; of bytes that are no header the number is most often larger
LARGEST_CHUNK = 256 << 20  # bytes, unpacked; recorders write some megabytes


class RosBag:
    """A bag, read by rosbags. Bags of ROS 2 without types are read with those of `definitions`."""

    def __init__(self, path: Path) -> None:
        """Open a bag and read what topics it has.

        Args:
            path: a file, or a folder of `ros2 bag`.

        Raises:
            DuagError: it is missing or broken, or defines types otherwise than ROS does.
        """
        from rosbags.rosbag1 import Reader as Reader1

        self.path = path
        hint = "; `rosbag reindex` mends one that was cut short" if path.suffix == ".bag" else ""
        wanted = f"a bag of ROS 1 or ROS 2{hint}"
        for file in _files_of(path) if path.is_dir() else [path]:
            check_file(file, wanted)
        with reading(path, wanted):
            self._reader = _opened(path)
            check_definitions(self._reader.typestore.fielddefs)
            for reader in self._reader.readers:
                if isinstance(reader, Reader1):
                    _bound_chunks(reader)
        self._encoding = "cdr" if self._reader.is2 else "ros1"
        try:
            self.topics = self._topics()
        except BaseException:
            self.close()
            raise

    def _topics(self) -> dict[str, LogTopic]:
        topics: dict[str, LogTopic] = {}
        for c in self._reader.connections:
            connection = c.topic, c.msgtype, c.msgcount  # of a bag of ROS 2 they stand in its metadata
            if not all(map(isinstance, connection, (str, str, int))):
                raise DuagError(
                    f"{self.path}: found {connection}, expected a topic, its type and number of messages"
                )
            before = topics.get(c.topic)
            if before is not None and before.schema != c.msgtype:
                raise DuagError(
                    f"{self.path}: {c.topic} holds {before.schema} and {c.msgtype}, expected one type"
                )
            count = c.msgcount + (before.count if before is not None else 0)
            kind = foxglove.ROS_TYPES.get(foxglove.plain_name(c.msgtype), c.msgtype)
            topics[c.topic] = LogTopic(c.topic, kind, c.msgtype, self._encoding, count)
        return topics

    def entries(self, topics: Sequence[str], heads: Sequence[str] = ()) -> Iterator[Entry]:
        """Messages of these topics in order of recording.

        Args:
            topics: their names.
            heads: those of which `header_ns` is all that will be asked; `data` may be cut behind it.

        Raises:
            DuagError: the bag is broken, or a message has no sound time.
        """
        heads = [t for t in heads if foxglove.plain_name(self.topics[t].schema) not in foxglove.ROS_TYPES]
        with reading(self.path, "a sound bag of ROS 1 or ROS 2"):
            for connection, log_ns, raw in messages(self._reader, topics, heads):
                read = partial(self._read, connection, raw)
                header = partial(ros_header_ns, raw, self._encoding, f"{self.path}: {connection.topic}")
                if foxglove.plain_name(connection.msgtype) in foxglove.ROS_TYPES:
                    header = partial(_stamp_of, read)
                time_ns = sound_time(log_ns, f"{self.path}: {connection.topic}")
                yield Entry(connection.topic, time_ns, None, raw, read, header)

    def _read(self, connection: Any, raw: bytes) -> Any:
        where = f"{self.path}: {connection.topic}"
        message = deserialized(self._reader.deserialize, raw, connection.msgtype, where)
        return foxglove.as_ros(foxglove.plain_name(connection.msgtype), message, where)

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
    """`AnyReader` of a bag; definitions of types that are not read here may be broken."""
    from rosbags.highlevel import AnyReader

    path = _UriPath(path) if set("#%?") & set(str(path)) else path
    reader: Any = AnyReader([path], default_typestore=of_ros2())
    try:
        reader.open()
    except Exception:  # of a bag that is broken itself it comes again
        reader = AnyReader([path], default_typestore=of_ros2())
        reader._open = partial(_open_sound_types, reader)
        reader.open()
    return reader


def _open_sound_types(reader: Any) -> None:
    """What `AnyReader` does to open a bag, without the types that cannot be understood and are not read."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    for inner in reader.readers:
        reader.stack.enter_context(inner)
    connections = [c for inner in reader.readers for c in inner.connections]
    store = get_typestore(Stores.EMPTY)
    for c in sorted(connections, key=lambda c: c.msgtype not in READ_TYPES):
        try:
            if c.msgdef.format.name != "MSG":
                raise ValueError(f"{c.msgtype} is defined in {c.msgdef.format.name}")
            found, alone = get_types_from_msg(c.msgdef.data, c.msgtype), get_typestore(Stores.EMPTY)
            alone.register(found)
            own = alone.hash_rihs01(c.msgtype) if reader.is2 else alone.generate_msgdef(c.msgtype)[1]
            if c.digest and c.digest != own:
                raise ValueError(f"{c.msgtype} has digest {c.digest}, expected {own}")
            store.register(found)
        except Exception:
            if c.msgtype in READ_TYPES:
                raise
    reader.connections, reader.typestore = connections, store


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


def reason(error: Exception) -> str:
    """What an error says, on one line; its kind if it says nothing.

    Args:
        error: any exception.

    Returns:
        At most 200 characters.
    """
    return " ".join(str(error).rstrip(".").split())[:200] or type(error).__name__


def check_definitions(found: Mapping[str, Any]) -> None:
    """Refuse a log that defines types that are read here otherwise than ROS does.

    Args:
        found: fields by type, as rosbags has them.

    Raises:
        ValueError: a type has other fields.
    """
    from rosbags.typesys import Stores, get_typestore

    standard = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    for name in sorted(set(found) & READ_TYPES):
        # the matrices D, K, R, P of ROS 1 have small letters in ROS 2
        has, wanted = (
            {(field if len(field) > 1 else field.lower()): kind for field, kind in types[name][1]}
            for types in (found, standard)
        )
        for field in wanted:
            if has.get(field) != wanted[field]:
                raise ValueError(f"its {name} has no field {field} as ROS has it")


def deserialized(read: Any, raw: bytes, kind: str, where: str) -> Any:
    """A message of ROS from its bytes, or an error that names its topic.

    Args:
        read: makes a message of bytes and the name of a type.
        raw: the bytes.
        kind: name of the type.
        where: begins the line of an error.

    Raises:
        InvalidMessage: the bytes are no message of that type.
    """
    try:
        return read(raw, kind)
    except Exception as error:  # whatever broken bytes provoke
        raise InvalidMessage(where, f"holds {len(raw)} bytes that are no {kind} ({reason(error)})") from error


def ros_header_ns(raw: bytes, encoding: str, where: str) -> int:
    """Stamp (ns) of a message that begins with a header, without reading the rest.

    Args:
        raw: the message, at least its first bytes.
        encoding: "cdr" or "ros1".
        where: begins the line of an error.

    Raises:
        InvalidMessage: there are too few bytes, or they begin with no header.
    """
    try:
        if encoding == "cdr":
            order = "<" if raw[1] & 1 else ">"
            seconds, nanoseconds, letters = struct.unpack_from(f"{order}iII", raw, 4)
        else:
            seconds, nanoseconds, letters = struct.unpack_from("<III", raw, 4)
    except (struct.error, IndexError) as error:
        raise InvalidMessage(where, f"holds {len(raw)} bytes, expected a message with a header") from error
    if letters > LONGEST_FRAME:
        raise InvalidMessage(where, f"has a frame of {letters} letters, expected at most {LONGEST_FRAME}")
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def _stamp_of(read: Any) -> int:
    return stamp_ns(read())
