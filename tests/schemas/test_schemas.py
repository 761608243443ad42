"""The checked-in description is that of the .proto files, and the rules for our schemas hold."""

from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2
from google.protobuf.descriptor import FieldDescriptor

from duagc import schemas
from duagc.schemas import build, topics

ELEMENT_TYPES = (
    "_int32",
    "_int64",
    "_uint8",
    "_uint16",
    "_uint32",
    "_uint64",
    "_float16",
    "_float32",
    "_float64",
)
OPAQUE_BYTES = ("payload", "header", "signature")


def own_messages() -> list[Any]:
    """Descriptors of all messages of package duagc.v1."""
    path = Path(schemas.__file__).parent / "descriptors.binpb"
    files = descriptor_pb2.FileDescriptorSet.FromString(path.read_bytes())
    names = [f"{file.package}.{message.name}" for file in files.file for message in file.message_type]
    return [schemas.message_class(name).DESCRIPTOR for name in sorted(names) if name.startswith("duagc.v1.")]


def test_descriptor_set_is_that_of_the_proto_files() -> None:
    pytest.importorskip("grpc_tools", reason="needs grpcio-tools (extra dev)")
    fresh = descriptor_pb2.FileDescriptorSet.FromString(build.compile_descriptors())
    kept = descriptor_pb2.FileDescriptorSet.FromString(build.DESCRIPTORS.read_bytes())
    assert fresh == kept, "run `python -m schemas.build`"


def test_every_proto_file_is_described() -> None:
    kept = descriptor_pb2.FileDescriptorSet.FromString(build.DESCRIPTORS.read_bytes())
    described = {f.name for f in kept.file if f.package == schemas.PACKAGE}
    assert described == {f"{build.PACKAGE_FOLDER}/{p.name}" for p in build.FOLDER.glob("*.proto")}


def test_no_map_and_no_oneof() -> None:
    for message in own_messages():
        assert not message.oneofs, message.full_name
        for field in message.fields:
            entry = field.message_type
            assert entry is None or not entry.GetOptions().map_entry, field.full_name


def test_arrays_name_their_element_type() -> None:
    for message in own_messages():
        for field in message.fields:
            if field.type == FieldDescriptor.TYPE_BYTES and field.name not in OPAQUE_BYTES:
                assert field.name.endswith(ELEMENT_TYPES), field.full_name


def test_messages_of_topics_begin_with_time_and_frame() -> None:
    for row in topics.TOPICS:
        if row.schema.startswith(schemas.PACKAGE):
            names = [f.name for f in schemas.message_class(row.schema).DESCRIPTOR.fields]
            assert names[:2] == ["timestamp", "frame_id"], row.schema
            assert "robot" in names or "<robot>" not in row.pattern, row.schema


def test_topics_are_distinct_and_their_schemas_exist() -> None:
    assert len({row.pattern for row in topics.TOPICS}) == len(topics.TOPICS)
    for row in topics.TOPICS:
        assert schemas.message_class(row.schema).DESCRIPTOR.full_name == row.schema
        robot = "delta_2" if "<robot>" in row.pattern else ""
        assert topics.find(row.of("delta_2")) == (row, robot)


@pytest.mark.parametrize(
    "topic", ["", "/", "/alpha/camera/colors", "alpha/map", "/Alpha/map", "/a b/map", "/a/b/map"]
)
def test_other_topics_are_not_found(topic: str) -> None:
    assert topics.find(topic) is None


@pytest.mark.parametrize("schema", sorted({row.schema for row in topics.TOPICS}))
def test_a_schema_describes_itself(schema: str) -> None:
    """What a log carries is enough to read its messages, without any of our code."""
    message = schemas.message_class(schema)(timestamp={"seconds": 3, "nanos": 7})
    foreign = schemas.message_class_from(schema, schemas.descriptor_set(schema))
    read: Any = foreign.FromString(message.SerializeToString())
    assert (read.timestamp.seconds, read.timestamp.nanos) == (3, 7)
    assert schemas.descriptor_set(schema) == schemas.descriptor_set.__wrapped__(schema)


@pytest.mark.parametrize(
    "schema", ["", "Odometry", "duagc.v1.Nothing", "duagc.v2.Odometry", "foxglove.Nothing"]
)
def test_unknown_schemas_are_key_errors(schema: str) -> None:
    with pytest.raises(KeyError):
        schemas.message_class(schema)


def test_the_documentation_has_every_topic() -> None:
    text = (build.FOLDER.resolve().parent / "docs" / "reference" / "formats.md").read_text()
    for row in topics.TOPICS:
        assert f"| `{row.pattern}` | `{row.schema}` | {row.producer} | {row.scope.value} |" in text, (
            row.pattern
        )
