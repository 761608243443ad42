"""Packets of at most 1200 bytes: header, strict parser, cutting of messages.

    offset  size  field
    0       2     magic "DG"
    2       1     version
    3       1     kind of the message
    4       2     sender, index in the sorted list of the team
    6       2     receiver, likewise
    8       4     sequence number of the packet on this directed link
    12      4     round in which it was sent
    16      4     message id, unique for its sender
    20      4     offset of the payload in the message
    24      4     total length of the message
    28      2     length of the payload
    30      4     CRC-32 of everything else

Little-endian. A message is cut at multiples of `chunk_bytes(kind)`, so an offset names a chunk and a parser can tell
a wrong one. A pose or evidence chunk holds whole records and is useful alone.
"""

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum

MAGIC = b"DG"
VERSION = 1
MAX_PACKET_BYTES = 1200
_FIELDS = struct.Struct("<2sBBHHIIIIIH")
_CRC = struct.Struct("<I")
HEADER_BYTES = _FIELDS.size + _CRC.size
MAX_PAYLOAD_BYTES = MAX_PACKET_BYTES - HEADER_BYTES

EVIDENCE_HEAD_BYTES = 8
EVIDENCE_BYTES, EVIDENCE_EXACT_BYTES, EVIDENCE_DOUBLE_BYTES = 100, 188, 364  # of one record


class Kind(IntEnum):
    """What a message holds. The order is the order of sending within a round; evidence comes last."""

    ACK = 1  # chunks received, per message
    STATE = 2  # the state of the sender, and its poses of this round if it has any
    RELATIVE_FRAME = 3  # the relative frame of two robots by their loop closures; flooded
    DESCRIPTORS = 4  # compact descriptors of every keyframe, to recognize places
    REQUEST = 5  # keyframes whose sample is wanted
    SAMPLE = 6  # one keyframe: features with 3-D points, and points for registration
    CLOSURES = 7  # verdict on the pair: shared keyframes and their metric
    VOXELS = 8  # space that the sender's keyframes saw
    ANCHORS = 9  # agreed poses of the keyframes of one robot
    PAIRS = 10  # matched Gaussians of two robots
    EVIDENCE = 11  # Gaussians of one robot with their information, compact
    EVIDENCE_EXACT = 12  # the same in float32
    EVIDENCE_DOUBLE = 13  # the same in float64
    KEYFRAMES = 14  # own keyframes that known loop closures name (`duagc posegraph`)
    HELLO = 16  # digest of what the sender saw, from which the roles of the two ends follow
    TREE = 15  # elimination: fronts and blocks up the tree of robots, steps down
    CURRENT_POSES = 17  # poses of the keyframes of one robot while they are sought
    RECTIFIED_REQUEST = 18  # keyframes whose rectified features are wanted
    RECTIFIED = 19  # rectified features of one keyframe


FIRE_AND_FORGET = frozenset({Kind.ACK, Kind.STATE})
"""Kinds that are sent once, in one packet, and never acknowledged."""

URGENT_KINDS = frozenset({Kind.TREE, Kind.KEYFRAMES})
"""Kinds that hold up the whole team until they arrive."""


class MalformedError(ValueError):
    """A packet or a message that is not what it should be; the text is the reason."""


@dataclass(frozen=True, slots=True)
class Packet:
    """One parsed packet.

    Attributes:
        kind: of the message that it is cut from.
        sender: index in the sorted team.
        receiver: index in the sorted team.
        sequence: counts on this directed link.
        round: in which it was sent.
        message: id, unique for its sender.
        offset: of the payload in the message, bytes.
        total: bytes of the message.
        payload: a slice of the message.
    """

    kind: Kind
    sender: int
    receiver: int
    sequence: int
    round: int
    message: int
    offset: int
    total: int
    payload: bytes


EVIDENCE_KINDS = {
    Kind.EVIDENCE: EVIDENCE_BYTES,
    Kind.EVIDENCE_EXACT: EVIDENCE_EXACT_BYTES,
    Kind.EVIDENCE_DOUBLE: EVIDENCE_DOUBLE_BYTES,
}
"""Kinds whose packets hold whole records, each useful alone, and the bytes of a record."""


