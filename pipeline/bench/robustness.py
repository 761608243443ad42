"""What degraded cameras cost: one simulated recording, and the same walk with one dial after another turned up.

A cell is a value of a dial. Each is simulated with exact truth, run with the settings of every other run, and measured.
The clean cell has all dials at zero. A cell that is finished is kept, with the digest of the code and of the settings
that made it, and is computed again when either changes, or if its run failed.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from duagc.converters.simulate.sensors.degradations import FRAME_RATE_HZ, Degradations
from duagc.converters.simulate.sensors.rig import Rig
from duagc.converters.simulate.settings import SimulationSettings
from duagc.converters.simulate.team import simulate
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.bench.cell_digests import code_digest, mesh_digest
from duagc.pipeline.evaluation import coverage, trajectory_errors
from duagc.pipeline.evaluation.results import Absent, write_json
from duagc.pipeline.evaluation.true_paths import TruePaths
from duagc.pipeline.recording import Recording
from duagc.pipeline.runs.folder import RunFolder

CLEAN, ALL = "clean", "all"
ATE_RATIO, PSNR_LOSS_DB, WORST_M, GAP_SIGMA = 3.0, 3.0, 0.1, 0.05
"""Bounds at the middle values: ATE and PSNR against the clean cell, and the error of a pose called good."""

UNSCORED = ("fusion.finetune.steps_per_view=0",)
"""Settings of the runs: what costs time and decides nothing that is scored is left out."""

NO_POSE = Absent("not in this run")

Execute = Callable[[Path, Path], None]
"""Runs all stages on a recording into a folder."""


@dataclass(frozen=True)
class Dial:
    """A degradation.

    Attributes:
        name: on the command line.
        middle: its value at level 1, in `unit`.
        unit: of the value.
        zero: its value at level 0.
        source: where the middle value comes from.
    """

    name: str
    middle: float
    unit: str
    source: str
    zero: float = 0.0

    def value(self, level: float) -> float:
        """Value at a level; a rate is taken by its interval.

        Args:
            level: 0 is clean, 1 the middle.
        """
        if self.unit == "Hz":
            return 1 / (1 / self.zero + level * (1 / self.middle - 1 / self.zero))
        return self.zero + level * (self.middle - self.zero)

    def text(self, level: float) -> str:
        """Value at a level, with its unit.

        Args:
            level: 0 is clean, 1 the middle.
        """
        return f"{self.value(level):.3g} {self.unit}".strip()


DIALS = {
    dial.name: dial
    for dial in (
        Dial("exposure", 30.0, "%", "stated with the task; lag 0.3 s"),
        Dial("white_balance", 15.0, "%", "a light source that changes by about 500 K around 4500 K"),
        Dial(
            "vignette", 40.0, "%", "cos^4 law at the corner of a view of 63 degrees without correction: 60 %"
        ),
        Dial("blur", 8.0, "px", "stated with the task"),
        Dial(
            "rolling_shutter",
            30.0,
            "ms",
            "stated with the task; color of a first Kinect reads for a whole frame",
        ),
        Dial("lens", -0.3, "", "stated with the task; EuRoC: k1 = -0.283, k2 = 0.074"),
        Dial(
            "depth_step",
            10.0,
            "mm",
            "first Kinect 2.9 mm, OAK-D at 800 rows in whole pixels 15 mm, both at 1 m",
        ),
        Dial("depth_delay", 30.0, "ms", "one frame: color and depth of free-running cameras"),
        Dial("missing", 20.0, "%", "stated with the task"),
        Dial("rate", 5.0, "Hz", "stated with the task", zero=float(FRAME_RATE_HZ)),
    )
}


@dataclass(frozen=True)
class Cell:
    """One recording: a dial (or `CLEAN`, or `ALL` of them) at a level, 1 the middle."""

    dial: str
    level: float

    @property
    def name(self) -> str:
        """Of its files and rows."""
        return CLEAN if self.dial == CLEAN else f"{self.dial}-{self.level:g}"

    def value(self) -> str:
        """Of its dial, with its unit."""
        if self.dial in DIALS:
            return DIALS[self.dial].text(self.level)
        return "" if self.dial == CLEAN else f"{self.level:g} x middle"

    def settings(self) -> tuple[Rig, Degradations]:
        """Of the simulator."""
        turned = DIALS.values() if self.dial == ALL else [d for d in DIALS.values() if d.name == self.dial]
        at = {dial.name: dial.value(self.level) for dial in turned}
        rig = Rig(readout_s=at.get("rolling_shutter", 0.0) / 1000)
        return rig, Degradations(
            auto_exposure=at.get("exposure", 0.0) / 100,
            white_balance=at.get("white_balance", 0.0) / 100,
            vignette=at.get("vignette", 0.0) / 100,
            blur_px=at.get("blur", 0.0),
            lens_k1=at.get("lens", 0.0),
            depth_step_m=at.get("depth_step", 0.0) / 1000,
            depth_delay_s=at.get("depth_delay", 0.0) / 1000,
            missing=at.get("missing", 0.0) / 100,
            rate_hz=at.get("rate", float(FRAME_RATE_HZ)),
        )


@dataclass(frozen=True)
class RobustnessPlan:
    """What is measured.

    Attributes:
        dials: names of `DIALS`, or `ALL`.
        levels: values of the dials, 1 the middle.
        scene: of `duagc simulate`.
        robots: how many.
        frames: of the walk of each, at 30 Hz.
        size: width and height, pixels.
        noise: of the sensors, also in the clean cell: "none" or "kinect".
        seed: of scene, walks and noise.
    """

    dials: tuple[str, ...] = (*DIALS, ALL)
    levels: tuple[float, ...] = (1.0,)
    scene: str = "room"
    robots: int = 2
    frames: int = 60
    size: tuple[int, int] = (320, 240)
    noise: str = "kinect"
    seed: int = 0

    def cells(self) -> list[Cell]:
        """In the order of the table, clean first."""
        return [Cell(CLEAN, 0.0), *(Cell(dial, level) for dial in self.dials for level in self.levels)]


def run(
    plan: RobustnessPlan,
    out: Path,
    execute: Execute,
    settings: str,
    *,
    workers: int = 2,
    keep: bool = False,
    finished: Callable[[list[dict[str, Any]]], None] = lambda rows: None,
) -> list[dict[str, Any]]:
    """Measure every cell that is not yet in `out`.

    Args:
        plan: what to measure.
        out: folder of the results; cells that are finished there are taken from it.
        execute: runs all stages.
        settings: of the run, as text: cells of other settings are computed again.
        workers: processes that render; changes no result.
        keep: keep recording and run of every cell computed now.
        finished: gets the rows there are, after every cell.

    Returns:
        The rows, in the order of the cells.

    Raises:
        DuagError: a level is beyond what the simulator can do.
    """
    (out / "cells").mkdir(parents=True, exist_ok=True)
    made_by = hashlib.sha256(f"{code_digest()}\n{settings}".encode()).hexdigest()
    plain = _plain(plan)
    wanted = {cell: {"cell": asdict(cell), "plan": plain, "made_by": made_by} for cell in plan.cells()}
    found = {cell: row for cell, want in wanted.items() if (row := _kept(out, cell, want)) is not None}
    waiting = [cell for cell in plan.cells() if cell not in found]
    for cell in waiting:  # before minutes of work
        SimulationSettings(**_settings(cell, plan)).check()

    def measure_all(cells: Sequence[Cell]) -> Iterator[tuple[Cell, dict[str, Any]]]:
        for cell in cells:
            folder = out / "runs" / cell.name
            if folder.exists():
                shutil.rmtree(folder)
            folder.mkdir(parents=True)
            yield cell, measure(cell, plan, folder, execute, workers=workers)
            if not keep:
                shutil.rmtree(folder)

    for cell, row in track(measure_all(waiting), "robustness", len(waiting)):
        found[cell] = row
        write_json(_file(out, cell), wanted[cell] | {"row": row})
        finished([found[c] for c in plan.cells() if c in found])
    return [found[cell] for cell in plan.cells()]


def measure(
    cell: Cell, plan: RobustnessPlan, folder: Path, execute: Execute, *, workers: int = 1
) -> dict[str, Any]:
    """Simulate, run and measure one cell.

    Args:
        cell: the cell.
        plan: with scene and walk.
        folder: empty; gets the recording and the run.
        execute: runs all stages.
        workers: processes that render; changes no result.

    Returns:
        The row: plain numbers, None for what there is not; "failed" if the run could not be carried out.
    """
    simulate_cell(cell, plan, folder / "recording", workers=workers)
    row: dict[str, Any] = {"dial": cell.dial, "level": cell.level, "value": cell.value()}
    try:
        execute(folder / "recording", folder / "run")
    except DuagError as error:
        return row | {"failed": str(error).replace(str(folder), cell.name)}
    return row | measured(RunFolder(folder / "run"), Recording(folder / "recording"))


def simulate_cell(cell: Cell, plan: RobustnessPlan, out: Path, *, workers: int = 1) -> None:
    """Write the recording of a cell.

    Args:
        cell: the cell.
        plan: with scene and walk.
        out: folder of the recording; there is none yet.
        workers: processes that render; changes no result.
    """
    simulate(out, **_settings(cell, plan), workers=workers)


def _settings(cell: Cell, plan: RobustnessPlan) -> dict[str, Any]:
    """What is simulated for a cell."""
    rig, degradations = cell.settings()
    walk = {name: getattr(plan, name) for name in ("robots", "frames", "scene", "size", "noise", "seed")}
    return walk | {"rig": rig, "degradations": degradations, "triangles": True}


def measured(run_folder: RunFolder, recording: Recording) -> dict[str, Any]:
    """The numbers of a finished run.

    Args:
        run_folder: the run.
        recording: its recording, with ground truth.
    """
    metrics = run_folder.metrics
    robots, own = metrics["coverage"].values(), metrics["rendering"]["own"]["held_out"]
    frames = sum(robot["frames"] for robot in robots)
    return {
        "frames": frames,
        "tracked_share": sum(robot["posed"] for robot in robots) / frames,
        "lost": [
            {"robot": each.robot, "first": each.first, "last": each.last, "reason": each.reason}
            for each in coverage.lost_stretches(run_folder)
        ],
        "submaps": sum(robot["submaps"] for robot in robots),
        "components": len(metrics["components"]),
        "ate_m": metrics["team"]["ate_rmse_m_mean_of_robots"],
        "ate_team_m": metrics["team"]["ate_rmse_m"],
        "psnr_db": own["psnr_db"],
        "psnr_exposure_db": own["psnr_exposure_db"],
        "psnr_moved_db": own["psnr_moved_db"],
        "robots": metrics["team"]["robots"],
        "joined": metrics["team"]["robots_in_largest_component"],
        "worst_good_m": worst_good_m(run_folder, recording),
        "gap_sigma": metrics["consensus"].get("gap_to_oracle_sigma_p99"),
    }


def worst_good_m(run_folder: RunFolder, recording: Recording) -> float | None:
    """Largest distance from the truth of a pose that was not called lost, meters; None if there is none.

    Poses are those after consensus, and all members of a component have one alignment.

    Args:
        run_folder: the run.
        recording: its recording, with ground truth.
    """
    truth, worst = TruePaths.of(run_folder, recording), []
    for component in {robot.component for robot in run_folder.robots.values()}:
        members = {
            name: pairs
            for name in component
            if not isinstance(pairs := truth.after.get(name, NO_POSE), Absent)
            and run_folder.robots[name].component == component
        }
        T_gt_world = trajectory_errors.alignment(list(members.values()))
        if isinstance(T_gt_world, Absent):
            continue
        for name, pairs in members.items():
            good = {frame.stamp_ns for frame in run_folder.robots[name].frames if frame.status != "lost"}
            called = np.array([stamp in good for stamp in pairs.stamps_ns.tolist()], dtype=bool)
            squared = trajectory_errors.squared_errors_m2(pairs, T_gt_world)[called]
            worst += [float(np.sqrt(squared.max()))] if len(squared) else []
    return max(worst, default=None)


def bounds_met(row: dict[str, Any], clean: dict[str, Any]) -> dict[str, bool] | None:
    """Whether a row keeps within the bounds of the middle values; None for one that is all dials together or failed.

    Args:
        row: of one dial.
        clean: the row of the clean cell.
    """
    if row["dial"] in (CLEAN, ALL) or "failed" in row or "failed" in clean:
        return None
    return {
        "ate": clean["ate_m"] is not None and _within(row["ate_m"], ATE_RATIO * clean["ate_m"]),
        "psnr": None not in (row["psnr_db"], clean["psnr_db"])
        and row["psnr_db"] >= clean["psnr_db"] - PSNR_LOSS_DB,
        "component": row["components"] == 1,
        "worst": _within(row["worst_good_m"], WORST_M),
        "gap": _within(row["gap_sigma"], GAP_SIGMA),
    }


def _within(value: float | None, most: float) -> bool:
    return value is not None and value <= most


def _plain(plan: RobustnessPlan) -> dict[str, Any]:
    """What a cell depends on: all but which other cells there are; of a folder of meshes also what they are."""
    plain = asdict(plan) | {"size": list(plan.size)} | mesh_digest(plan.scene)
    del plain["dials"], plain["levels"]
    return plain


def _file(out: Path, cell: Cell) -> Path:
    return out / "cells" / f"{cell.name}.json"


def _kept(out: Path, cell: Cell, want: dict[str, Any]) -> dict[str, Any] | None:
    kept = _read(out, cell)
    row: dict[str, Any] | None = kept.pop("row", None)
    return row if kept == want and row is not None and "failed" not in row else None


def finished_row(out: Path, cell: Cell, plan: RobustnessPlan) -> dict[str, Any] | None:
    """The row of a cell that was finished on the same walk, whatever code and settings made it; None: there is none.

    Args:
        out: folder of the results.
        cell: the cell.
        plan: with scene and walk.
    """
    kept = _read(out, cell)
    return kept.get("row") if kept.get("plan") == _plain(plan) else None


def _read(out: Path, cell: Cell) -> dict[str, Any]:
    """The file of a finished cell; empty if there is none, or it is damaged."""
    try:
        return dict(json.loads(_file(out, cell).read_text()))
    except (OSError, ValueError):
        return {}
