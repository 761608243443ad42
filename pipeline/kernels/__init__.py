"""Drawing Gaussians, and the derivatives and information of what was drawn."""

from pipeline.kernels.rasterizer import Rasterizer, available_isas
from pipeline.kernels.types import FisherSums, Gradients, Render

__all__ = ["FisherSums", "Gradients", "Rasterizer", "Render", "available_isas"]
