"""The section "Coverage" of a report: how much of every log has a pose, in which submaps, and what was lost."""

from __future__ import annotations

from typing import Any

from duagc.pipeline.evaluation.coverage import lost_stretches
from duagc.pipeline.report import labels
from duagc.pipeline.runs.folder import RunFolder

ROBOT = {
    "frames": ("Frames", "images in the robot's log"),
    "frames_without_pixel": ("Without a pixel", "left out: they show nothing, as with a covered lens"),
    "posed": ("Posed", "frames with a trusted pose in some component"),
    "coverage": ("Coverage", "posed frames as a share of those that show something"),
    "submaps": ("Submaps", "1 unless tracking began anew where the camera was lost"),
    "components": ("Components", "frames of their own that the robot's submaps end in, after the exchange"),
}
COMPONENT = {
    "robots": ("Robots", "that are part of it"),
    "posed": ("Posed", "frames with a trusted pose in it"),
    "coverage": ("Coverage", "as a share of all frames of the team that show something"),
    "ate_rmse_m": ("ATE", "position error under one alignment for this component"),
}
REASONS = {
    "low_overlap": "too little of the map in view",
    "ill_conditioned": "the images leave the motion open",
    "residual": "the images do not fit the map",
    "jump": "the motion would be too fast",
    "no_depth": "too few depths",
    "no_pixel": "the frame shows nothing",
    "frozen_depth": "the depth image is frozen",
    "frozen_color": "the color image is frozen",
    "repeated": "both images are those before, and the camera had moved",
    "obstructed": "something is in front of the camera, or it is elsewhere",
    "contradiction": "depth and color contradict each other",
    "unconfirmed": "not recognized, or not yet confirmed",
    "something_moved": "the pose would follow something that moves",
    "contradicted_by_features": "matched features contradict the pose",
    "contradicted_by_depth": "depth contradicts the pose",
    "other_component": "in a component of its own",
    "small_submap": "in a first submap that remained too small",
}


def coverage_content(run: RunFolder, metrics: dict[str, Any]) -> dict[str, Any]:
    """What the section shows, by name.

    Args:
        run: the run.
        metrics: of the run; those of earlier versions know nothing of coverage.
    """
    robots, components = metrics.get("coverage", {}), metrics.get("components", {})
    stretches = lost_stretches(run)
    return {
        "coverage_columns": list(ROBOT.values()),
        "coverage": [(name, _values(row, ROBOT)) for name, row in robots.items()],
        "component_columns": list(COMPONENT.values()),
        "components": [
            (name.replace("+", ", "), _values(row, COMPONENT)) for name, row in components.items()
        ],
        "submaps": [
            (s.submap, name, f"{s.first_frame} to {s.last_frame}", s.frames, s.keyframes, s.loop_closures)
            for name, robot in run.robots.items()
            for s in robot.submaps
        ],
        "lost": [
            (
                s.robot,
                str(s.first) if s.first == s.last else f"{s.first} to {s.last}",
                s.last - s.first + 1,
                f"{s.duration_s:.2f} s",
                REASONS.get(s.reason, s.reason),
            )
            for s in stretches
        ],
        "lost_frames": sum(s.last - s.first + 1 for s in stretches),
    }


def _values(row: dict[str, Any], columns: dict[str, tuple[str, str]]) -> list[str]:
    return [_text(name, row[name]) for name in columns]


def _text(name: str, value: Any) -> str:
    if name == "coverage" and value is not None:
        return f"{100 * value:.1f} %"
    return labels.text(name, value)
