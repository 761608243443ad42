"""Which logs belong to which robot: by files and folders, by namespaces, or by a TOML file.

time_source = "header"            # options for all robots

[robots.jackal]
logs = ["jackal_0.bag", "jackal_1.bag"]      # next to this file; one log in several pieces
namespace = "/jackal"                        # only topics below it
color = "/jackal/camera/color/image_raw"     # options for this robot
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any

from duagc.converters.layouts.image_files import options_of
from duagc.converters.logs.choice import IMAGE_TYPES
from duagc.converters.logs.files import SUFFIXES, Log, is_own_log, open_log
from duagc.converters.logs.options import LogOptions
from duagc.converters.logs.video import is_video
from duagc.converters.writer import robot_names
from duagc.pipeline.base.atomic_folder import RECORDING, RUN
from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.base.files import check_file, read_toml
from duagc.pipeline.messages.parts import NANOSECONDS
from duagc.schemas import topics

NAMESPACE = "{namespace}"  # stands for that of each robot in the names of topics
TOPICS = ("color", "depth", "color_info", "depth_info", "imu", "odometry", "truth", "truth_file")
PIECES_NS = 5 * NANOSECONDS  # between the pieces of one log
DATE = re.compile(r"\d{4}(-\d\d){5}")
REMEDIES = {  # by how names of files end that hold a log: why it is not read
    ".bag.active": "was not closed (`rosbag reindex` mends it, then name it .bag)",
    ".db3.zstd": "is compressed (`zstd -d` unpacks it)",
    ".mcap.zstd": "is compressed (`zstd -d` unpacks it)",
    ".bag.part": "was not downloaded to its end",
    ".db3.part": "was not downloaded to its end",
    ".mcap.part": "was not downloaded to its end",
}
GROUPING = ("namespaces", "pieces")  # options that say which logs are whose, which a TOML file does itself


@dataclass(frozen=True)
class Source:
    """The logs of one robot, one log in pieces; what the user said about them.

    Attributes:
        label: how the recording calls them.
    """

    robot: str
    paths: tuple[Path, ...]
    namespace: str
    label: str
    settings: LogOptions

    @property
    def name(self) -> str:
        """How messages call it: the log, or the folder of several."""
        return str(self.paths[0] if len(self.paths) == 1 else self.paths[0].parent)

    @property
    def part(self) -> str:
        """What the robot's log says of where it is from: its namespace. Names of files are no content: logs that were
        renamed are the same logs, and what is made of them has the same digest."""
        return self.namespace if self.namespace == self.label else ""


def sources_of(src: Path, options: Mapping[str, Any]) -> list[Source]:
    """Logs, namespace and settings of every robot, in order of its name.

    Args:
        src: a log, a folder or a TOML file.
        options: what was said on the command line; it has the last word.
    Raises:
        DuagError: there is no log, or something is said that is not known.
    """
    if src.suffix == ".toml":
        return _from_file(src, options)
    settings = options_of(LogOptions, options, "ros")
    spaces = [f"/{text.strip().lstrip('/')}" for text in settings.namespaces.split(",") if text.strip()]
    if spaces or settings.pieces:
        paths = tuple(logs_in(src))
        parts = [(paths, space, space) for space in spaces or [""]]
        if not settings.pieces:
            _check_one_log(src, paths, spaces)
    else:
        groups = _groups(src)
        parts = [(paths, "", label if len(groups) > 1 else "") for label, paths in groups.items()]
    names = [robot_of(space) for space in spaces] or robot_names(len(parts))
    if len(parts) > 1:
        _check_shared(settings, spaces)
    if len(set(names)) < len(names):
        raise DuagError(
            f"{src}: namespaces {', '.join(spaces)} name a robot twice, expected different robots, or a TOML file "
            "with [robots.NAME] and its namespace for each"
        )
    return [
        Source(name, paths, space, label, _filled(settings, space))
        for name, (paths, space, label) in zip(names, parts, strict=True)
    ]


def _check_shared(settings: LogOptions, spaces: Sequence[str]) -> None:
    """Refuse a topic that would be every robot's: in one log it is of one of them; in logs of their own it may be."""
    for option in TOPICS if spaces else ("truth_file",):
        said = getattr(settings, option)
        if said and NAMESPACE not in said:
            hint = f"{option}={NAMESPACE}/... or " if spaces else ""
            raise DuagError(
                f"ros: {option}={said} for several robots, expected {hint}a TOML file that says whose it is"
            )


