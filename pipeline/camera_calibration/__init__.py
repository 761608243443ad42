"""Cameras of a recording estimated from its own images."""
