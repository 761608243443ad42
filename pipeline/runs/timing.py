"""What the stages of a run took. None of it is part of any digest."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from duagc.pipeline.base.shelf import SHELF
from duagc.pipeline.base.workers import peak_memory_bytes
from duagc.pipeline.runs.stages import Stage


def label(stage: str, robot: str | None) -> str:
    """Name of a stage of one robot, or of the team, in timing.json and manifest.json.

    Args:
        stage: its name.
        robot: whose; None: the team's.
    """
    return f"{stage}.{robot}" if robot else stage


class Timing:
    """Runs stages inside their declarations, and keeps wall time, processor time and peak memory of each."""

    def __init__(self) -> None:
        self.stages: dict[str, dict[str, Any]] = {}

    @contextmanager
    def stage(self, stage: Stage, folder: Path, robot: str | None = None) -> Iterator[None]:
        """Enforce and time a stage while the block runs.

        Args:
            stage: with what it declares.
            folder: of the robot if the stage is per robot, else of the run.
            robot: whose stage it is; None for a stage of the whole team.

        Raises:
            DuagError: the stage reads or writes what it did not declare.
        """
        with self.measured(stage.name, robot), stage.running(folder, robot):
            yield

    @contextmanager
    def measured(self, name: str, robot: str | None = None) -> Iterator[None]:
        """Time what is done while the block runs.

        Args:
            name: of what is done.
            robot: for whom; None for the whole team.
        """
        wall, cpu = time.perf_counter(), _processor_s()
        yield
        # the process may have another stage to do, or wait for others with what it freed
        SHELF.sweep(heap=True)
        self.stages[label(name, robot)] = {
            "stage": name,
            "robot": robot,
            "wall_s": round(time.perf_counter() - wall, 3),
            "cpu_s": round(_processor_s() - cpu, 3),
            "peak_rss_mb": round(peak_memory_bytes() / 1e6, 1),
        }

    def went_on(self, name: str, wall_s: float, cpu_s: float) -> None:
        """Count what processes did of a stage that went on from where they were killed.

        Args:
            name: label of the stage, which is over.
            wall_s: time of theirs.
            cpu_s: processor time of theirs.
        """
        row = self.stages[name]
        row["wall_s"] = round(row["wall_s"] + wall_s, 3)
        row["cpu_s"] = round(row["cpu_s"] + cpu_s, 3)


def _processor_s() -> float:
    """Processor time of this process, and of those that it has started and waited for."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime
