"""Normal equations of a registration and their minimum by the compiled kernels.

`residuals` and `search` define what is computed here.
"""

from __future__ import annotations

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.geometry.depth_noise import NEAREST_M
from duagc.pipeline.geometry.projection import BEHIND_COSINE
from duagc.pipeline.kernels import alignment
from duagc.pipeline.registration.normal_equations import NormalEquations, SamplesSeen, System
from duagc.pipeline.registration.pyramid import Level, RgbdPyramid
from duagc.pipeline.registration.reference import Reference, ReferenceLevel
from duagc.pipeline.registration.residuals import (
    GATE_SIGMAS,
    MAD_FROM,
    MAD_STRIDE,
    chance_between,
    gray_floor_of_depth,
)
from duagc.pipeline.registration.search import (
    ALL_DIRECTIONS,
    STEP_TOLERANCE,
    STEP_TOLERANCE_COARSE,
    levels_used,
)

_SIZE = alignment.PARAMETERS
_TILES = alignment.TILE_COLUMNS * alignment.TILE_ROWS


def linearize_at(
    reference: Reference,
    pyramid: RgbdPyramid,
    index: int,
    T_reference_target: Array,
    *,
    exposure: Array,
    config: RegistrationConfig,
    isa: str = "auto",
) -> System:
    """Normal equations of one level at one pose: `residuals.linearize_at`.

    Args:
        reference: the samples.
        pyramid: the target view.
        index: of the level.
        T_reference_target: [4, 4].
        exposure: (gain, offset), [2].
        config: gates and noise.
        isa: instruction set of the kernels.
    """
    samples = reference.levels[index]
    level = _level_arrays(samples, pyramid.levels[index], config)
    numbers = alignment.align_at(
        level, index, T_reference_target, exposure, settings=_settings(reference, pyramid, config), isa=isa
    )
    return _system(numbers, len(samples))


def minimize(
    reference: Reference,
    pyramid: RgbdPyramid,
    guess: Array,
    config: RegistrationConfig,
    *,
    prior_information: Array | None,
    projection: Array,
    isa: str = "auto",
) -> tuple[Array, Array, System]:
    """Pose, (gain, offset) and normal equations at the minimum: `search.minimize`.

    Args:
        reference: the samples.
        pyramid: the target view.
        guess: T_reference_target [4, 4], with an exact rotation.
        config: limits and noise.
        prior_information: [6, 6] in the right tangent of the guess; None: no prior.
        projection: [6, 6] P; the images count only along P x of a step x.
        isa: instruction set of the kernels.
    """
    count = max(1, levels_used(reference, pyramid, config))  # without any step, the guess is judged
    levels = [
        _level_arrays(samples, level, config)
        for samples, level in zip(reference.levels[:count], pyramid.levels[:count], strict=True)
    ]
    search = alignment.Search(
        iterations=config.iterations[:count] or (0,),
        min_samples=config.min_samples,
        tolerance=STEP_TOLERANCE,
        coarse_tolerance=STEP_TOLERANCE_COARSE,
        prior_information=prior_information,
        projection=None if projection is ALL_DIRECTIONS else projection,
        weights_by_correlation=config.weights_by_correlation,
    )
    T, exposure, numbers, _ = alignment.align(
        levels, guess, _settings(reference, pyramid, config), search, isa=isa
    )
    system = _system(numbers, len(reference.levels[0]))
    return T, exposure, system.by_correlation() if config.weights_by_correlation else system


def _level_arrays(samples: ReferenceLevel, level: Level, config: RegistrationConfig) -> alignment.LevelArrays:
    return alignment.level_arrays(
        samples.points,
        samples.normals,
        samples.intensities,
        samples.depth_sigmas,
        camera=level.camera,
        gray=level.gray,
        inverse_depth=level.usable_inverse_depth,
        has_depth=level.has_depth,
        depth_sigma_m=level.depth_sigma_m,
        target_normals=level.normals if config.normal_gate_rad > 0 else None,
    )


def _settings(
    reference: Reference, pyramid: RgbdPyramid, config: RegistrationConfig
) -> alignment.AlignmentSettings:
    return alignment.AlignmentSettings(
        use_depth=config.residuals != "gray",
        use_gray=config.residuals != "depth",
        gray_noise_of_depth=config.gray_noise_of_depth,
        depth_gate_m=config.depth_gate_m,
        depth_gate_relative=config.depth_gate_relative,
        gate_sigmas=GATE_SIGMAS,
        chance_inverse=chance_between(reference, pyramid),
        behind_squared=BEHIND_COSINE**2,
        min_normal_cosine=float(np.cos(config.normal_gate_rad)),
        sigma_base_m=config.depth_sigma_base_m,
        sigma_quadratic_per_m=config.depth_sigma_quadratic_per_m,
        sigma_nearest_m=NEAREST_M,
        depth_scale_floor=config.depth_sigma_floor,
        gray_scale_floor=config.gray_sigma_floor,
        gray_floor_of_depth=gray_floor_of_depth(reference, pyramid, config),
        huber_sigmas=config.huber_sigmas,
        min_gradient=config.min_gradient,
        mad_stride=MAD_STRIDE,
        mad_from=MAD_FROM,
    )


def _system(numbers: Array, samples: int) -> System:
    """What the kernels write: counts, then the equations of depth, then those of gray values."""
    seen, judged, conflicts, agreeing = (int(number) for number in numbers[:4])
    depth, gray = numbers[6:].reshape(2, -1)
    return System(
        depth=_normal_equations(depth),
        gray=_normal_equations(gray),
        seen=SamplesSeen(
            overlap=agreeing / max(samples - (seen - judged), 1),
            view=seen / max(samples, 1),
            conflict=conflicts / max(judged, 1),
            agreeing=agreeing,
            median_depth_m=float(numbers[4]),
            sigma_mean_m=float(numbers[5]),
        ),
    )


def _normal_equations(numbers: Array) -> NormalEquations:
    H, gradient, rest = np.split(numbers, [_SIZE * _SIZE, _SIZE * _SIZE + _SIZE])
    scale, count, squares, weights = (float(number) for number in rest[:4])
    return NormalEquations(
        H.reshape(_SIZE, _SIZE),
        gradient,
        scale,
        int(count),
        float(np.sqrt(squares / weights)) if count else 0.0,
        rest[4:].reshape(_SIZE, _TILES),
    )
