"""Rendering: exact depth and color of procedural scenes and of textured meshes."""
