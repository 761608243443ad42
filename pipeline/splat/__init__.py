"""Gaussians and what one does with them: files, losses, optimization."""
