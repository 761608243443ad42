"""Drawing Gaussians, and the derivatives and information of what was drawn."""

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
