"""Views of small scenes, and what the tests of them compare."""

import numpy as np

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels.reference import ReferenceRasterizer
from duagc.pipeline.kernels.types import Gradients
from tests.kernels.agreement import PARAMETERS
from tests.kernels.scenes import Scene, make_scene


def draw(rasterizer, scene: Scene, **options):
    return rasterizer.forward(scene.gaussians, scene.camera, scene.T_camera_map, scene.background, **options)


def tiny(kind="plain", n=6) -> Scene:
    """35 pixels, six Gaussians: small enough to differentiate number by number."""
    scene = make_scene(kind, n=n)
    return Scene(scene.gaussians, PinholeCamera(7, 5, 5.0, 5.5, 3.2, 2.1), scene.T_camera_map)


def flat(gradients: Gradients) -> np.ndarray:
    """[n, 14] of the five arrays."""
    n = len(gradients.means)
    return np.concatenate([getattr(gradients, name).reshape(n, -1) for name in PARAMETERS], axis=1)


def assert_same_gradients(
    found: Gradients, wanted: Gradients, rtol: float, drift: dict[str, float] | None = None
) -> None:
    """Relative L2 of every array; the quaternions of balls have no derivative but rounding. drift: allowed too."""
    smallest = 1e-12 * np.linalg.norm(flat(wanted))
    for name, exact in vars(wanted).items():
        if exact is not None:
            error = np.linalg.norm(getattr(found, name) - exact)
            assert error <= max(rtol * np.linalg.norm(exact), smallest, (drift or {}).get(name, 0.0)), name


def checkerboard(scene: Scene) -> np.ndarray:
    """A mask that cuts through blocks and tiles."""
    rows, columns = np.indices((scene.camera.height, scene.camera.width))
    return (rows // 2 + columns // 3) % 2 == 0


def tolerance(rasterizer) -> float:
    """Relative to a norm; float32 squares of derivatives of float32."""
    return 1e-12 if isinstance(rasterizer, ReferenceRasterizer) else 1e-4


def measured_images(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """A color and a depth image with holes, near what is drawn, so that residuals lie on both sides of the widths."""
    reference, rng = ReferenceRasterizer(), np.random.default_rng(11)
    render = draw(reference, scene)
    color = render.color + rng.normal(scale=0.15, size=render.color.shape)
    depth = render.depth / np.maximum(render.alpha, 1e-3) + rng.normal(scale=0.05, size=render.depth.shape)
    depth[rng.random(depth.shape) < 0.2] = 0.0
    return color.astype(np.float32), np.maximum(depth, 0.0).astype(np.float32)
