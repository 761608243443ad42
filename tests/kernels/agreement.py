"""How far the compiled kernels are from the float64 reference, and how far float32 may be from it.

A result in float32 can at best be the exact result of inputs that are off by a last digit. Where that already moves
a derivative by more than the bar, as it does for a needle longer than the image, no kernel can keep the bar. So an
error passes if it is below

    max(bar * |exact|, SLACK * moved),

`moved` being the largest change of the exact result when every number of the input moves up or down by half a unit in
the last place of float32: the result must be exact for inputs that are off by four units. In made scenes 99 % of the
arrays are below the bar itself. The second term also takes care of derivatives that vanish identically, as those of
a ball by its orientation.

Derivatives are sums over pixels of sums over screen numbers, and the diagonals sums of squares of the latter. A
Gaussian may be seen only where they cancel, as a needle across an image of two pixels: for it the floor is two units
in the last place of the terms without their signs. It decides where a derivative is 42 times smaller than its terms,
and a diagonal 420 times.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from pipeline.geometry.camera import PinholeCamera
from pipeline.kernels import FisherSums, Rasterizer
from pipeline.kernels.reference import ReferenceRasterizer
from tests.kernels.scenes import Scene

PARAMETERS = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
FAMILIES = {
    "means": slice(0, 3),
    "quaternions": slice(3, 7),
    "log-scales": slice(7, 10),
    "colours": slice(10, 13),
    "opacity": slice(13, 14),
}
IMAGE_BAR = 1e-5
GRADIENT_BAR = 1e-5
INFORMATION_BAR = 1e-4
SLACK = 8.0
HALF_ULP = 2.0**-24
DRAWS = 10
ROUNDING = 2 * 2.0**-23

Outputs = dict[str, tuple[np.ndarray, float, float]]
"""Name to array, bar, and floor: what counts as zero."""


class Float64Gaussians:
    """The arrays of some Gaussians, free of the rounding to float32; for the reference only."""

    def __init__(self, gaussians: Any) -> None:
        for name in PARAMETERS:
            setattr(self, name, getattr(gaussians, name).astype(np.float64))

    def __len__(self) -> int:
        return len(self.means)


def moved(scene: Scene, seed: int) -> tuple[Float64Gaussians, PinholeCamera, np.ndarray]:
    """Gaussians, camera and pose, every number of them half a unit in the last place off, up or down."""
    rng = np.random.default_rng(seed)

    def move(values: Any) -> Any:
        return values * (1 + HALF_ULP * rng.choice([-1.0, 1.0], np.shape(values)))

    gaussians, camera, T = Float64Gaussians(scene.gaussians), scene.camera, scene.T_camera_map.copy()
    for name in PARAMETERS:
        setattr(gaussians, name, move(getattr(gaussians, name)))
    fx, fy, cx, cy = move(np.array([camera.fx, camera.fy, camera.cx, camera.cy])).tolist()
    T[:3] = move(T[:3])
    return gaussians, PinholeCamera(camera.width, camera.height, fx, fy, cx, cy), T


def outputs(
    rasterizer: Any, scene: Scene, where: np.ndarray, inputs: tuple[Any, ...] | None = None
) -> Outputs:
    """Everything about one view, as far as it depends on the pixels `where`; `inputs` instead of the scene's own."""
    gaussians, camera, T = inputs or (scene.gaussians, scene.camera, scene.T_camera_map)
    render = rasterizer.forward(gaussians, camera, T, scene.background)
    out: Outputs = {name: (image[where], IMAGE_BAR, 0.0) for name, image in vars(render).items()}
    cotangents = scene.image(1, 3) * where[..., None], scene.image(2) * where, scene.image(3) * where
    gradients = rasterizer.backward(*cotangents, pose=True, fisher=True)
    of_gradients, of_pose, of_squares = (
        np.zeros((len(gaussians), 14)),
        np.zeros(6),
        np.zeros((len(gaussians), 14)),
    )
    if isinstance(rasterizer, ReferenceRasterizer):
        of_gradients, of_pose = rasterizer.gradient_terms(*cotangents)
        of_squares = rasterizer.empirical_terms(*cotangents)
    for name, columns in zip(PARAMETERS, FAMILIES.values(), strict=True):
        out[f"by {name}"] = (getattr(gradients, name), GRADIENT_BAR, rounding_of(of_gradients[:, columns]))
    out["by pose"] = (gradients.pose, GRADIENT_BAR, rounding_of(of_pose))
    out.update(diagonal_outputs("empirical", gradients.fisher_diagonal, of_squares))

    sums = FisherSums(len(gaussians))
    rasterizer.fisher(scene.image(4, low=0.0) * where, scene.image(5, low=0.0) * where, sums)
    blocks = sums.geometry_matrices()
    for name, rows, columns in (
        ("mm", slice(0, 3), slice(0, 3)),
        ("ms", slice(0, 3), slice(3, 9)),
        ("ss", slice(3, 9), slice(3, 9)),
    ):
        out[f"block {name}"] = (blocks[:, rows, columns], INFORMATION_BAR, 0.0)
    for i, block in enumerate(blocks):  # one at a time too: a weak Gaussian must not hide behind a strong one
        out[f"block of {i}"] = (block, INFORMATION_BAR, 0.0)
    out["information of colour"] = (sums.color, INFORMATION_BAR, 0.0)
    out["information of opacity"] = (sums.opacity, INFORMATION_BAR, 0.0)
    out["observations"] = (sums.observations.astype(np.float64), 0.0, 0.0)
    return out


def diagonal_outputs(name: str, diagonal: np.ndarray, terms: np.ndarray) -> Outputs:
    """A diagonal [n, 14] by families and by columns; terms: [n, 14], of the floor."""
    out: Outputs = {}
    for family, columns in FAMILIES.items():
        out[f"{name} {family}"] = (diagonal[:, columns], INFORMATION_BAR, rounding_of(terms[:, columns]))
    for k in range(14):
        out[f"{name} column {k}"] = (diagonal[:, k], INFORMATION_BAR, rounding_of(terms[:, k]))
    return out


def rounding_of(terms: np.ndarray) -> float:
    return ROUNDING * float(np.linalg.norm(terms))


@dataclasses.dataclass(frozen=True)
class Error:
    """One output. relative: error over norm; within_bar: without regard to its conditioning; passes: with it."""

    name: str
    relative: float
    within_bar: bool
    passes: bool


def compare(scene: Scene, isa: str = "auto") -> Iterator[Error]:
    """The error of every output; inputs are moved only if one is beyond its bar."""
    reference = ReferenceRasterizer()
    reference.forward(scene.gaussians, scene.camera, scene.T_camera_map, scene.background)
    where = reference.decided()
    wanted, found = outputs(reference, scene, where), outputs(Rasterizer(isa), scene, where)
    errors = {name: float(np.linalg.norm(found[name][0] - exact)) for name, (exact, _, _) in wanted.items()}
    limits = {
        name: max(bar * float(np.linalg.norm(exact)), floor) for name, (exact, bar, floor) in wanted.items()
    }
    changes = dict.fromkeys(wanted, 0.0)
    if any(errors[name] > limits[name] for name in wanted):
        for seed in range(DRAWS):
            other = outputs(reference, scene, where, moved(scene, seed))
            for name, (exact, _, _) in wanted.items():
                changes[name] = max(changes[name], float(np.linalg.norm(other[name][0] - exact)))
    for name, error in errors.items():
        norm = float(np.linalg.norm(wanted[name][0]))
        yield Error(
            name,
            error / norm if norm else float(error > 0),
            error <= limits[name],
            error <= max(limits[name], SLACK * changes[name]),
        )
