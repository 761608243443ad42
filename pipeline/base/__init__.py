"""Errors, files, worker processes, random streams, progress: what every other part stands on."""
