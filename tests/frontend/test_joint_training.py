"""The end of the training of a map of tiles: the views of all tiles, each with all that it may see."""

import numpy as np

from duagc.pipeline.base.checkpoints import NO_CHECKPOINTS
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.evaluation.image_metrics import psnr
from duagc.pipeline.frontend.growing_map import GrowingMap
from duagc.pipeline.frontend.joint_training import JointTraining, JointView
from duagc.pipeline.frontend.mapping import Mapper
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from tests.frontend.test_mapping import CAMERA, POSES, posed, same, shot

CONFIG = MappingConfig(max_gaussians=2000, iterations=10)
UNSEEN_ID = 10**6
INFORMATION = 0.003**-2 * np.eye(6)
MOVED = se3.exp(np.array([0.004, -0.003, 0.002, 0.001, -0.002, 0.001]))


def _whole() -> GrowingMap:
    """A map of two views, and a Gaussian behind all of them."""
    mapper = Mapper(CAMERA, CONFIG, seed=5)
    for k in range(2):
        mapper.add_keyframe(k, posed(POSES[k]))
    whole = mapper.growing_map
    hidden = whole.gaussians.select(slice(1))
    whole.append(hidden.replace(means=np.array([[0, 0, -5]], np.float32), ids=np.array([UNSEEN_ID])))
    return whole


def _views(T_camera_tracked: np.ndarray) -> list[JointView]:
    def view(k: int) -> JointView:
        color, depth_m = shot(POSES[k])

        tracked = POSES[k] if k == 0 else POSES[k] @ T_camera_tracked
        return JointView(10 * k, tracked, INFORMATION, k == 0, lambda: PosedRgbd(color, depth_m, POSES[k]))

    return [view(k) for k in range(4)]


def _trained(
    threads: int = 1, steps: int = 60, pose_rate: float = CONFIG.pose_rate
) -> tuple[GrowingMap, JointTraining, int]:
    whole, config = _whole(), CONFIG.model_copy(update={"pose_rate": pose_rate})
    training = JointTraining(_views(MOVED), CAMERA, config, depth="blended", seed=5, threads=threads)
    pruned = training.run(whole, steps, NO_CHECKPOINTS, "final")
    return whole, training, pruned


def _mean_psnr(gaussians: Gaussians) -> float:
    views = [(T, shot(T)[0] / 255) for T in POSES[2:]]  # that the map was not made of
    drawn = [Rasterizer().forward(gaussians, CAMERA, se3.inverse(T)).color for T, _ in views]
    return float(np.mean([psnr(color, true) for color, (_, true) in zip(drawn, views, strict=True)]))


def test_all_views_train_what_they_see_and_move_to_where_the_map_shows_it() -> None:
    before = _whole()
    begun = before.gaussians
    whole, training, pruned = _trained()
    assert len(whole) == len(begun) - pruned
    assert _mean_psnr(whole.gaussians) > _mean_psnr(begun) + 1.0
    losses = training.losses
    assert list(losses) == [0, 10, 20, 30]
    poses = training.poses
    assert np.array_equal(poses[0], POSES[0])
    assert all(not np.array_equal(poses[10 * k], POSES[k] @ MOVED) for k in (1, 2, 3))
    fixed = _trained(pose_rate=0.0)[1]
    assert all(np.array_equal(fixed.poses[10 * k], POSES[k] @ MOVED) for k in (1, 2, 3))
    assert sum(losses.values()) < sum(fixed.losses.values())
    hidden = whole.gaussians.select(whole.gaussians.ids == UNSEEN_ID)
    assert same(hidden, begun.select(begun.ids == UNSEEN_ID))
    shared = np.isin(begun.ids, whole.gaussians.ids) & (begun.ids != UNSEEN_ID)
    kept = whole.gaussians.select(whole.gaussians.ids != UNSEEN_ID)
    assert (kept.means != begun.select(shared).means).any(axis=1).mean() > 0.5


def test_the_same_bits_whatever_the_threads() -> None:
    first, of_first, _ = _trained(steps=9)
    second, of_second, _ = _trained(threads=3, steps=9)
    assert same(first.gaussians, second.gaussians)
    assert of_first.losses == of_second.losses
    assert all(
        np.array_equal(a, b) for a, b in zip(of_first.poses.values(), of_second.poses.values(), strict=True)
    )


def test_views_without_a_step_have_no_loss() -> None:
    assert list(_trained(steps=0)[1].losses) == []
    assert len(_trained(steps=1)[1].losses) == 1
