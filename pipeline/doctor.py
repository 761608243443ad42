"""What this machine has for a run, what lacks, and the line that mends it."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from duagc import __version__
from duagc.pipeline.base.determinism import SETTINGS
from duagc.pipeline.base.machine import memory_bytes, processors

REQUIRED = {
    "numpy": "numpy",
    "scipy": "scipy",
    "cv2": "opencv-python-headless",
    "mcap": "mcap",
    "google.protobuf": "protobuf",
    "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
    "pyarrow": "pyarrow",
    "pydantic": "pydantic",
    "matplotlib": "matplotlib",
    "jinja2": "jinja2",
    "rerun": "rerun-sdk",
    "torch": "torch",
    "rosbags": "rosbags",
}
"""Modules without which a command fails, and the packages that have them."""
OPTIONAL = {
    "open3d": (
        "open3d-cpu",
        "all scenes of `duagc simulate` but a plain room, `duagc export --points`, benches, tracking by Open3D",
        "pip install open3d-cpu",
    ),
    "cryptography": (
        "cryptography",
        "exchange.transport.signatures = 'ed25519'",
        "pip install 'duagc[signed]'",
    ),
    "small_gicp": ("small_gicp", "exchange.verification.method = 'gicp'", "pip install 'duagc[gicp]'"),
    "submitit": ("submitit", "`duagc batch --engine slurm`", "pip install 'duagc[slurm]'"),
    "ray": ("ray", "`duagc batch --engine ray`", "pip install 'duagc[ray]'"),
    "pytest": ("pytest", "the tests", "pip install 'duagc[test]'"),
    "grpc_tools": ("grpcio-tools", "new messages: python -m duagc.schemas.build", "pip install 'duagc[dev]'"),
}
"""Modules that a run does without: the package, what lacks without it, and what installs it."""
LEAST_MEMORY_BYTES, LEAST_DISK_BYTES = 2_000_000_000, 2_000_000_000


@dataclass(frozen=True)
class Found:
    """One thing about this machine.

    Attributes:
        name: of the thing.
        state: "ok"; "note": something lacks that a run does without; "missing": a run would fail.
        found: what there is.
        lacks: what does not work; "".
        remedy: the line that mends it; "".
    """

    name: str
    state: Literal["ok", "note", "missing"]
    found: str
    lacks: str = ""
    remedy: str = ""


def examine(out: Path) -> list[Found]:
    """Look at everything.

    Args:
        out: where runs would go.
    """
    return [*_versions(), _kernels(), *_machine(), _disk(out), _settings(), *_libraries()]


def _versions() -> Iterator[Found]:
    yield Found("duagc", "ok", f"{__version__} in {Path(__file__).resolve().parents[1]}")
    python = platform.python_version()
    system = f"{platform.system()} {platform.machine()}"
    yield Found("python", "ok", f"{python} on {system}")


def _kernels() -> Found:
    """The compiled kernels, and the instruction sets that they and this processor have."""
    try:
        from duagc.pipeline.kernels import available_isas
    except ImportError as error:
        return Found("kernels", "missing", str(error), "every run", "make setup, or pip install .")
    sets = available_isas()
    if sets == ["portable"]:
        return Found(
            "kernels", "note", "portable only", "speed", "a processor with AVX2, or a build for this one"
        )
    return Found("kernels", "ok", ", ".join(sets))


def _machine() -> Iterator[Found]:
    usable, all_of_them = processors(), os.cpu_count() or 1
    share = _processor_share()
    limited = f", limited to {share:g} of them" if share is not None and share < usable else ""
    yield Found("processors", "ok", f"{usable} of {all_of_them} usable{limited}")
    total, free = memory_bytes()
    if total is None or free is None:
        yield Found("memory", "note", "unknown", "an estimate of what fits", "look into /proc/meminfo")
        return
    text = f"{free / 1e9:.1f} GB free of {total / 1e9:.1f} GB"
    if free < LEAST_MEMORY_BYTES:
        yield Found("memory", "note", text, "runs of several robots at a time", "duagc run --workers 1")
    else:
        yield Found("memory", "ok", text)


def _processor_share() -> float | None:
    """Processors that a control group allows on the average."""
    with suppress(OSError, ValueError):
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        return int(quota) / int(period)
    return None


def _disk(out: Path) -> Found:
    folder = Path(os.path.abspath(out))
    while not folder.exists():
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):  # permissions do not tell: /proc has them
            pass
    except OSError as error:
        remedy = "duagc run --out with a folder that you may write to"
        said = f"{folder} cannot be written: {error.strerror}"
        return Found("disk", "missing", said, "every run there", remedy)
    free = shutil.disk_usage(folder).free
    text = f"{free / 1e9:.1f} GB free in {folder}"
    if free < LEAST_DISK_BYTES:
        return Found("disk", "note", text, "long runs", "duagc gc --max 1G, or another --out")
    return Found("disk", "ok", text)


def _settings() -> Found:
    """Whether results are independent of processor and threads."""
    from duagc.pipeline.base.determinism import is_deterministic

    if is_deterministic():
        return Found("determinism", "ok", f"{len(SETTINGS)} settings of the numeric libraries in place")
    return Found(
        "determinism", "note", "numpy was imported before duagc", "equal bits here", "import duagc first"
    )


def _libraries() -> Iterator[Found]:
    for module, package in REQUIRED.items():
        if _is_there(module):
            yield Found(package, "ok", _version(package))
        else:
            yield Found(package, "missing", "not installed", "commands that use it", "pip install duagc")
    for module, (package, lacks, remedy) in OPTIONAL.items():
        if _is_there(module):
            yield Found(package, "ok", _version(package))
        else:
            yield Found(package, "note", "not installed", lacks, remedy)


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "of unknown version"


def text(findings: list[Found]) -> str:
    """For people: a line for each thing, and what mends those that lack.

    Args:
        findings: about the machine.
    """
    width = max(len(f.name) for f in findings)
    lines = []
    for f in findings:
        lines.append(f"{f.state:<8} {f.name:<{width}}  {f.found}")
        if f.remedy:
            lines.append(f"{'':<8} {'':<{width}}  lacks: {f.lacks}; mend: {f.remedy}")
    return "\n".join(lines)
