"""What is in logs of other programs, what a conversion would choose, and a TOML file to start from."""

from __future__ import annotations

import json
from array import array
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from duagc.converters.logs.choice import IMAGE_TYPES, POINTS_TYPE, Chooser, repeats
from duagc.converters.logs.clocks import RobotClock, compare, overlap_warnings
from duagc.converters.logs.entries import Entry
from duagc.converters.logs.files import SUFFIXES, Log, is_own_log, open_log
from duagc.converters.logs.motion import IMU_TYPE, POSE_TYPES
from duagc.converters.logs.robot_log import RobotLog
from duagc.converters.logs.sources import (
    Source,
    is_log,
    overlap_words,
    pieces_words,
    robot_of,
    sources_of,
    unread,
)
from duagc.converters.logs.video import is_video
from duagc.pipeline.base.byte_counts import bytes_text
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import size_bytes
from duagc.pipeline.base.progress import track
from duagc.pipeline.messages.parts import NANOSECONDS
from duagc.pipeline.recording.names import MAGIC, RECORDING_FILE

HEADERS_FIRST, HEADERS_EACH = (
    100,
    20,
)  # of a topic's messages, all of the first and one of each later so many are asked


def is_foreign(path: Path) -> bool:
    """Whether a path is a log, or a folder of logs, that other programs wrote, or a TOML file about such.

    Args:
        path: a file or a folder; need not exist.
    """
    if path.suffix == ".toml":
        return path.is_file()
    if path.suffix == ".mcap" and path.is_file():
        with path.open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC and not is_own_log(path)
    if path.is_file():
        return path.suffix in SUFFIXES
    if not path.is_dir() or (path / RECORDING_FILE).is_file():
        return False
    if is_log(path):
        return True
    inner = [p for p in sorted(path.iterdir()) if not p.name.startswith(".")]
    inner += [p for folder in inner if folder.is_dir() for p in sorted(folder.iterdir())]
    return any(is_log(p) and (p.is_dir() or is_foreign(p)) for p in inner)


def describe(src: Path) -> dict[str, Any]:
    """Topics, rates and times of logs; per robot what would be chosen and why, or why not; how clocks differ.

    Args:
        src: a log, a folder of logs or a TOML file.

    Returns:
        Plain numbers and text, ready for JSON.
    """
    logs: dict[str, Any] = {}
    robots: dict[str, Any] = {}
    sources = list(_robots(src))
    clocks: list[RobotClock] = []
    pieces: list[str] = []
    with ExitStack() as opened:
        for source, spaces in sources:
            log = opened.enter_context(open_log(source.paths, source.name))
            if log.name not in logs:
                logs[log.name] = _log(log)
                if src.suffix != ".toml" and (words := overlap_words(source, log)):
                    pieces.append(words)
            robot_log, robots[source.robot] = _robot(log, source)
            if spaces:
                robots[source.robot]["by_namespace"] = spaces
            if robot_log:
                if robot_log.drift is not None:
                    robots[source.robot]["drift_ppm"] = 1e6 * robot_log.drift.rate
                robot_log.settle_drift()
                clocks.append(robot_log.clock(source.robot))
        spans = {c.robot: (c.start_ns, c.end_ns) for c in clocks}
        if src.suffix != ".toml" and (words := pieces_words([s for s, _ in sources], spans)):
            pieces.append(words)
        if len(clocks) > 1:
            for robot, offset in compare(clocks).items():
                robots[robot]["clock"] = offset.row()
    return {
        "kind": "foreign",
        "logs": logs,
        "robots": robots,
        "warnings": unread(src) + pieces + (overlap_warnings(clocks) if clocks else []),
    }


def _robots(src: Path) -> Iterator[tuple[Source, str]]:
    """The robots that a conversion would find, and those that namespaces would tell apart, with these namespaces."""
    for source in sources_of(src, {}):
        with open_log(source.paths, source.name) as log:
            spaces = [] if src.suffix == ".toml" else namespaces(log)
        for space in spaces:
            yield replace(source, robot=robot_of(space), namespace=space), ",".join(spaces)
        if not spaces:
            yield source, ""


