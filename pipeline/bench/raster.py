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

import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from duagc.pipeline.base.machine import processors
from duagc.pipeline.base.progress import track
from duagc.pipeline.bench import torch_tiles
from duagc.pipeline.config.training import LossConfig
from duagc.pipeline.geometry import so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import Rasterizer, _raster, available_isas
from duagc.pipeline.kernels.types import FisherSums, Gradients, LossWeights, Statistics
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.losses import rgbd_loss

Size = tuple[int, int]

SIZES_PX: tuple[Size, ...] = ((320, 240), (640, 480), (1200, 680))
GAUSSIANS = (60_000, 300_000, 1_000_000)
THREADS = (1, 2)
ROUNDS = 7
ROOM_M = np.array([6.0, 3.0, 5.0])  # x, y down, z
SPACING_PER_SCALE, FLATNESS = 0.62, 0.13
TORCH_ROUNDS = 3
TORCH_LARGEST = 640 * 480 * 60_000  # pixels times Gaussians: seconds and gigabytes beyond
PEAK_S = 0.1  # per instruction set, number of threads and scene; the best counts

# Floating-point operations per pair, counted in the source; a multiply-add counts as two, min, compare as one. What the
# four pixels of a row of a block share counts a quarter.
LOG2_ALPHA = 10  # pixel - center 2, e = M d 4, log2 opacity - |e|^2 4
ALPHA = 17  # 2^t and 1 - 2^t 15: three to split off the exponent, five multiply-adds, two for the rest; two clamps
REPLAY = LOG2_ALPHA + ALPHA + 3  # transmittance before, from that behind by a division; weight
E_AGAIN = 3  # e for the sums
OWN = 8 + 3 + 2  # cotangent of the own value, of what lies behind; w, zero where alpha is clamped
MOMENTS = E_AGAIN + 5 + 9 / 4  # six, of w
SCREEN_MOMENTS = E_AGAIN + 9 + 23 / 4  # thirteen, of w^2
DEPTH_MOMENTS = E_AGAIN + 5 + 8 / 4  # five
SWEEP = OWN + MOMENTS + 4 * 2  # weight times the four cotangents
FLOPS = {
    "forward": ALPHA + 3 + 4 * 2,  # weight, transmittance, closed?; three colors and depth
    "backward": REPLAY + SWEEP,
    "backward_fisher": REPLAY + SWEEP + (1 + SCREEN_MOMENTS) + (2 + DEPTH_MOMENTS) + (1 + 4 * 2),
    "gauss_newton": REPLAY + 4 * 3 + 13 + SCREEN_MOMENTS + DEPTH_MOMENTS + (1 + 2 * 2) + 2 * 2,
    "contributions": REPLAY + 1,
}
FLOPS["view_gradients"] = (
    FLOPS["forward"] + SWEEP
)  # alpha and weight are there; the loss is of pixels, not of pairs
EVALUATED_FLOPS = (
    LOG2_ALPHA + 1
)  # of the pairs that a forward looks at, drawn or not: is alpha at least 1/255?
TITLES = {
    "forward": "forward",
    "backward": "backward",
    "backward_fisher": "backward + empirical",
    "gauss_newton": "gauss_newton",
    "contributions": "contributions",
    "forward_loss_backward": "forward, loss, backward",
    "view_gradients": "view_gradients",
}


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
        """Instruction sets and numbers of threads that run in this scene."""
        every = [(isa, n) for isa in self.isas for n in self.threads]
        smallest = scene == self.scenes()[0]
        return [c for c in every if not self._spares(c[0]) or (smallest and c[1] == min(self.threads))]

    def rounds_of(self, isa: str) -> int:
        """Rounds that are timed; one before them warms up."""
        return 1 if self._spares(isa) else self.rounds

    def _spares(self, isa: str) -> bool:
        return isa == "portable" and len(self.isas) > 1 and not self.portable_everywhere

    def torch_rounds(self, scene: tuple[Size, int]) -> int:
        """Rounds of plain torch in this scene."""
        (width, height), n = scene
        return min(TORCH_ROUNDS, self.rounds) if self.torch_too and width * height * n <= TORCH_LARGEST else 0


