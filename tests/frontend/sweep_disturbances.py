"""Every disturbance from many places of a log: the table of docs/lost-and-found.md. No test; it takes minutes.

python -m tests.frontend.sweep_disturbances recordings/redkitchen/alpha.mcap --every 20
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from pipeline.frontend.config import FrontendConfig
from pipeline.frontend.tracked import Status
from pipeline.frontend.tracking import Tracker
from pipeline.recording import open_rgbd
from tests.frontend import disturbances as d
from tests.frontend.disturbances import Row, Shot, Undisturbed
from tests.frontend.test_lost import filmed

FRAMES = 50  # of a trial


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
    run = Undisturbed(Tracker(camera, FrontendConfig()), shots, starts)
    lost = sum(frame.status is Status.LOST for frame in run.frames)
    print(f"{len(shots)} frames, {lost} lost undisturbed; {len(starts)} places")
    print("disturbance       good while disturbed  wrong  worst mm  found again after  not found")
    disturbances = d.further() if arguments.further else d.every(d.resized(filmed(5, 30), camera))
    for disturbance in disturbances:
        rows = [run.disturbed(start, disturbance, FRAMES) for start in starts]
        print(f"{disturbance.__name__:18}{_summary(rows)}", flush=True)


def _summary(trials: Sequence[Sequence[Row]]) -> str:
    rows = [row for trial in trials for row in trial]
    disturbed = [row for row in rows if row.shot.disturbed]
    worst_m = max((row.moved_m for row in rows if row.good and not row.shot.foreign), default=0.0)
    sound = [[row.good for row in trial if not row.shot.disturbed] for trial in trials]
    after = [good.index(True) for good in sound if True in good]
    missing = sum(bool(good) and True not in good for good in sound)
    good = f"{sum(row.good for row in disturbed)} of {len(disturbed)}"
    wrong = f"{sum(row.wrong for row in rows)} in {sum(any(row.wrong for row in t) for t in trials)}"
    return f"{good:>14} {wrong:>12} {1e3 * worst_m:9.0f} {max(after, default=0):18} {missing:10}"


if __name__ == "__main__":
    main()
