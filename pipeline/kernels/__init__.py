"""Drawing Gaussians, and the derivatives and information of what was drawn."""

try:
    import duagc.pipeline.kernels._raster  # noqa: F401
except ImportError as error:
    raise ImportError(
        f"the compiled kernels: {error}, expected the module that `make setup` or `pip install .` builds",
        name="duagc.pipeline.kernels._raster",
    ) from error

from duagc.pipeline.kernels.adam import CompiledAdam
from duagc.pipeline.kernels.arguments import available_isas
from duagc.pipeline.kernels.rasterizer import Rasterizer
from duagc.pipeline.kernels.types import FisherSums, Gradients, LossWeights, Render, Statistics, ViewLoss

__all__ = [
    "CompiledAdam",
    "FisherSums",
    "Gradients",
    "LossWeights",
    "Rasterizer",
    "Render",
    "Statistics",
    "ViewLoss",
    "available_isas",
]
