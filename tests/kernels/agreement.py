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

from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import FisherSums, Gradients, LossWeights, Rasterizer, Render
from duagc.pipeline.splat.information import unpack_geometry
from duagc.pipeline.splat.losses import rgbd_loss
from tests.kernels.rounding_reference import RoundingReference
from tests.kernels.scenes import Scene

PARAMETERS = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
FAMILIES = {
    "means": slice(0, 3),
    "quaternions": slice(3, 7),
    "log-scales": slice(7, 10),
    "colors": slice(10, 13),
    "opacity": slice(13, 14),
}
IMAGE_BAR = 1e-5
GRADIENT_BAR = 1e-5
INFORMATION_BAR = 1e-4
SLACK = 8.0
HALF_ULP = 2.0**-24
DRAWS = 10
LOSS = LossWeights(color_huber=0.1, depth_weight=0.5, depth_huber_m=0.02, alpha_weight=0.02)
EXPOSURE = (0.1, -0.05)
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
    rasterizer: Any,
    scene: Scene,
    where: np.ndarray,
    depth_kind: DepthKind = "blended",
    inputs: tuple[Any, ...] | None = None,
    floors: bool = False,
) -> Outputs:
    """Everything about one view of the pixels `where`; `inputs` instead of the scene's own. floors: the reference's."""
    view = inputs or (scene.gaussians, scene.camera, scene.T_camera_map)
    options: dict[str, Any] = {"depth_kind": depth_kind, "mask": None if where.all() else where}
    render = rasterizer.forward(*view, scene.background, **options)
    out: Outputs = {name: (image, IMAGE_BAR, 0.0) for name, image in vars(render).items()}
    weights, pixels = rasterizer.contributions()
    out["weights"], out["pixels"] = (weights, IMAGE_BAR, 0.0), (pixels.astype(np.float64), 0.0, 0.0)

    cotangents = scene.image(1, 3), scene.image(2), scene.image(3)
    gradients = rasterizer.backward(*cotangents, pose=True, fisher=True)
    out.update(gradient_outputs("by", rasterizer, gradients, cotangents, floors))
    squares = rasterizer.empirical_terms(*cotangents) if floors else np.zeros((len(weights), 14))
    out.update(diagonal_outputs("empirical", gradients.fisher_diagonal, squares))
    out.update(information_outputs(rasterizer, scene, len(weights), floors))
    out.update(loss_outputs(rasterizer, scene, view, options, floors))
    return out


def gradient_outputs(
    name: str, rasterizer: Any, gradients: Gradients, cotangents: tuple[Any, ...], floors: bool
) -> Outputs:
    """The arrays of `gradients`."""
    n = len(gradients.opacity_logits)
    terms, of_pose = np.zeros((n, 14)), np.zeros(6)
    if floors:
        terms, of_pose = rasterizer.gradient_terms(*cotangents)
    out: Outputs = {f"{name} pose": (gradients.pose, GRADIENT_BAR, rounding_of(of_pose))}
    for parameter, columns in zip(PARAMETERS, FAMILIES.values(), strict=True):
        floor = rounding_of(terms[:, columns])
        out[f"{name} {parameter}"] = (getattr(gradients, parameter), GRADIENT_BAR, floor)
    return out