def run(plan: RasterPlan) -> dict[str, Any]:
    """Times, work and peaks as {"machine": {...}, "rows": [...]}, ready for JSON; a row per scene and candidate."""
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


class Peaks:
    """The best rates that the machine has shown so far."""

    def __init__(self, isas: Iterable[str], threads: Iterable[int]) -> None:
        self.load_average = os.getloadavg()[0]  # of the last minute: others that want the same cores
        self.fma_gflops = {isa: dict.fromkeys(threads, 0.0) for isa in isas}
        self.read_gb_per_s = dict.fromkeys(threads, 0.0)
        self.copy_gb_per_s = dict.fromkeys(threads, 0.0)

    def measure(self) -> None:
        """Try again to reach higher rates."""
        for isa, rates in self.fma_gflops.items():
            for n in rates:
                rates[n] = max(rates[n], _raster.fma_rate(isa, n, PEAK_S))
        for n in self.read_gb_per_s:
            read, copied = _raster.bandwidth(n, 2 * PEAK_S)
            self.read_gb_per_s[n] = max(self.read_gb_per_s[n], read)
            self.copy_gb_per_s[n] = max(self.copy_gb_per_s[n], copied)

    def as_dict(self) -> dict[str, Any]:
        """What ran all this, and the peaks; keys of the inner dictionaries are numbers of threads."""
        return {
            "cpu": cpu_name(),
            "cores": processors(),
            "isas": list(self.fma_gflops),
            **vars(self),
        }


