"""What is in a log, a recording or a run, as numbers and as text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from duagc.pipeline.base.byte_counts import bytes_text
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry.lens import Lens
from duagc.pipeline.recording.folder import Recording
from duagc.pipeline.recording.log_checksums import parsing
from duagc.pipeline.recording.names import DIGEST_RECORD, LOG_RECORD, RECORDING_FILE, ROBOT_KEY
from duagc.pipeline.recording.pairing import pair_topics
from duagc.pipeline.recording.preview import reach, some_frames, write_preview
from duagc.pipeline.recording.read import LogFile
from duagc.pipeline.recording.rgbd import open_rgbd
from duagc.schemas import topics as topic_table

GAP_RATIO = 1.5  # an interval this much longer than the median one is a gap


def info(path: Path) -> dict[str, Any]:
    """What is in a log, a recording or a run: topics, counts, rates, times, extents, gaps, digests, warnings.

    Args:
        path: of a log, a recording or a run.

    Returns:
        Plain numbers and text, ready for JSON; "kind" is "log", "recording" or "run". What is not known is None.

    Raises:
        DuagError: it is none of these, or a log is damaged.
    """
    path = Path(path)
    if path.is_file():
        return {"kind": "log", **_log_info(path)}
    if (path / RECORDING_FILE).is_file():
        return _recording_info(path)
    logs = sorted(p for p in path.rglob("*.mcap")) if path.is_dir() else []
    if not logs:
        found = "a folder without logs" if path.is_dir() else "no such file or folder"
        raise DuagError(f"{path}: {found}, expected a log, a recording or a run")
    return {"kind": "run", "logs": {p.relative_to(path).as_posix(): _log_info(p) for p in logs}}


def _log_info(path: Path) -> dict[str, Any]:
    with LogFile(path) as log, parsing(path):
        metadata = dict(log.metadata())
        topics = {topic: _topic_info(log, topic) for topic in sorted(log.channels)}
        times = [t[key] for t in topics.values() for key in ("start_ns", "end_ns") if t[key] is not None]
        warnings = [f"{topic}: {w}" for topic, t in topics.items() for w in t.pop("warnings")]
        warnings += _pairing_warnings(log)
        return {
            "robot": metadata.get(LOG_RECORD, {}).get(ROBOT_KEY) or None,
            "bytes": path.stat().st_size,
            "messages": sum(t["messages"] for t in topics.values()),
            "start_ns": min(times, default=None),
            "end_ns": max(times, default=None),
            "digest": metadata.get(DIGEST_RECORD, {}).get("sha256"),
            "topics": topics,
            "warnings": warnings,
        }


def _pairing_warnings(log: LogFile) -> list[str]:
    """Images of a camera without a partner, and depth of another time."""
    out = []
    for topic in sorted(log.channels):
        row = topic_table.find(topic)
        if row is None or row[0] is not topic_table.COLOR:
            continue
        sources = (topic_table.DEPTH, topic_table.RAW_DEPTH, topic_table.LIDAR)
        depth = next((name for s in sources if log.entries(name := s.of(row[1]))), None)
        if depth is None:
            continue
        found = pair_topics(log, topic, depth)
        if found.color_alone:
            near = f"within {found.tolerance_ns / 1e6:g} ms"
            out.append(f"{topic}: {len(found.color_alone)} images have none of {depth} {near}: no depth")
        if found.depth_alone:
            out.append(f"{depth}: {len(found.depth_alone)} images are nearest to none of {topic}: not used")
        if found.largest_offset_ns:
            out.append(f"{depth}: up to {found.largest_offset_ns / 1e6:.1f} ms from {topic}")
    return out


def _topic_info(log: LogFile, topic: str) -> dict[str, Any]:
    channel = log.channels[topic]
    times = np.array([time for time, _, _ in log.entries(topic)], dtype=np.int64)
    statistics = log.summary.statistics
    count = statistics.channel_message_counts.get(channel.id, 0) if statistics else len(times)
    warnings = []
    if count != len(times):
        warnings.append(f"{count} messages, of which the index knows {len(times)}")
    out: dict[str, Any] = {
        "schema": log.schema_of(channel)[0] or None,
        "messages": count,
        "start_ns": int(times[0]) if len(times) else None,
        "end_ns": int(times[-1]) if len(times) else None,
        "rate_hz": None,
        "gaps": 0,
        "longest_gap_s": None,
        "metadata": channel.metadata,
        "warnings": warnings,
    }
    intervals = np.diff(times)
    if len(intervals) and times[-1] > times[0]:
        out["rate_hz"] = len(intervals) / (int(times[-1] - times[0]) * 1e-9)
        row = topic_table.find(topic)
        gaps = intervals[intervals > GAP_RATIO * np.median(intervals)]
        if len(gaps) and row is not None and row[0].scope is topic_table.Scope.SENSOR:
            out["gaps"], out["longest_gap_s"] = len(gaps), int(gaps.max()) * 1e-9
            warnings.append(f"{len(gaps)} gaps, the longest {gaps.max() * 1e-9:.3f} s")
    return out


def _recording_info(path: Path) -> dict[str, Any]:
    recording = Recording(path)
    recording.check_names()
    out: dict[str, Any] = {"kind": "recording", **recording.description, "robots": {}}
    out["calibrated"] = recording.calibration
    out["warnings"] = warnings = list(recording.description.get("warnings", []))
    for robot in recording.robots:
        row = dict(recording.description["robots"][robot])
        log = _log_info(recording.log(robot))
        recorded = recording.digest(row["log"])
        if log["digest"] != recorded != "nothing":
            warnings.append(f"{robot}: {row['log']} has digest {log['digest']}, expected {recorded}")
        if recording.groundtruth(robot) is None:
            row["groundtruth"] = None
        warnings += [f"{robot}: {w}" for w in log["warnings"]]
        out["robots"][robot] = {
            **row,
            "bytes": log["bytes"],
            "messages": log["messages"],
            "topics": log["topics"],
            **_frames_info(recording.log(robot)),
        }
    return out


def _frames_info(path: Path) -> dict[str, Any]:
    """What the frames of a robot's log are; recording.json is not trusted."""
    with open_rgbd(path) as log:
        stamps = [color for color, _ in log.pairing.pairs]
        return {
            "frames": len(log),
            "start_ns": stamps[0],
            "end_ns": stamps[-1],
            "camera": asdict(log.camera),
            "lens": _lens_info(log.lens),
            "depth_scale_m": log.depth_scale,
            "masked_share": 0.0 if log.valid is None else float(np.mean(~log.valid)),
            **reach(some_frames(log)),
        }


