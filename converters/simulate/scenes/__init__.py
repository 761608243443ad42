"""Procedural scenes: what stands where, and what it is painted with."""
