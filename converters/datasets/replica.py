"""Replica as rendered for iMAP and NICE-SLAM: one camera in one of eight rooms, exact depth and poses.

SRC is a scene, for example `Replica/room0`; `cam_params.json` lies next to it. The original Replica release has no
`traj.txt` and is another dataset; Replica-V2 (vMAP) has another layout.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from duagc.converters.layouts import image_folder, replica_layout
from duagc.converters.layouts.image_files import options_of
from duagc.converters.layouts.sound_camera import check_camera
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_json
from duagc.pipeline.geometry.camera import PinholeCamera


class Options(replica_layout.LayoutOptions):
    """Time; camera and depth scale are those of cam_params.json."""


def convert(src: Path, out: Path, robots: int = 1, force: bool = False, **options: Any) -> None:
    """Convert a scene, cut into contiguous parts.

    Args:
        src: folder of the scene.
        out: folder of the recording.
        robots: how many parts.
        force: replace a recording that is there.
        options: of `Options`, by name.

    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    settings = options_of(Options, options, "replica")
    camera, depth_scale = _read_camera(src)
    clip, warnings = replica_layout.read_part(src, "", camera, depth_scale, options=settings)
    image_folder.write_parts(
        out, "replica", src, clip, robots=robots, options=settings, warnings=warnings, force=force
    )


def _read_camera(src: Path) -> tuple[PinholeCamera, float]:
    """Camera and meters per unit of depth, from cam_params.json in the scene or next to it."""
    path = next((f / "cam_params.json" for f in (src, src.parent) if (f / "cam_params.json").is_file()), None)
    if path is None:
        raise DuagError(f"{src.parent / 'cam_params.json'}: not found, expected the camera of the renders")
    try:
        c = read_json(path, "the camera of the renders")["camera"]
        camera = PinholeCamera(
            int(c["w"]), int(c["h"]), *(float(c[name]) for name in ("fx", "fy", "cx", "cy"))
        )
        depth_scale = 1.0 / float(c["scale"])
    except (ValueError, TypeError, KeyError, ArithmeticError) as error:
        raise DuagError(
            f"{path}: {type(error).__name__} {error}, expected camera with w, h, fx, fy, cx, cy, scale"
        ) from error
    check_camera(camera, str(path))
    if not 0 < depth_scale < np.inf:
        raise DuagError(f"{path}: scale is {c['scale']}, expected a positive number of units per meter")
    return camera, depth_scale
