"""A calibration as text, as plain values, and as options of a converter."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from duagc import __version__
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.camera_calibration.calibrate import Calibration, Judged
from duagc.pipeline.camera_calibration.rig import DEPTH, LENS, NAMES, ROTATION
from duagc.pipeline.geometry import so3

CONVERTER = "7scenes"
AS_RECORDED = ("depth_focal_px", "depth_cx_px", "depth_cy_px", "baseline_m")
OPTIONS = {
    "color_focal_px": ("fx",),
    "color_focal_y_px": ("fy",),
    "color_cx_px": ("cx",),
    "color_cy_px": ("cy",),
    "color_distortion": ("k1", "k2", "k3"),
    "color_rotation_rad": ROTATION,
    "depth_correction_per_m": DEPTH,
}
"""Options of the converter that take a calibration, and the numbers that each takes."""
DEPTHS_M = (1.0, 3.0)  # at which a correction of depth is reported
BEFORE = ("color_focal_px", "color_cx_px", "color_cy_px")  # a recording may have other values of these

UNITS = dict.fromkeys(NAMES, "1/m") | dict.fromkeys(LENS, "px") | dict.fromkeys(("k1", "k2", "k3"), "")
UNITS |= dict.fromkeys(ROTATION, "rad") | {"delay_s": "s"}


def plain(found: Calibration) -> dict[str, Any]:
    """As plain values: every number with its standard deviation and those of each half, the self-check, options.

    Args:
        found: the calibration.
    """
    values = [found.rig.values(), *(half.values() for half in found.halves)]
    return {
        "views": found.views,
        "landmarks": found.landmarks,
        "halves": found.names,
        "values": {
            name: {
                "value": float(values[0][k]),
                "sigma": found.sigma[name],
                "of_halves": [float(v[k]) for v in values[1:]],
                "unit": UNITS[name],
            }
            for k, name in enumerate(NAMES)
        },
        "judged": [
            {
                "views": judged.views,
                "calibrated_by": judged.calibrated_by,
                "as_recorded": vars(judged.before),
                "calibrated": vars(judged.after),
            }
            for judged in found.judged
        ],
        "options": options(found),
    }


def not_taken(recording: dict[str, Any]) -> str:
    """Why no options of a converter would take a calibration of a recording; "" if some do.

    Args:
        recording: its description.
    """
    converter, used = recording.get("converter", {}).get("name"), recording.get("parameters", {})
    if converter != CONVERTER:
        return f"was made by {converter}, which takes no calibration, expected one by {CONVERTER}"
    if recording.get("calibration"):
        return "is calibrated already, expected one as its converter makes it"
    resampled = [name for name in OPTIONS if name not in BEFORE and used.get(name)]
    return f"was converted with {', '.join(resampled)}, expected one without" if resampled else ""


def options(found: Calibration) -> dict[str, float | str] | None:
    """Options of the recording's converter that take it, None if there are none (see `not_taken`).

    They include the cameras that the recording was made with: the calibration is relative to them.

    Args:
        found: the calibration.
    """
    if not_taken(found.recording):
        return None
    v = {name: float(value) for name, value in zip(NAMES, found.rig.values(), strict=True)}
    used = found.recording["parameters"]
    as_recorded = {name: used[name] for name in AS_RECORDED if name in used}
    pixels = {option: round(v[names[0]], 2) for option, names in OPTIONS.items() if names[0] in LENS[:4]}
    return (
        as_recorded
        | pixels
        | {
            "color_distortion": _text([v["k1"], v["k2"], 0, 0, v["k3"]]),
            "color_rotation_rad": _text([v[name] for name in ROTATION]),
            "depth_correction_per_m": _text([v[name] for name in DEPTH]),
        }
    )


def toml(found: Calibration) -> str:
    """The options as a file for `duagc convert --options`; comments give the uncertainty of each number.

    Args:
        found: the calibration.

    Raises:
        ValueError: no options take the calibration.
    """
    taken = options(found)
    if taken is None:
        raise ValueError(not_taken(found.recording))
    values = plain(found)["values"]
    name, version = json.dumps(found.recording["name"]), __version__
    lines = [
        f"Cameras of the recording {name} from its own images, by duagc {version}:",
        f"{found.views} views, {found.landmarks} features followed. As recorded -> as views that were not used "
        "calibrate it:",
        *(change(judged) for judged in found.judged),
        f"To use them: duagc convert {CONVERTER} SRC --options THIS_FILE --out REC",
        "",
        "cameras that the recording was made with; the rest is relative to them",
    ]
    lines = [f"# {line}" if line else "" for line in lines]
    for option, value in taken.items():
        if option in OPTIONS:
            lines += ["", *(f"# {_known(name, values[name])}" for name in OPTIONS[option])]
        lines.append(f"{option} = {json.dumps(value)}")
    later = _known("delay_s", values["delay_s"])
    return "\n".join([*lines, "", f"# {later}: color is so much later than depth; no option takes it", ""])


def check_out(out: Path, force: bool, recording: dict[str, Any], folder: Path) -> None:
    """Refuse, before anything is measured, a file that `write` would not write.

    Args:
        out: the file.
        force: whether it may exist.
        recording: description of the recording.
        folder: of the recording.

    Raises:
        DuagError: no options take the calibration, or the file cannot be written.
    """
    if why := not_taken(recording):
        raise DuagError(f"{folder}: {why}, for --out; see --apply")
    if out.suffix != ".toml" or not out.absolute().parent.is_dir():
        raise DuagError(
            f"{out}: found no such place for a file of options, expected NAME.toml in a folder that exists"
        )
    if out.exists() and not (force and out.is_file()):
        raise DuagError(f"{out}: exists already; choose another --out or give --force")


def write(found: Calibration, out: Path) -> None:
    """Write `toml`; the name appears only when the file is complete.

    Args:
        found: the calibration.
        out: the file.

    Raises:
        DuagError: the file cannot be written.
    """
    text, partial = toml(found), out.with_name(out.name + ".part")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(out)
    except OSError as error:
        raise DuagError(f"{out}: {error.strerror or error}, expected to write options") from error


def format_calibration(found: Calibration) -> str:
    """A calibration as a readable table.

    Args:
        found: the calibration.
    """
    tree = plain(found)
    lines = [
        f"{found.views} views, {found.landmarks} features followed; halves: {'; '.join(found.names)}",
        "",
        f"{'':8} {'value':>11} {'sigma':>10} {'first half':>11} {'second half':>11}",
    ]
    for name, entry in tree["values"].items():
        first, second = entry["of_halves"]
        lines.append(
            f"{name:8} {entry['value']:11.5f} {entry['sigma']:10.5f} {first:11.5f} {second:11.5f} {entry['unit']}"
        )
    lines += ["", "agreement of views that a calibration did not use: as recorded -> calibrated"]
    lines += [change(judged) for judged in found.judged]
    return "\n".join(lines)


def uses(found: Calibration) -> str:
    """What can be done with a calibration that is better, in two lines.

    Args:
        found: the calibration.
    """
    why = not_taken(found.recording)
    options = f"the recording {why}" if why else "--out FILE.toml writes this as options for duagc convert"
    return f"--apply REC writes the recording with these cameras\n{options}"


def changes(found: Calibration, delay_ns: int) -> list[str]:
    """What a recording with this calibration has that the recorded one has not, in sentences.

    Args:
        found: the calibration.
        delay_ns: how much earlier the stamps of depth become.
    """
    rig, c = found.rig, found.rig.camera
    rays = c.rays()[:: max(1, c.height // 24), :: max(1, c.width // 32)].reshape(-1, 3)
    moved = rig.project(rays @ rig.R_color_depth.T)[0] - c.project(rays)
    px = np.linalg.norm(moved, axis=-1)
    mm = [1e3 * np.abs(rig.depth(np.full(len(rays), 1 / z), rays) - z) for z in DEPTHS_M]
    turn = " ".join(f"{1e3 * angle:.1f}" for angle in so3.log(rig.R_color_depth))
    delay, sigma = 1e3 * rig.delay_s, 1e3 * found.sigma["delay_s"]
    stamps = f"stamps of depth moved by {-1e-6 * delay_ns:+.1f} ms" if delay_ns else "stamps as recorded"
    fx, fy, cx, cy, *lens = rig.lens.tolist()
    return [
        f"color resampled: pixels moved by {np.median(px):.1f} px (median), {px.max():.1f} px at most; "
        f"lens {fx:.1f} {fy:.1f} px, center {cx:.1f} {cy:.1f} px, distortion {_text(lens)}, "
        f"turned against depth by {turn} mrad",
        "depth corrected: "
        + ", ".join(
            f"at {z:g} m by {np.median(d):.1f} mm (median), {d.max():.1f} mm at most"
            for z, d in zip(DEPTHS_M, mm, strict=True)
        ),
        f"color {delay:.1f} +- {sigma:.1f} ms later than its stamps say: {stamps}",
        *(f"agreement, as recorded -> calibrated: {change(judged)}" for judged in found.judged),
    ]


def _known(name: str, entry: dict[str, Any]) -> str:
    """A number with its standard deviation, and the values by the halves."""
    first, second = entry["of_halves"]
    text = f"{name} = {entry['value']:.5f} +- {entry['sigma']:.5f} {entry['unit']}".rstrip()
    return f"{text} (halves {first:.5f}, {second:.5f})"


def change(judged: Judged) -> str:
    """How the agreement of views that a calibration did not use changes.

    Args:
        judged: the views.
    """
    before, after = judged.before, judged.after
    return (
        f"{judged.views}, by {judged.calibrated_by}: features {before.features_px:.2f} -> {after.features_px:.2f} px, "
        f"their depth {before.depth_of_features:.2f} -> {after.depth_of_features:.2f} sigma(z), "
        f"depth images {before.depth:.2f} -> {after.depth:.2f} sigma(z)"
    )


def _text(values: list[float]) -> str:
    return " ".join(f"{value:.5f}" for value in values)
