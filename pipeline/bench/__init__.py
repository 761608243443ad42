"""Measurements side by side with something else in the same run: one module for each `duagc bench` command."""
