"""Clocks that differ by planted amounts: of robots in one log, of robots with common messages, of the truth."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from duagc.converters import registry
from duagc.converters.datasets import ros
from duagc.converters.logs import clocks
from duagc.converters.logs.describe import describe
from duagc.converters.logs.options import LogOptions
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.checks.check import check
from duagc.pipeline.geometry import so3
from duagc.pipeline.recording import format_info, info, open_rgbd, read_log
from tests.fixtures.box_room import path
from tests.fixtures.kimera_multi import imu
from tests.fixtures.ros_bags import FRAMES, START_NS, STEP_NS, Ros, scene, still
from tests.fixtures.ros_clocks import HUSKY_LATE_NS, both, moved_headers


def clocks_of(recording: Path) -> dict[str, Any]:
    return json.loads((recording / "recording.json").read_text())["clocks"]


def start(recording: Path, robot: str) -> int:
    with open_rgbd(recording / f"{robot}.mcap") as log:
        return log.frame(0).stamp_ns


def test_one_recorder_tells_how_headers_differ(tmp_path: Path) -> None:
    """Reported always, applied only if asked."""
    r = Ros(2)
    jackal, husky = both(r)
    bag = r.write(tmp_path / "bag", sorted(jackal + husky, key=lambda x: x[1]), "mcap")
    options = ["namespaces=/jackal,/husky"]
    registry.convert("ros", bag, tmp_path / "kept", options=options)
    stated = clocks_of(tmp_path / "kept")["husky"]
    assert stated["offset_s"] == pytest.approx(HUSKY_LATE_NS / 1e9, abs=1e-6)
    assert stated["low_s"] <= HUSKY_LATE_NS / 1e9 <= stated["high_s"]
    assert stated["how"] == "one recorder"
    assert stated["added_s"] == 0
    assert start(tmp_path / "kept", "husky") == START_NS + STEP_NS - HUSKY_LATE_NS
    warnings = json.loads((tmp_path / "kept" / "recording.json").read_text())["warnings"]
    assert any("husky: its times" in w and "none in common" in w for w in warnings)
    registry.convert("ros", bag, tmp_path / "moved", options=[*options, "clocks=estimated"])
    assert abs(start(tmp_path / "moved", "husky") - START_NS - STEP_NS) < 1000
    assert start(tmp_path / "moved", "jackal") == START_NS + STEP_NS
    assert clocks_of(tmp_path / "moved")["husky"]["added_s"] == pytest.approx(HUSKY_LATE_NS / 1e9, abs=1e-6)
    shown = format_info(info(tmp_path / "moved"))
    assert "clock 3.250000 s behind the first robot's (one recorder), 3.250000 s were added" in shown
    registry.convert("ros", bag, tmp_path / "zero", options=[*options, "clocks=from_zero"])
    assert [start(tmp_path / "zero", robot) for robot in ("jackal", "husky")] == [0, 0]


def test_readings_before_the_first_frame_have_no_place_from_zero(tmp_path: Path) -> None:
    """An IMU that was on before the camera: with all clocks from zero it begins with the first frame."""
    r = Ros(2)
    rows = scene(r)
    identity = r.tf(r.transform(START_NS, "_color", "_imu", np.eye(4)))
    times = [START_NS + STEP_NS + k * 10_000_000 for k in range(-4, 10)]
    rows += [("/imu", t, imu(r, t, "_imu", np.array([0.0, 0.1, 0.0]))) for t in times] + [
        ("/tf_static", START_NS, identity)
    ]
    bag = r.write(tmp_path / "bag", sorted(rows, key=lambda x: x[1]), "mcap")
    for clocks_option, count in (("from_zero", 10), ("as_recorded", 14)):
        out = tmp_path / clocks_option
        registry.convert("ros", bag, out, options=["imu=/imu", f"clocks={clocks_option}"])
        assert len(list(read_log(out / "alpha.mcap", ["/alpha/imu"]))) == count
    with pytest.raises(DuagError, match="leads before 1970"):
        registry.convert("ros", bag, tmp_path / "rec", options=["clock_offset_s=-1e10"])


def test_clocks_that_agree_are_left_alone(tmp_path: Path) -> None:
    r = Ros(2)
    rows = scene(r, prefix="/jackal") + scene(r, prefix="/husky", poses=path(FRAMES, 0.2))
    bag = r.write(tmp_path / "bag", sorted(rows, key=lambda x: x[1]), "mcap")
    registry.convert("ros", bag, tmp_path / "rec", options=["namespaces=/jackal,/husky", "clocks=estimated"])
    assert clocks_of(tmp_path / "rec")["husky"]["added_s"] == 0
    assert start(tmp_path / "rec", "husky") == START_NS + STEP_NS


RECORDER_NS = 1_700_000_000  # husky's recorder is so much ahead of jackal's


def chat(r: Ros, sender: str, at_own: bool, seed: int) -> list[tuple[str, int, Any]]:
    """What a robot says, as a recorder notes it: at once on the robot itself, after some milliseconds on the other."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(20):
        sent = START_NS + k * 10_000_000
        way = 0 if at_own else int(rng.integers(4_000_000, 15_000_000))
        ahead = RECORDER_NS if (sender == "husky") == at_own else 0
        own = sent + (RECORDER_NS if sender == "husky" else 0)
        place = r.make("geometry_msgs/msg/Point", x=float(k), y=0.0, z=0.0)
        message = r.make("geometry_msgs/msg/PointStamped", header=r.header(own, sender), point=place)
        rows.append((f"/{sender}/chat", sent + way + ahead, message))
    return rows


