"""Microsoft 7-Scenes: Kinect v1 sequences of seven rooms, poses by KinectFusion, one world per room.

A sequence is a folder of `frame-NNNNNN.color.png` (or .jpg), `.depth.png` (16 bit, millimeters, 0 and 65535 invalid)
and `.pose.txt` (4x4, depth camera to world, x right, y down, z forward). There are no time stamps: they are made at
30 Hz from the frame number. The depth is not registered to color: it is here, with the constants below. True poses
may be those of others (`reference_poses`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator

from duagc.converters.layouts import reference_poses
from duagc.converters.layouts.calibrated import correct, is_pinhole, numbers, square_camera
from duagc.converters.layouts.image_files import add_numbered, kept_color, options_of, read_depth, rigid
from duagc.converters.layouts.image_folder import LengthOptions
from duagc.converters.layouts.self_check import ReprojectionCheck
from duagc.converters.robot_writer import RobotWriter
from duagc.converters.writer import RecordingWriter, robot_names
from duagc.pipeline.base import determinism
from duagc.pipeline.base.ahead import in_order
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_text
from duagc.pipeline.base.progress import track
from duagc.pipeline.geometry import depth_error, se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens
from duagc.pipeline.kernels.drawn_depth import displaced_depth
from duagc.pipeline.messages.parts import NANOSECONDS
from duagc.pipeline.recording.greatest_depth import units_of_depth

Depth = Array
Reference = dict[int, Array]  # T_world_color [4, 4] by frame number

WIDTH, HEIGHT = 640, 480
DEPTH_SCALE = 0.001
FRAME_FILE = re.compile(r"frame-(\d+)\.(color|depth|pose)\.(png|jpg|jpeg|txt)")
SEQUENCE_FOLDER = re.compile(r"seq-(\d+)")
OTHER_CAMERAS = "info.txt"  # BundleFusion has the same names of frames, and its cameras in this file
FOCAL_LENGTHS = {"depth_focal_px", "color_focal_px"}
KINDS = ("color", "depth", "pose")
MOST_NUMBERS = 10_000_000  # four days

LENGTHS = {
    "color_distortion": (4, 5),
    "color_rotation_rad": (3,),
    "depth_correction_per_m": (depth_error.COEFFICIENTS,),
}
"""How many numbers options hold that are lists of numbers."""


class Options(LengthOptions):
    """Cameras and time; the defaults are those of the Kinect that recorded 7-Scenes."""

    depth_focal_px: float = Field(585.0, gt=0)
    """Focal length of the depth camera, as the dataset's page gives it."""
    depth_cx_px: float = 320.0
    """Principal point of the depth camera, as the dataset's page gives it."""
    depth_cy_px: float = 240.0
    """Principal point of the depth camera, as the dataset's page gives it."""
    color_focal_px: float = Field(525.0, gt=0)
    """Focal length of the color camera, nominal; it agrees with the images of RedKitchen to 2 px."""
    color_cx_px: float = 320.0
    """Principal point of the color camera; fitted on RedKitchen to 1 px, together with the baseline."""
    color_cy_px: float = 237.8
    """Principal point of the color camera; fitted on RedKitchen: depth edges fall on color edges."""
    baseline_m: float = 0.025
    """The color camera sits this far to the right (+x) of the depth camera; a point shifts by -f b / z pixels."""
    color_focal_y_px: float = Field(0.0, ge=0)
    """Focal length of the color camera along y; 0: that along x."""
    color_distortion: str = ""
    """Lens of the color camera: k1 k2 p1 p2 [k3] as OpenCV has them; empty: none. With this option, the one before or
    the one after, color is seen as by a pinhole camera that is turned as the depth camera is."""
    color_rotation_rad: str = ""
    """Rotation vector x y z that takes directions of the depth camera to those of the color camera; empty: none."""
    depth_correction_per_m: str = ""
    """Smooth error of the depth camera, c0 .. c5: 1/z + c0 (1 - 2 m / z) + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2 is
    the true 1/z at the ray (x, y, 1); empty: none."""
    rate_hz: int = Field(30, gt=0, le=1000)
    """Frames per second; the dataset has no time stamps."""
    reference_poses: str = ""
    """File of true poses to take instead of the dataset's, by structure from motion: a line per image, in the format of
    `pgt/sfm/7scenes/redkitchen_train.txt` of Brachmann et al. (ICCV 2021). Frames it lacks have no ground truth."""
    reference_sequence: str = ""
    """Which sequence of that file a folder holds that is not called seq-NN, for example "seq-01"."""
    sequences: str = Field("", coerce_numbers_to_str=True)
    """Numbers of the sequences to take, for example "1,3"; all if empty. Several make one robot each."""

    def depth_camera(self) -> PinholeCamera:
        """The camera that the depth images were taken with."""
        f = self.depth_focal_px
        return PinholeCamera(WIDTH, HEIGHT, f, f, self.depth_cx_px, self.depth_cy_px)

    @field_validator(*LENGTHS)
    @classmethod
    def _are_numbers(cls, text: str, info: ValidationInfo) -> str:
        assert info.field_name is not None
        numbers(text, LENGTHS[info.field_name])
        return text

    def lens(self) -> Lens:
        """The camera that the color images were taken with."""
        f, fy = self.color_focal_px, self.color_focal_y_px or self.color_focal_px
        source = PinholeCamera(WIDTH, HEIGHT, f, fy, self.color_cx_px, self.color_cy_px)
        x, y, z = numbers(self.color_rotation_rad, LENGTHS["color_rotation_rad"]) or (0.0, 0.0, 0.0)
        distortion = numbers(self.color_distortion, LENGTHS["color_distortion"])
        return Lens(source, distortion, rotation_rad=(x, y, z))

    def color_camera(self) -> PinholeCamera:
        """The camera of the color images in the recording."""
        return square_camera(self.lens())

    def depth_correction(self) -> tuple[float, ...]:
        """c0 .. c5, or nothing."""
        return numbers(self.depth_correction_per_m, LENGTHS["depth_correction_per_m"])


