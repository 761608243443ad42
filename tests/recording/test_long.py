"""Memory does not grow with the length of a log."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer

from duagc.pipeline.geometry.camera import PinholeCamera
from tests.fixtures.ros_bags import START_NS, STEP_NS, Ros

CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
SHORT, LONG = 15, 150
GROWTH_MB = 30  # the longer bag is 130 MB longer
STEPS = {
    "convert": "from duagc.converters.registry import convert; convert('ros', Path({bag!r}), Path({rec!r}))",
    "info": "from duagc.pipeline.recording import info; info(Path({rec!r}))",
    "check": "from duagc.pipeline.checks.check import check; assert check(Path({rec!r})).sound",
    "recover": "from duagc.pipeline.recording.recovery import recover; "
    "recover(Path({rec!r}), Path({rec!r} + '-saved'))",
}


def write_bag(path: Path, frames: int) -> None:
    """A few images with noise, which does not compress, again and again."""
    rng, r = np.random.default_rng(0), Ros(1)
    plain = np.full((CAMERA.height, CAMERA.width, 3), 60, np.uint8)
    colors = [cv2.circle(plain.copy(), (50 * k, 200), 40, (90, 200, 50), -1) for k in range(5)]
    jpegs = [cv2.imencode(".jpg", color)[1].tobytes() for color in colors]
    depths = [2000 + rng.integers(0, 500, plain.shape[:2]).astype(np.uint16) for _ in range(5)]
    topics = ("/c/color/image_raw", "/c/aligned_depth_to_color/image_raw")
    with Writer(path) as bag:
        connections = {}
        for i in range(frames):
            at = START_NS + i * STEP_NS
            rows = [
                (f"{topics[0]}/compressed", r.compressed(at, "c", jpegs[i % 5], "jpeg")),
                (topics[1], r.image(at, "c", depths[i % 5], "16UC1")),
            ]
            if i == 0:
                infos = ("/c/color/camera_info", "/c/aligned_depth_to_color/camera_info")
                rows = [*((info, r.info(at, "c", CAMERA)) for info in infos), *rows]
            for topic, message in rows:
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, kind, typestore=r.store)
                bag.write(connections[topic], at, r.store.serialize_ros1(message, kind))


def peak_mb(code: str) -> float:
    """Largest memory of a process that runs some code."""
    before = "import resource; from pathlib import Path; "
    before += "from duagc.pipeline.base import determinism; determinism.configure_determinism(); "
    after = "; print('PEAK', resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    root = Path(__file__).parents[2]
    arguments = [sys.executable, "-c", before + code + after]
    out = subprocess.run(arguments, capture_output=True, text=True, check=True, cwd=root)
    return float(out.stdout.split("PEAK")[1])


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("bags")
    for frames in (SHORT, LONG):
        write_bag(folder / f"{frames}.bag", frames)
    return {frames: folder / f"{frames}.bag" for frames in (SHORT, LONG)}


def test_memory_does_not_grow_with_the_length(bags: dict[int, Path]) -> None:
    grown = bags[LONG].stat().st_size - bags[SHORT].stat().st_size
    assert grown > 4 * GROWTH_MB * 2**20 / 1.5
    for name, code in STEPS.items():
        peaks = {}
        for frames, bag in bags.items():
            peaks[frames] = peak_mb(code.format(bag=str(bag), rec=str(bag.with_name(f"rec{frames}"))))
        assert peaks[LONG] - peaks[SHORT] < GROWTH_MB, f"{name}: {peaks}"
