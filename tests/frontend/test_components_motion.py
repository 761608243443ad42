"""Each component of a robot is optimized on images that are moved by its own motion."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS
from duagc.pipeline.base.lap_times import LapTimes
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend import stage
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.geometry.trajectory import Trajectory


class ReachedError(Exception):
    """The optimization begins."""


def test_the_motion_of_another_component_is_forgotten(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    moved: list[tuple[Trajectory, ...]] = []
    log = SimpleNamespace(robot="alpha", move_depth=lambda *parts: moved.append(parts))
    keyframe = SimpleNamespace(T_map_keyframe=np.eye(4))
    submaps = [SimpleNamespace(number=number, keyframes=[keyframe]) for number in (0, 1)]
    frames = [
        SimpleNamespace(status=Status.OK, keyframe_index=0, T_keyframe_camera=np.eye(4), stamp_ns=stamp)
        for stamp in (1, 2, 3, 4)
    ]
    tracked = SimpleNamespace(frames=frames, submap_of=[0, 0, 1, 1], submaps=submaps)

    def optimization(*_: object) -> None:
        raise ReachedError

    monkeypatch.setattr(stage, "PathOptimization", optimization)
    of_component = stage._ComponentStage(
        log=log,
        name="alpha-2",
        config=FrontendConfig(),
        seed=0,
        threads=1,
        progress=False,
        noise_m=None,
        depth="blended",
        clock=LapTimes(),
        checkpoints=NO_CHECKPOINTS,
    )
    moved.append((Trajectory(np.array([1, 2]), np.tile(np.eye(4), (2, 1, 1))),))  # by the component before
    component = SimpleNamespace(keyframes=[keyframe], pairs=[])
    with pytest.raises(ReachedError):
        of_component.run(component, frames, tracked, tmp_path / "alpha.2.mcap")
    assert [part.stamps_ns.tolist() for part in moved[-1]] == [[1, 2], [3, 4]]