def _check_one_log(src: Path, paths: Sequence[Path], spaces: Sequence[str]) -> None:
    """Refuse logs that have the same images: they may be pieces of one, or logs of robots that are called alike."""
    holding: dict[str, Path] = {}
    for path in paths if len(paths) > 1 else ():
        with open_log((path,), str(path)) as log:
            for topic in (name for space in spaces for name in log.of_type(*IMAGE_TYPES, below=space)):
                if (other := holding.setdefault(topic, path)) is not path:
                    raise DuagError(
                        f"{src}: {topic} is in {other.name} and in {path.name}, expected pieces=true if one goes on "
                        "with the other, or a TOML file that lists the logs of each robot"
                    )


def _filled(settings: LogOptions, space: str) -> LogOptions:
    """The settings with the namespace of a robot in the names of its topics."""
    said = {option: getattr(settings, option) for option in TOPICS}
    return settings.model_copy(
        update={k: v.replace(NAMESPACE, space) for k, v in said.items() if NAMESPACE in v}
    )


def robot_of(namespace: str) -> str:
    """The name of a robot by its namespace: "/Husky-1" is husky_1.

    Args:
        namespace: with or without a slash before it.
    """
    name = re.sub(r"[^a-z0-9_]", "_", namespace.lower().strip("/"))
    return name if name[:1].isalpha() else f"robot_{name}"


def _from_file(path: Path, options: Mapping[str, Any]) -> list[Source]:
    """The robots that a TOML file lists."""
    content = read_toml(path, "a TOML file that lists robots")
    robots = content.pop("robots", None)
    if not isinstance(robots, dict) or not robots:
        raise DuagError(f"{path}: found no [robots.NAME], expected one for each robot")
    for option in GROUPING:
        if option in content or option in options:
            raise DuagError(
                f"{path}: {option} is said, expected `logs` and `namespace` of each robot instead"
            )
    _check_names(content, f"{path}")
    if len(robots) > 1 and (content.get("truth_file") or options.get("truth_file")):
        raise DuagError(
            f"{path}: truth_file is said for several robots, expected it in [robots.NAME] of each"
        )
    if isinstance(content.get("truth_file"), str):
        content["truth_file"] = str(path.parent / content["truth_file"])
    sources = []
    for name in sorted(robots):
        where = f"{path}: [robots.{name}]"
        row = robots[name]
        if not isinstance(row, dict) or not re.fullmatch(topics.ROBOT_NAME, name):
            raise DuagError(
                f"{where} expected a table, named with lower-case letters, digits and underscores"
            )
        row = dict(row)
        logs, namespace = row.pop("logs", None), row.pop("namespace", "")
        if not isinstance(logs, list) or not logs or not all(isinstance(log, str) for log in logs):
            raise DuagError(f"{where} logs = {logs!r}, expected a list of files or folders")
        if not isinstance(namespace, str) or (namespace and not namespace.startswith("/")):
            raise DuagError(f"{where} namespace = {namespace!r}, expected text that begins with a slash")
        _check_names(row, where, "logs", "namespace")
        if isinstance(row.get("truth_file"), str):
            row["truth_file"] = str(path.parent / row["truth_file"])
        settings = options_of(LogOptions, {**content, **row, **options}, where)
        paths = tuple(inner for log in logs for inner in logs_in(path.parent / log))
        label = " ".join(Path(log).name for log in logs) if len(robots) > 1 else ""
        sources.append(Source(name, paths, namespace, label, settings))
    return sources


def _check_names(table: Mapping[str, Any], where: str, *more: str) -> None:
    """Refuse a key that is no option."""
    known = [*more, *(name for name in LogOptions.model_fields if name not in GROUPING)]
    for key in table:
        if key not in known:
            raise DuagError(f"{where} {key} is no option; {closest(key, known, 'options')}")


def logs_in(src: Path) -> list[Path]:
    """All logs of a folder, or the log itself, in the order of the numbers in their names.

    Args:
        src: a folder, or one log.
    """
    return [path for group in _groups(src).values() for path in group]


def _groups(src: Path) -> dict[str, tuple[Path, ...]]:
    """The logs of every robot, by the name of its log or folder."""
    if not src.exists():
        raise DuagError(f"{src}: no such file or folder, expected a log")
    if src.is_file() and src.suffix not in SUFFIXES:
        why = _remedy(src) or "is no log"
        raise DuagError(f"{src}: {why}, expected one of {', '.join(SUFFIXES)}")
    if not src.is_dir():
        check_file(src, "a log")
    if is_log(src):
        return {src.name: (src,)}
    groups = {}
    for path in sorted(src.iterdir(), key=_natural):
        inner = (path,) if is_log(path) and not is_own_log(path) else _inside(path)
        if inner:
            groups[path.name] = inner
    if not groups:
        more = "".join(f"; {text}" for text in unread(src))
        own = next(
            (f" but DUAG-C's own {path.name}" for path in sorted(src.iterdir()) if is_own_log(path)), ""
        )
        raise DuagError(f"{src}: found no log{own}, expected one for each robot{more}")
    return groups


