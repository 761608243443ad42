"""What a run that was measured says of its recording, and advises its user to try."""

from __future__ import annotations

from collections import Counter

from duagc.pipeline.base.component_names import robot_of
from duagc.pipeline.evaluation.network import Session, follows_moved
from duagc.pipeline.recording import Recording, open_rgbd
from duagc.pipeline.runs.folder import RunFolder

APART_PX = 1.0
"""Matched features of held-out views that are farther apart than this in the median speak of inexact cameras.

With exact cameras they are 0.15 to 0.65 px apart, with those that datasets state 1.7 to 2.1.
"""
FEWEST_PAIRS = 10
CERTAIN_SIGMAS = 4.0
"""Scales of depth that differ by more standard deviations are said to."""
APART_OF_OWN, APART_M = 10.0, 0.1
"""A team's error beyond this many times its robots' own errors, and this, is not one of tracking."""


def advice(run: RunFolder, source: Recording, session: Session) -> list[str]:
    """Sentences on what is wrong with the recording, most often none.

    Args:
        run: that was measured.
        source: its recording.
        session: the exchange of the run.
    """
    said = (
        joining_advice(run),
        calibration_advice(run, source),
        depth_scale_advice(run),
        moved_advice(session),
        truth_advice(run),
    )
    return [sentence for sentence in said if sentence]


def joining_advice(run: RunFolder) -> str:
    """A sentence that names the maps that were not joined; "" where all are in one frame, or not fused yet.

    Args:
        run: measured or not.
    """
    if not all((robot.folder / "fused.mcap").is_file() for robot in run.robots.values()):
        return ""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name, robot in run.robots.items():
        groups.setdefault(robot.component, []).append(name)
    if len(groups) < 2:
        return ""
    apart = "; ".join(", ".join(names) for names in groups.values())
    return (
        f"Not in one frame of the world: {apart}. No loop closures that hold join them; "
        "`duagc inspect --loop-closures` says why."
    )


def calibration_advice(run: RunFolder, source: Recording) -> str:
    """A sentence that advises to calibrate the cameras, where features speak of inexact ones; else "".

    Nothing is advised where a calibration was asked for already, or where depth is that of a LiDAR.

    Args:
        run: that was measured.
        source: its recording.
    """
    if run.calibration or source.calibration:
        return ""
    apart = []
    for name, robot in run.metrics["robots"].items():
        off_px, pairs = robot.get("feature_agreement_px"), robot.get("feature_agreement_pairs") or 0
        if off_px is not None and off_px > APART_PX and pairs >= FEWEST_PAIRS and not _by_lidar(source, name):
            apart.append(f"{off_px:.1f} px ({name})")
    if not apart:
        return ""
    return (
        f"Matched features of held-out views are {', '.join(apart)} apart, with exact cameras below 0.7 px: "
        "`duagc run --calibrate` may give better poses and maps."
    )


def depth_scale_advice(run: RunFolder) -> str:
    """A sentence that names robots whose depth is longer or shorter than that of the first of their component.

    Args:
        run: that was measured.
    """
    off = []
    for name, robot in run.metrics["robots"].items():
        scale = robot.get("depth_scale", {})  # runs of earlier versions have none
        ratio, sigma = scale.get("depth_ratio"), scale.get("sigma_depth_ratio")
        if ratio is not None and abs(ratio - 1.0) > CERTAIN_SIGMAS * sigma:
            off.append(f"{name} measures {ratio:.3f} ± {sigma:.3f} times the distances")
    if not off:
        return ""
    return (
        f"Scales of depth differ: {', '.join(off)} of the first robot, of the same things; "
        "poses between the robots are wrong by as much, and `depth_scale` at conversion corrects it."
    )


def moved_advice(session: Session) -> str:
    """A sentence that names robots between whose views something moved, by which they are not joined.

    Args:
        session: the exchange of the run.
    """
    moved = Counter(
        f"{min(d.robot, d.peer)} and {max(d.robot, d.peer)}"
        for d in session.loop_closures
        if follows_moved(d)
    )
    if not moved:
        return ""
    pairs = ", ".join(f"{pair} ({count})" for pair, count in sorted(moved.items()))
    return (
        f"Something moved between the views of {pairs} and stands in their maps where each saw it; "
        "loop closures that follow it, so many, are left out."
    )


def truth_advice(run: RunFolder) -> str:
    """A sentence that says so where robots agree with the ground truth each by itself, and not together.

    Args:
        run: that was measured.
    """
    errors = {
        name: (robot["ate_rmse_m"], robot["ate_rmse_m_joint"])
        for name, robot in run.metrics["robots"].items()
        if robot.get("ate_rmse_m") is not None and robot.get("ate_rmse_m_joint") is not None
    }
    if not errors:
        return ""
    own_m, joint_m = (max(values) for values in zip(*errors.values(), strict=True))
    if joint_m <= max(APART_M, APART_OF_OWN * own_m):
        return ""
    return (
        f"{' and '.join(errors)} agree with the ground truth to {1000 * own_m:.0f} mm each by itself, and to "
        f"{joint_m:.2f} m together: they were joined by what only looks alike, or their ground truths are in "
        "different frames."
    )


def _by_lidar(source: Recording, name: str) -> bool:
    with open_rgbd(source.log(robot_of(name))) as log:
        return log.swept