def information_outputs(rasterizer: Any, scene: Scene, n: int, floors: bool) -> Outputs:
    """The `gauss_newton` information of the last view, in blocks and one Gaussian at a time."""
    precisions, sums = (scene.image(4, low=0.0), scene.image(5, low=0.0)), FisherSums(n, diagonal=True)
    rasterizer.fisher(*precisions, sums, residual=scene.image(6, low=0.0))
    blocks, mean, log = unpack_geometry(sums.geometry), slice(0, 3), slice(3, 9)
    out: Outputs = {}
    for name, rows, columns in (("mm", mean, mean), ("ms", mean, log), ("ss", log, log)):
        out[f"block {name}"] = (blocks[:, rows, columns], INFORMATION_BAR, 0.0)
    for i, block in enumerate(blocks):  # one at a time too: a weak Gaussian must not hide behind a strong one
        out[f"block of {i}"] = (block, INFORMATION_BAR, 0.0)
    out["information of color"] = (sums.color, INFORMATION_BAR, 0.0)
    out["information of opacity"] = (sums.opacity, INFORMATION_BAR, 0.0)
    out["observations"] = (sums.observations.astype(np.float64), 0.0, 0.0)
    out["weight"], out["residual"] = (sums.weight, IMAGE_BAR, 0.0), (sums.residual, IMAGE_BAR, 0.0)

    terms = rasterizer.information_terms(*precisions) if floors else np.zeros((n, 14))
    assert sums.diagonal is not None
    out.update(diagonal_outputs("gauss_newton", sums.diagonal, terms))
    full = rasterizer.full_fisher(*precisions)
    for a, rows in FAMILIES.items():
        for b, columns in FAMILIES.items():
            # |F_ij| <= sqrt(F_ii F_jj): the terms of what lies off the diagonal
            floor = np.sqrt(rounding_of(terms[:, rows]) * rounding_of(terms[:, columns]))
            out[f"full {a} {b}"] = (full[:, rows, columns], INFORMATION_BAR, float(floor))
    return out


def loss_outputs(
    rasterizer: Any, scene: Scene, view: tuple[Any, ...], options: dict[str, Any], floors: bool
) -> Outputs:
    """The loss of the view against made images, and its derivatives."""
    rng, shape = np.random.default_rng(7), (scene.camera.height, scene.camera.width)
    color = rng.random((*shape, 3)).astype(np.float32)
    depth_m = rng.uniform(0.5, 4.0, shape).astype(np.float32)
    depth_m[rng.random(shape) < 0.2] = 0.0
    loss, gradients = rasterizer.view_gradients(
        *view,
        color=color,
        depth_m=depth_m,
        loss=LOSS,
        exposure=EXPOSURE,
        background=scene.background,
        pose=True,
        **options,
    )
    # of the image that was drawn: slopes are differences of colors, in which errors within its bar grow
    render = rasterizer.forward(*view, scene.background, **options)
    exact = Render(*(image.astype(np.float64) for image in vars(render).values()))
    wanted = rgbd_loss(exact, color, depth_m, LOSS, exposure=EXPOSURE, mask=options["mask"])
    cotangents = (wanted.d_color, wanted.d_depth, wanted.d_alpha) if floors else ()
    out: Outputs = {"loss": (np.array([loss.value, loss.color, loss.depth]), IMAGE_BAR, 0.0)}
    off = np.array(loss.d_exposure) - np.array(wanted.d_exposure)
    limit = max(GRADIENT_BAR * float(np.linalg.norm(wanted.d_exposure)), ROUNDING)  # means of slopes up to 1
    out["loss by exposure"] = (off, 0.0, limit)
    out.update(gradient_outputs("loss by", rasterizer, gradients, cotangents, floors))
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


def compare(scene: Scene, isa: str = "auto", depth_kind: DepthKind = "blended") -> Iterator[Error]:
    """The error of every output; inputs are moved only until all are explained."""
    reference = RoundingReference()
    reference.forward(scene.gaussians, scene.camera, scene.T_camera_map, scene.background)
    where = reference.decided()
    wanted = outputs(reference, scene, where, depth_kind, floors=True)
    found = outputs(Rasterizer(isa), scene, where, depth_kind)
    errors = {name: float(np.linalg.norm(found[name][0] - exact)) for name, (exact, _, _) in wanted.items()}
    limits = {
        name: max(bar * float(np.linalg.norm(exact)), floor) for name, (exact, bar, floor) in wanted.items()
    }
    changes = dict.fromkeys(wanted, 0.0)
    for seed in range(DRAWS):
        if all(errors[name] <= max(limits[name], SLACK * changes[name]) for name in wanted):
            break
        other = outputs(reference, scene, where, depth_kind, moved(scene, seed))
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
