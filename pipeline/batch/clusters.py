"""Engines of clusters, imported by need: Slurm by submitit, and Ray.

A cell is a process of its own there too, so an engine carries a few texts and nothing else; all machines see the
recordings, the folder of the batch and the store under the same paths.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from duagc.pipeline.base.errors import DuagError

POLL_S = 0.2


def cell_command(arguments: Mapping[str, str]) -> list[str]:
    """What runs a cell.

    Args:
        arguments: of `batch.cell.enter`.
    """
    named = [word for name in ("out", "store", "cell") for word in (f"--{name}", arguments[name])]
    return [sys.executable, "-m", "duagc.pipeline.batch.cell", arguments["suite"], *named]


def _carry_out(arguments: dict[str, str]) -> int:
    """On a machine of the cluster: run a cell, and return its exit code."""
    return subprocess.run(cell_command(arguments), check=False).returncode


class SlurmEngine:
    """Jobs of Slurm, or, to try that out, of this machine by submitit's local executor."""

    def __init__(self, slots: int, folder: Path, *, cluster: str | None = None, **parameters: Any) -> None:
        """Configure submitit for jobs of one task on one processor; none is submitted yet.

        Args:
            slots: jobs at the same time.
            folder: for what submitit writes.
            cluster: "local": this machine; None: Slurm.
            parameters: of `submitit.AutoExecutor.update_parameters`, such as `timeout_min` and `slurm_partition`.

        Raises:
            DuagError: submitit is not installed, or Slurm is not here.
        """
        try:
            import submitit
        except ImportError as error:
            raise DuagError(_extra("slurm", "submitit")) from error
        self.slots = slots
        try:
            self._executor = submitit.AutoExecutor(folder=folder, cluster=cluster or "slurm")
        except RuntimeError as error:
            raise DuagError(f"--engine slurm: {error}, expected sbatch on this machine") from error
        self._executor.update_parameters(name="duagc", cpus_per_task=1, tasks_per_node=1, **parameters)
        self._jobs: dict[str, Any] = {}

    def __enter__(self) -> SlurmEngine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for job in self._jobs.values():
            job.cancel()

    def submit(self, name: str, arguments: Mapping[str, str]) -> None:
        """Start a cell as a job.

        Args:
            name: of it.
            arguments: of `batch.cell.enter`.
        """
        self._jobs[name] = self._executor.submit(_carry_out, dict(arguments))

    def wait(self) -> str:
        """Wait until a job has ended, well or not, and return the name of its cell."""
        while True:
            for name, job in self._jobs.items():
                if job.done():
                    del self._jobs[name]
                    return name
            time.sleep(POLL_S)


class RayEngine:
    """Tasks of a Ray cluster: the one at $RAY_ADDRESS, else one of this machine."""

    def __init__(self, slots: int) -> None:
        """Join the cluster.

        Args:
            slots: tasks at the same time.

        Raises:
            DuagError: Ray is not installed.
        """
        try:
            import ray
        except ImportError as error:
            raise DuagError(_extra("ray", "ray")) from error
        self.slots = slots
        self._ray = ray
        if not ray.is_initialized():
            ray.init(log_to_driver=False)
        # A task that dies is tried again by the batch, which counts.
        self._task = ray.remote(num_cpus=1, max_retries=0)(_carry_out)
        self._running: dict[Any, str] = {}

    def __enter__(self) -> RayEngine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for task in self._running:
            self._ray.cancel(task, force=True)
        self._ray.shutdown()

    def submit(self, name: str, arguments: Mapping[str, str]) -> None:
        """Start a cell as a task.

        Args:
            name: of it.
            arguments: of `batch.cell.enter`.
        """
        self._running[self._task.remote(dict(arguments))] = name

    def wait(self) -> str:
        """Wait until a task has ended, well or not, and return the name of its cell."""
        (task, *_), _ = self._ray.wait(list(self._running), num_returns=1)
        return self._running.pop(task)


def _extra(extra: str, package: str) -> str:
    return f"--engine {extra}: package {package} not found; pip install 'duagc[{extra}]'"
