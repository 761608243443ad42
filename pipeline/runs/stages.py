"""Every stage of a run with the topics and files that it may read and write. What is declared here is enforced.

To add a stage `NAME`:

1. `schemas/topics.py`: one `Topic` for each new topic, `producer="NAME"`.
2. Here: `NAME = Stage("NAME", reads=..., writes=..., reads_files=..., writes_files=...)`, and its place in `STAGES`.
3. `pipeline/NAME/stage.py`: a function from paths to paths; it reads with `read_log` and writes with `LogWriter`.
4. `pipeline/steps.py`: a function that calls it, named by `code` of the declaration; `pipeline/chain.py`: a
   method that runs it; `pipeline/job.py`: its place.
5. `pipeline/runs/digest.py`: the files that it writes, so that digests cover them.
6. `tests/layers.py`: the folder, and what it may import.

A stage that reads or writes anything else is stopped with one line that names it. So is a stage of one robot that
touches another robot's topics: what robots know of each other came through a recorded packet.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from duagc.pipeline.base.component_names import same_robot
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.recording.access import limited
from duagc.schemas import topics
from duagc.schemas.topics import Scope, Topic

WHERE = "pipeline/runs/stages.py"
CALIBRATED = "calibrated"
"""Folder of a run with the recording that it calibrated; as in any recording, topics are what is limited."""
CALIBRATED_FILES = f"{CALIBRATED}/*"
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


@dataclass(frozen=True)
class Stage:
    """A step of a run, and all that it may read and write.

    Attributes:
        name: as in `Topic.producer` and timing.json.
        reads: topics that it reads, of sensor logs or of earlier stages.
        writes: topics that it writes; it is the producer of each.
        reads_files: files that it reads inside its folder; `*` stands for anything. Its folder is the robot's
            if `per_robot`, else that of the run. Files elsewhere, such as the recording, are not limited by name.
        writes_files: files that it writes inside its folder; it may also read these.
        per_robot: whether it is run for one robot at a time, from that robot's topics alone.
        settings: of the run that it uses, by dotted name; a section stands for all that is in it, "" for all settings.
        code: `module:function` that computes it; results are found again as long as neither it nor what it imports
            changes. "": its results are not kept.
    """

    name: str
    reads: tuple[Topic, ...]
    writes: tuple[Topic, ...] = ()
    reads_files: tuple[str, ...] = ()
    writes_files: tuple[str, ...] = ()
    per_robot: bool = False
    settings: tuple[str, ...] = ()
    code: str = ""

    def __post_init__(self) -> None:
        for topic in self.writes:
            if topic.producer != self.name:
                raise ValueError(
                    f"stage {self.name} writes {topic.pattern}, which {topic.producer} produces by the topic table"
                )

    @contextmanager
    def running(self, folder: Path, robot: str | None = None) -> Iterator[None]:
        """Enforce the declaration while the block runs, in this thread.

        Topics are checked where logs are opened (`recording.access`), files by an audit hook of Python: what libraries
        open without Python (Parquet, .rrd) is not seen.

        Args:
            folder: of the robot if `per_robot`, else of the run.
            robot: whose stage it is; None for a stage of the whole team.
        Raises:
            DuagError: the stage reads or writes what it did not declare.
            ValueError: no robot for a stage that is per robot, or one for a stage of the team.
        """
        if (robot is not None) != self.per_robot:
            raise ValueError(f"stage {self.name}: robot is {robot}, per_robot is {self.per_robot}")
        _install_hook()
        running = _Running(self, os.path.abspath(folder), robot)
        token = _running.set(running)
        try:
            with limited(running):
                yield
        finally:
            _running.reset(token)


@dataclass(frozen=True)
class _Running:
    """A stage at work in a folder."""

    stage: Stage
    folder: str
    robot: str | None

    def check_read(self, path: Path, topic: str) -> None:
        """Refuse a topic that the stage did not declare to read."""
        if not self._declared(topic, (*self.stage.reads, *self.stage.writes)):
            self._refuse(path, f"reads {topic}", "reads")

    def check_write(self, path: Path, topic: str) -> None:
        """Refuse a topic that the stage did not declare to write."""
        if not self._declared(topic, self.stage.writes):
            self._refuse(path, f"writes {topic}", "writes")

    def check_file(self, path: str, writing: bool) -> None:
        """Refuse a file inside the stage's folder that it did not declare."""
        inside = os.path.abspath(path)
        if not inside.startswith(self.folder + os.sep) or os.path.isdir(inside):
            return
        name = inside[len(self.folder) + 1 :].removesuffix(".part")
        allowed = self.stage.writes_files if writing else (*self.stage.reads_files, *self.stage.writes_files)
        if not any(fnmatchcase(name, pattern) for pattern in allowed):
            verb, field = ("writes", "writes_files") if writing else ("reads", "reads_files")
            self._refuse(Path(inside), f"{verb} this file", field)

    def _declared(self, topic: str, declared: tuple[Topic, ...]) -> bool:
        row = topics.find(topic)
        if row is None:
            return False
        own = self.robot is None or same_robot(self.robot, row[1])
        return row[0] in declared and own

    def _refuse(self, path: Path, what: str, field: str) -> None:
        of = "" if self.robot is None else f" of {self.robot}"
        raise DuagError(
            f"{path}: stage {self.stage.name}{of} {what}, expected one of its `{field}` in {WHERE}"
        )


_running: ContextVar[_Running | None] = ContextVar("running", default=None)
_hooked: list[bool] = []


