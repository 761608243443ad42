"""What `duagc run` on a recording will take, from runs that were measured."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from duagc.pipeline.checks.findings import Finding, Severity

# seconds per million pixels of a frame, whole runs on two idle cores: RedKitchen takes 118 s for 205 of them
# (docs/results/runs.md) and the demo about 60 s for 55; textures and speed decide how many keyframes there are
SECONDS_PER_MEGAPIXEL = (0.5, 1.2)
BYTES_PER_ROBOT = 50_000_000  # maps at their cap of Gaussians with information; report and Rerun file
BYTES_PER_FRAME = 25_000


def estimate(robots: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Seconds (from, to) on two cores and bytes on disk of a run, from `frames` and `pixels` of every robot."""
    megapixels = sum(row["frames"] * row["pixels"] for row in robots.values()) * 1e-6
    low, high = (megapixels * seconds for seconds in SECONDS_PER_MEGAPIXEL)
    size = sum(BYTES_PER_ROBOT + BYTES_PER_FRAME * row["frames"] for row in robots.values())
    return {"seconds_from": low, "seconds_to": high, "bytes": float(size)}


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
