"""Poses of 7-Scenes by others than the data set: the files that Brachmann et al. publish (ICCV 2021).

"On the Limits of Pseudo Ground Truth in Visual Camera Re-Localization" finds the poses of all images of a scene by
structure from motion, from color alone. A file has a line per image, in any order: `seq-01/frame-000000.color.png`,
the rotation as quaternion w x y z and the translation (m) that take the scene's coordinates to the color camera's,
and a focal length, which is not used here.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_text
from duagc.pipeline.geometry import se3

EXPECTED = "lines of `seq-01/frame-000000.color.png qw qx qy qz tx ty tz f`"
IMAGE = re.compile(r"(seq-\d+)/frame-(\d+)\.color\.png")
MAX_NORM_DEFECT = 1e-3  # of a quaternion; the files have six digits


def read(path: Path, sequence: str) -> dict[int, NDArray[np.float64]]:
    """T_scene_color [4, 4], meters, of the color camera by frame number, of one sequence.

    Args:
        path: the file.
        sequence: as the file names it, `seq-01`; empty: the only one that the file has.
    Raises:
        DuagError: names the file, the line, what was found and what was expected.
    """
    poses: dict[str, dict[int, NDArray[np.float64]]] = {}
    for number, line in enumerate(read_text(path, EXPECTED).splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        image = IMAGE.fullmatch(words[0])
        if image is None:
            raise DuagError(f"{path}: line {number}: found {words[0][:60]!r}, expected {EXPECTED}")
        frames = poses.setdefault(image[1], {})
        if int(image[2]) in frames:
            raise DuagError(f"{path}: line {number}: found {words[0]} again, expected every image once")
        frames[int(image[2])] = _pose(words[1:], f"{path}: line {number}")
    names = sorted(poses)
    if not names:
        raise DuagError(f"{path}: found no pose, expected {EXPECTED}")
    if not sequence and len(names) > 1:
        found, asked = ", ".join(names), f"--set reference_sequence={names[0]}"
        raise DuagError(f"{path}: found poses of {found}, expected the choice of one, as with {asked}")
    if sequence and sequence not in poses:
        raise DuagError(f"{path}: found poses of {', '.join(names)}, expected some of {sequence}")
    return poses[sequence or names[0]]


def _pose(words: list[str], where: str) -> NDArray[np.float64]:
    """T_scene_color of the numbers of a line."""
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise DuagError(f"{where}: {error}, expected {EXPECTED}") from error
    if len(numbers) != 8 or not np.isfinite(numbers).all():
        raise DuagError(f"{where}: found {len(numbers)} numbers, expected {EXPECTED}, all finite")
    norm = float(np.linalg.norm(numbers[:4]))
    if abs(norm - 1) > MAX_NORM_DEFECT:
        raise DuagError(f"{where}: found a quaternion of length {norm:.4f}, expected 1")
    return se3.inverse(se3.from_quat_translation(numbers[:4] / norm, numbers[4:7]))