def _inside(folder: Path) -> tuple[Path, ...]:
    """The logs of a folder; none of a recording or a run of ours."""
    if not folder.is_dir() or folder.name.startswith(".") or _is_own_folder(folder):
        return ()
    paths = sorted(folder.iterdir(), key=_natural)
    return tuple(path for path in paths if is_log(path) and not is_own_log(path))


def _is_own_folder(folder: Path) -> bool:
    return any((folder / name).is_file() for name in (*RECORDING.marks, *RUN.marks))


def unread(src: Path) -> list[str]:
    """What to say of files of a folder that hold a log, but not in a form that is read.

    Args:
        src: a folder of logs, or anything else.
    """
    if not src.is_dir() or is_log(src):
        return []
    paths = [p for p in sorted(src.iterdir()) if not p.name.startswith(".")]
    folders = [p for p in paths if p.is_dir() and not is_log(p) and not _is_own_folder(p)]
    paths += [p for folder in folders for p in sorted(folder.iterdir())]
    return [f"{path.name} {words}; left out" for path in paths if path.is_file() and (words := _remedy(path))]


def _remedy(path: Path) -> str:
    """Why a file that holds a log is not read as it is; empty: it holds none, or is read."""
    return next((words for end, words in REMEDIES.items() if path.name.endswith(end)), "")


def pieces_words(sources: Sequence[Source], spans_ns: Mapping[str, tuple[int, int]]) -> str:
    """What to say of logs that are pieces of one, by their names and times; empty: they are not.

    Args:
        sources: of all robots.
        spans_ns: first and last time of the images, by robot, of those that are known.
    """
    for after in sources:
        before = piece_before(after, sources)
        if before is None or not {before.robot, after.robot} <= spans_ns.keys():
            continue
        between_ns = spans_ns[after.robot][0] - spans_ns[before.robot][1]
        if 0 < between_ns < PIECES_NS:
            return (
                f"{after.paths[0].name} begins {between_ns / NANOSECONDS:.3f} s after the end of "
                f"{before.paths[0].name}, as pieces of one log do; expected --set pieces=true, or a TOML file "
                "that says which robots they are"
            )
    return ""


def overlap_words(source: Source, log: Log) -> str:
    """What to say of logs in one folder that hold images of one topic at one time, as logs of two robots do.

    Args:
        source: of a robot.
        log: its logs, open.

    Returns:
        Empty: one goes on where the other ends, as pieces of one log do, or `pieces` says that they are pieces.
    """
    looked_at = _image_topics(log) if len(log.parts) > 1 and not source.settings.pieces else []
    for topic in looked_at:
        holding = [part for part in log.parts if topic in part.topics and part.topics[topic].count]
        begins = [(next(iter(part.entries([topic], [topic]))).log_ns, part) for part in holding]
        for (_, part), (begin_ns, after) in pairwise(sorted(begins, key=itemgetter(0))):
            if any(entry.log_ns > begin_ns for entry in part.entries([topic], [topic])):
                return (
                    f"{source.name}: {topic} is in {part.path.name} and in {after.path.name} at the same time, "
                    f"expected pieces of one log; if each is a robot's, convert {source.name} itself, or list the "
                    "logs of each robot in a TOML file"
                )
    return ""


def _image_topics(log: Log) -> list[str]:
    """Names of topics of images or video."""
    return sorted(
        t.name for t in log.topics.values() if t.count and (t.type in IMAGE_TYPES or is_video(t.type))
    )


def piece_before(source: Source, sources: Sequence[Source]) -> Source | None:
    """Whose log one continues, if they are pieces of one, by their names: run_1 follows run_0; None: nobody's.

    Args:
        source: of a robot.
        sources: of all robots.
    """
    stem, number = _numbered(source)
    return next((s for s in sources if number > 0 and _numbered(s) == (stem, number - 1)), None)


def _numbered(source: Source) -> tuple[str, int]:
    """Name and number of a log that may be a piece, from 0; -1: it is none.

    `rosbag record --split` writes the date of each piece before its number.
    """
    match = re.fullmatch(r"(.*)_(\d+)", DATE.sub("", source.paths[0].stem))
    if match is None or len(source.paths) > 1 or source.namespace:
        return source.paths[0].stem, -1
    return match[1], int(match[2])


def is_log(path: Path) -> bool:
    """Whether a path is one log, by its name: a file, or a folder of `ros2 bag`.

    Args:
        path: need not exist.
    """
    if path.is_file():
        return path.suffix in SUFFIXES and not path.name.startswith(".")
    return (path / "metadata.yaml").is_file()


def _natural(path: Path) -> list[Any]:
    """Order in which 9.bag comes before 10.bag."""
    return [(int(word), "") if word.isdigit() else (0, word) for word in re.split(r"(\d+)", path.name)]
