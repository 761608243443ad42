"""Table of the errors of the compiled kernels against the float64 reference.

    python -m tests.kernels.accuracy [number of made scenes] [ray_plane]

Relative L2 over the fixed scenes of `scenes` and over made scenes of `drawn_scenes`, the same in every run. "Within
the bar" is the plain bar; what is beyond it must be so because of its conditioning or be counted in the last column,
see `agreement`.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict

import numpy as np

from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.kernels.agreement import Error, compare
from tests.kernels.drawn_scenes import OPACITIES, PLACES, SHAPES, made_scene
from tests.kernels.scenes import KINDS, Scene, make_scene

MADE = 200


def mixed_scene(seed: int) -> Scene:
    """Up to 40 Gaussians of all kinds in an image of up to 40x40 pixels."""
    rng = np.random.default_rng([seed, 11])
    count, (width, height) = rng.integers(1, 41), rng.integers(1, 41, 2).tolist()
    kinds = [tuple(str(rng.choice(names)) for names in (SHAPES, PLACES, OPACITIES)) for _ in range(count)]
    fx, fy, cx, cy = rng.uniform([8, 8, -0.5, -0.5], [64, 64, 1.5, 1.5]) * [1, 1, width, height]
    numbers = np.array([fx, fy, cx, cy], dtype=np.float32).tolist()
    return made_scene(seed, kinds, PinholeCamera(width, height, *numbers))


def group_of(name: str) -> str | None:
    """The row of an output; None for parts of other rows."""
    if re.search(r" column \d+$", name):
        return None
    return re.sub(r"^block of \d+$", "block of one Gaussian", name)


def main() -> None:
    fixed: dict[str, list[Error]] = defaultdict(list)
    made: dict[str, list[Error]] = defaultdict(list)
    count = int(sys.argv[1]) if len(sys.argv) > 1 else MADE
    depth_kind: DepthKind = "ray_plane" if "ray_plane" in sys.argv else "blended"
    for scenes, errors in (
        ((make_scene(kind) for kind in KINDS), fixed),
        ((mixed_scene(seed) for seed in range(count)), made),
    ):
        for scene in scenes:
            for error in compare(scene, depth_kind=depth_kind):
                group = group_of(error.name)
                if group is not None:
                    errors[group].append(error)
    print("| result | fixed scenes, worst | made scenes: median | 99 % | within the bar | unexplained |")
    print("|---|---|---|---|---|---|")
    for group in fixed:
        worst = max(error.relative for error in fixed[group] if error.within_bar)
        found = np.array([error.relative for error in made[group]])
        print(
            f"| {group} | {worst:.1e} | {np.median(found):.1e} | {np.quantile(found, 0.99):.1e}"
            f" | {np.mean([error.within_bar for error in made[group]]):.1%}"
            f" | {sum(not error.passes for error in fixed[group] + made[group])} |"
        )


if __name__ == "__main__":
    main()