def namespaces(log: Log) -> list[str]:
    """Namespaces of a log, if it has several that each have color and depth, as images or points; else none.

    They are where the names of its images part: /fleet/r1 and /fleet/r2, or /r1 and /r2.
    Where messages that hold both, or video, only repeat what another namespace has, theirs does not count.

    Args:
        log: whose topics are looked at.
    """
    images = [t.name for t in log.topics.values() if t.count and (t.type in IMAGE_TYPES or is_video(t.type))]
    folders = [name.strip("/").split("/")[:-1] for name in images]
    shared = sum(1 for _ in takewhile(lambda parts: len(set(parts)) == 1, zip(*folders, strict=False)))
    names = sorted({f"/{'/'.join(folder[: shared + 1])}" for folder in folders if len(folder) > shared})
    ranks = {}
    for name in names if len(names) > 1 else []:
        inner = Chooser(log, name)
        color, depth = inner.color().topic, inner.depth().topic
        if color and (depth or log.of_type(POINTS_TYPE, below=name)):
            ranks[name] = max(repeats(log, topic) for topic in (color, depth) if topic)
    spaces = [name for name, rank in ranks.items() if rank == min(ranks.values())]
    return spaces if len(spaces) > 1 else []


def _log(log: Log) -> dict[str, Any]:
    """Size, span and topics of a log."""
    times: dict[str, array[int]] = {name: array("q") for name in log.topics}
    delays: dict[str, list[int]] = {name: [] for name in log.topics if _has_header(log, name)}
    publish = False
    messages = sum(topic.count for topic in log.topics.values())
    entries = log.entries(*log.topics, heads=log.topics)
    for entry in track(entries, f"read {Path(log.name).name}", messages):
        seen = times[entry.topic]
        publish |= entry.publish_ns is not None
        if entry.topic in delays and (len(seen) < HEADERS_FIRST or len(seen) % HEADERS_EACH == 0):
            stamp = _header_ns(entry)
            if stamp:
                delays[entry.topic].append(entry.log_ns - stamp)
            elif not delays[entry.topic]:  # the first one says nothing
                del delays[entry.topic]
        seen.append(entry.log_ns)
    spans = [(t[0], t[-1]) for t in times.values() if t]
    return {
        "bytes": sum(size_bytes(part.path) for part in log.parts),
        "pieces": [part.path.name for part in log.parts],
        "start_ns": min((a for a, _ in spans), default=None),
        "end_ns": max((b for _, b in spans), default=None),
        "time_sources": ["header", "log", *(["publish"] if publish else [])],
        "topics": {
            name: {
                "type": topic.type,
                "schema": topic.schema,
                "encoding": topic.encoding,
                "messages": topic.count,
                "other_types": dict(topic.others),
                "rate_hz": _rate(times[name]),
                "recorded_after_header_s": _median_s(delays.get(name, [])),
            }
            for name, topic in sorted(log.topics.items())
        },
    }


def _has_header(log: Log, topic: str) -> bool:
    """Whether the messages of a topic have a header, by the first one; False where it cannot be read."""
    try:
        return log.topics[topic].count > 0 and hasattr(log.first(topic), "header")
    except DuagError:
        return False


def _header_ns(entry: Entry) -> int:
    """The time in a header, 0 where it says nothing."""
    try:
        return int(entry.header_ns())
    except DuagError:
        return 0


def _rate(times: array[int]) -> float | None:
    span_ns = times[-1] - times[0] if times else 0
    return (len(times) - 1) * NANOSECONDS / span_ns if span_ns > 0 else None


def _median_s(delays: list[int]) -> float | None:
    return float(np.median(delays)) / NANOSECONDS if delays else None


def _robot(log: Log, source: Source) -> tuple[RobotLog | None, dict[str, Any]]:
    """What would be chosen for a robot and why, what else there is, and what keeps from converting."""
    space, settings = source.namespace, source.settings
    out: dict[str, Any] = {
        "log": log.name,
        "logs": [str(p.resolve()) for p in source.paths],
        "namespace": space,
    }
    robot_log, problem = None, None
    try:
        chooser = Chooser(log, space, settings.model_dump())
        color, depth = chooser.color(), chooser.depth()
        choices = {"color": color, "depth": depth}
        for option, image in (("color_info", color), ("depth_info", depth)):
            if image.topic in chooser.images:
                choices[option] = chooser.info(option, image.topic)
        out["choices"] = {
            k: {"topic": c.topic, "why": c.why, "candidates": c.candidates} for k, c in choices.items()
        }
        robot_log = RobotLog(log, space, settings)
        out["frames"] = len(robot_log.pairs)
        moved = robot_log.T_color_depth is not None
        out["depth"] = "moved into the color camera" if moved else "registered to color already"
        if robot_log.derived:
            out["depth"] = robot_log.derived.words
        out["warnings"] = robot_log.warnings
    except DuagError as error:
        robot_log, problem = None, str(error)
    out["problem"] = problem
    kinds = {"imu": (IMU_TYPE,), "odometry": POSE_TYPES, "truth": POSE_TYPES, "points": (POINTS_TYPE,)}
    out["others"] = {kind: log.of_type(*types, below=space) for kind, types in kinds.items()}
    return robot_log, out


