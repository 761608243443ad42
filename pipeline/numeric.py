"""Settings of the numeric libraries that make results independent of threads and of the processor, and bounded.

Call `settle()` before numpy, scipy or OpenCV is imported for the first time; child processes inherit the
environment. One BLAS thread, because a product split over threads sums in another order; the AVX2 code paths of
OpenBLAS, numpy and OpenCV on every machine, because their AVX-512 paths round differently.
"""

import os

_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENCV_CPU_DISABLE": "AVX512-SKX",
    "PYTHONHASHSEED": "0",
    "OPENCV_IO_MAX_IMAGE_PIXELS": str(1 << 26),  # a small file can hold a large image
}


def settle() -> None:
    """Put the settings into the environment of this process and of its children."""
    os.environ.update(_ENVIRONMENT)


def settle_opencv() -> None:
    """Make OpenCV use the calling thread only; its parallel loops are not all order-preserving."""
    import cv2

    cv2.setNumThreads(1)
