"""Tracking under every disturbance from many places of a log; it takes minutes.

python -m duagc.pipeline.experiments.tracking_disturbances recordings/redkitchen/alpha.mcap --every 20
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from duagc.converters.simulate.settings import camera_of
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.evaluation import groundtruth
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.experiments import disturbances as d
from duagc.pipeline.experiments.disturbed_tracking import DisturbanceRow, Undisturbed
from duagc.pipeline.experiments.shots import Shot, filmed, resized
from duagc.pipeline.frontend.tracked import Status
from duagc.pipeline.frontend.tracking import Tracker
from duagc.pipeline.geometry import se3
from duagc.pipeline.recording import Recording, open_rgbd

FILMED = camera_of((240, 180))  # of the foreign room
FRAMES = 50  # of a trial
BEFORE = 17  # frames before a disturbance, half a second, by which a trial is aligned to the true poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("log", type=Path)
    parser.add_argument("--first", type=int, default=20, help="first frame that a disturbance begins at")
    parser.add_argument("--every", type=int, default=20, help="frames between such frames")
    parser.add_argument("--further", action="store_true", help="the other list of disturbances")
    arguments = parser.parse_args()
    with open_rgbd(arguments.log) as log:
        camera = log.camera
        shots = [Shot(f.index, f.stamp_ns, f.color, f.depth) for f in map(log.frame, range(len(log)))]
    starts = range(arguments.first, len(shots) - FRAMES // 2, arguments.every)
    truth = _true_poses(arguments.log, shots)
    run = Undisturbed(Tracker(camera, FrontendConfig()), shots, starts)
    lost = sum(frame.status is Status.LOST for frame in run.frames)
    print(f"{len(shots)} frames, {lost} lost undisturbed; {len(starts)} places")
    head = "disturbance       good while disturbed  wrong  worst mm  relocalized after  not found"
    print(f"{head}  worst mm from truth  undisturbed" if truth else head)
    disturbances = d.further() if arguments.further else d.every(resized(filmed(5, 30, FILMED), camera))
    for disturbance in disturbances:
        rows = [run.disturbed(start, disturbance, FRAMES) for start in starts]
        print(
            f"{disturbance.__name__:18}{_summary(rows)}{_errors_to_truth(run, truth, starts, rows)}",
            flush=True,
        )


def _summary(trials: Sequence[Sequence[DisturbanceRow]]) -> str:
    rows = [row for trial in trials for row in trial]
    disturbed = [row for row in rows if row.shot.disturbed]
    worst_m = max((row.moved_m for row in rows if row.good and not row.shot.foreign), default=0.0)
    undisturbed = [[row.good for row in trial if not row.shot.disturbed] for trial in trials]
    after = [good.index(True) for good in undisturbed if True in good]
    missing = sum(bool(good) and True not in good for good in undisturbed)
    good = f"{sum(row.good for row in disturbed)} of {len(disturbed)}"
    wrong = f"{sum(row.wrong for row in rows)} in {sum(any(row.wrong for row in t) for t in trials)}"
    return f"{good:>14} {wrong:>12} {1e3 * worst_m:9.0f} {max(after, default=0):18} {missing:10}"


def _true_poses(log: Path, shots: Sequence[Shot]) -> dict[int, np.ndarray]:
    """T_world_camera [4, 4] by frame index, of the frames that the recording has one of."""
    truth = groundtruth.trajectory(Recording(log.parent), log.stem)
    if isinstance(truth, Absent):
        return {}
    poses = dict(zip(truth.stamps_ns.tolist(), truth.poses, strict=True))
    return {shot.index: poses[shot.stamp_ns] for shot in shots if shot.stamp_ns in poses}


def _errors_to_truth(
    run: Undisturbed,
    truth: dict[int, np.ndarray],
    starts: Sequence[int],
    trials: Sequence[Sequence[DisturbanceRow]],
) -> str:
    """Largest error of good poses, mm, and that of the undisturbed run in the same frames.

    By the true poses, relative to the half second before the disturbance: the drift from the beginning of the log to
    there is no error of what came after.
    """
    disturbed, undisturbed = [0.0], [0.0]
    for start, rows in zip(starts, trials, strict=True):
        before = [k for k in range(start - BEFORE, start) if k in truth]
        if not before:
            continue
        # mean of the motions that align the map to the truth, in the tangent of the last of them
        aligned = [truth[k] @ se3.inverse(run.poses[k]) for k in before]
        T_world_map = aligned[-1] @ se3.exp(
            np.mean([se3.log(se3.inverse(aligned[-1]) @ T) for T in aligned], axis=0)
        )
        for row in rows:
            k = row.shot.index
            if k in truth and row.good and not row.shot.foreign:
                disturbed.append(float(se3.distance(truth[k], T_world_map @ row.T_map_camera)[0]))
                undisturbed.append(float(se3.distance(truth[k], T_world_map @ run.poses[k])[0]))
    return f" {1e3 * max(disturbed):20.0f} {1e3 * max(undisturbed):12.0f}" if len(disturbed) > 1 else ""


if __name__ == "__main__":
    main()
