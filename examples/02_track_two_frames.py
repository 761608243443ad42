"""Register two RGB-D frames and compare the estimated motion with the true one.

    python examples/02_track_two_frames.py

The frames are simulated; `duagc.open_rgbd` opens the log of any recording in the same way.
"""

import tempfile
from pathlib import Path

import duagc  # isort: skip  (before numpy: it sets what makes results reproducible)
import numpy as np

from duagc.pipeline.evaluation import groundtruth


def pyramid_of(log: duagc.RgbdLog, index: int) -> duagc.RgbdPyramid:
    """Image pyramid of one frame of a log."""
    frame = log.frame(index)
    return duagc.RgbdPyramid.build(frame.color.astype(np.float32) / 255, frame.depth, log.camera)


def main() -> None:
    """Simulate six frames of one robot, register the last to the first, print the motion and its uncertainty."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "room"
        duagc.simulate(recording, robots=1, frames=6, size=(320, 240), workers=1)
        with duagc.open_rgbd(duagc.Recording(recording).log("alpha")) as log:
            first, last = pyramid_of(log, 0), pyramid_of(log, 5)
        T_world_camera = groundtruth.trajectory(duagc.Recording(recording), "alpha").poses
    result = duagc.register(duagc.Reference.from_pyramid(first), last, np.eye(4), duagc.RegistrationConfig())
    print(f"outcome {result.outcome.name}, overlap {result.overlap:.2f}")
    T = result.T_reference_target
    print(f"moved by {1000 * np.linalg.norm(T[:3, 3]):.1f} mm")
    T_true = duagc.se3.inverse(T_world_camera[0]) @ T_world_camera[5]
    error_m, error_rad = duagc.se3.distance(T_true, T)
    print(f"error {1000 * error_m:.3f} mm, {1000 * error_rad:.3f} mrad")


if __name__ == "__main__":
    main()
