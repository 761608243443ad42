"""Where a robot starts whose odometry has drifted far."""

import numpy as np

from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.posegraph.initialization import own_start
from duagc.pipeline.posegraph.relative_poses import RelativePoses

POSES, LAP = 600, 500


def measured(T, i, j, sigmas, rng):
    """Relative poses with noise: of the odometry 2 cm and 3 mrad, of loops 1 mm and 1 mrad."""
    sigma_m, sigma_rad = sigmas
    noise = np.concatenate(
        [sigma_m * rng.normal(size=(len(i), 3)), sigma_rad * rng.normal(size=(len(i), 3))], axis=1
    )
    information = np.diag([sigma_m**-2.0] * 3 + [sigma_rad**-2.0] * 3)
    return RelativePoses(
        i, j, se3.inverse(T[i]) @ T[j] @ se3.exp(noise), np.tile(information, (len(i), 1, 1))
    )


def test_loops_that_a_long_walk_is_thousands_of_sigmas_from_are_kept():
    rng = np.random.default_rng(0)
    angle = 2 * np.pi * np.arange(POSES) / LAP
    radius_m = LAP / (2 * np.pi)
    turns = so3.exp(np.stack([0 * angle, 0 * angle, angle + np.pi / 2], axis=1))
    places = radius_m * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    T = se3.from_rotation_translation(turns, places)
    step, again = np.arange(POSES - 1), np.arange(0, POSES - LAP, 5)
    odometry = measured(T, step, step + 1, (0.02, 0.003), rng)
    loops = measured(T, again, again + LAP, (0.001, 0.001), rng)
    _, kept = own_start(odometry, loops, POSES, PoseConsensusConfig(robust=True))
    assert kept.all()
