"""What is in a log, a recording or a run, as numbers and as text."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import DuagError
from pipeline.recording.folder import Recording
from pipeline.recording.names import DIGEST_RECORD, LOG_RECORD, RECORDING_FILE, ROBOT_KEY
from pipeline.recording.pairing import TOLERANCE_NS, pair
from pipeline.recording.read import LogFile, parsing
from schemas import topics as topic_table

GAP_RATIO = 1.5  # an interval this much longer than the median one is a gap


def info(path: Path) -> dict[str, Any]:
    """What is in a log, a recording or a run: topics, counts, rates, times, extents, gaps, digests, warnings.

    Returns:
        Plain numbers and text, ready for JSON; "kind" is "log", "recording" or "run". What is not known is None.
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
    """Images of a camera without a partner: they are no frames."""
    out = []
    for topic in sorted(log.channels):
        row = topic_table.find(topic)
        if row is None or row[0] is not topic_table.COLOR:
            continue
        sources = (topic_table.DEPTH, topic_table.RAW_DEPTH, topic_table.LIDAR)
        depth = next((name for s in sources if log.entries(name := s.of(row[1]))), None)
        if depth is None:
            continue
        found = pair(log.entries_by_time(topic), log.entries_by_time(depth))
        for name, other, alone in ((topic, depth, found.color_alone), (depth, topic, found.depth_alone)):
            if alone:
                near = f"within {TOLERANCE_NS / 1e6:g} ms"
                out.append(f"{name}: {len(alone)} images have none of {other} {near} and are no frames")
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
        "metadata": channel.metadata,
        "warnings": warnings,
    }
    intervals = np.diff(times)
    if len(intervals) and times[-1] > times[0]:
        out["rate_hz"] = len(intervals) / (int(times[-1] - times[0]) * 1e-9)
        row = topic_table.find(topic)
        gaps = intervals[intervals > GAP_RATIO * np.median(intervals)]
        if len(gaps) and row is not None and row[0].scope is topic_table.Scope.SENSOR:
            warnings.append(f"{len(gaps)} gaps, the longest {gaps.max() * 1e-9:.3f} s")
    return out


def _recording_info(path: Path) -> dict[str, Any]:
    recording = Recording(path)
    out: dict[str, Any] = {"kind": "recording", **recording.description, "robots": {}}
    out["warnings"] = warnings = list(recording.description.get("warnings", []))
    for robot in recording.robots:
        row = dict(recording.description["robots"][robot])
        log = _log_info(recording.log(robot))
        recorded = row.get("digests", {}).get(row["log"])
        if recorded and log["digest"] != recorded:
            warnings.append(f"{robot}: {row['log']} has digest {log['digest']}, expected {recorded}")
        if recording.groundtruth(robot) is None:
            row["groundtruth"] = None
        warnings += [f"{robot}: {w}" for w in log["warnings"]]
        out["robots"][robot] = {
            **row,
            "bytes": log["bytes"],
            "messages": log["messages"],
            "topics": log["topics"],
        }
    return out


def format_info(content: Mapping[str, Any]) -> str:
    """The result of `info` as text for people."""
    if content["kind"] == "log":
        lines = _log_lines(content)
    elif content["kind"] == "run":
        lines = [
            line for name, log in content["logs"].items() for line in (f"{name}", *_log_lines(log, "  "))
        ]
    else:
        source = " ".join(str(v) for v in content["source"].values() if isinstance(v, str) and v)
        lines = [f"recording {content['name']}: {source}, {len(content['robots'])} robots"]
        for robot, row in content["robots"].items():
            lines += _robot_lines(robot, row)
            lines += _clock_lines(content.get("clocks", {}).get(robot))
    return "\n".join([*lines, *(f"warning: {w}" for w in content.get("warnings", []))])


def _robot_lines(robot: str, row: Mapping[str, Any]) -> list[str]:
    c = row["camera"]
    seconds = (row["end_ns"] - row["start_ns"]) * 1e-9
    lines = [
        f"  {robot}: {row['frames']} frames in {seconds:.2f} s, {row['bytes'] / 1e6:.1f} MB",
        f"    camera {c['width']}x{c['height']}, focal length {c['fx']:g} {c['fy']:g} px, "
        f"centre {c['cx']:g} {c['cy']:g} px, depth in {row['depth_scale_m']:g} m",
        f"    ground truth: {row['groundtruth'] or 'none'}",
    ]
    if row.get("path"):
        span = ", ".join(
            f"{low:.2f}..{high:.2f}"
            for low, high in zip(row["path"]["low_m"], row["path"]["high_m"], strict=True)
        )
        lines.append(f"    path {row['path']['length_m']:.2f} m within {span} m")
    return lines + _topic_lines(row["topics"], "    ")


def _clock_lines(clock: Mapping[str, Any] | None) -> list[str]:
    """How a robot's clock differs from the first one's, where the converter could tell."""
    if not clock or clock["how"] == "the reference":
        return []
    seconds, added = clock["offset_s"], f", {clock['added_s']:.6f} s were added" if clock["added_s"] else ""
    told = "not known" if seconds is None else f"{seconds:.6f} s behind the first robot's"
    return [f"    clock {told} ({clock['how']}){added}"]


def _log_lines(log: Mapping[str, Any], indent: str = "") -> list[str]:
    span = "no messages"
    if log["start_ns"] is not None:
        span = f"{log['messages']} messages, {log['start_ns'] * 1e-9:.3f} to {log['end_ns'] * 1e-9:.3f} s"
    size, digest = f"{log['bytes'] / 1e6:.1f} MB", log["digest"] or "not recorded"
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