def cpu_name() -> str:
    """As the system calls it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def draws(name: str) -> bool:
    """Whether a pass draws the view itself, rather than refer to what was drawn."""
    return name in ("forward", "view_gradients")


class RasterScene:
    """One image size and number of Gaussians, its candidates and their times."""

    def __init__(self, plan: RasterPlan, size: Size, gaussians: int) -> None:
        self.plan, self.size, self.gaussians = plan, size, gaussians
        candidates = plan.candidates((size, gaussians))
        self.times_ms: dict[tuple[str, int], dict[str, list[float]]] = {c: {} for c in candidates}
        self.torch_times_ms: dict[int, dict[str, list[float]]] = {n: {} for n in plan.threads}
        self.scratch_bytes: dict[tuple[str, int], int] = {}

    def rounds(self, peaks: Peaks) -> Iterator[None]:
        """Time everything once per round, after one that only warms up; yields after each."""
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
        """A row per candidate."""
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


class RasterView:
    """The room in one camera, with what the passes over it take."""

    def __init__(self, size: Size, gaussians: int) -> None:
        width, height = size
        self.room, self.T_camera_map = make_room(gaussians), view_of_room()
        self.camera = PinholeCamera(width, height, width / 2, width / 2, width / 2 - 0.5, height / 2 - 0.5)
        shape, rng = (height, width), np.random.default_rng(1)
        self.d_color = np.sign(rng.normal(size=(*shape, 3))).astype(np.float32)
        self.d_depth = np.sign(rng.normal(size=shape)).astype(np.float32)
        self.precision, self.sums = np.ones(shape, dtype=np.float32), FisherSums(gaussians)
        render = Rasterizer().forward(self.room, self.camera, self.T_camera_map)
        noise = rng.normal(0, 0.05, (*shape, 4)).astype(np.float32)
        self.color = (render.color + noise[..., :3]).clip(0, 1)
        self.depth_m = np.where(render.alpha > 0.5, render.depth / render.alpha.clip(0.5) + noise[..., 3], 0)
        self.weights = LossConfig()

    def passes(self, rasterizer: Rasterizer) -> dict[str, Callable[[], object]]:
        """The calls to time, in this order: each but the first refers to the view that is drawn last."""
        d, view = (self.d_color, self.d_depth), (self.room, self.camera, self.T_camera_map)
        weights = LossWeights(**self.weights.model_dump())

        def forward_loss_backward() -> Gradients:
            loss = rgbd_loss(rasterizer.forward(*view), self.color, self.depth_m, self.weights)
            return rasterizer.backward(loss.d_color, loss.d_depth, loss.d_alpha, pose=True)

        return {
            "forward": lambda: rasterizer.forward(*view),
            "backward": lambda: rasterizer.backward(*d, pose=True),
            "backward_fisher": lambda: rasterizer.backward(*d, pose=True, fisher=True),
            "gauss_newton": lambda: rasterizer.fisher(self.precision, self.precision, self.sums),
            "contributions": rasterizer.contributions,
            "forward_loss_backward": forward_loss_backward,
            "view_gradients": lambda: rasterizer.view_gradients(
                *view, color=self.color, depth_m=self.depth_m, loss=weights, pose=True
            ),
        }

    def array_bytes(self, name: str, visible: int) -> int:
        """Arrays of the caller that a pass reads or writes once; the sums of the Gaussians in sight both."""
        n, pixels, floats = len(self.room), self.camera.width * self.camera.height, 4
        a_sum = 8 * (45 + 3 + 1 + 1 + 1) + 4
        return {
            "forward": floats * (14 * n + 5 * pixels),
            "backward": floats * (28 * n + 4 * pixels),
            "backward_fisher": floats * (42 * n + 4 * pixels),
            "gauss_newton": floats * (14 * n + 2 * pixels) + 2 * a_sum * visible,
            "contributions": floats * 2 * n,
            "view_gradients": floats * (28 * n + 4 * pixels),
        }[name]


class RasterWork:
    """What the passes over one view have to do, counted; the same on every instruction set and number of threads."""

    def __init__(self, isa: str, view: RasterView) -> None:
        self.moved_bytes: dict[str, float] = {}
        for name in FLOPS:
            rasterizer = Rasterizer(isa)  # a new one, whose memory shows what the pass needs
            passes = view.passes(rasterizer)
            passes["forward"]()
            self.seen: Statistics = rasterizer.statistics()
            passes[name]()
            drawn = self.seen.scratch_bytes
            added = rasterizer.statistics().scratch_bytes - drawn
            # what a pass adds is written once and read once, what the forward left is read once more
            scratch = 2 * (drawn + added) if draws(name) else drawn + 2 * added
            self.moved_bytes[name] = scratch + view.array_bytes(name, self.seen.visible)

    def flops(self) -> dict[str, float]:
        """Of each pass, by `FLOPS`."""
        counts = {name: flops * self.seen.blended_pairs for name, flops in FLOPS.items()}
        for name in filter(draws, FLOPS):
            counts[name] += EVALUATED_FLOPS * self.seen.evaluated_pairs
        return counts


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


# ---------------------------------------------------------------- the room


def make_room(n: int, seed: int = 0) -> Gaussians:
    """n flat Gaussians on the walls, floor and ceiling of a room, seen from the origin near one of its corners."""
    rng = np.random.default_rng(seed)
    areas = np.array([ROOM_M[1] * ROOM_M[2], ROOM_M[0] * ROOM_M[2], ROOM_M[0] * ROOM_M[1]]).repeat(2)
    face = rng.choice(6, n, p=areas / areas.sum())
    axis, side = face // 2, face % 2
    points = rng.random((n, 3)) * ROOM_M
    points[np.arange(n), axis] = side * ROOM_M[axis]
    spacing = np.sqrt(areas.sum() / n)
    log_scales = np.log(spacing * SPACING_PER_SCALE) + rng.normal(0, 0.45, (n, 3))
    log_scales[np.arange(n), axis] += np.log(FLATNESS)
    angle = rng.uniform(0, np.pi, n)
    turn = so3.exp(angle[:, None] * np.eye(3)[axis])  # about the normal
    return Gaussians(
        ids=np.arange(n),
        anchors=np.zeros(n, dtype=np.int32),
        means=points - np.array([0.5, 1.3, 0.4]),
        quats_wxyz=so3.to_quat_wxyz(turn).astype(np.float32),
        log_scales=log_scales,
        colors=np.clip(0.5 + 0.3 * np.sin(2 * points) + rng.normal(0, 0.08, (n, 3)), 0, 1),
        opacity_logits=rng.normal(1.0, 1.6, n).astype(np.float32),
    )


def view_of_room() -> np.ndarray:
    """T_camera_map [4, 4]: from the origin toward the far corner."""
    forward = np.array([3.7, 0.4, 3.6])
    z = forward / np.linalg.norm(forward)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    return T
