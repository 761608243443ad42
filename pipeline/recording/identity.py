"""The identity of a log: a digest of what it says, whatever the compressor and the chunks of its file."""

import hashlib
import json
import struct
from collections.abc import Iterable, Mapping


def framed(*parts: bytes) -> bytes:
    """Parts with their lengths before them, so that no two lists of parts give the same bytes.

    Args:
        *parts: in order; the length of each is 8 bytes, little-endian.
    """
    return b"".join(struct.pack("<Q", len(part)) + part for part in parts)


def channel_identity(topic: str, schema: str, schema_data: bytes) -> bytes:
    """SHA-256 (32 bytes) of topic, name of the schema and the schema itself.

    Args:
        topic: full name.
        schema: full name of the schema; "" without one.
        schema_data: the schema as the log has it.
    """
    schema_digest = hashlib.sha256(schema_data).digest()
    return hashlib.sha256(framed(topic.encode(), schema.encode(), schema_digest)).digest()


class ContentDigest:
    """SHA-256 over messages in log order, then over channel metadata, metadata records and attachments, sorted."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def add(
        self, identity: bytes, log_time_ns: int, publish_time_ns: int, *, sequence: int, data: bytes
    ) -> None:
        """Take in the next message.

        Args:
            identity: of its channel (`channel_identity`).
            log_time_ns: log time, ns.
            publish_time_ns: publish time, ns.
            sequence: number of the message in its channel.
            data: the bytes of the message.
        """
        self._hash.update(identity + struct.pack("<QQIQ", log_time_ns, publish_time_ns, sequence, len(data)))
        self._hash.update(data)

    def finish(
        self,
        channels: Iterable[tuple[bytes, Mapping[str, str]]],
        metadata: Iterable[tuple[str, Mapping[str, str]]],
        attachments: Iterable[bytes],
    ) -> str:
        """The digest as 64 hex characters, after the last message.

        Args:
            channels: identity and metadata of every channel, in any order.
            metadata: name and content of every metadata record, in any order.
            attachments: bytes that identify each attachment, in any order.
        """
        named = [("", identity.hex(), text) for identity, text in channels]
        named += [("metadata", name, text) for name, text in metadata]
        rows = sorted((kind, name, sorted(text.items())) for kind, name, text in named)
        self._hash.update(framed(json.dumps(rows).encode(), *sorted(attachments)))
        return self._hash.hexdigest()
