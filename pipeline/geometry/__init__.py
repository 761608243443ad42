"""Rotations, rigid motions, covariances, cameras and trajectories. Arrays in, arrays out."""

from duagc.pipeline.geometry import se3, so3

__all__ = ["se3", "so3"]  # as modules: `duagc` exports them
