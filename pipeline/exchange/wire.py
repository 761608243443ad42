"""Bytes of every kind of message, and their strict reading. Little-endian throughout.

Readers trust nothing: every count is checked against the bytes that are there, every index against its limit, every
number that enters the mathematics must be finite. What does not fit raises MalformedError with the reason.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.consensus.cycles import Proposal
from pipeline.consensus.evidence import unpack_symmetric
from pipeline.consensus.links import SharedKeyframes
from pipeline.exchange.compact import COMPACT, decode, encode
from pipeline.exchange.packets import (
    EVIDENCE_BYTES,
    EVIDENCE_DOUBLE_BYTES,
    EVIDENCE_EXACT_BYTES,
    EVIDENCE_HEAD_BYTES,
    EVIDENCE_KINDS,
    Kind,
    MalformedError,
    chunk_bytes,
    records_per_chunk,
)
from pipeline.registration import Reference, ReferenceLevel
from pipeline.registration.features import DIMENSIONS, Descriptors, Features

Array = NDArray[np.float64]

MAX_KEYFRAMES = 100_000
MAX_COORDINATE = 1e6  # m, or units of theta; beyond it positions lose their meaning
MAX_INFORMATION = 1e15  # of a coordinate, 1/m^2: 30 nm
INDEFINITE_TOLERANCE = 1e-4  # of the largest eigenvalue: rounding of float32
MAX_LOG_COVARIANCE = 60.0  # beyond it exponentials overflow in float32
ROTATION_TOLERANCE = 1e-6  # of R R' = 1 in a pose that a neighbour sent


class Reader:
    """Walks through the bytes of a message and never past their end."""

    def __init__(self, data: bytes, what: str) -> None:
        self.data, self.what, self.position = data, what, 0

    def fields(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Fixed fields."""
        return layout.unpack(self._take(layout.size))

    def array(self, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """An array in C order; floats must be finite."""
        kind = np.dtype(dtype).newbyteorder("<")
        count = 1
        for n in shape:
            count *= n
        values = np.frombuffer(self._take(count * kind.itemsize), kind).reshape(shape).astype(dtype)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise MalformedError(f"{self.what}: not a finite number")
        return values

    def poses(self, n: int) -> Array:
        """Motions [n, 4, 4] from their upper rows, float64."""
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, :3] = self.array("float64", (n, 3, 4))
        R = T[:, :3, :3]
        if np.abs(R).max(initial=0.0) > 2.0 or np.abs(T[:, :3, 3]).max(initial=0.0) > MAX_COORDINATE:
            raise MalformedError(f"{self.what}: a pose is not a rigid motion, or beyond {MAX_COORDINATE:g} m")
        off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(initial=0.0)
        if off > ROTATION_TOLERANCE or np.linalg.det(R).min(initial=1.0) < 0:
            raise MalformedError(f"{self.what}: a pose is not a rigid motion")
        return T

    def done(self) -> None:
        """Check that nothing is left."""
        if self.position != len(self.data):
            raise MalformedError(f"{self.what}: {len(self.data) - self.position} bytes too many")

    def _take(self, size: int) -> bytes:
        if self.position + size > len(self.data):
            raise MalformedError(f"{self.what}: {len(self.data)} bytes, more were announced")
        part = self.data[self.position : self.position + size]
        self.position += size
        return part