def two_logs(tmp_path: Path, speakers: tuple[str, ...], namespaces: bool) -> Path:
    """A log of jackal's recorder and one of husky's, each with what both say, and a TOML file that names them."""
    r = Ros(2)
    lines = []
    for robot, seed in (("jackal", 1), ("husky", 2)):
        poses = path(FRAMES, 0.2) if robot == "husky" else None
        ahead = RECORDER_NS if robot == "husky" else 0
        rows = [
            (t, ns + ahead, m) for t, ns, m in moved_headers(r, scene(r, f"/{robot}", poses=poses), ahead)
        ]
        for k, speaker in enumerate(speakers):
            rows += chat(r, speaker, speaker == robot, seed + 10 * k)
        r.write(tmp_path / robot, sorted(rows, key=lambda x: x[1]), "mcap")
        space = f'namespace = "/{robot}"\n' if namespaces else ""
        lines.append(f'[robots.{robot}]\nlogs = ["{robot}"]\n{space}')
        for option, topic in (("color", "color/image_raw"), ("depth", "depth/image_rect_raw")):
            lines.append(f'{option} = "/{robot}/camera/{topic}"\n')
    (tmp_path / "team.toml").write_text("".join(lines))
    return tmp_path / "team.toml"


def test_messages_without_a_time_tell_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Counters of two robots say the same at times that have nothing to do with each other; images are not read."""
    r = Ros(2)
    for robot, late_ns in (("husky", 0), ("jackal", 37_000_000_000)):
        rows = [(t, ns + late_ns, m) for t, ns, m in moved_headers(r, still(r), late_ns)]
        rows += [
            ("/heartbeat", START_NS + late_ns + k * STEP_NS, r.make("std_msgs/msg/UInt32", data=k))
            for k in range(20)
        ]
        r.write(tmp_path / "logs" / robot, sorted(rows, key=lambda x: x[1]), "mcap")
    hashed: list[bytes] = []
    digest = clocks.hashlib.blake2b
    monkeypatch.setattr(
        clocks.hashlib, "blake2b", lambda data, **more: hashed.append(data) or digest(data, **more)
    )
    registry.convert("ros", tmp_path / "logs", tmp_path / "rec", options=["clocks=estimated"])
    assert clocks_of(tmp_path / "rec")["bravo"]["offset_s"] is None
    assert start(tmp_path / "rec", "bravo") - start(tmp_path / "rec", "alpha") == 37_000_000_000
    assert not hashed


def test_the_reference_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    r = Ros(2)
    for robot in ("a", "b", "c"):
        r.write(
            tmp_path / "logs" / robot, sorted(still(r) + chat(r, "x", False, 1), key=lambda x: x[1]), "mcap"
        )
    read: list[str] = []
    times = clocks._times
    monkeypatch.setattr(clocks, "_times", lambda log, topics: read.append(log.name) or times(log, topics))
    registry.convert("ros", tmp_path / "logs", tmp_path / "rec")
    assert sorted(Path(name).name for name in read) == ["a", "b", "c"]
    assert clocks_of(tmp_path / "rec")["charlie"]["offset_s"] == 0


def test_messages_in_both_directions_bound_the_difference(tmp_path: Path) -> None:
    team = two_logs(tmp_path, ("jackal", "husky"), namespaces=True)
    registry.convert("ros", team, tmp_path / "rec", options=["clocks=estimated"])
    stated = clocks_of(tmp_path / "rec")["jackal"]  # husky is first by name
    assert stated["low_s"] <= RECORDER_NS / 1e9 <= stated["high_s"]
    assert stated["high_s"] - stated["low_s"] < 0.025
    assert stated["how"] == "40 messages that both recorded, sent by both"
    assert abs(start(tmp_path / "rec", "jackal") - start(tmp_path / "rec", "husky")) < 6_000_000


def test_clocks_that_lead_before_their_beginning_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stamps since the start of a computer, which another one started earlier."""
    second = 1_000_000_000

    class Log:
        name, shift_ns, pairs = "b.bag", 0, {50 * second: None}
        settings = LogOptions(clocks="estimated")
        settle_drift = clock = written_ns = lambda self, stamp_ns=0: stamp_ns + self.shift_ns

    offset = SimpleNamespace(seconds=-100.0, matters=True)
    monkeypatch.setattr(ros, "compare", lambda _: {"b": offset})
    monkeypatch.setattr(Log, "clock", lambda self, robot: robot)
    with pytest.raises(DuagError, match=r"b.bag: begins at -50.0 s by the settled clocks, expected 0 s"):
        ros.settle_clocks(SimpleNamespace(warnings=[]), {"b": Log()})


