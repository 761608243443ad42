"""Planted faults are noticed, each by its own finding, and sound recordings raise no alarm."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from duagc.converters.simulate.team import simulate
from duagc.pipeline import job
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.checks import check
from duagc.pipeline.cli import app
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import LogWriter, Record, Recording, read_log
from duagc.pipeline.run_plan import RunPlan
from duagc.schemas import topics

FRAMES = 20
COLOR, DEPTH = topics.COLOR.of("bravo"), topics.DEPTH.of("bravo")
CALIBRATION = topics.CALIBRATION.of("bravo")
SHARED = Path(__file__).parents[3] / "shared" / "data"
Change = Callable[[list[Record]], Iterator[tuple[Record, Any, int]]]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sound") / "room"
    simulate(out, robots=2, frames=FRAMES, size=(280, 210), noise="kinect", seed=1, workers=1)
    return out


def planted(
    sound: Path,
    out: Path,
    change: Change,
    scale: float | None = None,
    truth: bool = True,
    alone: bool = True,
) -> Path:
    """A copy whose log of bravo is written again as `change` says: record, message, publish time."""
    shutil.copytree(sound, out)
    records = list(read_log(sound / "bravo.mcap"))
    description = json.loads((sound / "recording.json").read_text())
    stated = description["robots"]["bravo"]["depth_scale_m"]
    if alone:
        del description["robots"]["alpha"]
        (out / "recording.json").write_text(json.dumps(description))
    with LogWriter(out / "bravo.mcap", "bravo") as log:
        log.channel(DEPTH, topics.DEPTH.schema, {"depth_scale": repr(stated * (scale or 1))})
        for record, message, publish_ns in change(records):
            log.write(record.topic, message, record.log_time_ns, publish_ns)
    if not truth:
        (out / "bravo.groundtruth.mcap").unlink()
    return out


def nothing(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    for record in records:
        yield record, record.proto(), record.publish_time_ns


def late_depth(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """Every depth image has the time of the one three frames later."""
    depths = [record for record in records if record.topic == DEPTH]
    source = {r.log_time_ns: depths[max(0, i - 3)] for i, r in enumerate(depths)}
    for record, message, publish_ns in nothing(records):
        if record.topic == DEPTH:
            message = source[record.log_time_ns].proto()
            message.timestamp.FromNanoseconds(publish_ns)
        yield record, message, publish_ns


def unregistered(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """Depth as a camera some pixels to the side sees it."""
    for record, message, publish_ns in nothing(records):
        if record.topic == DEPTH:
            depth = m.unpack_depth(message, "")
            message = m.pack_depth(publish_ns, "bravo", np.roll(depth, 8, axis=1))
        yield record, message, publish_ns


def along_the_ray(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """Depth is the distance from the camera."""
    (camera,) = [m.unpack_calibration(record.proto()) for record in records if record.topic == CALIBRATION]
    for record, message, publish_ns in nothing(records):
        if record.topic == DEPTH:
            units = np.rint(m.unpack_depth(message, "") * camera.ray_lengths())
            message = m.pack_depth(publish_ns, "bravo", units.astype(np.uint16))
        yield record, message, publish_ns


def blue(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """Red and blue exchanged."""
    for record, message, publish_ns in nothing(records):
        if record.topic == COLOR:
            image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
            message.data = cv2.imencode(".png", image[:, :, ::-1])[1].tobytes()
            message.format = "png"
        yield record, message, publish_ns


def swapped(**names: str) -> Change:
    """Other intrinsics: each named one has the value of another."""

    def change(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
        for record, message, publish_ns in nothing(records):
            if record.topic == CALIBRATION:
                camera = m.unpack_calibration(message)
                camera = replace(camera, **{name: getattr(camera, other) for name, other in names.items()})
                message = m.pack_calibration(publish_ns, "bravo", camera)
            yield record, message, publish_ns

    return change


def stuck(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """Ten color images in a row are the same."""
    colors = [record for record in records if record.topic == COLOR]
    for record, message, publish_ns in nothing(records):
        if record.topic == COLOR and colors[5].log_time_ns < record.log_time_ns < colors[15].log_time_ns:
            message.data = colors[5].proto().data
        yield record, message, publish_ns


def twice(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """An image has the time of the one before, and another time in the message."""
    stamps = sorted({record.log_time_ns for record in records})
    for record, message, publish_ns in nothing(records):
        again = record.log_time_ns == stamps[8] and record.topic != CALIBRATION
        yield record, message, stamps[7] if again else publish_ns


def no_clock(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """Images with times that protobuf itself refuses."""
    for record, message, publish_ns in nothing(records):
        if record.topic == COLOR:
            message.timestamp.nanos = -1
        yield record, message, publish_ns


def gap(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """A second without images, in the times alone."""
    middle = records[len(records) // 2].log_time_ns
    for record, message, publish_ns in nothing(records):
        late = 10**9 if publish_ns > middle else 0
        message.timestamp.FromNanoseconds(publish_ns + late)
        yield record, message, publish_ns + late


def dark(share: float) -> Change:
    """Nothing but noise before a part of the color images, as by a covered lens."""

    def change(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
        last_ns = records[0].log_time_ns + share * (records[-1].log_time_ns - records[0].log_time_ns)
        rng = np.random.default_rng(0)
        for record, message, publish_ns in nothing(records):
            if record.topic == COLOR and publish_ns <= last_ns:
                noise = rng.integers(0, 3, (210, 280, 3), dtype=np.uint8)
                message.data, message.format = cv2.imencode(".png", noise)[1].tobytes(), "png"
            yield record, message, publish_ns

    return change


def no_depth(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    for record, message, publish_ns in nothing(records):
        if record.topic == DEPTH:
            message.data = bytes(len(message.data))
        yield record, message, publish_ns


def half_depth(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """Every second depth image is missing."""
    depths = [record.log_time_ns for record in records if record.topic == DEPTH]
    for record, message, publish_ns in nothing(records):
        if record.topic != DEPTH or depths.index(record.log_time_ns) % 2:
            yield record, message, publish_ns


def near(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """Every fifth depth image is empty, as of what is nearer than the sensor measures; then ten in a row."""
    depths = [record.log_time_ns for record in records if record.topic == DEPTH]
    for record, message, publish_ns in nothing(records):
        if record.topic == DEPTH and ((k := depths.index(record.log_time_ns)) % 5 == 0 or 10 < k < 20):
            message.data = bytes(len(message.data))
        yield record, message, publish_ns


FAULTS: dict[str, tuple[Change, dict[str, Any], str, str]] = {
    "scale x5": (nothing, {"scale": 5}, "error", "depth scale"),
    "scale x0.2": (nothing, {"scale": 0.2}, "error", "depth scale"),
    "scale x0.001, no truth": (nothing, {"scale": 0.001, "truth": False}, "error", "depth scale"),
    "scale x5, no truth": (nothing, {"scale": 5, "truth": False}, "warning", "depth scale"),
    "late depth": (late_depth, {}, "warning", "depth in time"),
    "unregistered depth": (unregistered, {}, "warning", "depth in place"),
    "depth along the ray": (along_the_ray, {"truth": False}, "warning", "depth along z"),
    "red and blue": (blue, {"alone": False}, "warning", "color order"),
    "center swapped": (swapped(cx="cy", cy="cx"), {}, "warning", "intrinsics"),
    "size for focal length": (swapped(fx="height"), {}, "warning", "intrinsics"),
    "stuck": (stuck, {}, "warning", "repeats"),
    "times twice": (twice, {}, "warning", "times"),
    "times of no clock": (no_clock, {}, "warning", "times"),
    "gap": (gap, {}, "warning", "gaps"),
    "dark": (dark(1), {}, "error", "light"),
    "mostly dark": (dark(0.9), {}, "warning", "light"),
    "no depth": (no_depth, {}, "error", "depth"),
    "some without depth": (near, {}, "warning", "depth"),
    "half the depth": (half_depth, {}, "warning", "pairs"),
}


REPEATED = "scale x0.2", "size for focal length"  # of a finding that another fault stands for in `make test`


@pytest.mark.parametrize(
    "name", [pytest.param(f, marks=[pytest.mark.slow] if f in REPEATED else []) for f in FAULTS]
)
def test_a_planted_fault_is_noticed(sound: Path, tmp_path: Path, name: str) -> None:
    change, how, severity, expected = FAULTS[name]
    report = check.check(planted(sound, tmp_path / "rec", change, **how))
    found = {(f.severity.value, f.check) for f in report.findings if f.robot == "bravo"}
    assert (severity, expected) in found, check.format_report(report)
    assert report.sound == (severity != "error")


def test_a_sound_recording_raises_no_alarm(sound: Path, tmp_path: Path) -> None:
    report = check.check(sound)
    assert not report.findings, check.format_report(report)
    assert set(report.robots) == {"alpha", "bravo"}
    assert report.robots["alpha"]["frames"] == FRAMES
    assert report.robots["alpha"]["exact"] == 0
    assert "nothing found" in check.format_report(report)
    assert check.check(sound).plain() == report.plain()
    again = check.check(planted(sound, tmp_path / "rec", nothing))  # the metadata of the log are lost
    assert [f.check for f in again.findings] == ["digest"]


def test_images_without_depth_are_no_repeats(sound: Path, tmp_path: Path) -> None:
    found = check.check(planted(sound, tmp_path / "rec", near)).findings
    assert any(f"12 of {FRAMES} images" in f.found and "no depth at all" in f.found for f in found)
    assert not [f for f in found if f.check == "repeats"]


def test_a_recording_given_twice_is_an_error(sound: Path, tmp_path: Path) -> None:
    """The same images by another robot, at other times."""
    copy = tmp_path / "rec"
    shutil.copytree(sound, copy)
    with LogWriter(copy / "alpha.mcap", "alpha") as log:
        log.channel(topics.DEPTH.of("alpha"), topics.DEPTH.schema, {"depth_scale": "0.0002"})
        for record in read_log(sound / "bravo.mcap"):
            message = record.proto()
            if record.topic in (COLOR, DEPTH):
                message.timestamp.FromNanoseconds(record.publish_time_ns + 10**9)
            times = record.log_time_ns + 10**9, record.publish_time_ns + 10**9
            log.write(record.topic.replace("bravo", "alpha"), message, *times)
    report = check.check(copy)
    copies = [f for f in report.findings if f.check == "copies"]
    assert [f.robot for f in copies] == ["bravo"], check.format_report(report)
    assert f"{FRAMES} of its color images are those of alpha" in copies[0].found
    assert not report.sound


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (0.77, "in 77% of the pixels"),
        (0.0051, "in 1% of the pixels"),
        (0.004, "in less than 1% of the pixels"),
    ],
)
def test_a_small_share_of_depth_is_not_none(share: float, words: str) -> None:
    row: dict[str, Any] = {"frames": 9, "reprojection": None, "keyframes_from": 1, "keyframes_to": 2}
    estimate = {"seconds_from": 1.0, "seconds_to": 2.0, "measured_stages": 0, "bytes": 1e6}
    robots = {
        "alpha": row | {"depth_m": [1.0, 2.0, 3.0], "with_depth": share},
        "bravo": row | {"depth_m": None, "with_depth": 0.0},
    }
    first, second, *_ = check.format_report(check.Report("rec", [], robots, estimate)).splitlines()
    assert first == f"alpha: 9 frames, 1 to 2 keyframes, depth 1.00 2.00 3.00 m (1, 50, 99 %) {words}"
    assert second == "bravo: 9 frames, 1 to 2 keyframes, no depth"


def seldom_depth(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
    """Depth of every fifth image alone: the frames between share it."""
    depths = [record.log_time_ns for record in records if record.topic == DEPTH]
    for record, message, publish_ns in nothing(records):
        if record.topic != DEPTH or record.log_time_ns in depths[::5]:
            yield record, message, publish_ns


def test_frames_that_share_depth_say_nothing_of_its_scale(sound: Path, tmp_path: Path) -> None:
    report = check.check(planted(sound, tmp_path / "rec", seldom_depth))
    assert "depth scale" not in {f.check for f in report.findings}, check.format_report(report)
    assert report.sound


@pytest.mark.parametrize(("change", "calibrate"), [(nothing, False), (late_depth, False), (late_depth, True)])
def test_a_run_says_as_it_begins_that_depth_is_of_another_time(
    sound: Path, tmp_path: Path, change: Change, calibrate: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*args: Any, meanwhile: Callable[[], None], **kwargs: Any) -> Any:
        meanwhile()
        raise DuagError("stopped")

    monkeypatch.setattr(job.RobotProcesses, "prepare", stop)
    recording = Recording(planted(sound, tmp_path / "rec", change))
    lines: list[str] = []
    plan = RunPlan(workers=1, calibrate=calibrate)
    with pytest.raises(DuagError, match="stopped"):
        job.Job(recording, tmp_path, RunConfig(), plan, log=lines.append, place=tmp_path).stages()
    said = [line for line in lines if "depth in time" in line]
    assert [" bravo: " in line for line in said] == [True] * (change is late_depth and not calibrate)
    assert all("duagc run --calibrate" in line for line in said)


def test_logs_that_cannot_be_read_are_findings(sound: Path, tmp_path: Path) -> None:
    out = shutil.copytree(sound, tmp_path / "rec")
    log = out / "alpha.mcap"
    log.write_bytes(log.read_bytes()[:-1000])
    result = CliRunner().invoke(app, ["check", str(out), "--json"])
    assert result.exit_code == 1
    content = json.loads(result.stdout)
    assert not content["sound"]
    assert [f["robot"] for f in content["findings"] if f["severity"] == "error"] == ["alpha"]
    assert set(content["robots"]) == {"bravo"}
    assert [f["advice"] for f in content["findings"] if f["severity"] == "error"] == [
        "duagc recover may save it"
    ]
    result = CliRunner().invoke(app, ["check", str(out / "bravo.mcap")])
    assert result.exit_code == 0
    assert "nothing found" in result.stdout


def test_an_odometry_tells_the_scale(sound: Path, tmp_path: Path) -> None:
    """Without ground truth, poses of another sensor contradict a wrong depth scale."""
    poses = list(read_log(sound / "bravo.groundtruth.mcap", [topics.GROUNDTRUTH_POSE.of("bravo")]))

    def change(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
        for record, pose in zip([r for r in records if r.topic == COLOR], poses, strict=True):
            T = se3.inverse(m.unpack_pose_in_frame(poses[0].proto())) @ m.unpack_pose_in_frame(pose.proto())
            prior = replace(record, topic=topics.ODOMETRY_PRIOR.of("bravo"))
            yield prior, m.pack_pose_in_frame(pose.publish_time_ns, "odometry", T), pose.publish_time_ns

    def with_prior(records: list[Record]) -> Iterator[tuple[Record, Any, int]]:
        rows = [*nothing(records), *change(records)]
        yield from sorted(rows, key=lambda row: row[0].log_time_ns)

    for scale, sound_ in ((1.0, True), (2.0, False)):
        out = planted(sound, tmp_path / f"{scale}", with_prior, scale=scale, truth=False)
        report = check.check(out)
        assert report.sound == sound_, check.format_report(report)


@pytest.mark.parametrize("source", ["redkitchen", "replica_office0/office0"])
def test_real_recordings_raise_no_alarm(tmp_path: Path, source: str) -> None:
    from duagc.converters import registry

    if not (SHARED / source).is_dir():
        pytest.skip("needs ../shared/data")
    if source == "redkitchen":
        src = tmp_path / "src"
        src.mkdir()
        for number in range(300, 324):
            for file in (SHARED / source).glob(f"frame-{number:06d}.*"):
                (src / file.name).symlink_to(file)
        registry.convert("7scenes", src, tmp_path / "rec", robots=2)
    else:
        registry.convert("replica", SHARED / source, tmp_path / "rec")
    report = check.check(tmp_path / "rec")
    alarms = report.of(check.Severity.ERROR) + report.of(check.Severity.WARNING)
    assert not alarms, check.format_report(report)
