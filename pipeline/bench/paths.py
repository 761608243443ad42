"""What the planners of paradigms reach: overlap, speed and distances, over scenes and numbers of robots. No images."""

import tempfile
import time
from collections.abc import Iterable
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from duagc.converters.simulate.sensors.degradations import FRAME_RATE_HZ
from duagc.converters.simulate.settings import camera_of, scene_of
from duagc.converters.simulate.simulated_scenes import set_up
from duagc.converters.simulate.trajectories import loops, paradigms
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.bench.tables import markdown
from duagc.pipeline.geometry import se3

Row = dict[str, Any]


def run(
    scenes: Iterable[str],
    figures: Iterable[str],
    robots: Iterable[int],
    overlaps: Iterable[float],
    *,
    frames: int,
    seed: int,
    up: str,
) -> list[Row]:
    """Plan every combination, and measure it as `simulate` does.

    Args:
        scenes: names, or folders of meshes.
        figures: paradigms of the paths.
        robots: numbers of robots.
        overlaps: shares of the view that neighbors are asked to see, 0..1.
        frames: per robot.
        seed: of scenes and paths.
        up: axis of meshes that is up: y, z or auto.

    Returns:
        Rows with scene, paradigm, robots, asked; then `refused` (why), or shared (mean of all neighbors),
        shared_from and shared_to, speed_m_s (slowest, fastest robot), of_usual_speed (likewise), clearance_m,
        robots_apart_m; and cpu_s.
    """
    rows = []
    camera = camera_of((480, 360))
    for scene in scenes:
        about = scene_of(scene, up)[1]
        with tempfile.TemporaryDirectory(prefix="duagc-scene-") as cache:
            stage = set_up(scene, about.get("up", ""), seed, Path(cache), as_meshes=False)
            small = stage.renderer(camera.scaled(*loops.OVERLAP_IMAGE))
            stage.free_space()
            for figure, count, asked in track(list(product(figures, robots, overlaps)), f"plan {scene}"):
                row: Row = {"scene": about["scene"], "paradigm": figure, "robots": count, "asked": asked}
                rows.append(row)
                start = time.process_time()
                try:
                    ways = paradigms.plan(
                        stage, figure, robots=count, frames=frames, overlap=asked, camera=camera, seed=seed
                    )
                except DuagError as error:
                    row["refused"] = str(error)
                    continue
                finally:
                    row["cpu_s"] = time.process_time() - start
                shared = [loops.shared_view(small, a, b) for a, b in pairwise(ways)]
                step_m = [float(se3.distance(way[:-1], way[1:])[0].mean()) for way in ways]
                row |= {
                    "shared": float(np.mean(shared)),
                    "shared_from": min(shared),
                    "shared_to": max(shared),
                    "speed_m_s": [FRAME_RATE_HZ * step for step in (min(step_m), max(step_m))],
                    "of_usual_speed": [step / stage.step_m for step in (min(step_m), max(step_m))],
                    "clearance_m": min(float(stage.clearance(way[:, :3, 3]).min()) for way in ways),
                    "robots_apart_m": paradigms.least_apart(ways),
                }
    return rows


def format_table(rows: list[Row]) -> str:
    """A row per scene and paradigm, a column per number of robots: worst overlap, slowest and fastest robot.

    Args:
        rows: of scenes, paradigms and numbers of robots; "refused" where no plan was found.
    """
    numbers = sorted({row["robots"] for row in rows})
    by_figure: dict[tuple[str, str], dict[int, list[Row]]] = {}
    for row in rows:
        by_figure.setdefault((row["scene"], row["paradigm"]), {}).setdefault(row["robots"], []).append(row)
    lines = markdown(
        ["scene", "paradigm", *(f"{n} robots" for n in numbers)],
        [[*key, *(_cell(found.get(n, [])) for n in numbers)] for key, found in by_figure.items()],
    )
    planned = [row for row in rows if "refused" not in row]
    if planned:
        lines += [
            "",
            f"Least distance to the scene {min(row['clearance_m'] for row in planned):.2f} m, between robots "
            f"{min(row['robots_apart_m'] for row in planned):.2f} m; processor time of a plan: median "
            f"{np.median([row['cpu_s'] for row in rows]):.1f} s, most {max(row['cpu_s'] for row in rows):.1f} s.",
        ]
    lines += ["", *dict.fromkeys(row["refused"] for row in rows if "refused" in row)]
    return "\n".join(lines).rstrip()


def _cell(rows: list[Row]) -> str:
    """The worst overlap of rows that differ in what was asked for, and their speeds."""
    planned = [row for row in rows if "refused" not in row]
    if not planned:
        return "no room"
    worst = max(planned, key=lambda row: abs(row["shared"] - row["asked"]))
    speeds = [share for row in planned for share in row["of_usual_speed"]]
    refused = f", {len(rows) - len(planned)} refused" if len(planned) < len(rows) else ""
    return f"{worst['asked']:.1f}: {worst['shared']:.2f}; {100 * min(speeds):.0f} to {100 * max(speeds):.0f} %{refused}"
