"""What a structured-light depth camera (a first Kinect) and a small color sensor make of exact images.

Disparity between projector and camera is measured in eighths of a pixel, with an error that neighboring pixels
share; there is no depth where the projector does not reach, at grazing incidence, too near or too far; at a depth
edge some pixels mix both sides.

Source of the axial error: Nguyen, Izadi, Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and
tracking", 3DIMPVT 2012, sigma(z) = 0.0012 + 0.0019 (z - 0.4)^2; it contains the quantization. Focal length, base line
and quantum are those of the sensor, whatever the size of the simulated image.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.inverse_depth import inverse_or_zero

SENSOR_FOCAL_PX = 580.0
BASELINE_M = 0.075
DISPARITY_STEP_PX = 0.125
NEAREST_M, FARTHEST_M = 0.4, 6.0
CORRELATION_OF_WIDTH = 1.0 / 480  # sigma of the blur of the error, as a share of the image width
GRAZING_COSINE = (0.09, 0.30)  # never below the first, always above the second
EDGE_STEP = 0.04  # relative step of depth within 3 x 3 pixels that makes a depth edge
MIXED_SHARE = 0.35
GRAY_SIGMA = 0.01  # of full scale


def axial_sigma_m(depth_m: Array) -> Array:
    """Standard deviation (m) of the measured depth at depths (m) of any shape.

    Args:
        depth_m: [...], meters.
    """
    return 0.0012 + 0.0019 * (depth_m - 0.4) ** 2


def depth_step_m(depth_m: Array) -> Array:
    """Distance (m) between neighboring measurable depths around depths (m) of any shape.

    Args:
        depth_m: [...], meters.
    """
    return DISPARITY_STEP_PX * depth_m**2 / (SENSOR_FOCAL_PX * BASELINE_M)


def kinect_depth(depth: Array, camera: PinholeCamera, rng: np.random.Generator) -> Array:
    """Measured depth [h, w] (m, 0 = none) of an exact depth image.

    Args:
        depth: exact, [h, w], meters, 0 = nothing there.
        camera: of the image.
        rng: source of the errors.
    """
    smooth, spots, dice = (
        rng.standard_normal(depth.shape),
        rng.standard_normal(depth.shape),
        rng.random(depth.shape),
    )
    blur = max(0.4, CORRELATION_OF_WIDTH * camera.width)
    error, spots = _unit_variance(smooth, blur), _unit_variance(spots, 1.5 * blur)
    valid = depth > 0
    z = _mixed(np.where(valid, depth, FARTHEST_M), dice)
    sigma = np.sqrt(axial_sigma_m(z) ** 2 - depth_step_m(z) ** 2 / 12)
    scale = SENSOR_FOCAL_PX * BASELINE_M
    disparity = scale / z + error * sigma * scale / z**2
    measured = scale / np.maximum(
        DISPARITY_STEP_PX * np.rint(disparity / DISPARITY_STEP_PX), DISPARITY_STEP_PX
    )
    valid &= ~_shadowed(depth, camera)
    low, high = GRAZING_COSINE
    valid &= _incidence_cosine(depth, camera) > low + (high - low) * np.clip(0.5 + 0.5 * spots, 0, 1)
    valid &= (measured > NEAREST_M) & (measured < FARTHEST_M)
    return np.where(valid, measured, 0.0)


def quantized(depth: Array, step_m: float) -> Array:
    """Depth (m, 0 = none), of any shape, in the steps of a sensor that measures disparity.

    Disparity is rounded to whole quanta, so neighboring depths around z are step_m z^2 apart; beyond half a quantum
    nothing is measured.

    Args:
        depth: before.
        step_m: distance between neighboring depths at 1 m; 0: none.
    """
    if step_m == 0:
        return depth
    inverse = inverse_or_zero(depth)
    quanta = np.rint(inverse / step_m)
    return np.where(quanta > 0, 1 / (step_m * np.maximum(quanta, 1.0)), 0.0)


def gray_noise(color: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A color image with independent noise of its brightness.

    Args:
        color: [h, w, 3].
        rng: source of the noise.
    """
    noise = 255 * GRAY_SIGMA * rng.standard_normal(color.shape[:2])
    return np.clip(np.rint(color + noise[..., None]), 0, 255).astype(np.uint8)


def _unit_variance(white: Array, sigma_px: float) -> Array:
    """White noise [h, w] blurred to neighbors, rescaled to unit variance."""
    size = 2 * int(np.ceil(4 * sigma_px)) + 1
    kernel = cv2.getGaussianKernel(size, sigma_px)
    return cv2.sepFilter2D(white, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101) / np.sum(kernel**2)


def _mixed(depth: Array, dice: Array) -> Array:
    """Depth in which some pixels at depth edges lie between the nearest and the farthest of their neighbors."""
    window = np.ones((3, 3), dtype=np.uint8)
    near, far = cv2.erode(depth, window), cv2.dilate(depth, window)
    mixes = (far - near > EDGE_STEP * near) & (dice < MIXED_SHARE)
    share = dice / MIXED_SHARE
    return np.where(mixes, 1 / (share / near + (1 - share) / far), depth)


def _shadowed(depth: Array, camera: PinholeCamera) -> NDArray[np.bool_]:
    """Pixels that the projector, a base line to the left of the camera, cannot reach past nearer things."""
    inverse = inverse_or_zero(depth)
    column = np.arange(camera.width) + camera.fx * BASELINE_M * inverse
    return column + 0.5 < np.maximum.accumulate(column, axis=1)


def _incidence_cosine(depth: Array, camera: PinholeCamera) -> Array:
    """Cosine of the angle between a pixel's ray and the surface normal, [h, w]; inverse depth of a plane is linear."""
    inverse = inverse_or_zero(depth)
    du, dv = _gentler_slope(inverse, 1), _gentler_slope(inverse, 0)
    rays = camera.rays()
    nx, ny = camera.fx * du, camera.fy * dv
    nz = inverse - rays[..., 0] * nx - rays[..., 1] * ny
    lengths = np.sqrt(nx**2 + ny**2 + nz**2) * np.linalg.norm(rays, axis=-1)
    return inverse / np.maximum(lengths, 1e-12)


def _gentler_slope(field: Array, axis: int) -> Array:
    """Of the differences to the two neighbors along an axis, the smaller one: it does not cross an edge."""
    step = np.diff(field, axis=axis)
    before = np.concatenate([np.take(step, [0], axis), step], axis=axis)
    after = np.concatenate([step, np.take(step, [-1], axis)], axis=axis)
    return np.where(np.abs(before) < np.abs(after), before, after)
