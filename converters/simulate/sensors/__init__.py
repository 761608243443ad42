"""Simulated sensors: rolling shutter, motion blur, exposure, LiDAR, depth noise."""
