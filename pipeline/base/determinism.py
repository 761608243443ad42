"""Settings of the numeric libraries that make results independent of threads and of the processor, and bounded.

Call `configure_determinism()` before numpy, scipy or OpenCV is imported for the first time; child processes inherit the
environment. One BLAS thread, because a product split over threads sums in another order; the AVX2 code paths of
OpenBLAS, numpy and OpenCV on every machine, because their AVX-512 paths round differently; and nothing of Intel's IPP
in OpenCV, which computes angles of SIFT another way on every family of processors. glibc gives the memory of an
image back to the system as soon as it is freed, and clearing it again for the next one took a third of the time of a
conversion: it keeps up to 256 MB.
"""

import ctypes
import os
import sys
from pathlib import Path

_KEPT_BYTES = 256 << 20  # of freed memory: features of a VGA image take 100 MB, and as much the next time
_OWN_MAPPING_BYTES = 32 << 20  # what is larger is given back at once
_SKX = {"avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl"}  # what OpenCV calls AVX512-SKX


def opencv_paths_to_disable(processor: str) -> str:
    """Value of OPENCV_CPU_DISABLE; OpenCV prints a line about every path that the processor does not have anyway.

    Args:
        processor: text of /proc/cpuinfo.
    """
    lines = (line.partition(":") for line in processor.splitlines())
    flags = next((set(words.split()) for name, _, words in lines if name.strip() == "flags"), set())
    return "AVX512-SKX" if flags >= _SKX else ""


def _processor() -> str:
    try:
        return Path("/proc/cpuinfo").read_text(errors="replace")
    except OSError:
        return ""


SETTINGS = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "passive",  # threads that wait for others leave the processor to who needs it
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENCV_CPU_DISABLE": opencv_paths_to_disable(_processor()),
    "OPENCV_IPP": "disabled",
    "OPENCV_LOG_LEVEL": "ERROR",  # it would warn of the line above
    "PYTHONHASHSEED": "0",
    "OPENCV_IO_MAX_IMAGE_PIXELS": str(1 << 26),  # a small file can hold a large image
    "MALLOC_TRIM_THRESHOLD_": str(_KEPT_BYTES),
    "MALLOC_MMAP_THRESHOLD_": str(_OWN_MAPPING_BYTES),
}
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of mallopt(3)


_LIBRARIES = ("numpy", "scipy", "cv2")  # they read the settings once, while they are imported

_in_time: bool | None = None


def configure_determinism() -> None:
    """Put the settings into the environment of this process and of its children.

    The first call decides whether this process computes under them: see `is_deterministic`.
    """
    global _in_time
    if _in_time is None:
        inherited = all(os.environ.get(name) == value for name, value in SETTINGS.items())
        _in_time = inherited or not any(name in sys.modules for name in _LIBRARIES)
    os.environ.update(SETTINGS)
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # for this process the environment comes too late
    if mallopt:
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
        mallopt(_M_MMAP_THRESHOLD, _OWN_MAPPING_BYTES)


def is_deterministic() -> bool:
    """Whether the numeric libraries of this process were, or will be, loaded under the settings.

    False if one of them was imported before `configure_determinism` was called, unless the process was started with the
    settings in its environment. Results then depend on the processor and on the number of threads; child processes
    are not affected.
    """
    return bool(_in_time)


def configure_opencv() -> None:
    """Make OpenCV use the calling thread only; its parallel loops are not all order-preserving."""
    import cv2

    cv2.setNumThreads(1)
