import numpy as np
from numpy.typing import NDArray

def nearest(
    isa: str,
    linear: NDArray[np.float64],
    extent: NDArray[np.float64],
    kind: NDArray[np.uint8],
    order: NDArray[np.int32],
    windows: NDArray[np.int32],
    nearest: NDArray[np.float64],
    seen: NDArray[np.int16],
) -> None: ...
def colors(
    isa: str,
    linear: NDArray[np.float64],
    extent: NDArray[np.float64],
    kind: NDArray[np.uint8],
    origin: NDArray[np.float64],
    seen: NDArray[np.int16],
    texels: NDArray[np.uint8],
    scale: float,
    color: NDArray[np.uint8],
    step2: NDArray[np.float32],
    left: NDArray[np.uint8],
) -> None: ...
def colors_between(
    isa: str,
    linear: NDArray[np.float64],
    extent: NDArray[np.float64],
    kind: NDArray[np.uint8],
    origin: NDArray[np.float64],
    seen: NDArray[np.int16],
    texels: list[NDArray[np.uint8]],
    scale: float,
    pixels: NDArray[np.int64],
    level: NDArray[np.float32],
    color: NDArray[np.uint8],
) -> None: ...
