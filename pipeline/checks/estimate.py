"""What `duagc run` on a recording will take, from runs that were measured."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from duagc.pipeline.checks.findings import Finding, Severity
from duagc.pipeline.checks.geometry import Move
from duagc.pipeline.config.frontend import KeyframeConfig

# Seconds on two idle cores of 2.6 GHz, fitted to the parts of whole runs (docs/reference/checks.md).
RUN_S = 6.0  # start, report, view
ROBOT_S, FRAME_S, KEYFRAME_S = (
    3.0,
    0.14,
    14.5,
)  # front end on one core; frame and keyframe for every million pixels
FUSION_S = (6.0, 60.0)  # of a robot that has peers: in any case, and for every million pixels of an image
EVALUATION_S = 0.35  # for every million pixels of all frames
EXCHANGE_S = 4.0  # of a pair of robots, and of the team
RANGE = (0.6, 1.7)  # of the sum: textures decide how long a map is trained, and robots may not meet
MEASURED_RANGE = (0.7, 1.4)  # where the machine was measured
BYTES_PER_ROBOT = 50_000_000  # maps at their cap of Gaussians with information; report and Rerun file
BYTES_PER_FRAME = 25_000


def keyframes(moved: Sequence[Move], frames: int, duration_ns: int) -> int:
    """About how many keyframes the front end makes: one whenever it has lost the share of a view that asks for one.

    Args:
        moved: registered pairs.
        frames: of the log.
        duration_ns: from the first frame to the last.
    """
    rates = [m.lost / (m.second_ns - m.first_ns) for m in moved if np.isfinite(m.lost)]
    if not rates:
        return frames  # nothing registers: it may try with every frame
    lost = float(np.mean(rates)) * duration_ns
    return min(frames, 1 + round(lost / (1 - KeyframeConfig().min_overlap)))


def front_end_s(robot: Mapping[str, Any]) -> float:
    """Processor time of the front end of a robot.

    Args:
        robot: `frames`, `pixels` of an image and `keyframes`.
    """
    megapixels = robot["pixels"] * 1e-6
    return ROBOT_S + megapixels * (FRAME_S * robot["frames"] + KEYFRAME_S * robot["keyframes"])


def fusion_s(robot: Mapping[str, Any]) -> float:
    """Time of the fusion of a robot that has peers.

    Args:
        robot: `pixels` of an image.
    """
    return FUSION_S[0] + FUSION_S[1] * robot["pixels"] * 1e-6


def evaluation_s(robots: Sequence[Mapping[str, Any]]) -> float:
    """Time of the evaluation of a team.

    Args:
        robots: `frames` and `pixels` of an image of every robot.
    """
    return EVALUATION_S * sum(robot["pixels"] * 1e-6 * robot["frames"] for robot in robots)


def estimate(
    robots: Mapping[str, Mapping[str, Any]], ratios: Mapping[str, float] = MappingProxyType({})
) -> dict[str, float]:
    """Seconds (from, to) of a run on two idle cores and bytes on disk.

    Args:
        robots: `frames`, `pixels` of an image and `keyframes` of every robot.
        ratios: what stages take on this machine, as a share of what is predicted, by their names.
    """
    rows, count = list(robots.values()), len(robots)
    front_ends = [ratios.get("frontend", 1.0) * front_end_s(row) for row in rows]
    seconds = RUN_S + max([*front_ends, sum(front_ends) / 2], default=0.0)
    seconds += ratios.get("evaluation", 1.0) * evaluation_s(rows)
    if count > 1:
        seconds += EXCHANGE_S * (1 + count * (count - 1) / 2)
        seconds += ratios.get("fusion", 1.0) * sum(map(fusion_s, rows))
    size = sum(BYTES_PER_ROBOT + BYTES_PER_FRAME * row["frames"] for row in rows)
    low, high = MEASURED_RANGE if "frontend" in ratios else RANGE
    return {"seconds_from": low * seconds, "seconds_to": high * seconds, "bytes": float(size)}


def check_disk(folder: Path, needed: float) -> Iterator[Finding]:
    """A finding if the disk of a folder has too little room."""
    free = shutil.disk_usage(folder).free
    if free < needed:
        yield Finding(
            Severity.WARNING,
            "disk",
            "",
            f"{free / 1e6:.0f} MB are free where the recording is",
            f"{needed / 1e6:.0f} MB for a run",
            "free some space, or give `duagc run` an --out on another disk",
        )
