"""Messages on the way, chunk by chunk: which chunks are acknowledged, here, or to be acknowledged."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.network.messages import Message
from duagc.pipeline.network.packets import EVIDENCE_KINDS, Kind, chunk_bytes


@dataclass
class OpenMessage:
    """An outgoing message: which chunks are acknowledged, and from which round each may be sent (again); at first 0.

    Attributes:
        message: that is sent.
        acknowledged: bool [chunks].
        due_round: int64 [chunks].
    """

    message: Message
    acknowledged: NDArray[np.bool_]
    due_round: NDArray[np.int64]

    def size(self, chunk: int) -> int:
        """Bytes of a chunk, headers left out.

        Args:
            chunk: its number.
        """
        whole = chunk_bytes(self.message.kind)
        return min(whole, len(self.message.payload) - chunk * whole)


@dataclass
class PartialMessage:
    """An incoming message: its chunks so far.

    Attributes:
        kind: of its content.
        total: bytes of the whole message.
        chunks: by number.
    """

    kind: Kind
    total: int
    chunks: dict[int, bytes] = field(default_factory=dict)


@dataclass
class ChunkNews:
    """Chunks of one message to acknowledge.

    Attributes:
        first: lowest number of a chunk.
        last: highest number.
        until_round: in which they are acknowledged for the last time.
    """

    first: int
    last: int
    until_round: int


def priority(entry: OpenMessage) -> tuple[bool, int, int]:
    """Evidence last, else by kind, then in the order of sending.

    Args:
        entry: that waits to be sent.
    """
    return entry.message.kind in EVIDENCE_KINDS, entry.message.kind, entry.message.id