# --- for people


def format_description(content: Mapping[str, Any]) -> str:
    """The result of `describe` as text.

    Args:
        content: of `describe`.
    """
    lines = []
    for name, log in content["logs"].items():
        lines += _log_lines(name, log)
    for robot, row in content["robots"].items():
        lines += _robot_lines(robot, row)
    return "\n".join([*lines, *(f"warning: {text}" for text in content["warnings"])])


def _log_lines(name: str, log: Mapping[str, Any]) -> list[str]:
    span = "no messages"
    if log["start_ns"] is not None:
        seconds = (log["end_ns"] - log["start_ns"]) / NANOSECONDS
        span = f"{seconds:.2f} s from {log['start_ns'] / NANOSECONDS:.3f} s"
    pieces = f" in {len(log['pieces'])} pieces" if len(log["pieces"]) > 1 else ""
    lines = [
        f"log {name}{pieces}: {bytes_text(log['bytes'])}, {span}, times: {', '.join(log['time_sources'])}"
    ]
    width = max((len(topic) for topic in log["topics"]), default=0)
    for topic, t in log["topics"].items():
        rate = f"{t['rate_hz']:8.2f} Hz" if t["rate_hz"] else " " * 11
        delay = t["recorded_after_header_s"]
        text = "" if delay is None else f"  recorded {delay:.3f} s after its header"
        others = "".join(f", and {count} of {kind}" for kind, count in t["other_types"].items())
        lines.append(f"  {topic:<{width}}  {t['messages']:>7}  {rate}  {t['type']}{others}{text}")
    return lines


def _robot_lines(robot: str, row: Mapping[str, Any]) -> list[str]:
    space = f" below {row['namespace']}" if row["namespace"] else ""
    lines = [f"robot {robot}: {row['log']}{space}"]
    if row.get("by_namespace"):
        lines.append(f"  one of several in the log; convert by --set namespaces={row['by_namespace']}")
    for option, choice in row.get("choices", {}).items():
        lines.append(f"  {option:<10}  {choice['topic'] or 'not decided'}: {choice['why']}")
    if row["problem"]:
        lines.append(f"  cannot be converted yet: {row['problem']}")
    else:
        lines.append(f"  {row['frames']} frames, depth is {row['depth']}")
        lines += [f"  warning: {text}" for text in row["warnings"]]
    for kind, found in row["others"].items():
        if found:
            lines.append(f"  {kind + '?':<10}  {', '.join(found)}")
    clock = row.get("clock")
    if clock and clock["how"] != "the reference":
        text = "not known" if clock["offset_s"] is None else f"add {clock['offset_s']:.6f} s"
        lines.append(f"  clock       {text} ({clock['how']})")
    return lines


def toml_text(content: Mapping[str, Any]) -> str:
    """A TOML file for `duagc convert ros FILE`: what a conversion would choose; what is open is a comment.

    Args:
        content: of `describe`.
    """
    sources = sorted({s for log in content["logs"].values() for s in log["time_sources"]})
    lines = [
        "# duagc convert ros THIS_FILE --out RECORDING",
        "# `duagc convert --list` has all options; above [robots] they hold for all. Paths: full, or from this file's.",
        f'time_source = "header"  # {", ".join(sources)}',
    ]
    for robot, row in content["robots"].items():
        lines += ["", f"[robots.{robot}]", f"logs = {json.dumps(row['logs'])}"]
        if row["namespace"]:
            lines.append(f"namespace = {json.dumps(row['namespace'])}")
        if row["problem"]:
            lines.append(f"# {' '.join(row['problem'].split())}")
        for option, choice in row.get("choices", {}).items():
            if choice["topic"]:
                lines.append(f"{option} = {json.dumps(choice['topic'])}  # {choice['why']}")
            else:
                lines += [f"# {option} = {json.dumps(topic)}" for topic in choice["candidates"] or [""]]
        for kind in ("imu", "odometry", "truth"):
            lines += [f"# {kind} = {json.dumps(topic)}" for topic in row["others"][kind]]
    return "\n".join(lines)
