"""Pose graphs: relative poses, solvers, robust weights, loop closures that agree, readers of public formats."""
