"""Drawing Gaussians, and the derivatives and information of what was drawn."""

from duagc.pipeline.base.errors import DuagError

try:
    import duagc.pipeline.kernels._raster  # noqa: F401
except ImportError as error:
    raise DuagError(f"the compiled kernels: {error}, expected what `make setup` builds") from error

from duagc.pipeline.kernels.adam import CompiledAdam
from duagc.pipeline.kernels.rasterizer import Rasterizer, available_isas
from duagc.pipeline.kernels.types import (
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