def _install_hook() -> None:
    """See every file that this process opens through Python; a hook cannot be taken out again, so there is one."""
    if _hooked:
        return
    _hooked.append(True)

    def on_event(event: str, arguments: tuple[object, ...]) -> None:
        if event != "open":
            return
        running = _running.get()
        if running is None or not isinstance(arguments[0], str | bytes | os.PathLike):
            return
        flags = arguments[2]
        writing = isinstance(flags, int) and bool(flags & _WRITING)
        running.check_file(os.fsdecode(arguments[0]), writing)

    sys.addaudithook(on_event)


SENSORS = tuple(topic for topic in topics.TOPICS if topic.scope is Scope.SENSOR)
TRUTH = tuple(topic for topic in topics.TOPICS if topic.scope is Scope.TRUTH)
STEPS = "duagc.pipeline.steps"
THICKNESS = "frontend.mapping.seeding.thickness_m"
ALL_SETTINGS = ("",)
RESULTS = tuple(topic for topic in topics.TOPICS if topic.scope in (Scope.ROBOT, Scope.TEAM))

FRONTEND = Stage(
    "frontend",
    reads=SENSORS,
    writes=(
        topics.ODOMETRY,
        topics.KEYFRAME,
        topics.KEYFRAME_FACTOR,
        topics.SUBMAP,
        topics.EXPOSURE,
        topics.MAP_UPDATE,
        topics.MAP,
        topics.UNREFINED_MAP,
    ),
    writes_files=("frontend.mcap", "frontend.*.mcap"),
    per_robot=True,
    settings=("seed", "frontend"),
    code=f"{STEPS}:frontend",
)
INFORMATION = Stage(
    "information",
    reads=(*SENSORS, topics.ODOMETRY, topics.KEYFRAME, topics.EXPOSURE, topics.MAP),
    writes=(topics.INFORMATION,),
    reads_files=("frontend.mcap",),
    writes_files=("information.mcap",),
    per_robot=True,
    settings=("information", "frontend.moving", THICKNESS),
    code=f"{STEPS}:information",
)
EXCHANGE = Stage(
    "exchange",
    reads=(
        *SENSORS,
        topics.ODOMETRY,
        topics.KEYFRAME,
        topics.KEYFRAME_FACTOR,
        topics.MAP,
        topics.INFORMATION,
    ),
    writes=(
        topics.PEER_MESSAGE,
        topics.PEER_PACKET,
        topics.EXCHANGE_SUMMARY,
        topics.AGENT_ROUND,
        topics.CONSENSUS_ROUND,
        topics.LOOP_CLOSURE_DECISION,
    ),
    reads_files=("robots/*/frontend.mcap", "robots/*/information.mcap", CALIBRATED_FILES),
    writes_files=("exchange.mcap", "consensus.mcap", "robots/*/session.npz"),
    settings=("seed", "exchange", THICKNESS),
    code=f"{STEPS}:exchange",
)
FUSION = Stage(
    "fusion",
    reads=(
        *SENSORS,
        topics.ODOMETRY,
        topics.KEYFRAME,
        topics.EXPOSURE,
        topics.KEYFRAME_FACTOR,
        topics.MAP,
        topics.INFORMATION,
    ),
    writes=(
        topics.FUSED_MAP,
        topics.REFINED_MAP,
        topics.CORRECTED_KEYFRAMES,
        topics.PEER_MAP_REPORT,
        topics.REJECTED_MATCHES,
        topics.PEER_COLORS,
    ),
    reads_files=("frontend.mcap", "information.mcap", "session.npz"),
    writes_files=("fused.mcap", "fused.ply", "refined.ply", "trajectory.tum", "odometry.tum"),
    per_robot=True,
    settings=("seed", "fusion", "exchange.matching", "exchange.weights", "frontend.moving", THICKNESS),
    code=f"{STEPS}:fusion",
)
_FINISHED = (
    CALIBRATED_FILES,
    "config.toml",
    "manifest.json",
    "timing.json",
    "exchange.mcap",
    "consensus.mcap",
    "robots/*/*.mcap",
    "robots/*/*.tum",
)
EVALUATION = Stage(
    "evaluation",
    reads=(*SENSORS, *TRUTH, *RESULTS),
    reads_files=_FINISHED,
    writes_files=("metrics.json", "metrics.parquet"),
    settings=ALL_SETTINGS,
    code=f"{STEPS}:evaluation",
)
REPORT = Stage(
    "report",
    reads=(*SENSORS, *TRUTH, *RESULTS),
    reads_files=(*_FINISHED, "metrics.json", "metrics.parquet"),
    writes_files=("report/index.html",),
    settings=ALL_SETTINGS,
    code=f"{STEPS}:report",
)
VIEW = Stage(
    "rrd",
    reads=(*SENSORS, *TRUTH, *RESULTS),
    reads_files=(*_FINISHED, "metrics.json", "metrics.parquet"),
    writes_files=("run.rrd",),
    settings=ALL_SETTINGS,
    code=f"{STEPS}:view",
)
CALIBRATION = Stage(
    "calibration",
    reads=SENSORS,
    writes_files=(CALIBRATED_FILES,),
    settings=("calibration", "frontend"),
    code=f"{STEPS}:calibration",
)
"""Before a run, if it is asked for. Its declaration is not enforced: it copies what it does not look at."""
STAGES = (FRONTEND, INFORMATION, EXCHANGE, FUSION, EVALUATION, REPORT, VIEW)
"""In the order in which a run takes them."""
