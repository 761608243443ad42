"""Names of array types that many modules use."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
"""Double precision, any shape; the docstring of every parameter gives the shape."""