@dataclass(frozen=True)
class SevenScenesFrame:
    """The files of one frame; `pose` is None in a sequence without poses."""

    number: int
    color: Path
    depth: Path
    pose: Path | None


def convert(src: Path, out: Path, robots: int = 1, force: bool = False, **options: Any) -> None:
    """Convert one sequence, cut into `robots` contiguous parts, or several sequences, one robot each.

    All robots start at time 0, as if they had moved together; they share the world of the dataset.

    Args:
        src: a folder of frames, or a folder of `seq-NN` folders.
        out: the recording to write.
        robots: number of parts of a single sequence; of several sequences, their number.
        force: replace a recording that is there.
        options: see `Options`.
    Raises:
        DuagError: names the file, what was found and what was expected.
    """
    determinism.configure_opencv()
    settings = options_of(Options, options, "7scenes")
    parts, skipped = _parts(Path(src), robots, settings)
    source = {
        "dataset": "7-Scenes",
        "folder": Path(src).resolve().name,
        "sequences": sorted({p[0] for p in parts if p[0]}),
    }
    references = [_reference(Path(src), sequence, frames, settings) for sequence, frames in parts]
    parameters = {"robots": robots, **settings.model_dump()}
    parameters["reference_poses"] = Path(settings.reference_poses).name
    with RecordingWriter(out, "", source, "7scenes", parameters=parameters, force=force) as recording:
        recording.warnings += skipped
        recording.warnings.append(
            f"no time stamps in the dataset: made from frame numbers at {settings.rate_hz} Hz"
        )
        for name, (_, frames), reference in zip(robot_names(len(parts)), parts, references, strict=True):
            # no name of a folder, which is no content; empty, as of a sequence alone, whose digest stays what it was
            sensors = {"depth": "Kinect v1, registered to color by the converter", "sequence": ""}
            with recording.robot(name, settings.color_camera(), DEPTH_SCALE, sensors) as robot:
                check = _write_robot(robot, frames, reference, settings, label=str(src))
            recording.checks[name] = {
                "first_frame": frames[0].number,
                "last_frame": frames[-1].number,
                **check,
            }
            if reference is not None:
                known = sum(files.number in reference for files in frames)
                if known < len(frames):
                    recording.warnings.append(f"{name}: reference poses of {known} of {len(frames)} frames")
            elif frames[0].pose is None:
                recording.warnings.append(f"{name}: the sequence has no poses: no ground truth")


# --- which frames make which robot ----------------------------------------------------------------------------------


