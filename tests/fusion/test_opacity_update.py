"""Opacities of imported Gaussians: own pixels against the information of the owner."""

import numpy as np
import pytest

from duagc.pipeline.config.consensus import MapMatching
from duagc.pipeline.config.fusion import FinetuneConfig, FusionConfig
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.fuse import FusedMap
from duagc.pipeline.fusion.opacity_update import update_opacities
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import OPACITY, OPACITY_INFORMATION, theta_of
from tests.fixtures.speckled_wall import CAMERA, POSES, wall

CONFIG = FusionConfig()
SIGMA = 0.02


def views(mask=None) -> list[PosedRgbd]:
    """Images of the wall and of the third imported disc, but not of the first."""
    seen = with_imported(0.0).gaussians
    seen = seen.select(np.r_[: len(wall()), len(seen) - 1])
    out = []
    for T in POSES:
        render = Rasterizer().forward(seen, CAMERA, se3.inverse(T))
        color = np.clip(np.rint(255 * render.color), 0, 255).astype(np.uint8)
        out.append(PosedRgbd(color, np.zeros(color.shape[:2], np.float32), T, mask))
    return out


def with_imported(information: float) -> FusedMap:
    """The wall, and three white discs of a peer: in front of it, behind the cameras, in front of it again."""
    own = wall()
    means = np.array([[0.3, 0.0, 1.5], [0.0, 0.0, -2.0], [-0.3, 0.1, 1.6]])
    quats, scales = np.tile([1.0, 0, 0, 0], (3, 1)), np.tile(np.log([0.08, 0.08, 0.001]), (3, 1))
    imported = Gaussians(
        1000 + np.arange(3), np.zeros(3), means, quats, scales, np.ones((3, 3)), np.full(3, 2.0)
    )
    gaussians = Gaussians.concatenate([own, imported])
    n = len(gaussians)
    sums = np.zeros((n, 31))
    sums[:, OPACITY_INFORMATION] = information
    source = np.where(np.arange(n) < len(own), 0, 1).astype(np.int32)
    return FusedMap(
        gaussians=gaussians,
        theta=theta_of(gaussians),
        information=sums,
        robots=("alpha", "bravo"),
        source=source,
        source_ids=gaussians.ids,
        members=np.ones(n, np.int32),
        matched=0,
        added=3,
        colors={},
    )


def updated(information: float, config: FusionConfig = CONFIG, threads: int = 1, mask=None) -> FusedMap:
    fused = with_imported(information)
    context = MapContext(CAMERA, config, MapMatching(), threads=threads)
    return update_opacities(
        fused, views(mask), context, num_own=len(wall()), color_sigma=SIGMA, pixels_per_sample=9.0
    )


def test_what_own_pixels_contradict_fades_and_nothing_else_changes():
    before, after = with_imported(1.0), updated(1.0)
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


def test_more_information_of_the_owner_counts_more():
    n = len(wall())
    logits = [float(updated(w).gaussians.opacity_logits[n]) for w in (1.0, 1e3, 1e5, 1e12)]
    assert logits == sorted(logits)
    assert logits[-1] == pytest.approx(2.0, abs=1e-3)


def test_without_steps_or_usable_pixels_every_bit_stays():
    before = with_imported(1.0)
    none = np.zeros((CAMERA.height, CAMERA.width), bool)
    for after in (updated(1.0, CONFIG.model_copy(update={"own_pixel_steps": 0})), updated(1.0, mask=none)):
        np.testing.assert_array_equal(after.gaussians.opacity_logits, before.gaussians.opacity_logits)


def test_threads_do_not_show():
    one, three = updated(1.0), updated(1.0, threads=3)
    np.testing.assert_array_equal(one.gaussians.opacity_logits, three.gaussians.opacity_logits)


def test_of_a_long_log_each_view_takes_what_it_sees():
    long = CONFIG.model_copy(update={"finetune": FinetuneConfig(keyframes=2)})
    one, other = updated(1.0), updated(1.0, long)
    assert np.array_equal(one.gaussians.opacity_logits, other.gaussians.opacity_logits)
    assert not np.array_equal(one.gaussians.opacity_logits, with_imported(1.0).gaussians.opacity_logits)


def test_the_opacity_is_where_own_pixels_and_the_owner_together_cost_least():
    """Against a search over the logit of the disc that own images contradict; no residual is large enough to clip."""
    n, sigma, per_sample, weight = len(wall()), 0.6, 9.0, 2.0
    before, images = with_imported(weight), views()
    context = MapContext(CAMERA, CONFIG.model_copy(update={"own_pixel_steps": 12}), MapMatching())
    after = update_opacities(
        before, images, context, num_own=n, color_sigma=sigma, pixels_per_sample=per_sample
    )

    def cost(logit: float) -> float:
        logits = after.gaussians.opacity_logits.copy()
        logits[n] = logit
        shown, total = after.gaussians.replace(opacity_logits=logits), 0.5 * weight * (logit - 2.0) ** 2
        for view in images:
            render = Rasterizer().forward(shown, CAMERA, se3.inverse(view.T_world_camera))
            off = render.color.astype(np.float64) - view.unit_color
            total += np.sum(off**2) / (2 * sigma**2 * per_sample)
        return total

    tried = np.linspace(-1.5, 2.0, 141)
    best = tried[np.argmin([cost(logit) for logit in tried])]
    assert -1.0 < best < 1.5  # neither of the two decides alone
    assert after.gaussians.opacity_logits[n] == pytest.approx(best, abs=0.06)