def _lens_info(lens: Lens | None) -> dict[str, Any] | None:
    if lens is None:
        return None
    return {
        "source": asdict(lens.source),
        "distortion": list(lens.distortion),
        "fisheye": lens.fisheye,
        "rotation_rad": list(lens.rotation_rad),
    }


def write_preview_of(path: Path, out: Path) -> None:
    """Write a picture of a recording, or of the log of one robot; see `preview.write_preview`.

    Args:
        path: of a recording or a log.
        out: of the PNG; must not exist.

    Raises:
        DuagError: `out` exists, or what is shown cannot be read.
    """
    path = Path(path)
    if path.is_file():
        logs = [path]
    else:
        recording = Recording(path)
        logs = [recording.log(robot) for robot in recording.robots]
    write_preview(logs, out)


def format_info(content: Mapping[str, Any]) -> str:
    """The result of `info` as text for people.

    Args:
        content: as `info` returns it.
    """
    if content["kind"] == "log":
        lines = _log_lines(content)
    elif content["kind"] == "run":
        lines = [
            line for name, log in content["logs"].items() for line in (f"{name}", *_log_lines(log, "  "))
        ]
    else:
        source = " ".join(str(v) for v in content["source"].values() if isinstance(v, str) and v)
        lines = [f"recording {content['name']}: {source}, {len(content['robots'])} robots"]
        lines += _robot_table(content["robots"])
        lines += [f"  calibration: {line}" for line in content["calibrated"]]
        for robot, row in content["robots"].items():
            lines += _robot_lines(robot, row)
            lines += _clock_lines(content.get("clocks", {}).get(robot))
    return "\n".join([*lines, *(f"warning: {w}" for w in content.get("warnings", []))])


