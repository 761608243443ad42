"""Images that were read row after row, of a log that does not say so: the readout is found where it is certain."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from duagc.pipeline.base.checkpoints import Checkpoints
from duagc.pipeline.config.frontend import FrontendConfig, TrackingConfig
from duagc.pipeline.config.motion_times import ReadoutConfig
from duagc.pipeline.frontend import readout_time
from duagc.pipeline.frontend.frame_pairs import FramePairs, MovingView
from duagc.pipeline.frontend.motion_differences import FoundTime
from duagc.pipeline.frontend.readout_time import certain_readout
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.recording import open_rgbd
from duagc.pipeline.recording.rolling_shutter import Readout, line_times_ns
from tests.fixtures.carried_camera import FRAME_NS, rms_error_m, true_path, walk, write
from tests.fixtures.room import render

CAMERA = PinholeCamera(240, 180, 195.0, 195.0, 119.5, 89.5)
FRAMES = 46
READOUT_S, ABOUT_S = 0.03, 0.008
BAND = 20  # rows, or columns, that are rendered at one time
CONFIG = ReadoutConfig(pairs=46)
FRONTEND = FrontendConfig(
    tracking=TrackingConfig(strides=(2, 1, 1, 1)), mapping_enabled=False, readout=CONFIG
)


@cache
def read(k: int, readout_s: float, by_columns: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Gray image and depth of a frame whose rows are read one after the other, a band of them at a time."""
    if readout_s == 0:
        return render(walk(k), camera=CAMERA)
    count = CAMERA.width if by_columns else CAMERA.height
    first = np.arange(0, count, BAND)
    frames_later = line_times_ns(first + BAND // 2, count, readout_s) / FRAME_NS
    bands = [
        replace(CAMERA, width=BAND, cx=CAMERA.cx - at)
        if by_columns
        else replace(CAMERA, height=BAND, cy=CAMERA.cy - at)
        for at in first
    ]
    images = [render(walk(k + later), camera=band) for later, band in zip(frames_later, bands, strict=True)]
    gray, depth = (np.concatenate(kind, axis=int(by_columns)) for kind in zip(*images, strict=True))
    return gray, depth


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Logs by what is read row after row."""
    folder = tmp_path_factory.mktemp("readout")
    kinds = {
        "none": Readout(),
        "color": Readout(READOUT_S),
        "upside down": Readout(-READOUT_S, -READOUT_S),
        "turned": Readout(READOUT_S, by_columns=True),
        "depth": Readout(0.0, READOUT_S),
    }
    return {name: write(folder / name, CAMERA, images(readout)) for name, readout in kinds.items()}


def images(readout: Readout, frames: int = FRAMES) -> list[tuple[np.ndarray, np.ndarray]]:
    """Gray images and depth of a log that is read so."""
    times_s, by_columns = (readout.color_s, readout.depth_s), readout.by_columns
    read_each = [[read(k, time_s, by_columns) for time_s in times_s] for k in range(frames)]
    return [(color[0], depth[1]) for color, depth in read_each]


def found(path: Path, config: ReadoutConfig = CONFIG) -> Readout:
    """The readout of a log by the true path."""
    with open_rgbd(path) as log:
        readout = certain_readout(FramePairs(log, [true_path(FRAMES)]), config)
        assert not log.readout.rolls
        return readout


@pytest.mark.parametrize(
    ("name", "color_s", "depth_s"),
    [
        ("upside down", -READOUT_S, -READOUT_S),
        ("turned", READOUT_S, 0.0),
        ("none", 0.0, 0.0),
        ("depth", 0.0, 0.0),  # no such cameras are built: it is an error of depth
    ],
)
def test_a_readout_is_found_by_each_camera(
    logs: dict[str, Path], name: str, color_s: float, depth_s: float
) -> None:
    readout = found(logs[name])
    assert readout.by_columns == (name == "turned")
    assert readout.color_s == pytest.approx(color_s, abs=ABOUT_S if color_s else 0)
    assert readout.depth_s == pytest.approx(depth_s, abs=ABOUT_S if depth_s else 0)


def test_color_is_made_still_where_depth_is_certain(tmp_path: Path) -> None:
    short_s = 0.004  # which is left where color alone is read so
    readout = found(write(tmp_path / "log", CAMERA, images(Readout(short_s, READOUT_S))))
    assert readout.depth_s == pytest.approx(READOUT_S, abs=ABOUT_S)
    assert readout.color_s == pytest.approx(short_s, abs=0.003)


def test_only_that_of_color_is_looked_for_where_depth_was_computed(tmp_path: Path) -> None:
    rolling = write(tmp_path / "rolling", CAMERA, images(Readout(READOUT_S, READOUT_S)), with_sigma=True)
    readout = found(rolling)
    assert readout.color_s == pytest.approx(READOUT_S, abs=ABOUT_S)
    assert readout.depth_s == 0
    assert not found(write(tmp_path / "still", CAMERA, images(Readout()), with_sigma=True)).rolls


def test_none_is_found_where_the_log_states_one_or_it_is_not_certain(
    logs: dict[str, Path], tmp_path: Path
) -> None:
    path = logs["upside down"]
    assert not found(path, CONFIG.model_copy(update={"sigmas": 1000.0})).rolls
    assert not found(path, CONFIG.model_copy(update={"min_pairs": 1000})).rolls
    assert not found(path, CONFIG.model_copy(update={"most_sigma_s": 1e-6})).rolls
    assert not found(path, CONFIG.model_copy(update={"enabled": False})).rolls
    assert not found(path, CONFIG.model_copy(update={"least_move": 0.5})).rolls
    stated = write(tmp_path / "stated", CAMERA, images(Readout(READOUT_S), frames=3), Readout().notes())
    with open_rgbd(stated) as log:
        assert log.states_readout
        assert not certain_readout(FramePairs(log, []), CONFIG).rolls


def test_a_long_time_that_is_hardly_known_is_not_certain() -> None:
    """As found of a robot that turned at an even speed, whose camera has a global shutter."""
    assert FoundTime(0.030, 0.009).is_certain(ReadoutConfig())
    assert not FoundTime(0.085, 0.021).is_certain(ReadoutConfig())


@pytest.mark.parametrize(("left_s", "rolls"), [(0.004, True), (-0.004, True), (-0.090, False)])
def test_a_readout_that_its_second_round_reverses_is_none(
    logs: dict[str, Path], monkeypatch: pytest.MonkeyPatch, left_s: float, rolls: bool
) -> None:
    rounds = iter(([FoundTime(0.020, 0.005), None], [FoundTime(left_s, 0.001), None]))
    monkeypatch.setattr(readout_time, "_estimated", lambda *_, **__: next(rounds))
    config = CONFIG.model_copy(update={"move_to_track_again": CONFIG.least_move})  # two rounds
    readout = found(logs["none"], config)
    assert readout.rolls == rolls
    assert not rolls or readout.color_s == pytest.approx(0.020 + left_s)


def test_halves_that_move_too_differently_give_way_to_others(
    logs: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a machine that vibrates; and it is looked for again while much is left."""
    rounds = iter([[None, None], *([FoundTime(1e-3 * left_ms, 1e-3), None] for left_ms in (10, 8, 3))])
    seen: list[list[tuple[int, int]]] = []

    def estimated(
        _: object, pairs: list[tuple[MovingView, MovingView]], *__: object, **___: object
    ) -> object:
        seen.append([(first.index, second.index) for first, second in pairs])
        return next(rounds)

    monkeypatch.setattr(readout_time, "_estimated", estimated)
    config = CONFIG.model_copy(update={"move_to_track_again": CONFIG.least_move})
    assert found(logs["none"], config).color_s == pytest.approx(0.021)
    assert seen[0] != seen[1] == seen[2] == seen[3]


def test_columns_are_looked_at_in_the_pairs_that_rows_were(
    logs: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where rows of the views of the largest change cannot be registered, columns of them may be."""
    seen: list[tuple[bool, list[tuple[int, int]]]] = []

    def estimated(
        _: object,
        pairs: list[tuple[MovingView, MovingView]],
        *__: object,
        by_columns: bool,
    ) -> object:
        seen.append((by_columns, [(first.index, second.index) for first, second in pairs]))
        return [None, None]

    monkeypatch.setattr(readout_time, "_estimated", estimated)
    assert not found(logs["none"]).rolls
    (rows, largest), (_, typical), (columns, *first), (_, *second) = seen
    assert (rows, columns) == (False, True)
    assert largest != typical
    assert (first, second) == ([largest], [typical])


def parts_of(path: Path, out: Path, config: FrontendConfig) -> set[str]:
    """Run the front end; names of what it did."""
    parts = set[str]()
    checkpoints = Checkpoints(report=lambda name, *_: parts.add(name))
    run_frontend(path, out, config, checkpoints=checkpoints)
    return parts


def test_frames_are_tracked_once_where_rows_move_little(logs: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "frontend.mcap"
    far = CONFIG.model_copy(update={"move_to_track_again": 0.5})
    assert "tracking again" not in parts_of(logs["color"], out, FRONTEND.model_copy(update={"readout": far}))
    readout = Readout.found(out)
    assert readout is not None
    assert readout.color_s == pytest.approx(READOUT_S, abs=ABOUT_S)


def test_the_front_end_makes_images_still_by_it(logs: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "frontend.mcap"
    assert "tracking again" in parts_of(logs["color"], out, FRONTEND)
    assert rms_error_m(out) < 0.0075  # 0.015 without
    with open_rgbd(logs["color"]) as log:
        log.move_depth_by(out)
        assert log.readout == Readout.found(out)
        assert log.readout.color_s == pytest.approx(READOUT_S, abs=ABOUT_S)
        assert log.readout.depth_s == 0
        with open_rgbd(logs["color"]) as as_read:
            assert np.array_equal(log.frame(9, still=False).color, as_read.frame(9).color)
        with_depth, alone = log.frame(9), log.frame(9, depth=False)
        assert np.array_equal(alone.color, with_depth.color)
        assert np.array_equal(alone.mask, with_depth.mask)
        assert with_depth.depth.any()
        assert not alone.depth.any()
        seen, rolling = with_depth.color[..., 0] / 255.0, read(9, READOUT_S)[0]
        usable, still = log.frame(9).mask, render(walk(9), camera=CAMERA)[0]
        assert np.abs(seen - still)[usable].mean() < 0.5 * np.abs(rolling - still)[usable].mean()
