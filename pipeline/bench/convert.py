"""What a conversion costs compared with reading and writing alone.

Reading and writing alone: the log's own library (rosbags, mcap) reads every message of the topics that the conversion
takes, and the MCAP library writes their bytes as they are, with the settings of our logs. Each of the two runs in a
process of its own, start included, one after the other.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from duagc.converters import registry
from duagc.converters.logs.files import open_log
from duagc.converters.logs.robot_log import RobotLog
from duagc.converters.logs.sources import sources_of
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import size_bytes
from duagc.pipeline.base.workers import peak_memory_bytes
from duagc.pipeline.recording.write import mcap_writer

TASKS = ("copy", "convert")


def run(src: Path, options: Sequence[str], folder: Path) -> dict[str, Any]:
    """Copy a log and convert it.

    Args:
        src: a log of one robot.
        options: `name=value` of the conversion.
        folder: must not exist; results are written there and removed.

    Returns:
        The size of the log in bytes; for "copy" and "convert" the processor time and the wall time in seconds, the
        largest memory and what was written in bytes.
    Raises:
        DuagError: the log cannot be converted, or is not that of one robot.
    """
    topics = _topics(src, options)
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise DuagError(f"{folder}: {error.strerror or error}, expected to write there") from error
    out: dict[str, Any] = {"log": src.name, "bytes": size_bytes(src), "topics": topics}
    try:
        for task in TASKS:
            target = folder / task
            out[task] = {**_measured(task, src, target, topics, options=options), "bytes": size_bytes(target)}
            _remove(target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return out


def _topics(src: Path, options: Sequence[str]) -> list[str]:
    """The topics that a conversion takes, without those that have a few messages only."""
    sources = sources_of(src, registry.parse_options(options))
    if len(sources) != 1 or len(sources[0].paths) != 1:
        raise DuagError(f"{src}: found {len(sources)} robots, expected one log of one robot")
    with open_log(sources[0].paths) as log:
        robot = RobotLog(log, sources[0].namespace, sources[0].settings)
        s = robot.settings
        moving = {s.imu, s.odometry, *s.truth.split()[:1]} & set(log.topics)
        return sorted({robot.color, robot.depth, *moving})


def _measured(
    task: str, src: Path, target: Path, topics: Sequence[str], *, options: Sequence[str]
) -> dict[str, Any]:
    said = json.dumps([task, str(src.resolve()), str(target.resolve()), list(topics), list(options)])
    start = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", __name__, said], stdout=subprocess.PIPE, text=True, check=False
    )
    if done.returncode:
        why = done.stdout.strip().rpartition("\n")[2] or f"ended with {done.returncode}"
        raise DuagError(f"{src}: the process that was to {task} it: {why}")
    return {**json.loads(done.stdout.splitlines()[-1]), "wall_s": time.monotonic() - start}


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def format_table(found: dict[str, Any]) -> str:
    """The result of `run` as text.

    Args:
        found: what `run` returned.
    """
    rows = [
        ("processor time", "cpu_s", 1.0, "s"),
        ("wall time", "wall_s", 1.0, "s"),
        ("largest memory", "peak_bytes", 1e6, "MB"),
        ("written", "bytes", 1e6, "MB"),
    ]
    lines = [
        f"{found['log']}: {found['bytes'] / 1e6:.0f} MB; read and write alone: {', '.join(found['topics'])}"
    ]
    lines.append(f"{'':16}{'alone':>10}{'converted':>12}{'ratio':>8}")
    for name, key, unit, symbol in rows:
        alone, converted = (found[task][key] / unit for task in TASKS)
        lines.append(f"{name:16}{alone:10.1f}{converted:12.1f}{converted / alone:8.2f}  {symbol}")
    return "\n".join(lines)


# --- in the processes that are measured


def _copy(src: Path, out: Path, topics: Sequence[str]) -> None:
    with out.open("wb") as stream:
        writer = mcap_writer(stream)
        writer.start()
        channels = {topic: writer.register_channel(topic, "", 0) for topic in topics}
        for topic, time_ns, data in _messages(src, topics):
            writer.add_message(channels[topic], time_ns, data, time_ns)
        writer.finish()


def _messages(src: Path, topics: Sequence[str]) -> Iterator[tuple[str, int, bytes]]:
    if src.suffix == ".mcap":
        from mcap.reader import make_reader

        with src.open("rb") as stream:
            for _, channel, message in make_reader(stream).iter_messages(topics):
                yield channel.topic, message.log_time, message.data
        return
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([src], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        connections = [c for c in reader.connections if c.topic in topics]
        for connection, time_ns, data in reader.messages(connections=connections):
            yield connection.topic, time_ns, data


def _main(said: str) -> None:
    task, src, target, topics, options = json.loads(said)
    if task == "copy":
        _copy(Path(src), Path(target), topics)
    else:
        registry.convert("ros", Path(src), Path(target), options=options)
    spent = os.times()
    print(json.dumps({"cpu_s": spent.user + spent.system, "peak_bytes": peak_memory_bytes()}))


if __name__ == "__main__":
    from duagc.pipeline.base import determinism

    determinism.configure_determinism()
    try:
        _main(sys.argv[1])
    except (DuagError, OSError) as failed:
        print(failed)
        sys.exit(1)
