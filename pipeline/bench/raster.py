"""Speed of the rasterizer on a synthetic room, next to a plain torch tile rasterizer and the machine's own peak.

Everything is measured in one run. Rounds of all candidates alternate, so that other load on the machine hits them
alike. One thread: the thread's own CPU time (that of the process would count idle helpers that still spin), the median
over the rounds. More threads: wall time, the lower quartile.

The fraction of the peak is counted by hand, not measured: what a pair of pixel and Gaussian needs (`FLOPS`), times the
drawn pairs, over the time of the whole call, over the rate of multiply-adds of the same instruction set on as many
threads. Projection, sorting, lists and the chain to the parameters take time but are not counted, nor are lanes of a
vector in which nothing is drawn. The fraction of the bandwidth is counted alike: arrays and scratch memory of a pass,
each written or read once, over the rate of a copy; what stays in a cache counts too.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np

from duagc.pipeline.base.progress import track
from duagc.pipeline.bench import torch_tiles
from duagc.pipeline.bench.peaks import Peaks
from duagc.pipeline.bench.raster_work import FLOPS, RasterView, RasterWork, Size
from duagc.pipeline.kernels import Rasterizer, available_isas

SIZES_PX: tuple[Size, ...] = ((320, 240), (640, 480), (1200, 680))
GAUSSIANS = (60_000, 300_000, 1_000_000)
THREADS = (1, 2)
ROUNDS = 7
TORCH_ROUNDS = 3
TORCH_LARGEST = 640 * 480 * 60_000  # pixels times Gaussians: seconds and gigabytes beyond


@dataclass(frozen=True)
class RasterPlan:
    """What to measure: every scene with every instruction set on every number of threads.

    portable_everywhere: else the portable build, slow on x86 where it must imitate fused multiply-add, runs one round
    of the smallest scene on one thread.
    """

    sizes: tuple[Size, ...] = SIZES_PX
    gaussians: tuple[int, ...] = GAUSSIANS[:1]
    threads: tuple[int, ...] = THREADS
    isas: tuple[str, ...] = tuple(available_isas())
    rounds: int = ROUNDS
    torch_too: bool = True
    portable_everywhere: bool = False

    def scenes(self) -> list[tuple[Size, int]]:
        """Image sizes and numbers of Gaussians, small ones first."""
        return [(size, n) for n in sorted(self.gaussians) for size in sorted(self.sizes)]

    def candidates(self, scene: tuple[Size, int]) -> list[tuple[str, int]]:
        """Instruction sets and numbers of threads that run in this scene.

        Args:
            scene: image size (px) and number of Gaussians.
        """
        every = [(isa, n) for isa in self.isas for n in self.threads]
        smallest = scene == self.scenes()[0]
        return [c for c in every if not self._spares(c[0]) or (smallest and c[1] == min(self.threads))]

    def rounds_of(self, isa: str) -> int:
        """Rounds that are timed; one before them warms up.

        Args:
            isa: instruction set.
        """
        return 1 if self._spares(isa) else self.rounds

    def _spares(self, isa: str) -> bool:
        return isa == "portable" and len(self.isas) > 1 and not self.portable_everywhere

    def torch_rounds(self, scene: tuple[Size, int]) -> int:
        """Rounds of plain torch in this scene.

        Args:
            scene: image size (px) and number of Gaussians.
        """
        (width, height), n = scene
        return min(TORCH_ROUNDS, self.rounds) if self.torch_too and width * height * n <= TORCH_LARGEST else 0


def run(plan: RasterPlan) -> dict[str, Any]:
    """Times, work and peaks as {"machine": {...}, "rows": [...]}, ready for JSON; a row per scene and candidate.

    Args:
        plan: what to measure.
    """
    peaks = Peaks(plan.isas, plan.threads)
    measured: list[RasterScene] = []
    rounds = _rounds(plan, peaks, measured)
    total = sum(_ticks(plan, scene) * (plan.rounds + 1) for scene in plan.scenes())
    for _ in track(rounds, "timing the rasterizer", total=total):
        pass
    rows = [row for scene in measured for row in scene.rows(peaks)]
    return {"machine": peaks.as_dict(), "rows": rows}


def _ticks(plan: RasterPlan, scene: tuple[Size, int]) -> int:
    """Roughly how long a round of a scene takes, in steps of the progress bar."""
    (width, height), n = scene
    pixels = width * height
    torch_share = plan.torch_rounds(scene) / (plan.rounds + 1)
    return round(1 + pixels / 25_000 + n / 10_000 + torch_share * (30 + pixels / 1000))


def _rounds(plan: RasterPlan, peaks: Peaks, measured: list[RasterScene]) -> Iterator[None]:
    """Measure scene by scene, round by round; yields as often as a round's share of the whole."""
    for scene in plan.scenes():
        measured.append(RasterScene(plan, *scene))
        for _ in measured[-1].rounds(peaks):
            yield from repeat(None, _ticks(plan, scene))


