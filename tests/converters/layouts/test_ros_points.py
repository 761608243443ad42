"""PointCloud2 in all its layouts, and sweeps of a moving LiDAR as of one time."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from duagc.converters.layouts.ros_points import PointTimes, UnusableSweep, as_of, points_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording.motion import GyroPrior, OdometryPrior

POINTS = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 0.25], [7.0, -8.0, 9.0], [0.5, 0.5, 0.5]])
CODES = {"i1": 1, "u1": 2, "u2": 4, "u4": 6, "f4": 7, "f8": 8}


def cloud(
    names: str = "xyz",
    kind: str = "f4",
    extra: dict[str, tuple[str, Any]] | None = None,
    height: int = 1,
    pad: int = 0,
    big: bool = False,
    lead: int = 0,
) -> Any:
    """POINTS with coordinates in the given order, further fields, padded points (lead) and rows (pad)."""
    order = ">" if big else "<"
    columns = {n: (kind, POINTS[:, "xyz".index(n)]) for n in names} | (extra or {})
    offset, fields, layout = lead, [], []
    for name, (code, values) in columns.items():
        fields.append(SimpleNamespace(name=name, offset=offset, datatype=CODES[code], count=1))
        layout.append((offset, np.asarray(values).astype(order + code)))
        offset += np.dtype(code).itemsize
    step, width = offset + 3, len(POINTS) // height
    rows = np.full((len(POINTS), step), 0xAB, np.uint8)
    for at, values in layout:
        rows[:, at : at + values.itemsize] = values.view(np.uint8).reshape(len(POINTS), -1)
    data = np.pad(rows.reshape(height, width * step), ((0, 0), (0, pad)), constant_values=0xCD)
    return SimpleNamespace(
        fields=fields,
        width=width,
        height=height,
        point_step=step,
        row_step=width * step + pad,
        is_bigendian=big,
        data=data.ravel(),
        header=SimpleNamespace(stamp=SimpleNamespace(sec=1_700_000_000, nanosec=250_000_000)),
    )


@pytest.mark.parametrize("height", [1, 2])
def test_the_last_row_needs_no_padding(height: int) -> None:
    """So do images come, and sweeps of one row from which a driver took points and left the length of the row."""
    message = cloud(height=height, pad=64)
    message.data = message.data[:-64]
    np.testing.assert_array_equal(points_of(message, "here")[0], POINTS)
    message.data = message.data[:-1]
    short = len(message.data)
    with pytest.raises(UnusableSweep, match=f"{short} bytes .* and {short + 1} bytes"):
        points_of(message, "here")


@pytest.mark.parametrize("names", ["xyz", "zyx"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize(
    ("height", "pad", "big", "lead"), [(1, 0, False, 0), (2, 5, False, 4), (1, 0, True, 2)]
)
def test_layouts(names: str, kind: str, height: int, pad: int, big: bool, lead: int) -> None:
    message = cloud(names, kind, {"intensity": ("u1", [1, 2, 3, 4])}, height, pad, big, lead)
    points, seconds = points_of(message, "here")
    np.testing.assert_array_equal(points, POINTS)
    assert (seconds == 0).all()


@pytest.mark.parametrize(
    ("name", "kind", "values"),
    [
        ("time", "f4", [-0.1, -0.05, 0.0, 0.025]),
        ("t", "u4", [0, 50_000_000, 75_000_000, 99_000_000]),
        ("offset_time", "u4", [0, 1, 2, 99_999_999]),
    ],
)
def test_times(name: str, kind: str, values: list[float]) -> None:
    _, seconds = points_of(cloud(extra={name: (kind, values)}), "here")
    unit = 1.0 if kind == "f4" else 1e-9
    np.testing.assert_allclose(seconds, np.array(values) * unit, rtol=1e-6)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1_700_000_000.25 + t for t in (0.0, 0.05, 0.1, 0.15)], (0.0, 0.05, 0.1, 0.15)),
        ([1.70000000025e18 + t for t in (0.0, 5e7, 1e8, 1.5e8)], (0.0, 0.05, 0.1, 0.15)),
        ([0.0, 0.05, 0.1, 0.15], (0.0, 0.05, 0.1, 0.15)),
        ([500.0, 500.05, 500.1, 500.15], (0.0, 0.0, 0.0, 0.0)),
    ],
    ids=["seconds", "nanoseconds", "after the stamp", "another clock"],
)
def test_times_of_the_clock_itself(values: list[float], expected: tuple[float, ...]) -> None:
    message = cloud(extra={"timestamp": ("f8", values)})
    message.header = SimpleNamespace(stamp=SimpleNamespace(sec=1_700_000_000, nanosec=250_000_000))
    points, seconds = points_of(message, "here")
    assert len(points) == 4
    np.testing.assert_allclose(seconds, expected, atol=1e-6)


UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
SWEEP_S = np.array([0.0, 0.03, 0.07, 0.1])


def sweeps_of(name: str, times: Any, kind: str = "f8", starts_s: Any = (1000,) * 8) -> list[Any]:
    """Sweeps every 0.1 s. times: of the points of one that begins at a time, s."""
    messages = []
    for k, start_s in enumerate(starts_s):
        messages.append(cloud(extra={name: (kind, times(start_s + k * 0.1))}))
        messages[-1].header.stamp = SimpleNamespace(sec=start_s, nanosec=k * 100_000_000)
    return messages


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("name", ["time", "t", "offset_time", "timestamp"])
@pytest.mark.parametrize("clock", ["after", "before", "of the clock", "of a simulated clock"])
def test_the_unit_of_times_is_what_makes_a_sweep(name: str, unit: str, clock: str) -> None:
    """Whatever the name; the first sweeps of a simulation are near its time 0."""
    from_s = {"after": 0.0, "before": -0.1, "of the clock": 1.7e9, "of a simulated clock": 0.0}[clock]
    is_absolute = "clock" in clock
    starts_s = [int(from_s) if is_absolute else 0] * 8
    messages = sweeps_of(
        name,
        lambda start_s: (SWEEP_S + (start_s if is_absolute else from_s)) / UNITS[unit],
        starts_s=starts_s,
    )
    times = PointTimes.found(messages, "here")
    named = {"time": "s", "timestamp": unit}.get(name, "ns")
    usual = unit == named and (not is_absolute or name == "timestamp")
    assert (times.words == "") == usual, times.words
    assert (
        usual
        or f"field {name} is taken in {unit} {'of the clock' if is_absolute else 'after'}" in times.words
    )
    points, seconds = points_of(messages[3], "here", times)
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_allclose(seconds, SWEEP_S + (0 if is_absolute else from_s), atol=1e-6)


def test_a_part_of_a_sweep_has_the_unit_of_all() -> None:
    """By itself a short part would be of a larger unit."""
    messages = sweeps_of("t", lambda _: SWEEP_S * 1e9, "u4")
    messages[2] = cloud(extra={"t": ("u4", [0, 1_000, 100_000, 999_000])})
    messages[2].header = messages[3].header
    seconds = points_of(messages[2], "here", PointTimes.found(messages, "here"))[1]
    np.testing.assert_allclose(seconds, [0, 1e-6, 1e-4, 999e-6])


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (
            lambda start_s: SWEEP_S + start_s + 37,
            "field timestamp goes from 1037 to 1037.8 with stamps from 1000.0",
        ),
        (lambda _: [0.0, 1e9, 3e9, 4.2e9], "field timestamp goes from 0 to 4200000000 "),
        (lambda _: np.zeros(4), "its points have no times, expected a field time, t, "),
        (lambda _: np.full(4, np.nan), "its points have no times, expected a field time, t, "),
    ],
    ids=["another clock", "no unit", "zeros", "nan"],
)
def test_times_that_are_not_known_are_told(times: Any, words: str) -> None:
    """TAI is 37 s before UTC; points are kept, as of the time of their message."""
    messages = sweeps_of("timestamp", times)
    found = PointTimes.found(messages, "here")
    assert f"sweeps hold what the LiDAR moved meanwhile: {words}" in found.words
    points, seconds = points_of(messages[0], "here", found)
    np.testing.assert_array_equal(points, POINTS)
    assert (seconds == 0).all()


def test_points_that_are_none_are_left_out() -> None:
    message = cloud(kind="f8", extra={"time": ("f8", [0.0, np.nan, 0.1, 1e30])})
    points, seconds = points_of(message, "here")
    np.testing.assert_array_equal(points, POINTS[[0, 2]])
    np.testing.assert_array_equal(seconds, [0.0, 0.1])
    for lost in (np.nan, np.inf, 1e30):
        message = cloud()
        values = np.full(4, lost, "<f4").view(np.uint8).reshape(4, 4)
        message.data.reshape(4, -1)[1:3, 4:8] = values[1:3]
        assert len(points_of(message, "here")[0]) == 2


@pytest.mark.parametrize(
    "change",
    [
        {"point_step": 0},
        {"width": 5},
        {"width": 2**31, "row_step": 0},
        {"height": 2**31},
        {"row_step": 3},
        {"data": np.zeros(0, np.uint8)},
        {"point_step": 2, "row_step": 0},
    ],
)
def test_wrong_sizes_are_one_line(change: dict[str, Any]) -> None:
    message = cloud()
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(DuagError, match=r"^here"):
        points_of(message, "here")


def test_wrong_fields_are_one_line() -> None:
    message = cloud()
    message.fields[0].datatype = 9
    with pytest.raises(DuagError, match="here: field x has type 9"):
        points_of(message, "here")
    message.fields[0] = SimpleNamespace(name="range", offset=0, datatype=7, count=1)
    with pytest.raises(DuagError, match=r"here has fields \['range', 'y', 'z'\]"):
        points_of(message, "here")


def test_points_of_a_moving_lidar_come_to_one_time() -> None:
    """Each point of a landmark field was measured from another pose; as of one time they are where they were then."""
    rng = np.random.default_rng(0)
    landmarks = rng.uniform(-5, 5, (400, 3))
    times = np.arange(400) * 250_000  # 0.1 s
    twist = np.array([0.8, -0.2, 0.1, 0.3, -0.5, 0.4])
    T_camera_lidar = se3.exp(np.array([0.1, -0.2, 0.05, 0.4, -1.0, 0.2]))
    at_ns = 30_000_000

    def pose(time_ns: float, moves: np.ndarray) -> np.ndarray:
        return se3.exp(moves * time_ns * 1e-9)

    stamps, turn = range(0, 200_000_000, 10_000_000), twist * [0, 0, 0, 1, 1, 1]
    odometry = OdometryPrior(stamps, np.array([pose(t, twist) for t in stamps]))
    gyro = GyroPrior(range(-10_000_000, 200_000_000, 5_000_000), np.tile(twist[3:], (42, 1)))
    for moves, prior in ((twist, odometry), (turn, gyro)):
        measured = np.array(
            [
                se3.transform(se3.inverse(pose(t, moves) @ T_camera_lidar), p[None])[0]
                for t, p in zip(times, landmarks, strict=True)
            ]
        )
        expected = se3.transform(se3.inverse(pose(at_ns, moves) @ T_camera_lidar), landmarks)
        found = as_of(at_ns, measured, times, T_camera_lidar, motion=prior)
        before, after = (np.linalg.norm(p - expected, axis=1).max() for p in (measured, found))
        assert before > 0.1
        assert after < 0.01  # within a moment of 2 ms
        np.testing.assert_array_equal(as_of(at_ns, measured, times, T_camera_lidar, motion=None), measured)
        far = as_of(
            at_ns, measured, times + 10**9, T_camera_lidar, motion=prior
        )  # where the prior does not reach
        np.testing.assert_array_equal(far, measured)
