"""What a robot takes home from a session, as a file: the exchange writes it and the fusion of that robot reads it."""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import check_file, new_file
from duagc.pipeline.base.shelf import LARGE_BYTES, SHELF
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.runs.robot_data import LoopClosureRecord, SessionResult

NAME = "session.npz"
SCHEMA = 3
_DAMAGE = (  # what reading a damaged file raises; RuntimeError: a flag or a method that zipfile does not know
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    RuntimeError,
)


def write_session_result(path: Path, result: SessionResult) -> None:
    """Write the result of a session.

    Args:
        path: of the file.
        result: of one robot.
    """
    arrays = _Arrays()
    plain = {
        "schema": SCHEMA,
        "robot": result.robot,
        "component": list(result.component),
        "T_world_keyframe": arrays.add(result.T_world_keyframe),
        "T_world_keyframe_of": {name: arrays.add(T) for name, T in result.T_world_keyframe_of.items()},
        "own_evidence": _plain_evidence(result.own_evidence, arrays),
        "evidence": {name: _plain_evidence(e, arrays) for name, e in result.evidence.items()},
        "depth_of": result.depth_of,
        "camera_of": {name: asdict(camera) for name, camera in result.camera_of.items()},
        "arrived": result.arrived,
        "pairs": [[lower, higher, arrays.add(ids)] for (lower, higher), ids in result.pairs.items()],
        "closures": [_plain_closure(closure, arrays) for closure in result.closures],
        "agreed": result.agreed,
        "converged": result.converged,
        "rounds": result.rounds,
        "rounds_to_agreement": result.rounds_to_agreement,
        "refused": result.refused,
        "types": [str(array.dtype) for array in arrays.arrays],
    }
    with new_file(path) as part, zipfile.ZipFile(part, "w") as file:  # compressed it would be a fifth smaller
        with file.open("result.json", "w") as stream:  # unlike `writestr` it writes no time
            stream.write(json.dumps(plain).encode())
        for number, array in enumerate(arrays.arrays):
            with file.open(f"{number}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, _narrowed(array), allow_pickle=False)
            if array.nbytes > LARGE_BYTES:
                SHELF.sweep(heap=True)


def read_session_result(path: Path) -> SessionResult:
    """Read the result of a session.

    Args:
        path: of the file.

    Raises:
        DuagError: it is missing, damaged or of another version.
    """
    check_file(path, "the result of a session")
    try:
        with zipfile.ZipFile(path) as file:
            plain = json.loads(file.read("result.json"))
            if plain["schema"] != SCHEMA:
                raise DuagError(f"{path}: schema is {plain['schema']}, expected {SCHEMA}")
            return _result(plain, _Reader(file, plain["types"]))
    except _DAMAGE as error:
        raise DuagError(
            f"{path}: {str(error) or 'ends too early'}, expected the result of a session"
        ) from error


@dataclass
class _Arrays:
    """Arrays by number, as they stand in the file."""

    arrays: list[NDArray[Any]] = field(default_factory=list)

    def add(self, array: NDArray[Any]) -> int:
        self.arrays.append(array)
        return len(self.arrays) - 1


@dataclass(frozen=True)
class _Reader:
    file: zipfile.ZipFile
    types: list[str]

    def __call__(self, number: int | None) -> Any:
        if number is None:
            return None
        with self.file.open(f"{number}.npy") as stream:
            array = np.lib.format.read_array(stream, allow_pickle=False)
        return array.astype(self.types[number], copy=False)


def _narrowed(array: NDArray[Any]) -> NDArray[Any]:
    """The array in half the bytes where that loses no bit, as of evidence, which is rounded before it is sent."""
    if array.dtype == np.float64:
        narrow = array.astype(np.float32)
        if np.array_equal(narrow, array):
            return np.ascontiguousarray(narrow)
    return np.ascontiguousarray(array)


def _plain_evidence(evidence: Evidence, arrays: _Arrays) -> dict[str, Any]:
    parts = ("ids", "anchors", "theta", "information")
    return {"owner": evidence.owner, **{part: arrays.add(getattr(evidence, part)) for part in parts}}


def _plain_closure(closure: LoopClosureRecord, arrays: _Arrays) -> dict[str, Any]:
    found = {"T_own_peer": closure.T_own_peer, "information": closure.information}
    numbers = {name: None if array is None else arrays.add(array) for name, array in found.items()}
    return asdict(replace(closure, T_own_peer=None, information=None)) | numbers


def _evidence(plain: dict[str, Any], array: _Reader) -> Evidence:
    found = {name: value if name == "owner" else array(value) for name, value in plain.items()}
    return SHELF.put(Evidence(**found))


def _closure(plain: dict[str, Any], array: _Reader) -> LoopClosureRecord:
    arrays = {name: array(plain[name]) for name in ("T_own_peer", "information")}
    return LoopClosureRecord(**(plain | arrays))


def _result(plain: dict[str, Any], array: _Reader) -> SessionResult:
    return SessionResult(
        robot=plain["robot"],
        component=tuple(plain["component"]),
        T_world_keyframe=array(plain["T_world_keyframe"]),
        T_world_keyframe_of={name: array(T) for name, T in plain["T_world_keyframe_of"].items()},
        own_evidence=_evidence(plain["own_evidence"], array),
        evidence={name: _evidence(e, array) for name, e in plain["evidence"].items()},
        depth_of=plain["depth_of"],
        camera_of={name: PinholeCamera(**camera) for name, camera in plain["camera_of"].items()},
        arrived=plain["arrived"],
        pairs={(lower, higher): array(ids) for lower, higher, ids in plain["pairs"]},
        closures=tuple(_closure(closure, array) for closure in plain["closures"]),
        agreed=plain["agreed"],
        converged=plain["converged"],
        rounds=plain["rounds"],
        rounds_to_agreement=plain["rounds_to_agreement"],
        refused=plain["refused"],
    )
