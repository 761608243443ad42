"""Speed of the rasterizer on a synthetic room, beside a plain torch tile rasterizer in the same run.

Rounds of all candidates alternate, so that other load on the machine hits them alike. Time with one thread is the
thread's own CPU time (that of the process would count idle helpers that still spin), with more threads wall time; the
median over the rounds is reported.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from pipeline.geometry import so3
from pipeline.geometry.camera import PinholeCamera
from pipeline.kernels import reference
from pipeline.kernels.rasterizer import Rasterizer, available_isas
from pipeline.kernels.types import FisherSums
from pipeline.splat.gaussians import Gaussians

SIZES_PX = ((320, 240), (640, 480), (1200, 680))
THREADS = (1, 2)
GAUSSIANS = 60_000
ROOM_M = np.array([6.0, 3.0, 5.0])  # x, y down, z
SPACING_PER_SCALE, FLATNESS = 0.62, 0.13
TORCH_TILE_PX = 16
TORCH_ROUNDS = 3


def run(
    sizes: tuple[tuple[int, int], ...] = SIZES_PX,
    threads: tuple[int, ...] = THREADS,
    gaussians: int = GAUSSIANS,
    rounds: int = 7,
    with_torch: bool = True,
) -> dict[str, Any]:
    """Milliseconds of forward, backward (with pose), and Fisher information, per size, instruction set and threads.

    The portable build is slow on x86, where it must imitate fused multiply-add: one round, one thread.
    """
    room = make_room(gaussians)
    rows: list[dict[str, Any]] = []
    for width, height in sizes:
        camera = PinholeCamera(width, height, width / 2, width / 2, width / 2 - 0.5, height / 2 - 0.5)
        candidates = {
            (isa, n): _steps(Rasterizer(isa, n), room, camera)
            for isa in available_isas()
            for n in threads
            if isa != "portable" or n == min(threads)
        }
        times: dict[tuple[str, int], dict[str, list[float]]] = {c: {} for c in candidates}
        for k in range(rounds + 1):  # the first warms up
            for (isa, n), steps in candidates.items():
                if isa == "portable" and k != 1:
                    continue
                for name, step in steps.items():
                    milliseconds, _ = _timed(step, wall=n > 1)
                    if k > 0:
                        times[isa, n].setdefault(name, []).append(milliseconds)
        for (isa, n), by_step in times.items():
            medians = {name: statistics.median(values) for name, values in by_step.items()}
            rows.append({"width": width, "height": height, "implementation": isa, "threads": n, **medians})
    if with_torch:
        rows.append(_torch_row(room, *sizes[0], rows))
    return {"gaussians": gaussians, "unit": "ms", "rows": rows}


def format_table(result: dict[str, Any]) -> str:
    """The result of `run` as a table of text."""
    lines = [
        f"{result['gaussians']} Gaussians; ms; one thread: CPU time, more: wall time",
        f"{'size':>10} {'implementation':>15} {'threads':>7} {'forward':>9} {'backward':>9} {'fisher':>9}",
    ]
    for row in result["rows"]:
        size = f"{row['width']}x{row['height']}"
        cells = "".join(f" {row[name]:9.1f}" if name in row else f" {'-':>9}" for name in STEPS)
        lines.append(f"{size:>10} {row['implementation']:>15} {row['threads']:>7}{cells}")
        if "slower_than_fastest" in row:
            ratios = ", ".join(f"{name} x{value:.0f}" for name, value in row["slower_than_fastest"].items())
            lines.append(f"  plain torch against the fastest build, one thread each: {ratios}")
    return "\n".join(lines)


STEPS = ("forward", "backward", "fisher")


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
    """T_camera_map [4, 4]: from the origin towards the far corner."""
    forward = np.array([3.7, 0.4, 3.6])
    z = forward / np.linalg.norm(forward)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    return T


def _timed(step: Callable[[], Any], wall: bool) -> tuple[float, Any]:
    """Milliseconds of a step, and what it returned."""
    clock = time.perf_counter if wall else time.thread_time
    start = clock()
    result = step()
    return 1e3 * (clock() - start), result


def _steps(rasterizer: Rasterizer, room: Gaussians, camera: PinholeCamera) -> dict[str, Callable[[], object]]:
    shape, rng, T = (camera.height, camera.width), np.random.default_rng(1), view_of_room()
    d_color = np.sign(rng.normal(size=(*shape, 3))).astype(np.float32)
    d_depth = np.sign(rng.normal(size=shape)).astype(np.float32)
    precision, sums = np.ones(shape, dtype=np.float32), FisherSums(len(room))
    return {
        "forward": lambda: rasterizer.forward(room, camera, T),
        "backward": lambda: rasterizer.backward(d_color, d_depth, pose=True),
        "fisher": lambda: rasterizer.fisher(precision, precision, sums),
    }


# ---------------------------------------------------------------- plain torch, for comparison


def _torch_row(room: Gaussians, width: int, height: int, rows: list[dict[str, Any]]) -> dict[str, Any]:
    import torch

    camera = PinholeCamera(width, height, width / 2, width / 2, width / 2 - 0.5, height / 2 - 0.5)
    threads_before = torch.get_num_threads()
    torch.set_num_threads(1)
    parameters = _torch_parameters(room)
    times: dict[str, list[float]] = {"forward": [], "backward": []}
    for _ in range(TORCH_ROUNDS):
        forward = partial(torch_tiles, parameters, camera, view_of_room())
        milliseconds, image = _timed(forward, wall=False)
        times["forward"].append(milliseconds)
        times["backward"].append(_timed(image.sum().backward, wall=False)[0])
        del image
    torch.set_num_threads(threads_before)
    row: dict[str, Any] = {
        "width": width,
        "height": height,
        "implementation": "plain torch",
        "threads": 1,
        **{name: statistics.median(values) for name, values in times.items()},
    }
    same = [r for r in rows if (r["width"], r["height"], r["threads"]) == (width, height, 1)]
    if same:
        row["slower_than_fastest"] = {
            name: row[name] / min(r[name] for r in same) for name in ("forward", "backward")
        }
    return row


def _torch_parameters(room: Gaussians) -> dict[str, Any]:
    import torch

    names = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
    return {name: torch.tensor(getattr(room, name), requires_grad=True) for name in names}


def torch_tiles(parameters: dict[str, Any], camera: PinholeCamera, T_camera_map: np.ndarray) -> Any:
    """Colour and depth [H, W, 4] by the reference's formulas, tile by tile, in float32; differentiable."""
    import torch

    T = torch.tensor(T_camera_map, dtype=torch.float32)
    sigma = reference.sigma_of(parameters["quats_wxyz"], parameters["log_scales"])
    order, z, centres, conics = reference.project(parameters["means"], sigma, T[:3, :3], T[:3, 3], camera)
    opacities = torch.sigmoid(parameters["opacity_logits"][order])
    values = torch.cat([parameters["colors"][order], z[:, None]], dim=1)
    with torch.no_grad():
        reach = 2 * torch.log(255 * opacities).clamp(min=0)
        extent = torch.sqrt(reach[:, None] * torch.linalg.inv(conics).diagonal(dim1=1, dim2=2))
        low, high = centres - extent, centres + extent
        size = torch.tensor([camera.width, camera.height])
        seen = torch.nonzero(((low < size) & (high >= 0)).all(dim=1) & (reach > 0))[:, 0]
    tiles = []
    for y in range(0, camera.height, TORCH_TILE_PX):
        height = min(TORCH_TILE_PX, camera.height - y)
        in_strip = seen[(low[seen, 1] <= y + height - 1) & (high[seen, 1] >= y)]
        for x in range(0, camera.width, TORCH_TILE_PX):
            width = min(TORCH_TILE_PX, camera.width - x)
            i = in_strip[(low[in_strip, 0] <= x + width - 1) & (high[in_strip, 0] >= x)]
            rows, columns = torch.meshgrid(
                torch.arange(y, y + height), torch.arange(x, x + width), indexing="ij"
            )
            pixels = torch.stack([columns, rows], -1).reshape(-1, 2).to(torch.float32)
            weights, _ = reference.blend(pixels, centres[i], conics[i], opacities[i])
            tiles.append((weights @ values[i]).reshape(height, width, 4))
    across = -(-camera.width // TORCH_TILE_PX)
    strips = [torch.cat(tiles[i : i + across], dim=1) for i in range(0, len(tiles), across)]
    return torch.cat(strips, dim=0)
