"""Message classes of package duagc.v1, built at run time from the checked-in descriptor set.

`schemas.message_class("duagc.v1.Odometry")` gives the class; `foxglove.*` names give the classes of
foxglove-schemas-protobuf. There is no generated code: protobuf's own refuses an older or newer runtime.
"""

from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.message import Message

PACKAGE = "duagc.v1"
FOXGLOVE = "foxglove"


def _pool_of(descriptor_set: bytes) -> descriptor_pool.DescriptorPool:
    """A pool of its own with every file of a serialized FileDescriptorSet, whatever their order in it."""
    pool = descriptor_pool.DescriptorPool()
    files = {f.name: f for f in descriptor_pb2.FileDescriptorSet.FromString(descriptor_set).file}
    done: set[str] = set()

    def add(name: str) -> None:
        if name in done or name not in files:
            return
        done.add(name)
        for dependency in files[name].dependency:
            add(dependency)
        pool.Add(files[name])

    for name in files:
        add(name)
    return pool


@cache
def _own_pool() -> descriptor_pool.DescriptorPool:
    return _pool_of((Path(__file__).parent / "descriptors.binpb").read_bytes())


@cache
def message_class(schema: str) -> type[Message]:
    """The class of a schema.

    Args:
        schema: its full name, for example "duagc.v1.Odometry" or "foxglove.RawImage".

    Raises:
        KeyError: no such schema here.
    """
    package, _, name = schema.rpartition(".")
    if package == PACKAGE:
        return message_factory.GetMessageClass(_own_pool().FindMessageTypeByName(schema))
    if package == FOXGLOVE:
        try:
            return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
        except (ImportError, AttributeError) as error:
            raise KeyError(schema) from error
    raise KeyError(schema)


def message_class_from(schema: str, descriptor_set: bytes) -> type[Message]:
    """The class of a schema that a log describes.

    Args:
        schema: its full name.
        descriptor_set: serialized FileDescriptorSet, as the log carries it.

    Raises:
        KeyError: the set does not have the schema.
    """
    return message_factory.GetMessageClass(_pool_of(descriptor_set).FindMessageTypeByName(schema))


def new(schema: str, **fields: Any) -> Any:
    """A message with some fields set.

    Args:
        schema: its name without the package, such as "Odometry".
        fields: values by field; the others have protobuf's defaults.

    Raises:
        KeyError: there is no such schema here.
        ValueError: it has no such field.
    """
    return message_class(f"{PACKAGE}.{schema}")(**fields)


@cache
def descriptor_set(schema: str) -> bytes:
    """Serialized FileDescriptorSet of a schema's file and all it imports, imports first; always the same.

    Args:
        schema: its full name.

    Raises:
        KeyError: there is no such schema here.
    """
    out = descriptor_pb2.FileDescriptorSet()
    seen: set[str] = set()

    def add(file: FileDescriptor) -> None:
        if file.name in seen:
            return
        seen.add(file.name)
        for dependency in sorted(file.dependencies, key=lambda f: f.name):
            add(dependency)
        file.CopyToProto(out.file.add())

    add(message_class(schema).DESCRIPTOR.file)
    return out.SerializeToString(deterministic=True)