def records_per_chunk(kind: Kind) -> int:
    """Records in a full packet of evidence.

    Args:
        kind: of the evidence.

    Raises:
        KeyError: it is no kind of evidence.
    """
    return (MAX_PAYLOAD_BYTES - EVIDENCE_HEAD_BYTES) // EVIDENCE_KINDS[kind]


_CHUNK_BYTES = {
    kind: EVIDENCE_HEAD_BYTES + records_per_chunk(kind) * EVIDENCE_KINDS[kind]
    if kind in EVIDENCE_KINDS
    else MAX_PAYLOAD_BYTES
    for kind in Kind
}


def chunk_bytes(kind: Kind) -> int:
    """Distance between the cuts of a message of this kind, in bytes.

    Args:
        kind: of the message.
    """
    return _CHUNK_BYTES[kind]


def chunk_count(kind: Kind, total_bytes: int) -> int:
    """Number of packets that a message needs; an empty message needs one.

    Args:
        kind: of the message.
        total_bytes: of the message.
    """
    return max(1, -(-total_bytes // chunk_bytes(kind)))


def serialize(packet: Packet) -> bytes:
    """Bytes of a packet: header, with its CRC over all else, and payload.

    Args:
        packet: with a payload of at most `MAX_PAYLOAD_BYTES`.

    Raises:
        ValueError: the payload does not fit.
    """
    if len(packet.payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"payload of {len(packet.payload)} bytes, at most {MAX_PAYLOAD_BYTES} fit")
    values = (
        MAGIC,
        VERSION,
        packet.kind,
        packet.sender,
        packet.receiver,
        packet.sequence,
        packet.round,
        packet.message,
        packet.offset,
        packet.total,
        len(packet.payload),
    )
    fields = _FIELDS.pack(*values)
    return fields + _CRC.pack(zlib.crc32(packet.payload, zlib.crc32(fields))) + packet.payload


def payload_bytes(data: bytes) -> int:
    """Length of the payload that a header announces; a signature may follow the payload.

    Args:
        data: bytes of a packet, at least its header.
    """
    return int(_FIELDS.unpack_from(data)[-1])


def parse(data: bytes) -> Packet:
    """Read one packet.

    Args:
        data: bytes of one packet, without a signature.

    Raises:
        MalformedError: anything is not as `serialize` writes it; the text is the reason.
    """
    if not HEADER_BYTES <= len(data) <= MAX_PACKET_BYTES:
        raise MalformedError(f"{len(data)} bytes, expected {HEADER_BYTES} to {MAX_PACKET_BYTES}")
    fields = data[: _FIELDS.size]
    magic, version, kind, sender, receiver, sequence, round_, message, offset, total, length = _FIELDS.unpack(
        fields
    )
    payload = data[HEADER_BYTES:]
    if magic != MAGIC:
        raise MalformedError(f"magic {magic!r}, expected {MAGIC!r}")
    if version != VERSION:
        raise MalformedError(f"version {version}, expected {VERSION}")
    if length != len(payload):
        raise MalformedError(f"length {length} in the header, {len(payload)} bytes follow")
    if _CRC.unpack_from(data, _FIELDS.size)[0] != zlib.crc32(payload, zlib.crc32(fields)):
        raise MalformedError("CRC does not match")
    if kind not in Kind._value2member_map_:
        raise MalformedError(f"unknown kind {kind}")
    kind = Kind(kind)
    if sender == receiver:
        raise MalformedError("sender and receiver are the same robot")
    step = chunk_bytes(kind)
    if kind in FIRE_AND_FORGET and (offset, total) != (0, length):
        raise MalformedError(f"{kind.name} must be one packet, found offset {offset} of {total}")
    if offset % step or (offset >= total and (offset, total) != (0, 0)):
        raise MalformedError(f"offset {offset} is not a cut of a {kind.name} of {total} bytes")
    if length != min(step, total - offset):
        raise MalformedError(
            f"{length} bytes at offset {offset} of {total}, expected {min(step, total - offset)}"
        )
    return Packet(
        kind=kind,
        sender=sender,
        receiver=receiver,
        sequence=sequence,
        round=round_,
        message=message,
        offset=offset,
        total=total,
        payload=payload,
    )
