"""Rotations, rigid motions, covariances, cameras and trajectories. Arrays in, arrays out."""
