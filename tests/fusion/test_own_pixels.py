"""Opacities of what was taken over: own pixels against what the owner knew."""

import numpy as np
import pytest

from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.fusion.finetune import View
from duagc.pipeline.fusion.fuse import FusedMap
from duagc.pipeline.fusion.opacity_update import weigh_by_own_pixels
from duagc.pipeline.geometry import se3
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import OPACITY, OPACITY_INFORMATION, theta_of
from tests.fusion.test_refine import CAMERA, POSES, wall

CONFIG = FusionConfig()
SIGMA = 0.02


def views(mask=None) -> list[View]:
    """Images of the wall and of the third of what is taken over, but not of the first."""
    seen = with_taken_over(0.0).gaussians
    seen = seen.select(np.r_[: len(wall()), len(seen) - 1])
    out = []
    for T in POSES:
        render = Rasterizer().forward(seen, CAMERA, se3.inverse(T))
        color = np.clip(np.rint(255 * render.color), 0, 255).astype(np.uint8)
        out.append(View(color, np.zeros(color.shape[:2], np.float32), T, mask))
    return out


def with_taken_over(information: float) -> FusedMap:
    """The wall, and three white discs of a neighbor's: before it, behind the cameras, before it again."""
    own = wall()
    means = np.array([[0.3, 0.0, 1.5], [0.0, 0.0, -2.0], [-0.3, 0.1, 1.6]])
    quats, scales = np.tile([1.0, 0, 0, 0], (3, 1)), np.tile(np.log([0.08, 0.08, 0.001]), (3, 1))
    taken = Gaussians(
        1000 + np.arange(3), np.zeros(3), means, quats, scales, np.ones((3, 3)), np.full(3, 2.0)
    )
    gaussians = Gaussians.concatenate([own, taken])
    n = len(gaussians)
    sums = np.zeros((n, 31))
    sums[:, OPACITY_INFORMATION] = information
    source = np.where(np.arange(n) < len(own), 0, 1).astype(np.int32)
    return FusedMap(
        gaussians, theta_of(gaussians), sums, ("alpha", "bravo"), source, gaussians.ids, np.ones(n, np.int32), 0, 3, {}
    )  # fmt: skip


def weighed(information: float, config: FusionConfig = CONFIG, threads: int = 1, mask=None) -> FusedMap:
    fused = with_taken_over(information)
    return weigh_by_own_pixels(
        fused, len(wall()), views(mask), CAMERA, SIGMA, 9.0, config, "blended", threads
    )  # fmt: skip


def test_what_own_pixels_contradict_fades_and_nothing_else_changes():
    before, after = with_taken_over(1.0), weighed(1.0)
    n = len(wall())
    hanging, unseen, fitting = after.gaussians.opacity_logits[n:]
    assert hanging < -2.0
    assert unseen == 2.0
    assert fitting == pytest.approx(2.0, abs=0.2)
    for name in ("ids", "means", "quats_wxyz", "log_scales", "colors"):
        np.testing.assert_array_equal(getattr(after.gaussians, name), getattr(before.gaussians, name))
    np.testing.assert_array_equal(after.gaussians.opacity_logits[:n], before.gaussians.opacity_logits[:n])
    np.testing.assert_array_equal(after.information, before.information)
    np.testing.assert_allclose(after.theta[:, OPACITY], after.gaussians.opacity_logits, atol=1e-6)


def test_an_owner_who_is_sure_is_believed_more():
    n = len(wall())
    logits = [float(weighed(w).gaussians.opacity_logits[n]) for w in (1.0, 1e3, 1e5, 1e12)]
    assert logits == sorted(logits)
    assert logits[-1] == pytest.approx(2.0, abs=1e-3)


def test_without_steps_or_usable_pixels_every_bit_stays():
    before = with_taken_over(1.0)
    none = np.zeros((CAMERA.height, CAMERA.width), bool)
    for after in (weighed(1.0, CONFIG.model_copy(update={"own_pixel_steps": 0})), weighed(1.0, mask=none)):
        np.testing.assert_array_equal(after.gaussians.opacity_logits, before.gaussians.opacity_logits)


def test_threads_do_not_show():
    one, three = weighed(1.0), weighed(1.0, threads=3)
    np.testing.assert_array_equal(one.gaussians.opacity_logits, three.gaussians.opacity_logits)
