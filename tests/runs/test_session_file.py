"""What a robot takes home from a session reads back bit for bit."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.runs.robot_data import LoopClosureRecord, SessionResult
from duagc.pipeline.runs.session_file import read_session_result, write_session_result


def evidence(owner: str, n: int, rounded: bool) -> Evidence:
    rng = np.random.default_rng(n)
    arrays = rng.normal(size=(n, 13)), rng.normal(size=(n, 31))
    theta, information = (a.astype(np.float32).astype(np.float64) if rounded else a for a in arrays)
    return Evidence(owner, np.arange(n) + 7, np.zeros(n, np.int32), theta, information)


def result() -> SessionResult:
    T = np.random.default_rng(1).normal(size=(3, 4, 4))
    T[0, 0, 0] = -0.0
    closure = LoopClosureRecord(
        robot="alpha",
        peer="bravo",
        own_keyframe=1,
        peer_keyframe=2,
        score=30,
        verdict="kept",
        matches=9,
        inliers=8,
        detail="",
        weight=0.5,
        T_own_peer=np.eye(4),
        information=None,
    )
    return SessionResult(
        robot="bravo",
        component=("alpha", "bravo"),
        T_world_keyframe=T,
        T_world_keyframe_of={"bravo": T, "alpha": T[:1]},
        own_evidence=evidence("bravo", 5, rounded=False),
        evidence={"alpha": evidence("alpha", 400, rounded=True)},
        depth_of={"alpha": "ray_plane"},
        camera_of={"alpha": PinholeCamera(640, 480, 525.25, 525.0, 319.5, 239.5)},
        arrived={"alpha": 0.3},
        pairs={("alpha", "bravo"): np.array([[1, 2], [3, 4]])},
        closures=(closure, replace(closure, T_own_peer=None, weight=None)),
        agreed=True,
        converged=False,
        rounds=12,
        rounds_to_agreement=None,
        refused={"late": 2},
    )


def same(first: object, second: object) -> None:
    assert type(first) is type(second)
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        assert first.dtype == second.dtype
        assert first.tobytes() == second.tobytes()
    elif isinstance(first, dict) and isinstance(second, dict):
        assert list(first) == list(second)  # the order counts
        for one, other in zip(first.values(), second.values(), strict=True):
            same(one, other)
    elif isinstance(first, tuple) and isinstance(second, tuple):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            same(one, other)
    elif hasattr(first, "__dict__"):
        same(vars(first), vars(second))
    else:
        assert first == second


def test_it_reads_back_bit_for_bit_and_equal_results_are_equal_bytes(tmp_path: Path) -> None:
    paths = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for path in paths:
        write_session_result(path, result())
    same(read_session_result(paths[0]), result())
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert paths[0].stat().st_size < 0.6 * 400 * (13 + 31) * 8  # rounded evidence takes half


def test_a_damaged_one_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "session.npz"
    with pytest.raises(DuagError, match=r"session\.npz: No such file"):
        read_session_result(path)
    write_session_result(path, result())
    content = bytearray(path.read_bytes())
    for damaged in (content[: len(content) // 2], content[:2000] + b"\0" * 50 + content[2050:]):
        path.write_bytes(damaged)
        with pytest.raises(DuagError, match=r"session\.npz: .*expected the result of a session"):
            read_session_result(path)


def test_no_changed_byte_ends_in_another_error(tmp_path: Path) -> None:
    path = tmp_path / "session.npz"
    write_session_result(path, result())
    content = path.read_bytes()
    directory = content.index(b"PK\x01\x02")
    for at in [*range(26, 60, 3), *range(directory - 2, directory + 60)]:
        path.write_bytes(content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :])
        found = outcome(path)
        if isinstance(found, str):
            assert re.fullmatch(r".*session\.npz: \S.*, expected .+", found)
        else:  # of a name or a time that nothing depends on
            same(found, result())


def outcome(path: Path) -> SessionResult | str:
    """What is read, or the line of the error."""
    try:
        return read_session_result(path)
    except DuagError as error:
        return str(error)
