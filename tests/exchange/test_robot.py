"""What an agent reads before its first packet: complaints name file, topic and what was expected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import DuagError
from pipeline.messages import GaussianMap, Keyframe
from pipeline.recording import LogWriter
from pipeline.robot import AgentInput, load
from schemas import topics


def write(
    folder: Path, data: Any, numbers: tuple[int, ...] = (0, 1), with_map: bool = True, first: int = 0
) -> AgentInput:
    """A robot's frontend.mcap and information.mcap; its sensor log does not exist."""
    source = AgentInput("alpha", folder / "alpha.mcap", folder / "frontend.mcap", folder / "information.mcap")
    with LogWriter(source.frontend, robot="alpha") as log:
        for number in numbers:
            keyframe = Keyframe(
                number, "alpha", number, 8 * number, np.eye(4), number - 1, np.eye(4), np.eye(6), (1, 0)
            )
            log.write(topics.KEYFRAME.of("alpha"), keyframe, number)
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
        ({}, r"alpha.mcap"),  # the sensor log itself
    ],
)
def test_files_that_do_not_belong_together(
    tmp_path: Path, make_robot: Any, changes: dict[str, Any], complaint: str
) -> None:
    data, _ = make_robot("alpha", 0.0, 1, 20)
    with pytest.raises(DuagError, match=complaint):
        load(write(tmp_path, data, **changes))
