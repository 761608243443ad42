"""Maps of a run for other programs: splats, or points with what is known of each; whole, or cut into tiles."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.atomic_folder import FolderKind, check_apart, new_folder
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import new_file
from duagc.pipeline.base.ply_points import write_points
from duagc.pipeline.evaluation.pixel_deviation import stated_in_world
from duagc.pipeline.geometry.view_extent import radii_m
from duagc.pipeline.messages import GaussianMap
from duagc.pipeline.runs.folder import RobotRun, RunFolder
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.ply import write_ply

FORMAT, SCHEMA = "duagc.export", 1
EXPORT_FILE = "export.json"
EXPORT = FolderKind("an export", (EXPORT_FILE,), (EXPORT_FILE, "*.ply", "*/*.ply"))

SMALLEST_TILE_M = 0.1

Kind = Literal["splats", "points"]


@dataclass(frozen=True)
class ExportPlan:
    """What is written.

    Attributes:
        kind: `splats`, every Gaussian, for splat viewers; `points`, a point cloud with normals and deviations.
        tile_m: edge of the cubes that a map is cut into; None: one file a map.
        robots: whose maps; empty: those of all robots.
        min_opacity: points are made of Gaussians of at least this peak opacity.
    """

    kind: Kind = "splats"
    tile_m: float | None = None
    robots: tuple[str, ...] = ()
    min_opacity: float = 0.5


def export(run_folder: Path, out: Path, plan: ExportPlan, *, force: bool = False) -> list[Path]:
    """Write the final map of each robot: the refined one, or the fused one where it met no other robot.

    Args:
        run_folder: a run.
        out: folder to write; `export.json` lists its files with what each holds.
        plan: what.
        force: replace an export that is there.

    Returns:
        The files of the maps, by robot and tile.

    Raises:
        DuagError: no such run or robot, `out` exists, or a map lacks what is asked for.
    """
    if plan.tile_m is not None and not SMALLEST_TILE_M <= plan.tile_m < np.inf:
        raise DuagError(f"--tile: found {plan.tile_m:g}, expected {SMALLEST_TILE_M:g} m or more")
    check_apart(out, [run_folder])
    run = RunFolder(run_folder)
    names = tuple(dict.fromkeys(plan.robots)) or tuple(run.robots)
    for name in names:
        if name not in run.robots:
            raise DuagError(f"{run_folder}: has no robot {name}, expected one of {', '.join(run.robots)}")
    with new_folder(out, force, EXPORT) as folder:
        robots = {name: _export_robot(run, run.robots[name], folder, plan) for name in names}
        description = {
            "format": FORMAT,
            "schema": SCHEMA,
            "kind": plan.kind,
            "axes": "x right, y down, z forward; meters",
            "tile_m": plan.tile_m,
            "robots": robots,
        }
        with new_file(folder / EXPORT_FILE) as part:
            part.write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")
    return [out / part["file"] for robot in robots.values() for part in robot["files"]]


def tiles(
    means: NDArray[np.float32], edge_m: float
) -> Iterator[tuple[tuple[int, int, int], NDArray[np.int64]]]:
    """Cubes that hold something, with the rows in each, ascending; in order of their places.

    Args:
        means: [n, 3].
        edge_m: of a cube; one has a corner at the origin.
    """
    if not len(means):
        return
    places = np.floor(means.astype(np.float64) / edge_m).astype(np.int64)
    cubes, cube = np.unique(places, axis=0, return_inverse=True)
    order = np.argsort(cube.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(cube.reshape(-1), minlength=len(cubes)))
    places_of = (tuple(cube) for cube in cubes.tolist())
    yield from zip(places_of, np.split(order, ends[:-1]), strict=True)


def _export_robot(run: RunFolder, robot: RobotRun, folder: Path, plan: ExportPlan) -> dict[str, Any]:
    shown = robot.refined_map or robot.fused_map
    gaussians = shown.gaussians
    columns = _points(run, robot, shown) if plan.kind == "points" else {}
    rows = np.arange(len(gaussians))
    if plan.kind == "points":
        rows = np.flatnonzero(columns["opacity"] >= plan.min_opacity)
        if not len(gaussians):
            raise DuagError(f"{robot.folder}: its final map has no Gaussian, expected some for --points")
        if not len(rows):
            most = columns["opacity"].max()
            raise DuagError(
                f"{robot.folder}: the most opaque of {len(gaussians)} Gaussians has {most:.2f}, "
                f"expected --min-opacity below {plan.min_opacity:g}"
            )
    parts: list[tuple[str, tuple[int, int, int] | None, NDArray[np.int64]]]
    if plan.tile_m is None:
        parts = [(f"{robot.robot}.ply", None, rows)]
    else:
        (folder / robot.robot).mkdir()
        parts = [
            (f"{robot.robot}/tile_{i:+05d}_{j:+05d}_{k:+05d}.ply", (i, j, k), rows[inside])
            for (i, j, k), inside in tiles(gaussians.means[rows], plan.tile_m)
        ]
    files = []
    for name, tile, chosen in parts:
        part = gaussians.select(chosen)
        if plan.kind == "points":
            colors = np.rint(np.clip(part.colors, 0.0, 1.0) * 255.0).astype(np.uint8)
            of_part = {key: values[chosen] for key, values in columns.items()}
            write_points(folder / name, part.means, colors=colors, **of_part)
        else:
            write_ply(folder / name, part)
        low, high = _drawn(part) if len(part) else (None, None)
        files.append({"file": name, "tile": tile, "gaussians": len(part), "low_m": low, "high_m": high})
    return {"frame": "world", "component": list(robot.component), "files": files}


def _drawn(part: Gaussians) -> tuple[list[float], list[float]]:
    """Corners of the box around all that Gaussians draw, in millimeters' steps outward."""
    means, reach = part.means.astype(np.float64), radii_m(part.log_scales).astype(np.float64)[:, None]
    low = np.floor((means - reach).min(axis=0) * 1e3) / 1e3
    high = np.ceil((means + reach).max(axis=0) * 1e3) / 1e3
    return low.tolist(), high.tolist()


def _points(run: RunFolder, robot: RobotRun, shown: GaussianMap) -> dict[str, NDArray[np.float32]]:
    """What a point cloud says of each Gaussian besides place and color: `normals`, `sigma_m`, `opacity`."""
    gaussians = shown.gaussians
    cameras = [run.robots[name].trajectory.positions for name in robot.component if name in run.robots]
    sigma_m = stated_in_world(robot, shown).sigma_m
    sigma_m = np.where(np.isfinite(sigma_m), sigma_m, np.nan)  # nothing is stated of these
    return {
        "normals": _toward(gaussians.normals(), gaussians.means, np.concatenate(cameras)).astype(np.float32),
        "sigma_m": sigma_m.astype(np.float32),
        "opacity": gaussians.opacities().astype(np.float32),
    }


def _toward(
    normals: NDArray[np.float64], means: NDArray[np.float32], cameras: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Normals [n, 3] with the sign that points to the nearest camera."""
    from scipy.spatial import KDTree

    _, nearest = KDTree(cameras).query(means)
    away = np.einsum("ij,ij->i", normals, cameras[nearest] - means) < 0
    return np.where(away[:, None], -normals, normals)
