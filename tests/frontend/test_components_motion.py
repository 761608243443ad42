"""Each component of a robot is optimized on images that are moved by its own motion."""

from types import SimpleNamespace

import numpy as np
import pytest

from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend import component_paths
from duagc.pipeline.frontend.component_paths import optimized_paths
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.geometry.trajectory import Trajectory


class ReachedError(Exception):
    """The optimization begins."""


def test_the_motion_of_another_component_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
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

    monkeypatch.setattr(component_paths, "PathOptimization", optimization)
    moved.append((Trajectory(np.array([1, 2]), np.tile(np.eye(4), (2, 1, 1))),))  # by the component before
    component = SimpleNamespace(numbers=(2,), keyframes=[keyframe], pairs=[])
    with pytest.raises(ReachedError):
        optimized_paths(log, [component], tracked, FrontendConfig(), seed=0, checkpoints=NO_CHECKPOINTS)
    assert [part.stamps_ns.tolist() for part in moved[-1]] == [[1, 2], [3, 4]]
