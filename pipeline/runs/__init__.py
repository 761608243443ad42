"""Runs and what a robot's stages leave in them, as arrays: read by stages, evaluation, report and viewers."""
