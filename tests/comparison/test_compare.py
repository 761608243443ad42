"""One bit that differs is named by stage, topic, message, time and field, with both values."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.comparison.compare import Compared, compare
from duagc.pipeline.comparison.fields import unequal
from duagc.pipeline.comparison.tolerances import Tolerance, Tolerances, read_tolerances
from duagc.pipeline.evaluation import evaluate
from duagc.pipeline.recording import LogWriter, log_metadata, read_log
from duagc.pipeline.splat.ply import write_ply
from tests.fixtures import fake_run
from tests.fixtures.commands import assert_one_line, duagc_here
from tests.fixtures.gaussian_maps import random_map


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> fake_run.FakeRun:
    return fake_run.make(tmp_path_factory.mktemp("fake"))


@pytest.fixture
def other(fake: fake_run.FakeRun, tmp_path: Path) -> Path:
    shutil.copytree(fake.run, tmp_path / "run")
    return tmp_path / "run"


def flip_bit(path: Path, topic: str, index: int, at: Any) -> int:
    """Change one message of a log by a function of its protobuf message; its log time."""
    records, metadata = list(read_log(path)), log_metadata(path)
    chosen = [record for record in records if record.topic == topic][index]
    with LogWriter(path, metadata.pop("robot"), metadata) as log:
        for record in records:
            message = record.proto()
            if record is chosen:
                at(message)
            log.write(record.topic, message, record.log_time_ns, record.publish_time_ns)
    return chosen.log_time_ns


def test_equal_runs_are_equal(fake: fake_run.FakeRun, other: Path) -> None:
    found = compare(fake.run, other)
    assert found.equal
    assert found.messages > 50
    assert found.text() == f"equal: {found.files} files, {found.messages} messages"
    result = duagc_here("compare", fake.run, other)
    assert (result.returncode, result.stdout.strip()) == (0, found.text())


def test_one_bit_of_tracking_is_named(fake: fake_run.FakeRun, other: Path) -> None:
    def nudge(message: Any) -> None:
        message.overlap = float(np.nextafter(message.overlap, 2.0))

    topic = "/alpha/odometry"
    time_ns = flip_bit(other / "robots" / "alpha" / "frontend.mcap", topic, 5, nudge)
    (found,) = compare(fake.run, other).differences
    assert (found.stage, found.file, found.where) == ("frontend", "robots/alpha/frontend.mcap", topic)
    assert (found.index, found.time_ns) == (5, time_ns)
    (field,) = found.fields
    assert field["name"] == "overlap"
    assert float(field["second"]) == np.nextafter(float(field["first"]), 2.0)
    result = duagc_here("compare", fake.run, other)
    assert result.returncode == 3
    assert (
        f"message 5 of 21 at {time_ns} ns: overlap: {field['first']} and {field['second']}" in result.stdout
    )


def test_one_bit_of_a_fused_map_is_named_with_its_gaussian(fake: fake_run.FakeRun, other: Path) -> None:
    def nudge(message: Any) -> None:
        content = bytearray(message.gaussians.means_float32)
        content[4 * (3 * 7 + 2)] ^= 1  # z of Gaussian 7
        message.gaussians.means_float32 = bytes(content)

    flip_bit(other / "robots" / "bravo" / "fused.mcap", "/bravo/fused_map", 0, nudge)
    (found,) = compare(fake.run, other).differences
    assert (found.stage, found.where) == ("fusion", "/bravo/fused_map")
    assert "gaussians.means[7, 2]: " in found.text
    assert 0 < found.fields[0]["largest"] < 1e-6


def test_earlier_stages_come_first_and_missing_messages_and_files_are_named(
    fake: fake_run.FakeRun, other: Path
) -> None:
    frontend = other / "robots" / "bravo" / "frontend.mcap"
    records = list(read_log(frontend))
    with LogWriter(frontend, "bravo") as log:
        for record in records[:-1]:
            log.write(record.topic, record.proto(), record.log_time_ns, record.publish_time_ns)
    (other / "exchange.mcap").unlink()
    path = other / "robots" / "alpha" / "trajectory.tum"
    lines = path.read_text().splitlines()
    words = lines[-1].split()
    path.write_text("\n".join([*lines[:-1], " ".join([words[0], "7.25", *words[2:]])]) + "\n")
    found = compare(fake.run, other)
    assert [d.stage for d in found.differences] == ["frontend", "exchange", "fusion"]
    assert "1 and 0 messages" in found.differences[0].text
    assert found.differences[1].text == f"not in {other}"
    assert re.match(r"poses\[20, 0, 3\]: \S+ and 7.25$", found.differences[2].text)


def test_changed_settings_are_noted_and_are_no_difference(fake: fake_run.FakeRun, other: Path) -> None:
    path = other / "config.toml"
    path.write_text(path.read_text().replace("1e-5", "1e-4"))
    found = compare(fake.run, other)
    assert found.equal
    assert found.notes == ["setting exchange.consensus.tolerance: 1e-05 and 0.0001"]


def test_other_versions_of_libraries_are_noted_and_are_no_difference(
    fake: fake_run.FakeRun, other: Path, tmp_path: Path
) -> None:
    first = tmp_path / "first"
    shutil.copytree(fake.run, first)
    for run, version in ((first, "2.4.6"), (other, "2.5.5")):
        (run / "manifest.json").write_text(json.dumps({"libraries": {"numpy": version, "scipy": "1.17.1"}}))
    found = compare(first, other)
    assert found.equal
    assert found.notes == ["library numpy: 2.4.6 and 2.5.5"]


def test_tolerances_count_per_field_and_have_reasons(
    fake: fake_run.FakeRun, other: Path, tmp_path: Path
) -> None:
    def nudge(message: Any) -> None:
        message.overlap += 0.01

    flip_bit(other / "robots" / "alpha" / "frontend.mcap", "/alpha/odometry", 5, nudge)
    path = tmp_path / "tolerances.toml"

    def compared(text: str) -> Compared:
        path.write_text(text)
        return compare(fake.run, other, read_tolerances(path))

    row = (
        '[[tolerance]]\nwhere = "/*/odometry"\nfield = "overlap"\nabsolute = {}\nreason = "another camera"\n'
    )
    found = compared(row.format(0.02))
    assert found.equal
    assert found.tolerated == 1
    assert not compared(row.format(0.001)).equal
    assert not compared(row.format(0.02).replace("overlap", "frame_index")).equal
    for text, complaint in (
        (row.format(0.02).replace("another camera", ""), "reason is empty, expected why this much is right"),
        (
            row.format(0.02).replace("absolute", "absolutes"),
            "tolerance 1: absolutes: expected perhaps absolute",
        ),
        (row.format(-1), "tolerance 1: absolute: expected a number greater than or equal to 0"),
        (row.format(0.02).replace("tolerance", "tolerances"), r"expected \[\[tolerance\]\] tables only"),
        ("[[tolerance", "not valid TOML"),
    ):
        with pytest.raises(DuagError, match=complaint):
            compared(text)


def test_metrics_are_compared_by_name(fake: fake_run.FakeRun, tmp_path: Path) -> None:
    runs = [tmp_path / "first", tmp_path / "second"]
    for run in runs:
        shutil.copytree(fake.run, run)
        evaluate(run, fake.recording, progress=False)
    assert compare(*runs).equal
    path = runs[1] / "metrics.json"
    metrics = json.loads(path.read_text())
    metrics["team"]["ate_rmse_m"] += 0.25
    path.write_text(json.dumps(metrics))
    (found,) = compare(*runs).differences
    assert (found.stage, found.file, found.fields[0]["name"]) == (
        "evaluation",
        "metrics.json",
        "team.ate_rmse_m",
    )
    assert found.fields[0]["largest"] == pytest.approx(0.25)


def test_logs_and_maps_and_recordings_are_compared(fake: fake_run.FakeRun, tmp_path: Path) -> None:
    log = fake.recording / "alpha.mcap"
    assert compare(log, log).equal
    assert not compare(log, fake.recording / "bravo.mcap").equal
    shutil.copytree(fake.recording, tmp_path / "recording")
    assert compare(fake.recording, tmp_path / "recording").equal
    (tmp_path / "recording" / "bravo.groundtruth.mcap").unlink()
    (found,) = compare(fake.recording, tmp_path / "recording").differences
    assert found.stage == "recording"
    for name in ("first", "second"):
        run = tmp_path / name / "robots" / "alpha"
        run.mkdir(parents=True)
        write_ply(run / "fused.ply", random_map(0 if name == "first" else 1)[0])
    (found,) = compare(tmp_path / "first", tmp_path / "second").differences
    assert found.where == ""
    assert "means[0, 0]: " in found.text


def test_descriptions_and_geometry_of_recordings_are_compared(fake: fake_run.FakeRun, tmp_path: Path) -> None:
    other = tmp_path / "recording"
    shutil.copytree(fake.recording, other)
    path = other / "recording.json"
    description = json.loads(path.read_text())
    row = description["robots"]["alpha"]
    row["digests"], description["name"] = {}, "another"
    description["parameters"]["seed"] = 7
    path.write_text(json.dumps(description))
    found = compare(fake.recording, other)
    assert found.equal
    assert found.notes == ["recording.json parameters.seed: absent and 7"]
    row["depth_scale_m"] *= 2
    path.write_text(json.dumps(description))
    geometry = other / "groundtruth.ply"
    content = bytearray(geometry.read_bytes())
    content[-1] ^= 1  # blue of the last point
    geometry.write_bytes(content)
    found = compare(fake.recording, other)
    assert [(d.stage, d.file) for d in found.differences] == [
        ("recording", "groundtruth.ply"),
        ("recording", "recording.json"),
    ]
    assert re.match(r"blue\[\d+\]: 0 and 1$", found.differences[0].text)
    assert found.differences[1].text == "robots.alpha.depth_scale_m: 0.001 and 0.002"
    geometry.write_bytes(b"ply\nformat ascii 1.0\n")
    assert "bytes: absent and " in compare(fake.recording, other).differences[0].text
    geometry.unlink()
    assert compare(fake.recording, other).differences[0].text == f"not in {other}"


def test_a_relative_tolerance_is_of_each_element() -> None:
    def allowed(first: object, second: object, **row: float) -> bool:
        (found,) = unequal({"x": np.array(first)}, {"x": np.array(second)})
        return Tolerances((Tolerance(where="*", field="x", reason="a test", **row),)).allow("run", found)

    assert allowed([1000.0, 1.0], [1001.0, 1.001], relative=0.01)
    assert not allowed([1000.0, 1.0], [1001.0, 1.5], relative=0.01)
    assert allowed([1000.0, 1.0], [1001.0, 1.5], relative=0.01, absolute=0.5)
    assert not allowed([np.inf], [1.0], relative=0.01)
    assert not allowed([1.0], [np.nan], relative=0.01, absolute=1.0)


def test_different_kinds_are_one_line(fake: fake_run.FakeRun, tmp_path: Path) -> None:
    assert_one_line(duagc_here("compare", fake.run, fake.recording), "is a recording, expected a run")
    assert_one_line(duagc_here("compare", fake.run, tmp_path), "expected a log, a recording")
    assert_one_line(duagc_here("golden", "check", fake.run, tmp_path / "none.json"), "none.json")


def test_signs_and_missing_numbers_count_as_values() -> None:
    def text(first: object, second: object) -> list[str]:
        return [found.text() for found in unequal({"x": first}, {"x": second})]

    assert text(np.array([np.nan, 1.0]), np.array([np.nan, 1.0])) == []
    assert text(np.array([0.0]), np.array([-0.0])) == ["x[0]: 0.0 and -0.0"]
    assert text(np.zeros(2), np.zeros(3)) == ["x: shape [2] and shape [3]"]
    assert text(1.0, np.nan) == ["x: 1.0 and nan"]
    assert text(b"ab", b"ac") == ["x[1]: 98 and 99"]
    assert text("a", "b") == ["x: a and b"]
    assert [found.text() for found in unequal({}, {"y": 2})] == ["y: absent and 2"]
    assert not Tolerances().allow("x", unequal({"x": 1.0}, {"x": 2.0})[0])


@pytest.mark.parametrize("kind", [int, np.int64, np.uint64])
def test_times_of_a_date_are_compared_to_the_nanosecond(kind: Any) -> None:
    """A float has steps of 256 ns there: a tolerance of nothing would allow one."""
    stamp_ns = 1_305_031_102_175_304_000
    for apart_ns in (1, -100):
        (found,) = unequal({"stamp_ns": kind(stamp_ns)}, {"stamp_ns": kind(stamp_ns + apart_ns)})
        assert found.largest == abs(apart_ns)
        assert not found.within(0.5, 0.0)
        assert found.within(100.0, 0.0)
    (found,) = unequal({"far": np.int64(-(1 << 63))}, {"far": np.int64((1 << 63) - 1)})
    assert found.largest == pytest.approx(2.0**64)


@pytest.mark.parametrize(
    ("first", "second"), [([1.0, None], [1.0, 2.0]), ([1, [2]], [1, [3]]), ([1 << 70], [1 << 71])]
)
def test_lists_of_more_than_numbers_are_compared_as_they_are(first: list[Any], second: list[Any]) -> None:
    assert unequal({"of": first}, {"of": first}) == []
    (found,) = unequal({"of": first}, {"of": second})
    assert (found.first, found.second) == (str(first), str(second))
    assert found.largest is None
