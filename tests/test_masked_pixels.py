"""What is under a mask is nothing to the estimator: other colors and depths there change no byte of its results."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from duagc.converters.simulate.team import simulate
from duagc.converters.writer import RecordingWriter
from duagc.pipeline import messages
from duagc.pipeline.config.base import load_config
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.recording import Recording, open_rgbd, read_log
from duagc.pipeline.runner import run
from duagc.pipeline.runs.digest import digest_file, result_files
from duagc.pipeline.runs.folder import RunFolder
from duagc.schemas import topics
from tests.fixtures.small_run import SMALL

SIZE = (160, 120)


def body() -> np.ndarray:
    """The bottom corner, as a robot sees its own gripper, and a rim."""
    valid = np.ones((SIZE[1], SIZE[0]), bool)
    valid[90:, 40:120] = False
    valid[:3] = valid[:, :2] = False
    return valid


def arm(k: int) -> np.ndarray:
    """What moves in front of the camera in some frames."""
    usable = np.ones((SIZE[1], SIZE[0]), bool)
    usable[30:70, 20 + 3 * k : 40 + 3 * k] = False
    return usable


def masked(source: Recording, out: Path, seed: int | None) -> Path:
    """The recording with masks, and under them what a seed draws; None: what there was."""
    rng = np.random.default_rng(seed)
    with RecordingWriter(out, "masked") as recording:
        for name in source.robots:
            with open_rgbd(source.log(name)) as log:
                truth = source.groundtruth(name)
                assert truth is not None
                poses = [
                    messages.unpack_pose_in_frame(record.proto())
                    for record in read_log(truth, [topics.GROUNDTRUTH_POSE.of(name)])
                ]
                with recording.robot(name, log.camera, log.depth_scale, find_regions=False) as robot:
                    robot.set_valid(body())
                    for frame in log.frames():
                        usable = arm(frame.index) if frame.index % 3 == 1 else None
                        hidden = ~(body() if usable is None else body() & usable)
                        color, depth = frame.color[:, :, ::-1].copy(), frame.depth / log.depth_scale
                        raw = np.rint(depth).astype(np.uint16)
                        if seed is not None:
                            color[hidden] = rng.integers(0, 256, color.shape, dtype=np.uint8)[hidden]
                            raw[hidden] = rng.integers(0, 5000, raw.shape, dtype=np.uint16)[hidden]
                        png = cv2.imencode(".png", color)[1].tobytes()
                        robot.add_frame(
                            frame.stamp_ns, png, "png", raw, mask=usable, T_world_camera=poses[frame.index]
                        )
    return out


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, Path]]:
    """Recording and run, of the frames as they were and with noise under the masks."""
    folder = tmp_path_factory.mktemp("masked")
    simulate(folder / "plain", robots=2, frames=10, size=SIZE, seed=1, overlap=0.9, workers=1)
    plain, out = Recording(folder / "plain"), []
    for seed in (None, 7):
        recording = masked(plain, folder / f"recording-{seed}", seed)
        config = load_config(RunConfig, overrides=SMALL)
        out_folder = folder / f"run-{seed}"
        run(recording, out_folder, config, workers=1, until="evaluation", log=lambda line: None)
        out.append((recording, out_folder))
    return out


def test_no_byte_of_the_results_depends_on_what_is_masked(runs: list[tuple[Path, Path]]) -> None:
    first, second = ({p: r / p for p in result_files(r)} for _, r in runs)
    assert set(first) == set(second)
    assert len(first) >= 8
    different = [str(name) for name in first if digest_file(first[name]) != digest_file(second[name])]
    assert different == []


def test_the_scores_are_those_of_the_other_pixels(runs: list[tuple[Path, Path]]) -> None:
    first, second = (RunFolder(run_folder).metrics["rendering"] for _, run_folder in runs)
    assert first == second
    assert first["own"]["held_out"]["psnr_db"] is not None
