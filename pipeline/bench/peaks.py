"""What the machine can do at best: multiply-adds of every instruction set, and bytes read and copied."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from duagc.pipeline.base.machine import processors
from duagc.pipeline.kernels import _raster

PEAK_S = 0.1  # per instruction set, number of threads and scene; the best counts


class Peaks:
    """The best rates that the machine has shown so far."""

    def __init__(self, isas: Iterable[str], threads: Iterable[int]) -> None:
        """Nothing is measured yet.

        Args:
            isas: instruction sets.
            threads: numbers of threads.
        """
        self.load_average = os.getloadavg()[0]  # of the last minute: others that want the same cores
        self.fma_gflops = {isa: dict.fromkeys(threads, 0.0) for isa in isas}
        self.read_gb_per_s = dict.fromkeys(threads, 0.0)
        self.copy_gb_per_s = dict.fromkeys(threads, 0.0)

    def measure(self) -> None:
        """Try again to reach higher rates."""
        for isa, rates in self.fma_gflops.items():
            for n in rates:
                rates[n] = max(rates[n], _raster.fma_rate(isa, n, PEAK_S))
        for n in self.read_gb_per_s:
            read, copied = _raster.bandwidth(n, 2 * PEAK_S)
            self.read_gb_per_s[n] = max(self.read_gb_per_s[n], read)
            self.copy_gb_per_s[n] = max(self.copy_gb_per_s[n], copied)

    def as_dict(self) -> dict[str, Any]:
        """What ran all this, and the peaks; keys of the inner dictionaries are numbers of threads."""
        return {
            "cpu": cpu_name(),
            "cores": processors(),
            "isas": list(self.fma_gflops),
            **vars(self),
        }


def cpu_name() -> str:
    """As the system calls it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
