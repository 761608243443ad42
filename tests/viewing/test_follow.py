"""What a run shows while it is computed."""

import socket
from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.viewing.follow import Follower
from tests.fixtures.fake_run import make
from tests.viewing.test_rerun_view import of_rrd


def test_paths_maps_and_rounds_are_shown_and_not_at_every_step(tmp_path: Path) -> None:
    import rerun as rr

    stream = rr.RecordingStream("duagc", recording_id="live-test")
    stream.save(tmp_path / "live.rrd")
    follower = Follower(stream, 0)
    report = follower.frontend("alpha", 0)
    path = Trajectory(np.arange(3), np.tile(np.eye(4), (3, 1, 1)))
    for step in range(50):
        report("tracking", step, 100, lambda: path)
    report("alpha.poses.loops", 1, 2, None)
    report("alpha.final", 100, 100, Gaussians.empty)
    for index in range(3):
        follower.round(index, {"packets": 7, "dropped": 1, "bytes": 1000})
    follower.close()
    found = of_rrd(tmp_path / "live.rrd")
    assert found["/live/alpha/path"]["LineStrips3D:strips"] == 1
    assert any(name.startswith("GaussianSplats3D:") for name in found["/live/alpha/map"])
    assert found["/live/rounds/dropped"]["Scalars:scalars"] == 3


def test_a_port_that_is_taken_is_one_line(tmp_path: Path) -> None:
    recording = Recording(make(tmp_path).recording)
    with socket.socket() as taken:
        taken.bind(("0.0.0.0", 0))
        taken.listen()
        with pytest.raises(
            DuagError, match=r"--follow: port \d+: Address already in use, expected a free one"
        ):
            Follower.serving(recording, taken.getsockname()[1])


def test_what_is_logged_reaches_the_server_of_another_stream(tmp_path: Path) -> None:
    recording = Recording(make(tmp_path).recording)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server, where = Follower.serving(recording, port)
    try:
        other = Follower.connected(where)
        other.round(0, {"packets": 1})
        other.close()
    finally:
        server.close()
    assert where[0].endswith(f":{port}/proxy")