class RasterScene:
    """One image size and number of Gaussians, its candidates and their times."""

    def __init__(self, plan: RasterPlan, size: Size, gaussians: int) -> None:
        """Nothing is measured yet.

        Args:
            plan: what to measure.
            size: of the images, px.
            gaussians: their number.
        """
        self.plan, self.size, self.gaussians = plan, size, gaussians
        candidates = plan.candidates((size, gaussians))
        self.times_ms: dict[tuple[str, int], dict[str, list[float]]] = {c: {} for c in candidates}
        self.torch_times_ms: dict[int, dict[str, list[float]]] = {n: {} for n in plan.threads}
        self.scratch_bytes: dict[tuple[str, int], int] = {}

    def rounds(self, peaks: Peaks) -> Iterator[None]:
        """Time everything once per round, after one that only warms up; yields after each.

        Args:
            peaks: of the machine; measured again before the first round.
        """
        view = RasterView(self.size, self.gaussians)
        self.work = RasterWork(self.plan.isas[0], view)
        rasterizers = {candidate: Rasterizer(*candidate) for candidate in self.times_ms}
        peaks.measure()
        for k in range(self.plan.rounds + 1):
            for candidate, rasterizer in rasterizers.items():
                if k <= self.plan.rounds_of(candidate[0]):
                    self._round(k, candidate, view.passes(rasterizer))
            if 0 < k <= self.plan.torch_rounds((self.size, self.gaussians)):
                for threads, times in self.torch_times_ms.items():
                    for name, milliseconds in _time_torch(view, threads).items():
                        times.setdefault(name, []).append(milliseconds)
            yield
        self.scratch_bytes = {
            c: rasterizer.statistics().scratch_bytes for c, rasterizer in rasterizers.items()
        }

    def _round(self, k: int, candidate: tuple[str, int], passes: dict[str, Callable[[], object]]) -> None:
        for name, step in passes.items():
            milliseconds, _ = _timed(step, wall=candidate[1] > 1)
            if k > 0:
                self.times_ms[candidate].setdefault(name, []).append(milliseconds)

    def rows(self, peaks: Peaks) -> list[dict[str, Any]]:
        """A row per candidate.

        Args:
            peaks: of the machine, so far.
        """
        return [self._row(isa, threads, peaks) for isa, threads in self.times_ms]

    def _row(self, isa: str, threads: int, peaks: Peaks) -> dict[str, Any]:
        ms = {name: _typical(values, threads) for name, values in self.times_ms[isa, threads].items()}
        torch_ms = {name: _typical(values, threads) for name, values in self.torch_times_ms[threads].items()}
        seen, flops, moved = self.work.seen, self.work.flops(), self.work.moved_bytes
        fma, copy = peaks.fma_gflops[isa][threads], peaks.copy_gb_per_s[threads]
        row: dict[str, Any] = {
            "width": self.size[0],
            "height": self.size[1],
            "gaussians": self.gaussians,
            "threads": threads,
            "isa": isa,
            **{f"{name}_ms": value for name, value in ms.items()},
            "torch_forward_ms": torch_ms.get("forward"),
            "torch_backward_ms": torch_ms.get("backward"),
            "visible": seen.visible,
            "intersections": seen.intersections,
            "evaluated_pairs": seen.evaluated_pairs,
            "contributing_pairs": seen.blended_pairs,
            "scratch_mb": 1e-6 * self.scratch_bytes[isa, threads],
        }
        for name in FLOPS:
            row[f"{name}_pairs_per_s"] = seen.blended_pairs / (1e-3 * ms[name])
            row[f"{name}_fraction_of_peak"] = flops[name] / (1e6 * ms[name]) / fma
            row[f"{name}_fraction_of_bandwidth"] = moved[name] / (1e6 * ms[name]) / copy
        return row


def _timed(step: Callable[[], Any], wall: bool) -> tuple[float, Any]:
    """Milliseconds of a step, and what it returned."""
    clock = time.perf_counter if wall else time.thread_time
    start = clock()
    result = step()
    return 1e3 * (clock() - start), result


def _typical(milliseconds: list[float], threads: int) -> float:
    """Median of CPU times, lower quartile of wall times: other load makes those longer, never shorter."""
    return float(np.percentile(milliseconds, 25)) if threads > 1 else statistics.median(milliseconds)


def _time_torch(view: RasterView, threads: int) -> dict[str, float]:
    """Milliseconds of one forward and one backward."""
    import torch

    threads_before = torch.get_num_threads()
    torch.set_num_threads(threads)
    parameters, wall = torch_tiles.tensors_of(view.room), threads > 1
    forward_ms, image = _timed(lambda: torch_tiles.draw(parameters, view.camera, view.T_camera_map), wall)
    backward_ms, _ = _timed(image.sum().backward, wall)
    torch.set_num_threads(threads_before)
    return {"forward": forward_ms, "backward": backward_ms}
