"""DUAG-C: recordings of a robot team to one uncertainty-weighted Gaussian map, without a central server."""

__version__ = "0.1.0"
