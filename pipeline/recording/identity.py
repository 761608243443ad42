"""The identity of a log: a digest of what it says, whatever the compressor and the chunks of its file."""

import hashlib
import json
import struct
from collections.abc import Iterable, Mapping


def framed(*parts: bytes) -> bytes:
    """Parts with their lengths before them, so that no two lists of parts give the same bytes."""
    return b"".join(struct.pack("<Q", len(part)) + part for part in parts)


def channel_identity(topic: str, schema: str, schema_data: bytes) -> bytes:
    schema_digest = hashlib.sha256(schema_data).digest()
    return hashlib.sha256(framed(topic.encode(), schema.encode(), schema_digest)).digest()


class ContentDigest:
    """SHA-256 over messages in log order, then over channel metadata, metadata records and attachments, sorted."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def add(
        self, identity: bytes, log_time_ns: int, publish_time_ns: int, *, sequence: int, data: bytes
    ) -> None:
        self._hash.update(identity + struct.pack("<QQIQ", log_time_ns, publish_time_ns, sequence, len(data)))
        self._hash.update(data)

    def finish(
        self,
        channels: Iterable[tuple[bytes, Mapping[str, str]]],
        metadata: Iterable[tuple[str, Mapping[str, str]]],
        attachments: Iterable[bytes],
    ) -> str:
        named = [("", identity.hex(), text) for identity, text in channels]
        named += [("metadata", name, text) for name, text in metadata]
        rows = sorted((kind, name, sorted(text.items())) for kind, name, text in named)
        self._hash.update(framed(json.dumps(rows).encode(), *sorted(attachments)))
        return self._hash.hexdigest()
