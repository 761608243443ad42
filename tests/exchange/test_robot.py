"""What an agent reads before its first packet: complaints name file, topic and what was expected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.messages import GaussianMap, Keyframe, KeyframeFactor
from duagc.pipeline.recording import LogWriter
from duagc.pipeline.runs.robot_data import AgentInput, load, registrations_of
from duagc.schemas import topics


def write(
    folder: Path,
    data: Any,
    numbers: tuple[int, ...] = (0, 1),
    with_map: bool = True,
    first: int = 0,
    ties: tuple[tuple[int, int], ...] = ((0, 1),),
) -> AgentInput:
    """A robot's frontend.mcap and information.mcap; its sensor log does not exist."""
    files = folder / "alpha.mcap", folder / "frontend.mcap", folder / "information.mcap"
    source = AgentInput("alpha", *files, thickness_floor_m=1e-3)
    with LogWriter(source.frontend, robot="alpha") as log:
        for number in numbers:
            keyframe = Keyframe(
                number, "alpha", number, 8 * number, np.eye(4), number - 1, np.eye(4), np.eye(6), (1, 0)
            )
            log.write(topics.KEYFRAME.of("alpha"), keyframe, number)
        for i, j in ties:
            factor = KeyframeFactor(j, "alpha", i, j, np.eye(4), np.eye(6), 0.5)
            log.write(topics.KEYFRAME_FACTOR.of("alpha"), factor, 2)
        if with_map:
            log.write(
                topics.MAP.of("alpha"),
                GaussianMap(9, "alpha", "alpha/map", data.gaussians.select(slice(first, 99))),
                9,
            )
    with LogWriter(source.information, robot="alpha") as log:
        log.write(topics.INFORMATION.of("alpha"), data.information, 9)
    return source


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"with_map": False}, r"frontend.mcap: /alpha/map not found"),
        ({"numbers": (0, 2)}, r"frontend.mcap: /alpha/keyframe is not numbered"),
        ({"first": 1}, r"information.mcap: is about other Gaussians"),
        ({"ties": ()}, r"frontend.mcap: registrations tie keyframe 1 to no other"),
        (
            {"ties": ((0, 1), (1, 2))},
            r"frontend.mcap: a registration ties keyframes 1 and 2, expected two of 2",
        ),
        ({"ties": ((1, 0),)}, r"frontend.mcap: a registration ties keyframes 1 and 0"),
        ({}, r"alpha.mcap"),  # the sensor log itself
    ],
)
def test_files_that_do_not_belong_together(
    tmp_path: Path, make_robot: Any, changes: dict[str, Any], complaint: str
) -> None:
    data, _ = make_robot("alpha", 0.0, 1, 20)
    with pytest.raises(DuagError, match=complaint):
        load(write(tmp_path, data, **changes))


def test_a_keyframe_may_be_tied_by_later_ones_only() -> None:
    """The first keyframe of a joined submap: loop closures lead from later ones to the map before."""
    T = np.eye(4)
    keyframes = [Keyframe(k, "alpha", k, 8 * k, T, k - 1, T, np.eye(6), (0, 0)) for k in range(4)]
    factors = [KeyframeFactor(j, "alpha", i, j, T, np.eye(6), 1.0) for i, j in ((0, 1), (2, 3), (1, 3))]
    assert len(registrations_of(Path("frontend.mcap"), keyframes, factors)) == 3
    with pytest.raises(DuagError, match="keyframe 2 to no other"):
        registrations_of(Path("frontend.mcap"), keyframes, factors[:1] + factors[2:])


def test_registrations_count_by_their_robust_weight() -> None:
    T = np.eye(4)
    keyframes = [Keyframe(k, "alpha", k, 8 * k, T, k - 1, T, np.eye(6), (0, 0)) for k in range(3)]
    ends = [(0, 1, 1.0), (1, 2, 0.5), (0, 2, 0.25)]
    factors = [KeyframeFactor(j, "alpha", i, j, T, 8 * np.eye(6), weight) for i, j, weight in ends]
    steps = registrations_of(Path("frontend.mcap"), keyframes, factors)
    assert [(s.i, s.j, s.information[0, 0]) for s in steps] == [(0, 1, 8.0), (1, 2, 4.0), (0, 2, 2.0)]
