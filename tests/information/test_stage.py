"""The information stage: what it writes, and what never enters."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.pipeline import messages
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.information import InformationConfig
from duagc.pipeline.config.mapping import THICKNESS_FLOOR_M
from duagc.pipeline.config.registration import MovingConfig
from duagc.pipeline.information.stage import run_information
from duagc.pipeline.recording import LogWriter, read_log
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.schemas import topics
from tests.fixtures.noisy_wall import CAMERA, POSES, views_of, wall

FRAME_NS = 33_333_333


def write_logs(
    folder: Path, held_out: tuple[int, ...] = (2,), keyframes: tuple[int, ...] = (0, 1, 3)
) -> Gaussians:
    """A sensor log of four frames and the front end's log of it."""
    gaussians = wall()
    with LogWriter(folder / "alpha.mcap", "alpha") as log:
        log.channel(topics.DEPTH.of("alpha"), topics.DEPTH.schema, {"depth_scale": "0.0001"})
        log.write(topics.CALIBRATION.of("alpha"), messages.pack_calibration(0, "alpha", CAMERA), 0)
        for index, view in enumerate(views_of(gaussians, 0.05)):
            # a held-out frame is black and far away: were it used, it would show
            color = view.color * (index not in held_out)
            depth = np.rint(view.depth_m * 1e4).astype(np.uint16)
            stamp = index * FRAME_NS
            png = cv2.imencode(".png", color[:, :, ::-1])[1].tobytes()
            log.write(topics.COLOR.of("alpha"), messages.pack_color(stamp, "alpha", png, "png"), stamp)
            log.write(topics.DEPTH.of("alpha"), messages.pack_depth(stamp, "alpha", depth), stamp)
    with LogWriter(folder / "frontend.mcap", "alpha") as log:
        for index, T in enumerate(POSES):
            stamp = index * FRAME_NS
            odometry = messages.Odometry(
                stamp, "alpha", index, index in held_out, 0, T, T, np.eye(6), "ok", 1.0, 0.0, 0.0
            )
            log.write(topics.ODOMETRY.of("alpha"), odometry, stamp)
            if index in keyframes:
                number = keyframes.index(index)
                keyframe = messages.Keyframe(
                    stamp, "alpha", number, index, T, number - 1, np.eye(4), np.zeros((6, 6)), (0.0, 0.0)
                )
                log.write(topics.KEYFRAME.of("alpha"), keyframe, stamp)
        stamp = 3 * FRAME_NS
        empty = messages.GaussianMap(stamp, "alpha", "alpha/map", Gaussians.empty())
        log.write(topics.MAP.of("alpha"), empty, stamp)
        log.write(topics.MAP.of("alpha"), messages.GaussianMap(stamp, "alpha", "alpha/map", gaussians), stamp)
    return gaussians


def informed(
    folder: Path, frontend: str = "frontend.mcap", out: str = "information.mcap", **settings: int
) -> messages.GaussianInformation:
    """The information of the logs of a folder."""
    paths = [folder / file for file in ("alpha.mcap", frontend, out)]
    threads = settings.pop("threads", 1)
    return run_information(
        *paths,
        config=InformationConfig(**settings),
        moving=MovingConfig(),
        thickness_floor_m=THICKNESS_FLOOR_M,
        threads=threads,
    )


def test_the_stage_writes_what_it_returns_and_the_threads_do_not_show(tmp_path: Path) -> None:
    gaussians = write_logs(tmp_path)
    result = informed(tmp_path)
    (record,) = read_log(tmp_path / "information.mcap")
    assert record.topic == "/alpha/information"
    back = record.message()
    np.testing.assert_array_equal(back.ids, gaussians.ids)
    np.testing.assert_array_equal(back.geometry, result.geometry)
    assert back.kind == "gauss_newton"
    assert back.window == "all"
    assert back.observations.max() == 3
    assert back.color_sigma == pytest.approx(0.05, rel=0.15)
    informed(tmp_path, out="again.mcap", threads=3)
    (again,) = read_log(tmp_path / "again.mcap")
    assert again.data == record.data


def test_held_out_frames_never_enter(tmp_path: Path) -> None:
    write_logs(tmp_path, held_out=(1,))
    with pytest.raises(DuagError, match=r"has frame 1, expected no frame that is held out"):
        informed(tmp_path)
    assert not (tmp_path / "information.mcap").exists()


@pytest.mark.parametrize(("frames", "held_out"), [(4, (1,)), (4, (1, 2)), (0, (1,))])
def test_other_frames_show_the_deviation_unless_they_are_held_out(
    tmp_path: Path, frames: int, held_out: tuple[int, ...]
) -> None:
    def deviation_m(name: str, held_out: tuple[int, ...], frames: int) -> np.ndarray:
        folder = tmp_path / name
        folder.mkdir()
        write_logs(folder, held_out=held_out, keyframes=(0, 3))
        return informed(folder, deviation_frames=frames).deviation_m

    keyframes_alone = deviation_m("alone", (1, 2), 0)
    takes_part = frames > 0 and 2 not in held_out
    assert np.array_equal(deviation_m("asked", held_out, frames), keyframes_alone) == (not takes_part)


def test_a_front_end_without_a_map_is_one_line(tmp_path: Path) -> None:
    write_logs(tmp_path)
    with LogWriter(tmp_path / "unfinished.mcap", "alpha"):
        pass
    with pytest.raises(DuagError, match="has no message, expected the map"):
        informed(tmp_path, "unfinished.mcap")
