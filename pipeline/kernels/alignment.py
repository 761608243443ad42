"""Normal equations of a registration, and their minimum: compiled kernels behind checked numpy arrays.

`registration.residuals` defines what they compute. All results are the same bits on every instruction set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import _raster
from duagc.pipeline.kernels.arguments import floats_of
from duagc.pipeline.kernels.outputs import NOTHING

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

PARAMETERS = 8  # translation, rotation, gain, offset
TILE_COLUMNS, TILE_ROWS = _raster.ALIGNMENT_TILES  # over which correlated residuals are summed
SYSTEM_SIZE: int = _raster.SYSTEM_SIZE  # of what the kernels give: see `registration.compiled`
_NO_DOUBLES = np.zeros(0)


@dataclass(frozen=True)
class AlignmentSettings:
    """What a registration assumes; the names are those of `RegistrationConfig`, where they are explained.

    Attributes:
        use_depth: whether residuals of depth count.
        use_gray: whether residuals of gray values count.
        gray_noise_of_depth: whether the noise of a sample's depth is noise of its gray value.
        depth_gate_m: absolute gate of depth.
        depth_gate_relative: the same as a share of the depth.
        gate_sigmas: the same in sigmas of measured depth.
        chance_inverse: by how much inverse depths of one surface differ at most by their noise, 1/m: what is off by
            less, but does not agree, is not judged.
        behind_squared: square of the cosine between ray and normal beyond which a surface is seen from behind.
        min_normal_cosine: of the angle between normals, where those of the target are given.
        sigma_base_m: of the noise of depth.
        sigma_quadratic_per_m: of the noise of depth.
        sigma_nearest_m: depth at which that noise is least.
        depth_scale_floor: smallest scale of residuals of depth, at the finest level.
        gray_scale_floor: smallest scale of residuals of gray values.
        gray_floor_of_depth: the same as a multiple of the scale of the depth.
        huber_sigmas: residuals beyond count linearly.
        min_gradient: 1/px, below which a gray value is not used.
        mad_stride: residuals between those that estimate a scale.
        mad_from: number of residuals up to which all estimate it.
    """

    use_depth: bool
    use_gray: bool
    gray_noise_of_depth: bool
    depth_gate_m: float
    depth_gate_relative: float
    gate_sigmas: float
    chance_inverse: float
    behind_squared: float
    min_normal_cosine: float
    sigma_base_m: float
    sigma_quadratic_per_m: float
    sigma_nearest_m: float
    depth_scale_floor: float
    gray_scale_floor: float
    gray_floor_of_depth: float
    huber_sigmas: float
    min_gradient: float
    mad_stride: int
    mad_from: int

    def array(self) -> Doubles:
        """In the order in which the kernels take them."""
        return np.array(list(vars(self).values()), dtype=np.float64)


@dataclass(frozen=True)
class Search:
    """How the minimum is searched.

    Attributes:
        iterations: steps at most per level, finest first.
        min_samples: number of agreeing samples below which a level ends.
        tolerance: m and rad, of the last step at the finest level.
        coarse_tolerance: the same at the others.
        prior_information: [6, 6] in the right tangent of the guess; None: no prior.
        projection: [6, 6], takes a tangent to its determined part; None: all of it is.
        weights_by_correlation: at the finest level, divide the weights of either kind by its correlation.
    """

    iterations: Sequence[int]
    min_samples: int
    tolerance: float
    coarse_tolerance: float
    prior_information: Doubles | None = None
    projection: Doubles | None = None
    weights_by_correlation: bool = False


LevelArrays = _raster.LevelArrays


def level_arrays(
    points: Floats,
    normals: Floats,
    intensities: Floats,
    depth_sigmas: Floats | None,
    *,
    camera: PinholeCamera,
    gray: Floats,
    inverse_depth: Floats,
    has_depth: bool,
    depth_sigma_m: Floats | None = None,
    target_normals: Floats | None = None,
) -> LevelArrays:
    """One level of a registration, for `align_at` and `align`.

    Args:
        points: samples of the reference, [n, 3], meters.
        normals: of the samples, [n, 3], unit length.
        intensities: of the samples, [n].
        depth_sigmas: of the samples, [n], meters; None: not known.
        camera: of the target.
        gray: of the target, [h, w].
        inverse_depth: of the target, [h, w], 1/m, 0 where unknown.
        has_depth: whether these are measured, or only tell where pixels may be used.
        depth_sigma_m: of the target, [h, w], meters; None: not known.
        target_normals: [h, w, 3]; None: normals are not compared.

    Raises:
        ValueError: arrays of different shapes; the message names them.
    """
    n, shape = len(points), (camera.height, camera.width)
    arrays = (
        floats_of("points", points, (n, 3)),
        floats_of("normals", normals, (n, 3)),
        floats_of("intensities", intensities, (n,)),
        NOTHING if depth_sigmas is None else floats_of("depth_sigmas", depth_sigmas, (n,)),
        floats_of("gray", gray, shape),
        floats_of("inverse_depth", inverse_depth, shape),
        NOTHING if depth_sigma_m is None else floats_of("depth_sigma_m", depth_sigma_m, shape),
        NOTHING if target_normals is None else floats_of("target_normals", target_normals, (*shape, 3)),
    )
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float32)
    return _raster.LevelArrays(*arrays, intrinsics, has_depth)


def align_at(
    level: LevelArrays,
    index: int,
    T_reference_target: Doubles,
    exposure: Doubles,
    *,
    settings: AlignmentSettings,
    isa: str = "auto",
) -> Doubles:
    """Normal equations at one pose, with all statistics.

    Args:
        level: of `level_arrays`.
        index: of the level, 0 the finest.
        T_reference_target: [4, 4].
        exposure: (gain, offset), [2].
        settings: gates and noise.
        isa: instruction set, as of `Rasterizer`.

    Returns:
        [SYSTEM_SIZE], as `registration.compiled` reads it.
    """
    out = np.zeros(SYSTEM_SIZE)
    T = np.ascontiguousarray(T_reference_target, dtype=np.float64).reshape(16)
    numbers = T, np.ascontiguousarray(exposure, dtype=np.float64), settings.array()
    _raster.align_at(isa, level, index, *numbers, out)
    return out


def align(
    levels: Sequence[LevelArrays],
    T_reference_target_guess: Doubles,
    settings: AlignmentSettings,
    search: Search,
    *,
    isa: str = "auto",
) -> tuple[Doubles, Doubles, Doubles, int]:
    """The minimum from the coarsest level to the finest.

    Args:
        levels: of `level_arrays`, finest first.
        T_reference_target_guess: [4, 4], with an exact rotation.
        settings: gates and noise.
        search: steps and tolerances.
        isa: instruction set, as of `Rasterizer`.

    Returns:
        T_reference_target [4, 4], (gain, offset), the normal equations there at the finest level as of `align_at`, and
        how often they were computed.
    """
    T = np.array(T_reference_target_guess, dtype=np.float64).reshape(16)
    exposure, out = np.array([1.0, 0.0]), np.zeros(SYSTEM_SIZE)
    limits = np.array(
        [search.min_samples, search.tolerance, search.coarse_tolerance, float(search.weights_by_correlation)]
    )
    prior, projection = (_square(name, getattr(search, name)) for name in ("prior_information", "projection"))
    numbers = T, exposure, settings.array(), limits, prior, projection
    steps = _raster.align(isa, list(levels), list(search.iterations), *numbers, out)
    return T.reshape(4, 4), exposure, out, steps


def _square(name: str, matrix: Doubles | None) -> Doubles:
    if matrix is None:
        return _NO_DOUBLES
    if matrix.shape != (6, 6):
        raise ValueError(f"{name} has shape {matrix.shape}, expected (6, 6)")
    return np.ascontiguousarray(matrix, dtype=np.float64)