def test_one_direction_bounds_one_side(tmp_path: Path) -> None:
    team = two_logs(tmp_path, ("jackal",), namespaces=True)
    registry.convert("ros", team, tmp_path / "rec")
    stated = clocks_of(tmp_path / "rec")["jackal"]
    assert stated["low_s"] is None
    assert stated["high_s"] >= RECORDER_NS / 1e9
    assert abs(stated["offset_s"] - RECORDER_NS / 1e9) < 0.016  # the way takes up to 15 ms
    assert "sent by one" in stated["how"]


def test_without_common_messages_nothing_is_made_up(tmp_path: Path) -> None:
    team = two_logs(tmp_path, (), namespaces=True)
    registry.convert("ros", team, tmp_path / "rec", options=["clocks=estimated"])
    stated = clocks_of(tmp_path / "rec")["jackal"]
    assert stated["offset_s"] is None
    assert stated["added_s"] == 0
    warnings = json.loads((tmp_path / "rec" / "recording.json").read_text())["warnings"]
    assert any("jackal: its clock is kept: recorders of their own" in w for w in warnings)


@pytest.mark.parametrize("late_s", [0.137, -0.42, 0.0])
def test_truth_that_turns_later_is_found(late_s: float) -> None:
    """A gyroscope at 200 Hz and poses at 30 Hz of one body; the poses' clock is behind."""
    rng = np.random.default_rng(3)
    phases, rates = rng.uniform(0, 6, 5), rng.uniform(0.3, 4, 5)

    def angle(t: np.ndarray) -> np.ndarray:
        return np.sum(0.4 * np.sin(np.outer(t, rates) + phases), axis=1)

    times = np.arange(0, 20, 0.005)
    speed = np.abs(np.gradient(angle(times), times)) + 0.02 * rng.standard_normal(len(times))
    poses_at = np.arange(0, 20, 1 / 30)
    T = np.tile(np.eye(4), (len(poses_at), 1, 1))
    T[:, :3, :3] = so3.exp(np.outer(angle(poses_at), [0.0, 0.0, 1.0]))
    stamps = np.round((poses_at + late_s) * 1e9).astype(np.int64)
    found = clocks.lag(np.round(times * 1e9).astype(np.int64), speed, *clocks.angular_speed(stamps, T))
    assert found is not None
    assert found[0] == pytest.approx(late_s, abs=0.005)
    still = clocks.lag(np.round(times * 1e9).astype(np.int64), 0 * speed, *clocks.angular_speed(stamps, T))
    assert still is None
    other = np.abs(rng.standard_normal(len(times)))
    assert clocks.lag(np.round(times * 1e9).astype(np.int64), other, *clocks.angular_speed(stamps, T)) is None