def _parts(
    src: Path, robots: int, options: Options
) -> tuple[list[tuple[str, list[SevenScenesFrame]]], list[str]]:
    """(name of the sequence, its frames) per robot, and warnings about frames that are missing."""
    folders = _sequence_folders(src, options)
    warnings: list[str] = []
    sequences = []
    for folder in folders:
        if (folder / OTHER_CAMERAS).is_file() and not options.model_fields_set >= FOCAL_LENGTHS:
            raise DuagError(
                f"{folder / OTHER_CAMERAS}: found, as in BundleFusion, with other cameras than 7-Scenes; "
                "expected --set depth_focal_px=, color_focal_px= and the other numbers of its cameras, baseline_m=0 if "
                "depth is registered"
            )
        frames, missing = list_frames(folder)
        frames = options.first(frames)
        missing = [number for number in missing if number < frames[-1].number]
        sequences.append((folder.name if len(folders) > 1 or folder != src else "", frames))
        if missing:
            shown = ", ".join(str(n) for n in missing[:10]) + (", ..." if len(missing) > 10 else "")
            warnings.append(
                f"{folder.name}: {len(missing)} frame numbers are missing and were skipped: {shown}"
            )
    if len(sequences) > 1:
        if robots != len(sequences):
            found = ", ".join(name for name, _ in sequences)
            expected = f"expected --robots {len(sequences)}, or one sequence chosen with --set sequences=1"
            raise DuagError(f"{src}: found sequences {found} for {robots} robots, {expected}")
        return sequences, warnings
    name, frames = sequences[0]
    robot_names(robots)
    if len(frames) < robots:
        raise DuagError(f"{src}: found {len(frames)} frames, expected at least {robots} for {robots} robots")
    cuts = [i * len(frames) // robots for i in range(robots + 1)]
    return [(name, frames[a:b]) for a, b in pairwise(cuts)], warnings


def _sequence_folders(src: Path, options: Options) -> list[Path]:
    if not src.is_dir():
        raise DuagError(f"{src}: no such folder, expected a sequence of 7-Scenes")
    found: dict[int, Path] = {}
    for path in sorted(src.iterdir()):
        if (match := SEQUENCE_FOLDER.fullmatch(path.name)) and path.is_dir():
            add_numbered(found, int(match[1]), path)
    if not options.sequences:
        return [found[n] for n in sorted(found)] or [src]
    wanted = [text.strip() for text in options.sequences.split(",")]
    if not all(text.isdigit() and int(text) in found for text in wanted):
        numbers = ", ".join(str(n) for n in sorted(found)) or "none"
        raise DuagError(f"{src}: found sequences {numbers}, expected {options.sequences!r} among them")
    return [found[n] for n in sorted({int(text) for text in wanted})]


def list_frames(folder: Path) -> tuple[list[SevenScenesFrame], list[int]]:
    """Frames of a sequence in order of their number, and the numbers that are missing in between.

    Args:
        folder: of the sequence.

    Raises:
        DuagError: a frame lacks its color, depth or (unless the sequence has no pose at all) its pose.
    """
    files: dict[str, dict[int, Path]] = {kind: {} for kind in KINDS}
    for path in sorted(folder.iterdir()):
        match = FRAME_FILE.fullmatch(path.name)
        if match and (match[2] == "pose") == (match[3] == "txt"):
            add_numbered(files[match[2]], int(match[1]), path)
    numbers = sorted(set().union(*files.values()))
    if not numbers:
        raise DuagError(f"{folder}: found no frame-NNNNNN.color.png or .jpg, expected a sequence of 7-Scenes")
    if numbers[-1] - numbers[0] > MOST_NUMBERS:
        raise DuagError(
            f"{folder}: frame numbers from {numbers[0]} to {numbers[-1]}, expected at most {MOST_NUMBERS} of a sequence"
        )
    kinds = KINDS if files["pose"] else KINDS[:2]
    for kind in kinds:
        for number in numbers:
            if number not in files[kind]:
                there = next(files[k][number] for k in KINDS if number in files[k])
                raise DuagError(
                    f"{there}: has no {kind} in the same folder, expected frame-{number:06d}.{kind}.*"
                )
    missing = sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers))
    return [
        SevenScenesFrame(n, files["color"][n], files["depth"][n], files["pose"].get(n)) for n in numbers
    ], missing