def array_bytes(values: Any, dtype: str) -> bytes:
    """Little-endian bytes in C order."""
    return np.ascontiguousarray(values, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()


def pose_bytes(T: Array) -> bytes:
    """Upper rows of motions [..., 4, 4], float64."""
    return array_bytes(np.asarray(T)[..., :3, :], "float64")


# --- state: once per link and round


@dataclass(frozen=True)
class State:
    """Where an agent stands, as it tells its neighbours in every round.

    links: pairs of robots whose relative frame it knows. parted: those of them that it knows to have been parted; what
    else is told holds for the team without them. Both are bit masks over the pairs of the team (`pair_bit`).
    frames_hops, still_hops: how many hops around it everybody has decided on all links, and holds still; 0 = not
    itself. agreed: its poses are final. done: it needs nothing more. sources: uint8 [team], for each owner of
    evidence where it comes from: a neighbour's index, COMPLETE or NOBODY.
    """

    links: int
    parted: int
    frames_hops: int
    still_hops: int
    agreed: bool
    done: bool
    sources: NDArray[np.uint8]


COMPLETE, NOBODY = 254, 255
MAX_TEAM = 64
_STATE = struct.Struct("<BBBB")


def pair_bit(a: int, b: int) -> int:
    """The bit of a pair of robots, by index, in a mask over all pairs."""
    lower, higher = min(a, b), max(a, b)
    return 1 << (higher * (higher - 1) // 2 + lower)


def _pairs_bytes(pairs: int, team: int) -> bytes:
    return pairs.to_bytes(_pairs_size(team), "little")


def _pairs_size(team: int) -> int:
    return -(-(team * (team - 1) // 2) // 8)


def _read_pairs(reader: Reader, team: int) -> int:
    """A mask over the pairs of the team."""
    pairs = int.from_bytes(reader.array("uint8", (_pairs_size(team),)).tobytes(), "little")
    if pairs >> (team * (team - 1) // 2):
        raise MalformedError(f"{reader.what}: names a pair outside the team")
    return pairs


def write_state(state: State) -> bytes:
    """Bytes of a state; the poses of the round may follow."""
    flags, team = int(state.agreed) | 2 * int(state.done), len(state.sources)
    head = _STATE.pack(state.frames_hops, state.still_hops, flags, team)
    masks = _pairs_bytes(state.links, team) + _pairs_bytes(state.parted, team)
    return head + array_bytes(state.sources, "uint8") + masks


def read_state(data: bytes, team: int) -> tuple[State, bytes]:
    """A state and the bytes that follow it."""
    reader = Reader(data, "state")
    frames_hops, still_hops, flags, n = reader.fields(_STATE)
    if n != team:
        raise MalformedError(f"state: about a team of {n}, expected {team}")
    if flags > 3:
        raise MalformedError("state: unknown flags")
    sources = reader.array("uint8", (n,))
    links, parted = _read_pairs(reader, team), _read_pairs(reader, team)
    state = State(links, parted, frames_hops, still_hops, bool(flags & 1), bool(flags & 2), sources)
    return state, data[reader.position :]


def write_labelled(parted: int, team: int, payload: bytes) -> bytes:
    """Bytes of TREE: a message of the solver, for the team without these links."""
    return _pairs_bytes(parted, team) + payload


def read_labelled(data: bytes, team: int) -> tuple[int, bytes]:
    """From TREE: the parted links, and the message."""
    reader = Reader(data, "elimination")
    return _read_pairs(reader, team), data[reader.position :]


# --- places

DIGEST_BYTES = 8


def read_digest(data: bytes) -> bytes:
    """From HELLO."""
    if len(data) != DIGEST_BYTES:
        raise MalformedError(f"hello: {len(data)} bytes, expected {DIGEST_BYTES}")
    return data


@dataclass(frozen=True)
class PlaceBook:
    """What a robot tells its neighbour to let it recognise places.

    descriptors: one array per keyframe. T_first_keyframe: [n, 4, 4], as seen from its
    first keyframe. drift: [n, 2], accumulated variance of its
    odometry from keyframe 0 (m^2, rad^2).
    """

    descriptors: list[Descriptors]
    T_first_keyframe: Array
    drift: Array


_COUNT = struct.Struct("<I")


def write_places(book: PlaceBook) -> bytes:
    """Bytes of DESCRIPTORS."""
    return b"".join(
        [
            _COUNT.pack(len(book.descriptors)),
            pose_bytes(book.T_first_keyframe),
            array_bytes(book.drift, "float64"),
            array_bytes([len(d) for d in book.descriptors], "uint16"),
            *(array_bytes(d, "uint8") for d in book.descriptors),
        ]
    )


def read_places(data: bytes) -> PlaceBook:
    """From DESCRIPTORS."""
    reader = Reader(data, "descriptors")
    n = _keyframe_count(reader)
    T, drift = reader.poses(n), reader.array("float64", (n, 2))
    if n and (drift.min() < 0 or drift.max() > 1e12 or np.diff(drift, axis=0).min(initial=0.0) < 0):
        raise MalformedError("descriptors: the drift of the odometry must grow from zero")
    counts = reader.array("uint16", (n,)).tolist()
    book = PlaceBook([reader.array("uint8", (count, DIMENSIONS)) for count in counts], T, drift)
    reader.done()
    return book


def _keyframe_count(reader: Reader) -> int:
    (n,) = reader.fields(_COUNT)
    if n > MAX_KEYFRAMES:
        raise MalformedError(f"{reader.what}: {n} keyframes, at most {MAX_KEYFRAMES}")
    return int(n)


def write_indices(indices: list[int]) -> bytes:
    """Bytes of REQUEST: keyframe indices."""
    return array_bytes(indices, "uint32")


def read_indices(data: bytes, limit: int) -> list[int]:
    """From REQUEST: ascending keyframe indices below `limit`."""
    if len(data) % 4:
        raise MalformedError("request: not a list of indices")
    indices = Reader(data, "request").array("uint32", (len(data) // 4,)).tolist()
    if indices != sorted(set(indices)) or (indices and indices[-1] >= limit):
        raise MalformedError(f"request: indices must ascend and stay below {limit}")
    return indices


# --- the verdict on a pair of robots


@dataclass(frozen=True)
class Verdicts:
    """What the lower-named end found out about a pair.

    candidates, verified, consistent: pairs of keyframes that were tried, that became closures, that agree.
    joined: the two robots share a frame. shared: then, the keyframes of the higher end that the lower one copies, and
    their metric.
    """

    candidates: int
    verified: int
    consistent: int
    joined: bool
    shared: SharedKeyframes


_VERDICTS = struct.Struct("<IIIBI")


def write_verdicts(verdicts: Verdicts) -> bytes:
    """Bytes of CLOSURES."""
    n = len(verdicts.shared.keyframes)
    head = (verdicts.candidates, verdicts.verified, verdicts.consistent, verdicts.joined, n)
    return b"".join(
        [
            _VERDICTS.pack(*head),
            array_bytes(verdicts.shared.keyframes, "int32"),
            array_bytes(verdicts.shared.metric, "float32"),
        ]
    )


def read_verdicts(data: bytes, limit: int) -> Verdicts:
    """From CLOSURES about keyframes below `limit`."""
    reader = Reader(data, "closures")
    candidates, verified, consistent, joined, n = reader.fields(_VERDICTS)
    if joined > 1 or bool(joined) != bool(n) or n > MAX_KEYFRAMES:
        raise MalformedError("closures: joined robots share keyframes, others do not")
    keyframes, metric = reader.array("int32", (n,)), reader.array("float32", (n, 6))
    reader.done()
    if n and (keyframes[0] < 0 or keyframes[-1] >= limit or np.diff(keyframes).min(initial=1) < 1):
        raise MalformedError(f"closures: shared keyframes must ascend and stay below {limit}")
    if n and not (metric.min() > 0 and metric.max() < 1e15):
        raise MalformedError("closures: the metric must be positive")
    return Verdicts(candidates, verified, consistent, bool(joined), SharedKeyframes(keyframes, metric))


# --- one keyframe


@dataclass(frozen=True)
class KeyframeSample:
    """What is needed of a keyframe to verify a closure with it: features, and samples for the registration."""

    keyframe: int
    features: Features
    reference: Reference


_SAMPLE = struct.Struct("<IHfHBf")
_INT16 = 32767


def write_sample(sample: KeyframeSample) -> bytes:
    """Bytes of SAMPLE; points in steps of the largest coordinate / 32767, normals in bytes, grey in bytes."""
    levels = sample.reference.levels
    feature_scale, feature_points = _shorts(sample.features.points)
    sample_scale, sample_points = _shorts(levels[0].points)
    return b"".join(
        [
            _SAMPLE.pack(
                sample.keyframe,
                len(sample.features),
                feature_scale,
                len(levels[0]),
                len(levels),
                sample_scale,
            ),
            array_bytes(sample.features.descriptors, "uint8"),
            feature_points,
            sample_points,
            array_bytes(np.rint(levels[0].normals * 127), "int8"),
            *(array_bytes(np.rint(np.clip(level.intensities, 0, 1) * 255), "uint8") for level in levels),
        ]
    )


def read_sample(data: bytes, limit: int) -> KeyframeSample:
    """From SAMPLE of a keyframe below `limit`."""
    reader = Reader(data, "sample")
    keyframe, n, feature_scale, m, levels, sample_scale = reader.fields(_SAMPLE)
    if keyframe >= limit:
        raise MalformedError(f"sample: keyframe {keyframe}, expected one below {limit}")
    if not (0 <= feature_scale < 1 and 0 <= sample_scale < 1) or not 1 <= levels <= 8:
        raise MalformedError("sample: impossible scale of points or number of levels")
    descriptors = reader.array("uint8", (n, DIMENSIONS))
    points = reader.array("int16", (n, 3)).astype(np.float32) * np.float32(feature_scale)
    sample_points = reader.array("int16", (m, 3)).astype(np.float32) * np.float32(sample_scale)
    normals = reader.array("int8", (m, 3)).astype(np.float32)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if m and length.min() == 0:
        raise MalformedError("sample: a normal of length zero")
    normals = (normals / np.maximum(length, np.float32(1e-6))).astype(np.float32)
    grays = [reader.array("uint8", (m,)).astype(np.float32) / np.float32(255) for _ in range(levels)]
    reader.done()
    reference = Reference(tuple(ReferenceLevel(sample_points, normals, gray) for gray in grays))
    return KeyframeSample(keyframe, Features(descriptors, points), reference)


def _shorts(points: NDArray[np.float32]) -> tuple[float, bytes]:
    """Step (m) and bytes of points in that step; the step as it will be read back."""
    largest = float(np.abs(points).max(initial=0.0))
    step = np.float32(largest * 1.000001 / _INT16)
    return float(step), array_bytes(np.rint(points / max(step, np.float32(1e-12))), "int16")


# --- frames and final poses


_FRAME = struct.Struct("<HHB")
_PROPOSAL = struct.Struct("<Iddd")
MAX_PROPOSALS = 8


@dataclass(frozen=True)
class PairFrames:
    """What the closures of two robots say of their relative frame, best supported first; lower index first."""

    lower: int
    higher: int
    proposals: tuple[Proposal, ...]


def write_frames(frames: PairFrames) -> bytes:
    """Bytes of FRAME."""
    parts = [_FRAME.pack(frames.lower, frames.higher, len(frames.proposals))]
    for p in frames.proposals:
        parts += [_PROPOSAL.pack(p.support, *p.variance, p.agreement), pose_bytes(p.T_a_b)]
    return b"".join(parts)


def read_frames(data: bytes, team: int) -> PairFrames:
    """From FRAME."""
    reader = Reader(data, "frame")
    lower, higher, n = reader.fields(_FRAME)
    if not lower < higher < team or not 1 <= n <= MAX_PROPOSALS:
        raise MalformedError("frame: the two robots must be in the team, lower first, and have a frame")
    proposals = []
    for _ in range(n):
        support, *variance, agreement = reader.fields(_PROPOSAL)
        if not (all(0 < v < MAX_COORDINATE**2 for v in variance) and 0 <= agreement <= 1):
            raise MalformedError("frame: impossible variance or agreement")
        proposals.append(Proposal(support, reader.poses(1)[0], (variance[0], variance[1]), agreement))
    reader.done()
    return PairFrames(lower, higher, tuple(proposals))


@dataclass(frozen=True)
class Anchors:
    """Agreed poses of one robot's keyframes in the common frame of the consensus, and of the first in its own map.

    T_common_keyframe: [n, 4, 4]. T_map_first: [4, 4].
    """

    owner: int
    T_common_keyframe: Array
    T_map_first: Array


_OWNER = struct.Struct("<HI")


def write_anchors(anchors: Anchors) -> bytes:
    """Bytes of ANCHORS."""
    head = _OWNER.pack(anchors.owner, len(anchors.T_common_keyframe))
    return head + pose_bytes(anchors.T_map_first) + pose_bytes(anchors.T_common_keyframe)


def read_anchors(data: bytes, team: int) -> Anchors:
    """From ANCHORS."""
    reader = Reader(data, "anchors")
    owner, n = reader.fields(_OWNER)
    if owner >= team or not 1 <= n <= MAX_KEYFRAMES:
        raise MalformedError("anchors: names a robot outside the team, or no keyframe")
    first, T = reader.poses(1)[0], reader.poses(n)
    reader.done()
    return Anchors(owner, T, first)


# --- space seen, matched Gaussians


def write_voxels(owner: int, keys: NDArray[np.int64]) -> bytes:
    """Bytes of VOXELS: ascending keys of the voxels that `owner` saw, differences in LEB128."""
    out = bytearray(_OWNER.pack(owner, len(keys)))
    for step in np.diff(keys, prepend=np.int64(0)).tolist():
        while step > 127:
            out.append(step & 127 | 128)
            step >>= 7
        out.append(step)
    return bytes(out)


def read_voxels(data: bytes, team: int) -> tuple[int, NDArray[np.int64]]:
    """From VOXELS: owner and ascending keys."""
    reader = Reader(data, "voxels")
    owner, n = reader.fields(_OWNER)
    values = np.frombuffer(data, np.uint8, offset=_OWNER.size).astype(np.int64)
    last = np.flatnonzero(values < 128)
    if owner >= team or len(last) != n or (len(values) and values[-1] >= 128):
        raise MalformedError("voxels: the list does not have the announced length")
    first = np.concatenate([[0], last[:-1] + 1]) if n else last
    place = np.arange(len(values)) - np.repeat(first, last - first + 1)
    if place.max(initial=0) > 8:
        raise MalformedError("voxels: a number is too large")
    steps = np.add.reduceat((values & 127) << (7 * place), first) if n else np.zeros(0, np.int64)
    if n > 1 and steps[1:].min() < 1:
        raise MalformedError("voxels: keys must ascend")
    if float(steps.astype(np.float64).sum()) >= 2.0**63:
        raise MalformedError("voxels: a number is too large")
    return owner, np.cumsum(steps)


_PAIRS = struct.Struct("<HHHI")


@dataclass(frozen=True)
class PairList:
    """Matched Gaussians of two robots, lower index first.

    ids: int64 [n, 2]. version: of the list; a later one replaces an earlier one.
    """

    lower: int
    higher: int
    version: int
    ids: NDArray[np.int64]


def write_pairs(pairs: PairList) -> bytes:
    """Bytes of PAIRS."""
    head = _PAIRS.pack(pairs.lower, pairs.higher, pairs.version, len(pairs.ids))
    return head + array_bytes(pairs.ids, "int64")


def read_pairs(data: bytes, team: int) -> PairList:
    """From PAIRS."""
    reader = Reader(data, "pairs")
    lower, higher, version, n = reader.fields(_PAIRS)
    if not lower < higher < team:
        raise MalformedError("pairs: the two robots must be in the team, lower first")
    ids = reader.array("int64", (n, 2))
    reader.done()
    if len(np.unique(ids[:, 0])) != n or len(np.unique(ids[:, 1])) != n:
        raise MalformedError("pairs: a Gaussian is matched twice")
    return PairList(lower, higher, version, ids)


# --- evidence

RECORD = np.dtype([("id", "<i8"), ("anchor", "<i4"), ("theta", "<f4", 13), ("information", "<f4", 31)])
RECORD_DOUBLE = np.dtype([("id", "<i8"), ("anchor", "<i4"), ("theta", "<f8", 13), ("information", "<f8", 31)])
_EVIDENCE = struct.Struct("<HHI")  # owner, version, records of the whole message
assert RECORD.itemsize == EVIDENCE_EXACT_BYTES
assert RECORD_DOUBLE.itemsize == EVIDENCE_DOUBLE_BYTES
assert COMPACT.itemsize == EVIDENCE_BYTES
assert _EVIDENCE.size == EVIDENCE_HEAD_BYTES


def record_dtype(kind: Kind) -> np.dtype[Any]:
    """Records as they are made and read for this kind of evidence."""
    return RECORD_DOUBLE if kind is Kind.EVIDENCE_DOUBLE else RECORD


def to_body(kind: Kind, records: NDArray[Any]) -> NDArray[Any]:
    """Records as they stand in a packet of this kind. Rounding happens here, once: a body is handed on as it is."""
    return encode(records) if kind is Kind.EVIDENCE else records


def from_body(kind: Kind, body: NDArray[Any]) -> NDArray[Any]:
    """Records as every receiver reads them."""
    return decode(body, RECORD) if kind is Kind.EVIDENCE else body


def write_evidence(kind: Kind, owner: int, version: int, body: NDArray[Any]) -> bytes:
    """Bytes of evidence of any kind: chunks of whole records, each with its own head, as they are cut."""
    n, per, size = len(body), records_per_chunk(kind), body.itemsize
    head = _EVIDENCE.pack(owner, version, n)
    chunks = max(1, -(-n // per))
    rows = np.zeros((chunks, chunk_bytes(kind)), np.uint8)
    rows[:, :EVIDENCE_HEAD_BYTES] = np.frombuffer(head, np.uint8)
    padded = np.zeros(chunks * per, body.dtype)
    padded[:n] = body
    rows[:, EVIDENCE_HEAD_BYTES:] = padded.view(np.uint8).reshape(chunks, per * size)
    return rows.tobytes()[: chunks * EVIDENCE_HEAD_BYTES + n * size]


def read_evidence_head(kind: Kind, chunk: bytes, team: int) -> tuple[int, int]:
    """Owner of a chunk of evidence and the number of records of the whole message."""
    owner, _, n = Reader(chunk[:EVIDENCE_HEAD_BYTES], "evidence").fields(_EVIDENCE)
    if owner >= team or (len(chunk) - EVIDENCE_HEAD_BYTES) % EVIDENCE_KINDS[kind]:
        raise MalformedError("evidence: names a robot outside the team, or holds a part of a record")
    return owner, n


def read_evidence(kind: Kind, data: bytes, team: int) -> tuple[int, NDArray[Any], NDArray[Any]]:
    """Owner, body and records of any number of consecutive chunks of one message, each id once.

    A complete message has the announced number of records; parts of one have fewer.
    """
    owner, announced = read_evidence_head(kind, data[:EVIDENCE_HEAD_BYTES], team)
    step = chunk_bytes(kind)
    chunks = -(-len(data) // step)
    padded = np.zeros(chunks * step, np.uint8)
    padded[: len(data)] = np.frombuffer(data, np.uint8)
    rows = padded.reshape(chunks, step)
    if (rows[:, :EVIDENCE_HEAD_BYTES] != rows[0, :EVIDENCE_HEAD_BYTES]).any():
        raise MalformedError("evidence: chunks of different messages")
    n, odd = divmod(len(data) - chunks * EVIDENCE_HEAD_BYTES, EVIDENCE_KINDS[kind])
    if odd or n > announced:
        raise MalformedError(f"evidence: {len(data)} bytes are no {announced} records")
    flat = np.ascontiguousarray(rows[:, EVIDENCE_HEAD_BYTES:]).reshape(-1)
    body: NDArray[Any] = flat.view(COMPACT if kind is Kind.EVIDENCE else record_dtype(kind))[:n].copy()
    for name in body.dtype.names or ():
        if body[name].dtype.kind == "f" and not np.isfinite(body[name]).all():
            raise MalformedError("evidence: not a finite number")
    records = from_body(kind, body)
    check_evidence(records)
    if kind is not Kind.EVIDENCE:  # the factors of the compact kind cannot say anything impossible
        check_information(records["information"].astype(np.float64))
    return owner, body, records


def check_evidence(records: NDArray[Any]) -> None:
    """Refuse records with impossible numbers. Raises MalformedError."""
    theta = records["theta"]
    if len(records) and (
        np.abs(theta).max() > MAX_COORDINATE or np.abs(theta[:, 3:9]).max() > MAX_LOG_COVARIANCE
    ):
        raise MalformedError("evidence: a Gaussian of impossible place or size")
    if len(records) and records["anchor"].min() < 0:
        raise MalformedError("evidence: a negative keyframe")
    if len(np.unique(records["id"])) != len(records):
        raise MalformedError("evidence: a Gaussian twice")


def check_information(information: Array) -> None:
    """Refuse information [n, 31] that no measurement can give: indefinite, or beyond all sensors.

    Raises:
        MalformedError: with the reason.
    """
    if np.abs(information).max(initial=0.0) > MAX_INFORMATION:
        raise MalformedError(f"evidence: information beyond {MAX_INFORMATION:g}")
    if information[:, 27:].min(initial=0.0) < 0:
        raise MalformedError("evidence: negative information")
    for part, size in ((slice(0, 6), 3), (slice(6, 27), 6)):
        values = np.linalg.eigvalsh(unpack_symmetric(information[:, part], size))
        if (values[:, 0] < -INDEFINITE_TOLERANCE * np.maximum(values[:, -1], 1e-6)).any():
            raise MalformedError("evidence: indefinite information")
