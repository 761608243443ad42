"""Drawing Gaussians, and the derivatives and information of what was drawn."""

from pipeline.errors import DuagError

try:
    import pipeline.kernels._raster  # noqa: F401
except ImportError as error:
    raise DuagError(f"the compiled kernels: {error}, expected what `make setup` builds") from error

from pipeline.kernels.optimiser import CompiledAdam
from pipeline.kernels.rasterizer import Rasterizer, available_isas
from pipeline.kernels.types import (
    DepthKind,
    FisherSums,
    Gradients,
    LossWeights,
    Render,
    Statistics,
    ViewLoss,
)

__all__ = [
    "CompiledAdam",
    "DepthKind",
    "FisherSums",
    "Gradients",
    "LossWeights",
    "Rasterizer",
    "Render",
    "Statistics",
    "ViewLoss",
    "available_isas",
]
