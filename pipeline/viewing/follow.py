"""A run in Rerun while it is computed. It is served, not written, and no result depends on it.

The process of the run serves; the processes of its robots log to that server. Paths and maps of front ends are in the
frames of their robots; what the team agrees on replaces them when it is fused (`run_rrd`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from duagc.pipeline.base.checkpoints import Shown
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording
from duagc.pipeline.report.figures import color_of
from duagc.pipeline.runs.folder import RunFolder
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.viewing.run_rrd import APPLICATION, ROUND, closed_panels, log_run, rgba, splats, thinned

if TYPE_CHECKING:
    import rerun as rr

LIVE = "live"  # timeline: since the run began
PORT = 9876
EVERY_S = 2.0
LARGEST_SHARE = 0.02
"""Of the time of a stage that showing it may take."""
MOST_GAUSSIANS = 60_000


class Follower:
    """Shows what one process of a run does."""

    def __init__(self, stream: rr.RecordingStream, began_ns: int) -> None:
        """Keep the stream, and the time that its timeline counts from.

        Args:
            stream: that goes to the server.
            began_ns: when the run began, by the clock of the machine.
        """
        self._stream, self._began_ns = stream, began_ns

    @classmethod
    def serving(cls, recording: Recording, port: int = PORT) -> tuple[Follower, tuple[str, str, int]]:
        """Serve a run from this process, until it ends.

        Args:
            recording: that the run is of.
            port: of the server, on all addresses of the machine.

        Returns:
            The follower, and what other processes of the run need: address, name of the run, and its begin.

        Raises:
            DuagError: the port is taken.
        """
        import rerun as rr

        began_ns = time.time_ns()
        name = f"live-{recording.name}-{began_ns}"
        stream = rr.RecordingStream(APPLICATION, recording_id=name)
        _check_port(port)
        address = stream.serve_grpc(grpc_port=port, default_blueprint=_blueprint(recording))
        return cls(stream, began_ns), (address, name, began_ns)

    @classmethod
    def connected(cls, where: tuple[str, str, int]) -> Follower:
        """Log to the server of another process of the run.

        Args:
            where: of `serving`.
        """
        import rerun as rr

        address, name, began_ns = where
        stream = rr.RecordingStream(APPLICATION, recording_id=name)
        stream.connect_grpc(address)
        return cls(stream, began_ns)

    def frontend(self, robot: str, number: int) -> Callable[[str, int, int, Shown | None], None]:
        """Hears of the steps of a front end, and shows its path and its map now and then.

        Args:
            robot: its name.
            number: of the robot, from 0, for its color.
        """
        due_s = 0.0

        def report(part: str, done: int, total: int, shown: Shown | None) -> None:
            nonlocal due_s
            begin_s = time.perf_counter()
            if shown is None or (begin_s < due_s and done != total):
                return
            self._show(robot, number, shown())
            end_s = time.perf_counter()
            due_s = end_s + max(EVERY_S, (end_s - begin_s) / LARGEST_SHARE)

        return report

    def round(self, index: int, counts: Mapping[str, int]) -> None:
        """Show a round of the exchange.

        Args:
            index: of the round.
            counts: of packets, dropped ones and bytes, by what is counted.
        """
        import rerun as rr

        self._now()
        self._stream.set_time(ROUND, sequence=index)
        for name, value in counts.items():
            self._stream.log(f"live/rounds/{name}", rr.Scalars(value))

    def finished(self, run: Path, recording: Path) -> None:
        """Show what the team agrees on: fused maps, paths, keyframes, rounds.

        Args:
            run: its folder.
            recording: its recording.
        """
        self._stream.reset_time()
        log_run(self._stream, RunFolder(run), Recording(recording), MOST_GAUSSIANS)

    def close(self) -> None:
        """Send what is left; of a server: end it."""
        self._stream.flush()
        self._stream.disconnect()

    def _now(self) -> None:
        self._stream.set_time(LIVE, duration=np.timedelta64(time.time_ns() - self._began_ns, "ns"))

    def _show(self, robot: str, number: int, shown: Any) -> None:
        import rerun as rr

        self._now()
        if isinstance(shown, Gaussians):
            few = shown.select(thinned(shown, MOST_GAUSSIANS))
            self._stream.log(f"live/{robot}/map", splats(few, few.colors))
        elif isinstance(shown, Trajectory):
            color = rgba(color_of(number) + "ff")
            strip = rr.LineStrips3D([shown.positions], colors=[color], radii=rr.Radius.ui_points(1.5))
            self._stream.log(f"live/{robot}/path", strip)


def _check_port(port: int) -> None:
    """Rerun would only write to its log that it cannot serve there."""
    import socket

    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("0.0.0.0", port))
        except OSError as error:
            raise DuagError(f"--follow: port {port}: {error.strerror}, expected a free one") from error


def _blueprint(recording: Recording) -> Any:
    """A view for every robot, one for the world, and the rounds."""
    import rerun.blueprint as rrb

    robots = [rrb.Spatial3DView(origin=f"/live/{name}", name=name) for name in recording.robots]
    world = rrb.Spatial3DView(
        origin="/world", contents=["$origin/paths/**", "$origin/maps/*/fused"], name="world"
    )
    rounds = rrb.TimeSeriesView(origin="/live/rounds", name="Exchange, per round")
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(*robots, world), rounds, row_shares=[3, 1]),
        rrb.TimePanel(timeline=LIVE, state="collapsed"),
        *closed_panels(),
    )
