"""`duagc check`: whether a recording is sound, before a run spends its time on it. A reader like the evaluation: true
poses are compared with the depth, and go nowhere else."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from duagc.pipeline.base import determinism
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.checks import estimate, geometry, gyroscope, images, measured, moves, scale, stamps
from duagc.pipeline.checks.findings import Finding, Report, Severity, judged, lines
from duagc.pipeline.checks.keyframe_count import count_keyframes
from duagc.pipeline.config.checks import ChecksConfig, MotionChecks
from duagc.pipeline.config.frontend import FailureConfig, FrontendConfig, KeyframeConfig
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.evaluation import groundtruth
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.recording import MotionPrior, Recording, RgbdLog, log_metadata, open_rgbd
from duagc.pipeline.recording.log_checksums import verify
from duagc.pipeline.recording.names import DIGEST_RECORD, is_mcap
from duagc.pipeline.recording.read import LogFile
from duagc.schemas.topics import COLOR

__all__ = ["Finding", "Report", "Severity", "check", "check_registration", "format_report"]

_DEFAULT = ChecksConfig()
_CLOCK_WORDS = (
    " ppm on that of the headers",
    " true pose: images are of ",
    " have none in common with the images",
    " as if their clocks differ",
)


def check(path: str | Path, config: ChecksConfig = _DEFAULT, *, store: str | Path | None = None) -> Report:
    """Check a recording, or the log of one robot.

    Args:
        path: folder of the recording, or the log.
        config: from which value on something is reported.
        store: results of earlier runs, which say how fast this machine is; None: there are none.

    Returns:
        All findings; `Report.sound` is whether there is no error among them.

    Raises:
        DuagError: it is neither. Everything else that is wrong is a finding.
    """
    determinism.configure_opencv()
    path = Path(path)
    report = Report(str(path))
    recording = None if path.is_file() else Recording(path)
    sights: dict[str, images.Sight] = {}
    colors: dict[str, images.Repeats] = {}
    for robot in recording.robots if recording else [""]:
        log = None
        try:
            log = recording.log(robot) if recording else path
            with open_rgbd(log) as rgbd:
                if recording:
                    rgbd.check_robot(robot)
                _check_robot(report, recording, rgbd, sights, colors=colors, config=config)
        except DuagError as error:
            report.findings.append(_unreadable(robot, error, _remedy(log)))
    report.findings += images.check_colors(sights, config.images)
    report.findings += images.check_copies(colors)
    speed = measured.MachineSpeed() if store is None else measured.speed_of(Path(store))
    report.estimate = estimate.estimate(report.robots, speed.ratios) | {"measured_stages": speed.stages}
    report.findings += estimate.check_disk(path.parent, report.estimate["bytes"])
    report.findings = list(judged(report.findings, config.sure, config.likely))
    return report


def _remedy(log: Path | None) -> str:
    """What may help where a log cannot be read: of a sound one nothing is to be recovered."""
    if log is None or not log.is_file():
        return ""
    if log.suffix in (".bag", ".db3"):
        return "duagc convert ros makes a recording of it"
    try:
        verify(log)
    except DuagError:
        return "duagc recover may save it" if is_mcap(log) else ""
    return "duagc info says what is in it"


def check_registration(log: Path, config: ChecksConfig = _DEFAULT) -> list[Finding]:
    """Whether color and depth of a log are of one time and place; a second or two, before a run begins.

    Args:
        log: of a robot.
        config: from which value on something is reported.

    Raises:
        DuagError: the log is damaged.
    """
    with open_rgbd(log) as rgbd:
        found = list(geometry.check_edges(rgbd.robot, geometry.edges_of(rgbd, config.edges), config.edges))
    return list(judged(found, config.sure, config.likely))


def expected_size(log: Path, config: FrontendConfig, checks: ChecksConfig = _DEFAULT) -> dict[str, int]:
    """About how many keyframes a run will make, and whether depth is exact; two seconds, before it begins.

    Args:
        log: of a robot.
        config: of its front end.
        checks: how many places and pairs are looked at.

    Raises:
        DuagError: the log is damaged.
    """
    with open_rgbd(log) as rgbd:
        moved = moves.moves(rgbd, checks.motion)
        keyframes = count_keyframes(rgbd, checks.keyframes, config.keyframes)
    return {
        "keyframes": keyframes.expected,
        "exact": int(moves.has_exact_depth(moved, config.mapping)),
    }


def _unreadable(robot: str, error: DuagError, advice: str) -> Finding:
    found, _, expected = str(error).partition(", expected ")
    return Finding(Severity.ERROR, "log", robot, found, expected or "a sound log", advice)


def _check_robot(
    report: Report,
    recording: Recording | None,
    log: RgbdLog,
    sights: dict[str, images.Sight],
    *,
    colors: dict[str, images.Repeats],
    config: ChecksConfig,
) -> None:
    robot, add = log.robot, report.findings.extend
    with LogFile(log.path) as file:
        if recording is not None:
            add(_check_digest(recording, robot, file))
            add(_check_clock(recording, robot))
        topics = images.read_repeats(file, robot)
    colors[robot] = topics[COLOR.of(robot)]
    for topic, repeats in topics.items():
        add(stamps.check_stamps(robot, topic, repeats.stamps_ns, config.times))
        add(images.check_repeats(robot, topic, repeats, config.images))
    add(stamps.check_pairs(robot, log.pairing, config.times))
    add(geometry.check_camera(robot, log.camera, config.camera))
    shown = np.unique(np.linspace(0, len(log) - 1, config.images.frames).astype(int)).tolist()
    sight = sights[robot] = images.Sight.of((log.frame(i) for i in shown), log.depth_scale, len(log))
    add(images.check_light(robot, sight, FailureConfig().max_saturated))
    add(images.check_sight(robot, sight, config.images))
    moved: list[moves.Move] = []
    if sight.known:
        moved = moves.moves(log, config.motion, as_range=True)
        add(geometry.check_moves(robot, moved, config.motion))
        sensors = " ".join(f"{key} {value}" for key, value in log_metadata(log.path).items())
        add(geometry.check_range(robot, sight, moved, sensors, config=config.motion))
        prior = log.motion_prior()
        add(_check_scales(recording, log, moved, prior, config=config.motion))
        add(gyroscope.check_gyroscope(robot, moved, prior))
        add(geometry.check_edges(robot, geometry.edges_of(log, config.edges), config.edges))
    keyframes = count_keyframes(log, config.keyframes, KeyframeConfig())
    residuals = [move.residual for move in moved if np.isfinite(move.residual)]
    report.robots[robot] = {
        "frames": len(log),
        "pixels": log.camera.width * log.camera.height,
        "moved": int(log.needs_motion),
        "exact": int(moves.has_exact_depth(moved, MappingConfig())),
        "depth_m": [round(value, 4) for value in sight.depth_m] if sight.known else None,
        "with_depth": round(sight.known, 4),
        "registered_pairs": f"{sum(move.T_first_second is not None for move in moved)} of {len(moved)}",
        "reprojection": round(float(np.median(residuals)), 5) if residuals else None,
        "keyframes": keyframes.expected,
        "keyframes_from": keyframes.low,
        "keyframes_to": keyframes.high,
    }


def _check_digest(recording: Recording, robot: str, file: LogFile) -> Iterator[Finding]:
    expected, found = (
        recording.digest(file.path.name),
        dict(file.metadata()).get(DIGEST_RECORD, {}).get("sha256"),
    )
    if expected not in ("nothing", found):
        yield Finding(
            Severity.WARNING,
            "digest",
            robot,
            f"{file.path.name} has digest {str(found)[:12]}",
            f"{expected[:12]} as in recording.json",
            "the log is not the one that was converted",
        )


def _check_clock(recording: Recording, robot: str) -> Iterator[Finding]:
    """What the converter said about clocks that differ, and left as they were."""
    others = tuple(f"{other}: " for other in recording.robots if other != robot)
    for text in map(str, recording.description["warnings"]):
        if not text.startswith(others) and any(words in text for words in _CLOCK_WORDS):
            found, _, expected = text.removeprefix(f"{robot}: ").partition("; expected ")
            if expected:
                yield Finding(
                    Severity.WARNING, "clock", robot, found, expected, "convert it again with that option"
                )


def _check_scales(
    recording: Recording | None,
    log: RgbdLog,
    moved: list[moves.Move],
    prior: MotionPrior | None,
    *,
    config: MotionChecks,
) -> Iterator[Finding]:

    def by_odometry(start_ns: int, stop_ns: int) -> float | None:
        motion = prior.between(start_ns, stop_ns) if prior else None
        return (
            float(np.linalg.norm(motion.T_start_stop[:3, 3])) if motion and motion.knows_translation else None
        )

    yield from scale.check_scale(log.robot, moved, "its odometry", by_odometry, config=config)
    truth = groundtruth.trajectory(recording, log.robot) if recording else Absent("a log alone")
    if isinstance(truth, Absent):
        return
    poses = dict(zip(truth.stamps_ns.tolist(), truth.poses, strict=True))

    def by_truth(start_ns: int, stop_ns: int) -> float | None:
        if start_ns not in poses or stop_ns not in poses:
            return None
        return float(np.linalg.norm(poses[start_ns][:3, 3] - poses[stop_ns][:3, 3]))

    yield from scale.check_scale(log.robot, moved, "its true poses", by_truth, config=config)


def format_report(report: Report) -> str:
    """The report as text for people.

    Args:
        report: of `check`.
    """
    out = []
    for robot, row in report.robots.items():
        depth = row["depth_m"]
        reach = "no depth"
        if depth:
            share = f"{row['with_depth']:.0%}" if row["with_depth"] > 0.005 else "less than 1%"
            reach = (
                f"depth {depth[0]:.2f} {depth[1]:.2f} {depth[2]:.2f} m (1, 50, 99 %) in {share} of the pixels"
            )
        moved = "" if row["reprojection"] is None else f", reprojection {row['reprojection']:.2%}"
        keyframes = f"{row['keyframes_from']} to {row['keyframes_to']} keyframes"
        out.append(f"{robot}: {row['frames']} frames, {keyframes}, {reach}{moved}")
    e = report.estimate
    unit, name = (60, "minutes") if e["seconds_to"] > 120 else (1, "seconds")
    span = f"{e['seconds_from'] / unit:.0f} to {e['seconds_to'] / unit:.0f} {name}"
    here = f" (as {e['measured_stages']:.0f} stages took here)" if e["measured_stages"] else ""
    if report.robots:
        out.append(
            f"a run takes {span} on two idle processors{here}, "
            f"and about {e['bytes'] / 1e6:.0f} MB of disk with its store"
        )
    out += lines(report.findings)
    counts = [f"{len(found)} {s.value}{'s' * (len(found) != 1)}" for s in Severity if (found := report.of(s))]
    return "\n".join([*out, ", ".join(counts) or "nothing found"])