def drifting(r: Ros, seconds: int, ppm: float) -> list[tuple[str, int, Any]]:
    """The scene again every two seconds; the recorder's clock gains on that of the headers, and delays play."""
    rows = scene(r)
    images = [row for row in rows if "image" in row[0]]
    out = [row for row in rows if "info" in row[0] or row[0] == "/tf_static"]
    rng = np.random.default_rng(5)
    for k in range(1, seconds // 2):
        for topic, _, message in images[2 * (k % FRAMES) : 2 * (k % FRAMES) + 2]:
            later = moved_headers(r, [(topic, 0, copy.deepcopy(message))], 2 * k * 10**9)[0][2]
            stamp = later.header.stamp.sec * 10**9 + later.header.stamp.nanosec
            delay = 0.004 + rng.exponential(0.003) + ppm * 1e-6 * (stamp - START_NS) / 1e9
            out.append((topic, stamp + round(1e9 * delay), later))
    return sorted(out, key=lambda x: x[1])


def test_a_drift_is_told_and_taken_out_if_asked(tmp_path: Path) -> None:
    r = Ros(2)
    bag = r.write(tmp_path / "bag", drifting(r, 120, 400.0), "mcap")
    registry.convert("ros", bag, tmp_path / "kept")
    (stated,) = [w for w in warnings_of(tmp_path / "kept") if "ppm" in w]
    assert "the recorder's clock gains 4" in stated
    assert "expected one rate, or --set clocks=estimated" in stated
    assert "ppm" in format_info(info(tmp_path / "kept"))
    (finding,) = [f for f in check(tmp_path / "kept").findings if f.check == "clock"]
    assert "ppm" in finding.found
    assert "clocks=estimated" in finding.expected
    found = describe(bag)
    assert found["robots"]["alpha"]["drift_ppm"] == pytest.approx(400, abs=15)
    assert any("ppm" in w for w in found["robots"]["alpha"]["warnings"])
    registry.convert("ros", bag, tmp_path / "settled", options=["clocks=estimated"])
    assert not [f for f in check(tmp_path / "settled").findings if f.check == "clock"]
    kept, settled = (span(tmp_path / name) for name in ("kept", "settled"))
    assert kept[0] == settled[0]
    assert settled[1] - kept[1] == pytest.approx(400e-6 * (kept[1] - kept[0]), rel=0.04)


def test_an_image_without_a_time_hides_no_drift(tmp_path: Path) -> None:
    r = Ros(2)
    rows = drifting(r, 120, 400.0)
    at = next(k for k, row in enumerate(rows) if "image" in row[0] and k > len(rows) // 2)
    topic, stamp_ns, message = rows[at]
    rows[at] = moved_headers(r, [(topic, 0, message)], -message.header.stamp.sec * 10**9)[0]
    rows[at][2].header.stamp.nanosec = 0
    rows[at] = (topic, stamp_ns, rows[at][2])
    bag = r.write(tmp_path / "bag", rows, "mcap")
    registry.convert("ros", bag, tmp_path / "settled", options=["clocks=estimated"])
    assert any("images without a time" in w for w in warnings_of(tmp_path / "settled"))
    assert any(
        "the recorder's clock gains 4" in w and "taken out" in w for w in warnings_of(tmp_path / "settled")
    )
    assert span(tmp_path / "settled")[1] - span(tmp_path / "settled")[0] < 150 * 10**9


def test_clocks_of_one_rate_are_left_alone(tmp_path: Path) -> None:
    r = Ros(2)
    bag = r.write(tmp_path / "bag", drifting(r, 120, 0.0), "mcap")
    registry.convert("ros", bag, tmp_path / "rec", options=["clocks=estimated"])
    assert not [w for w in warnings_of(tmp_path / "rec") if "ppm" in w]


@pytest.mark.parametrize("ppm", [-80.0, 0.0, 30.0])
def test_drift_by_the_least_delays(ppm: float) -> None:
    """An hour at 30 Hz, delays of 5 ms with a long tail; a stall of the recorder changes nothing."""
    rng = np.random.default_rng(2)
    stamps = START_NS + np.arange(0, 3600 * 10**9, 33_333_333)
    delays = 0.002 + rng.exponential(0.005, len(stamps)) + ppm * 1e-6 * (stamps - START_NS) / 1e9
    delays[40_000:46_000] += 0.5
    found = clocks.drift(stamps, np.rint(delays * 1e9).astype(np.int64))
    assert found is not None
    assert 1e6 * found.rate == pytest.approx(ppm, abs=0.1)
    assert found.matters == (ppm != 0)
    assert clocks.drift(stamps[:1500], np.zeros(1500, np.int64)) is None
    assert clocks.drift(stamps[:0], np.zeros(0, np.int64)) is None


def test_a_recorder_that_falls_behind_is_no_drift() -> None:
    stamps = START_NS + np.arange(0, 600 * 10**9, 33_333_333)
    found = clocks.drift(stamps, (stamps - START_NS) // 100)
    assert found is not None
    assert not found.matters


def warnings_of(recording: Path) -> list[str]:
    return list(json.loads((recording / "recording.json").read_text())["warnings"])


def span(recording: Path) -> tuple[int, int]:
    row = json.loads((recording / "recording.json").read_text())["robots"]["alpha"]
    return row["start_ns"], row["end_ns"]
