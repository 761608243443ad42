"""Simulated recordings of a robot team, with exact ground truth."""