def _reference(
    src: Path, sequence: str, frames: list[SevenScenesFrame], options: Options
) -> Reference | None:
    """T_world_color by frame number where other poses than the dataset's are asked for."""
    if not options.reference_poses:
        if options.reference_sequence:
            raise DuagError("7scenes: found reference_sequence alone, expected reference_poses with it")
        return None
    path = Path(options.reference_poses)
    name = sequence or (src.name if SEQUENCE_FOLDER.fullmatch(src.name) else options.reference_sequence)
    reference = reference_poses.read(path, name)
    first, last = frames[0].number, frames[-1].number
    if not any(files.number in reference for files in frames):
        raise DuagError(f"{path}: found none of frames {first} to {last}, expected poses of some of them")
    return reference


# --- one robot ------------------------------------------------------------------------------------------------------


def _write_robot(
    robot: RobotWriter,
    frames: list[SevenScenesFrame],
    reference: Reference | None,
    options: Options,
    *,
    label: str,
) -> dict[str, Any]:
    """Write all frames of a robot; returns what the self-check measured."""
    cameras = options.depth_camera(), options.color_camera()
    check = ReprojectionCheck(options.color_camera(), len(frames))
    lens, correction = options.lens(), options.depth_correction()
    robot.set_lens(None if is_pinhole(lens) else lens)
    holes = invalid = 0

    def images(files: SevenScenesFrame) -> tuple[bytes, str, Depth]:
        measured = correct(_depth_m(files.depth), options.depth_camera(), correction)
        depth = displaced_depth(measured, *cameras, options.baseline_m)
        return *kept_color(files.color, (WIDTH, HEIGHT)), depth

    found = zip(frames, in_order(images, frames), strict=True)
    titled = track(found, f"convert {robot.name}", total=len(frames))
    for index, (files, (color, color_format, depth)) in enumerate(titled):
        T_world_camera = _true_pose(files, reference, options)
        check.add(index, depth, T_world_camera)
        stamp_ns = (files.number - frames[0].number) * NANOSECONDS // options.rate_hz
        raw, _ = units_of_depth(depth, DEPTH_SCALE)
        robot.add_frame(stamp_ns, color, color_format, raw, T_world_camera=T_world_camera)
        holes += _count_holes(raw)
        invalid += raw.size - int(np.count_nonzero(raw))
    pixels = len(frames) * WIDTH * HEIGHT
    rates = {"registered_without_depth": invalid / pixels, "registered_holes": holes / pixels}
    return {**rates, **check.result(label)}


def _true_pose(files: SevenScenesFrame, reference: Reference | None, options: Options) -> Array | None:
    """T_world_camera [4, 4] of the recording's camera, None where it is not known."""
    if reference is not None:
        T_world_color = reference.get(files.number)
        T_color_camera = se3.from_rotation_translation(options.lens().rotation(), np.zeros(3))
        return None if T_world_color is None else T_world_color @ T_color_camera
    if files.pose is None:
        return None
    T_depth_camera = se3.from_rotation_translation(np.eye(3), [options.baseline_m, 0.0, 0.0])
    return _read_pose(files.pose) @ T_depth_camera


def _count_holes(depth: NDArray[np.uint16]) -> int:
    """Pixels without depth whose left and right, or upper and lower, neighbors have some: cracks of the warp."""
    full = depth != 0
    between = np.zeros_like(full)
    np.logical_and(full[:, :-2], full[:, 2:], out=between[:, 1:-1])
    between[1:-1] |= full[:-2] & full[2:]
    return int(np.count_nonzero(between > full))


def _depth_m(path: Path) -> Depth:
    """Depth [480, 640] in meters, 0 where there is none."""
    raw = read_depth(path, (WIDTH, HEIGHT), "depth in millimeters")
    return raw.astype(np.float64) * DEPTH_SCALE


def _read_pose(path: Path) -> Array:
    """T_world_depth [4, 4], its rotation made exactly orthonormal."""
    try:
        T = np.array(read_text(path, "4x4 numbers").split(), dtype=np.float64).reshape(4, 4)
    except ValueError as error:
        raise DuagError(f"{path}: {error}, expected 4x4 numbers") from error
    return rigid(T, str(path))
