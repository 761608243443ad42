"""Runs and recordings in Rerun. The only module that imports it; what it writes is no part of a digest.

A run is logged piece by piece (`write_rrd`). A recording opens in Rerun as it is; `recording_to_rrd` adds what the
viewer does not derive by itself: depth images with their unit, names of frames that hang together, and color without
the distortion of its lens.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import encode_jpeg, kind_of_path, new_file
from duagc.pipeline.messages import camera_frame
from duagc.pipeline.recording import RECORDING_FILE, Recording, open_rgbd, read_log
from duagc.pipeline.recording.color_images import ColorImages
from duagc.pipeline.runs.folder import RunFolder
from duagc.schemas import topics

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun.chunk import Chunk
from duagc.pipeline.viewing.rrd_file import written
from duagc.pipeline.viewing.run_rrd import APPLICATION, closed_panels, write_rrd

LOG_TIME, PUBLISH_TIME = "message_log_time", "message_publish_time"  # timelines that Rerun gives to a log


VIEWER_MEMORY = "4GiB"


def view(
    path: Path, save: Path | None = None, screenshot: Path | None = None, recording: Path | None = None
) -> None:
    """Open a run, a recording or a log in Rerun, or write it to a .rrd file or a picture.

    Args:
        path: folder of a run or of a recording, or an .mcap or .rrd file.
        save: write this .rrd file instead of opening a window.
        screenshot: write this PNG instead.
        recording: of a run, where it is now; None: where the manifest says.

    Raises:
        DuagError: the path is none of these, or no picture can be drawn on this machine.
    """
    for wanted, suffix in ((save, ".rrd"), (screenshot, ".png")):
        if wanted is None:
            continue
        if wanted.suffix != suffix or not wanted.absolute().parent.is_dir():
            raise DuagError(f"{wanted}: found no such place, expected NAME{suffix} in a folder that exists")
    with tempfile.TemporaryDirectory(prefix="duagc-view-") as folder:
        rrd = _as_rrd(Path(path), Path(folder), recording)
        if save is not None:
            with new_file(save) as part:
                shutil.copyfile(rrd, part)
        if screenshot is not None:
            take_screenshot(rrd, screenshot)
        if save is None and screenshot is None:
            _open_window(rrd)


def _as_rrd(path: Path, folder: Path, recording: Path | None) -> Path:
    if path.suffix == ".rrd" and path.is_file():
        return path
    out = folder / f"{path.name or 'view'}.rrd"
    if (path / "robots").is_dir():
        made = path / "run.rrd"
        if made.is_file():
            return made
        return write_rrd(path, RunFolder(path).recording_at(recording), out)
    if (path / RECORDING_FILE).is_file():
        shown = Recording(path)
        return recording_to_rrd([shown.log(robot) for robot in shown.robots], out)
    if path.suffix == ".mcap" and path.is_file():
        return recording_to_rrd([path], out)
    raise DuagError(
        f"{path}: {kind_of_path(path)}, expected a run (robots/), a recording ({RECORDING_FILE}), an .mcap or an "
        ".rrd file"
    )


def recording_to_rrd(logs: Sequence[Path], out: Path) -> Path:
    """Write logs as one .rrd file: what Rerun reads from MCAP by itself, and depth as depth images with their unit.

    Rerun takes a depth image of Foxglove's schema for a gray image. Here its bytes become a depth image next to it.

    Args:
        logs: of robots with a camera.
        out: name of the .rrd file.

    Returns:
        `out`.

    Raises:
        DuagError: a log cannot be read, or the file cannot be written.
    """
    import rerun as rr
    from rerun.chunk import Chunk, DeriveLens, LazyChunkStream, McapReader

    lenses = [
        DeriveLens("Image:buffer").to_component(rr.DepthImage.descriptor_buffer(), "."),
        DeriveLens("Image:format").to_component(rr.DepthImage.descriptor_format(), "."),
    ]
    streams, robots = [], []
    for path in logs:
        with open_rgbd(path) as log:
            robots.append(log.robot)
            topic, units_per_meter = topics.DEPTH.of(log.robot), 1.0 / log.depth_scale
            camera, lens = log.camera, log.lens
        depth, rest = McapReader(path).stream().split(content=topic)
        if lens is not None:
            rest = rest.drop(content=topics.COLOR.of(robots[-1]))
            streams.append(
                LazyChunkStream.from_iter(_rectified_color(path, robots[-1], ColorImages(camera, lens)))
            )
        meter = Chunk.from_columns(topic, indexes=[], columns=rr.DepthImage.columns(meter=[units_per_meter]))
        streams += [
            depth.lenses(lenses, output_mode="forward_unmatched"),
            rest,
            LazyChunkStream.from_iter([meter]),
        ]
    recording = rr.RecordingStream(APPLICATION, recording_id=f"recording-{out.stem}")
    with written(recording, _recording_blueprint(robots), out):
        recording.send_chunks(LazyChunkStream.merge(*streams))
    return out


def _rectified_color(path: Path, robot: str, images: ColorImages) -> Iterator[Chunk]:
    """Color of a log whose images have a lens, which Rerun does not take out, where and when Rerun has the others."""
    import rerun as rr
    from rerun.chunk import Chunk

    for record in read_log(path, [topics.COLOR]):
        data = encode_jpeg(images.decode(record)[:, :, ::-1], quality=95)
        times = {LOG_TIME: record.log_time_ns, PUBLISH_TIME: record.publish_time_ns}
        yield Chunk.from_columns(
            record.topic,
            indexes=[
                rr.TimeColumn(name, timestamp=[np.datetime64(time, "ns")]) for name, time in times.items()
            ],
            columns=[
                *rr.EncodedImage.columns(blob=[data], media_type=["image/jpeg"]),
                *rr.CoordinateFrame.columns(frame=[f"{camera_frame(robot)}_image_plane"]),
            ],
        )


def _recording_blueprint(robots: Sequence[str]) -> rrb.Blueprint:
    """Color, depth and points of every robot; the views name the frames of the log, which no entity path has."""
    import rerun as rr
    import rerun.blueprint as rrb

    rows = []
    for robot in robots:
        frame = camera_frame(robot)
        color, depth = topics.COLOR.of(robot), topics.DEPTH.of(robot)
        image_plane = rrb.SpatialInformation(target_frame=f"{frame}_image_plane")
        rows.append(
            rrb.Horizontal(
                rrb.Spatial2DView(
                    origin=color, contents=[color], name=f"{robot}: color", spatial_information=image_plane
                ),
                rrb.Spatial2DView(
                    origin=depth, contents=[depth], name=f"{robot}: depth", spatial_information=image_plane
                ),
                rrb.Spatial3DView(
                    origin=f"/{robot}",
                    contents=[color, depth, topics.CALIBRATION.of(robot)],
                    name=f"{robot}: points",
                    spatial_information=rrb.SpatialInformation(
                        target_frame=frame, axes=rr.ViewCoordinates.RDF, show_axes=True
                    ),
                ),
            )
        )
    return rrb.Blueprint(
        rrb.Vertical(*rows), rrb.TimePanel(timeline=LOG_TIME, state="collapsed"), *closed_panels()
    )


def _open_window(rrd: Path) -> None:
    """Open a file in a Rerun window and wait until it is closed; the viewer listens on this machine only.

    Raises:
        DuagError: there is no viewer, or it could not open a window.
    """
    command = [_executable(), *_served(_free_port())]
    done = subprocess.run(
        [*command, str(rrd)], check=False, stderr=subprocess.PIPE, text=True, errors="replace"
    )
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        raise DuagError(
            f"{rrd.name}: the viewer ended with {done.returncode} ({lines[-1] if lines else 'no word'}); "
            "on a machine without a display use --save or --screenshot"
        )


def _served(port: int) -> list[str]:
    """Options of a viewer that listens on this machine only."""
    return ["--bind", "127.0.0.1", "--port", str(port), "--memory-limit", VIEWER_MEMORY]


def take_screenshot(rrd: Path, png: Path, timeout_s: float = 60.0) -> None:
    """Draw a file without a window and save the picture; a software renderer (Mesa lavapipe) is enough.

    Args:
        rrd: the .rrd file.
        png: name of the picture; replaced if it exists.
        timeout_s: longest wait for the data, seconds.

    Raises:
        DuagError: there is no graphics driver, or the viewer has not shown the data in time.
    """
    command = [_executable(), *_served(port := _free_port()), "--headless"]
    with tempfile.TemporaryFile() as said:
        environment = os.environ | {"RERUN_APP_ONLY": "true"}
        viewer = subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            start_new_session=True,
        )
        try:
            data = _picture(viewer, port, rrd, time.monotonic() + timeout_s)
        except Exception as error:  # the client raises RuntimeError and its own kinds
            said.seek(0)
            why = _last_words(said.read().decode(errors="replace"), error)
            raise DuagError(
                f"{png}: the viewer drew no picture ({why}); it needs a graphics driver, "
                "for example the package mesa-vulkan-drivers"
            ) from error
        finally:
            with suppress(ProcessLookupError):
                os.killpg(viewer.pid, signal.SIGKILL)  # the command may be one that starts the viewer
            viewer.wait()
    with new_file(png) as part:
        part.write_bytes(data)


def _picture(viewer: subprocess.Popen[bytes], port: int, rrd: Path, end_s: float) -> bytes:
    """The picture that a viewer draws of a file, once it listens."""
    from rerun.experimental import ViewerClient

    while True:
        if viewer.poll() is not None:
            raise RuntimeError(f"it ended with {viewer.returncode}")
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                break
        if time.monotonic() > end_s:
            raise RuntimeError("it does not listen")
        time.sleep(0.1)
    client = ViewerClient(f"rerun+http://127.0.0.1:{port}/proxy")
    client.open(str(rrd))
    return _settled_picture(client, end_s)


def _last_words(said: str, error: Exception) -> str:
    """Why a viewer ended: of what it said the line of its panic, else the first line of an error, or what it is."""
    panics = [line.strip() for line in said.splitlines() if "panicked at" in line]
    return next(
        (line for line in (*panics, *map(str.strip, str(error).splitlines())) if line), type(error).__name__
    )


def _settled_picture(viewer: Any, end_s: float) -> bytes:
    """The picture once it does not change any more: what is on disk is drawn piece by piece."""
    last = b""
    while time.monotonic() < end_s:
        data = viewer.take_screenshot()
        if data == last:
            return data
        last = data
        time.sleep(1.5)
    return last


def _executable() -> str:
    """The viewer that was installed with this Python, else the one in PATH. Raises DuagError if there is none."""
    local = Path(sys.executable).with_name("rerun")
    found = str(local) if local.is_file() else shutil.which("rerun")
    if found is None:
        raise DuagError(
            "rerun: no viewer next to this Python or in PATH, expected that of the package rerun-sdk"
        )
    return found


def _free_port() -> int:
    """A port of this machine that is free."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