def _robot_table(robots: Mapping[str, Any]) -> list[str]:
    """One line per robot under a line of names."""
    names = ("robot", "frames", "seconds", "rate Hz", "gaps", "size", "with depth", "depth m (1, 50, 99 %)")
    rows = [names]
    for robot, row in robots.items():
        color = row["topics"][topic_table.COLOR.of(robot)]
        depth = " ".join(f"{meters:.2f}" for meters in row["depth_m"] or ())
        rate = f"{color['rate_hz']:.2f}" if color["rate_hz"] else "-"
        seconds = f"{(row['end_ns'] - row['start_ns']) * 1e-9:.2f}"
        size, share = bytes_text(row["bytes"]), f"{row['with_depth']:.0%}"
        rows.append(
            (robot, str(row["frames"]), seconds, rate, str(color["gaps"]), size, share, depth or "none")
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(f"{text:<{w}}" for text, w in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def _robot_lines(robot: str, row: Mapping[str, Any]) -> list[str]:
    c = row["camera"]
    lines = [
        f"  {robot}: camera {c['width']}x{c['height']}, focal length {c['fx']:g} {c['fy']:g} px, "
        f"center {c['cx']:g} {c['cy']:g} px, depth in {row['depth_scale_m']:g} m",
        f"    ground truth: {row['groundtruth'] or 'none'}",
    ]
    if row["lens"]:
        model = "fisheye distortion" if row["lens"]["fisheye"] else "distortion"
        numbers = " ".join(f"{number:g}" for number in row["lens"]["distortion"]) or "none"
        lines.append(f"    color images as the lens took them, {model} {numbers}: reading rectifies them")
    if row["masked_share"]:
        lines.append(f"    {row['masked_share']:.1%} of the pixels never show the scene and are masked")
    try:
        path = row["path"]
        spans = zip(path["low_m"], path["high_m"], strict=True)
        span = ", ".join(f"{low:.2f}..{high:.2f}" for low, high in spans)
        lines.append(f"    path {path['length_m']:.2f} m within {span} m")
    except (KeyError, TypeError, ValueError):  # there is none, or recording.json says nonsense
        pass
    return lines + _topic_lines(row["topics"], "    ")


def _clock_lines(clock: Mapping[str, Any] | None) -> list[str]:
    """How a robot's clock differs from the first one's, where the converter knows."""
    if not clock or clock["how"] == "the reference":
        return []
    seconds, added = clock["offset_s"], f", {clock['added_s']:.6f} s were added" if clock["added_s"] else ""
    offset = "not known" if seconds is None else f"{seconds:.6f} s behind the first robot's"
    return [f"    clock {offset} ({clock['how']}){added}"]


def _log_lines(log: Mapping[str, Any], indent: str = "") -> list[str]:
    span = "no messages"
    if log["start_ns"] is not None:
        span = f"{log['messages']} messages, {log['start_ns'] * 1e-9:.3f} to {log['end_ns'] * 1e-9:.3f} s"
    size, digest = bytes_text(log["bytes"]), log["digest"] or "not recorded"
    first = f"{indent}{log['robot'] or 'team'}: {span}, {size}, digest {digest}"
    return [first, *_topic_lines(log["topics"], indent + "  ")]


def _topic_lines(topics: Mapping[str, Any], indent: str) -> list[str]:
    width = max((len(t) for t in topics), default=0)
    return [
        f"{indent}{topic:<{width}}  {t['messages']:>7}  "
        + (f"{t['rate_hz']:8.2f} Hz" if t["rate_hz"] else " " * 11)
        + f"  {t['schema'] or 'no schema'}"
        for topic, t in topics.items()
    ]
