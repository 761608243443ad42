"""Settings of the numeric libraries that make results independent of threads and of the processor.

Call `settle()` before numpy, scipy or OpenCV is imported for the first time; child processes inherit the
environment. One BLAS thread, because a product split over threads sums in another order; the AVX2 code paths of
OpenBLAS, numpy and OpenCV on every machine, because their AVX-512 paths round differently.
"""

import os

_AVX512 = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"

_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": _AVX512,
    "OPENCV_CPU_DISABLE": "AVX512_SKX,AVX512_CLX,AVX512_ICL",
    "PYTHONHASHSEED": "0",
}


def settle() -> None:
    """Put the settings into the environment of this process and of its children."""
    os.environ.update(_ENVIRONMENT)


def settle_opencv() -> None:
    """Make OpenCV use the calling thread only; its parallel loops are not all order-preserving."""
    import cv2

    cv2.setNumThreads(1)
