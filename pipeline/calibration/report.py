"""A calibration in words, and as options of a converter."""

from __future__ import annotations

from typing import Any

from pipeline.calibration import Calibration
from pipeline.calibration.adjustment import Quality
from pipeline.calibration.rig import DEPTH, LENS, NAMES, ROTATION

UNITS = dict.fromkeys(NAMES, "1/m") | dict.fromkeys(LENS, "px") | dict.fromkeys(("k1", "k2", "k3"), "")
UNITS |= dict.fromkeys(ROTATION, "rad") | {"delay_s": "s"}


def plain(found: Calibration) -> dict[str, Any]:
    """As plain values: every number with its standard deviation and that of each half, the self-check, options."""
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
        "held_out": [
            {"half": name, "as_recorded": vars(before), "calibrated_by_the_other": vars(after)}
            for name, before, after in zip(found.names, found.before, found.after, strict=True)
        ],
        "options": options(found),
    }


def options(found: Calibration) -> dict[str, Any] | None:
    """Options of `duagc convert 7scenes` that take it, for a recording made by that without them; else None."""
    converter, used = found.recording["converter"]["name"], found.recording["parameters"]
    resampled = any(used.get(name) for name in ("color_focal_y_px", "color_distortion", "color_rotation_rad"))
    if converter != "7scenes" or resampled or used.get("depth_correction_per_m"):
        return None
    v = {name: float(value) for name, value in zip(NAMES, found.rig.values(), strict=True)}
    return {
        "color_focal_px": round(v["fx"], 2),
        "color_focal_y_px": round(v["fy"], 2),
        "color_cx_px": round(v["cx"], 2),
        "color_cy_px": round(v["cy"], 2),
        "color_distortion": _text([v["k1"], v["k2"], 0, 0, v["k3"]]),
        "color_rotation_rad": _text([v[name] for name in ROTATION]),
        "depth_correction_per_m": _text([v[name] for name in DEPTH]),
    }


def format_calibration(found: Calibration) -> str:
    """The same for people."""
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
    lines += ["", "agreement of a half: as recorded -> calibrated by the other half"]
    for name, before, after in zip(found.names, found.before, found.after, strict=True):
        lines.append(f"{name}: {_change(before, after)}")
    if tree["options"] is None:
        lines += [
            "",
            "the converter of this recording takes no calibration; see docs/recordings.md, Calibrating",
        ]
    else:
        lines += ["", "duagc convert 7scenes SRC --out REC \\"]
        lines.append(" \\\n".join(f"  --set {name}='{value}'" for name, value in tree["options"].items()))
    return "\n".join(lines)


def _change(before: Quality, after: Quality) -> str:
    return (
        f"features {before.features_px:.2f} -> {after.features_px:.2f} px, "
        f"their depth {before.depth_of_features:.2f} -> {after.depth_of_features:.2f} sigma(z), "
        f"depth images {before.depth:.2f} -> {after.depth:.2f} sigma(z)"
    )


def _text(values: list[float]) -> str:
    return " ".join(f"{value:.5f}" for value in values)
