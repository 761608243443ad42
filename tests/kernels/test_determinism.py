"""The same bits for any number of threads, any instruction set, any process, any load, any history of the memory."""

import hashlib
import multiprocessing
from functools import cache

import numpy as np
import pytest

from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.kernels import FisherSums, LossWeights, Rasterizer, available_isas
from tests.kernels.scenes import make_scene, random_gaussians

CAMERA = PinholeCamera(203, 117, 90.0, 92.0, 101.2, 57.1)
SMALL_CAMERA = PinholeCamera(107, 61, 47.4, 48.0, 53.2, 29.6)
LOSS = LossWeights(color_huber=0.1, depth_weight=0.5, depth_huber_m=0.02, alpha_weight=0.02)
SURFACE = LossWeights(**{**vars(LOSS), "surface_weight": 0.3})
CALLS = [(isa, threads) for isa in available_isas() for threads in (1, 2, 3, 5)]
QUICK = [call for call in CALLS if call[0] != "portable" or call[1] in (1, 3)]  # it imitates fma, at length
FAST = [call for call in QUICK if call[0] != "portable"] or QUICK[:1]
SLOW = [pytest.param(*call, marks=pytest.mark.slow) for call in CALLS if call not in QUICK]
PORTABLE = [call for call in QUICK if call not in FAST]
MANY, FEW = 3000, 1000  # Gaussians: in the slow tests, and in `make test`


def digest(rasterizer: Rasterizer, count: int = FEW) -> str:
    """SHA-256 over every output of views of so many Gaussians."""
    camera = CAMERA if count == MANY else SMALL_CAMERA
    gaussians = random_gaussians(count, seed=1)
    rng, shape = np.random.default_rng(2), (camera.height, camera.width)
    d_color, d_depth, d_alpha = (rng.normal(size=s).astype(np.float32) for s in ((*shape, 3), shape, shape))
    of_color, of_depth = (rng.uniform(0, 1e3, shape).astype(np.float32) for _ in range(2))
    color, depth_m = rng.random((*shape, 3)).astype(np.float32), rng.uniform(0, 4, shape).astype(np.float32)
    view = gaussians, camera, np.eye(4)
    arrays: list[np.ndarray] = []
    for depth, mask in (("blended", None), ("ray_plane", rng.random(shape) < 0.8)):
        sums = FisherSums(len(gaussians), diagonal=True)
        render = rasterizer.forward(*view, (0.1, 0.2, 0.3), depth_kind=depth, mask=mask)
        gradients = rasterizer.backward(d_color, d_depth, d_alpha, pose=True, fisher=True)
        by_pose = rasterizer.backward(d_color, d_depth, d_alpha, pose=True, parameters=False)
        rasterizer.fisher(of_color, of_depth, sums, residual=of_depth)
        opacity, seen = np.zeros(len(gaussians)), np.zeros(len(gaussians), np.uint32)
        rasterizer.opacity_information(of_color, of_depth, opacity, seen)
        arrays += [opacity, seen]
        arrays += [*vars(render).values(), *vars(gradients).values(), *sums.arrays().values(), by_pose.pose]
        arrays += [rasterizer.full_fisher(of_color, of_depth), *rasterizer.contributions()]
        again, layer_m = rasterizer.forward_with_layer(*view, depth_kind=depth, mask=mask)
        assert np.array_equal(again.alpha, render.alpha)
        arrays += [layer_m]
        loss, gradients = rasterizer.view_gradients(
            *view,
            color=color,
            depth_m=depth_m,
            loss=LOSS,
            exposure=(0.1, -0.05),
            mask=mask,
            depth_kind=depth,
            pose=True,
        )
        _, of_surface = rasterizer.view_gradients(
            *view,
            color=color,
            depth_m=depth_m,
            loss=SURFACE,
            mask=mask,
            depth_kind=depth,
            depth_certainty=color[..., 0].copy(),
        )
        arrays += [a for a in vars(of_surface).values() if a is not None]
        alone, _ = rasterizer.view_gradients(
            *view, color=color, depth_m=depth_m, loss=SURFACE, mask=mask, depth_kind=depth, parameters=False
        )
        arrays += [np.array([alone.value, alone.surface])]
        statistics = rasterizer.statistics()
        arrays += [a for a in vars(gradients).values() if a is not None]
        arrays += [np.array([loss.value, loss.color, loss.depth, *loss.d_exposure])]
        arrays += [np.array([statistics.visible, statistics.intersections])]
        arrays += [np.array([statistics.evaluated_pairs, statistics.blended_pairs])]
        _, closed_early = rasterizer.view_gradients(
            *view, color=color, depth_m=depth_m, loss=SURFACE, mask=mask, depth_kind=depth, closing=0.05
        )
        arrays += [a for a in vars(closed_early).values() if a is not None]
    assert len(arrays) == 2 * 44
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


@cache
def one_digest(count: int = FEW) -> str:
    return digest(Rasterizer(*CALLS[0]), count)


@pytest.mark.parametrize(("isa", "threads"), FAST + PORTABLE[:1])
def test_one_digest_for_threads_and_instruction_sets(isa, threads):
    assert digest(Rasterizer(isa, threads)) == one_digest()


@pytest.mark.slow
def test_one_digest_while_the_number_of_threads_changes():
    class Changing:
        calls = 0

        def __index__(self) -> int:
            self.calls += 1
            return 1 + self.calls % 4

    threads = Changing()
    assert digest(Rasterizer(threads=threads)) == one_digest()
    assert threads.calls >= 3


@pytest.mark.parametrize(("isa", "threads"), [*QUICK, *SLOW])
def test_one_digest_of_many_gaussians(isa, threads):
    assert digest(Rasterizer(isa, threads), MANY) == one_digest(MANY)


def digest_of(call: tuple[str, int], count: int) -> str:
    return digest(Rasterizer(*call), count)


@pytest.mark.parametrize(
    ("calls", "count"), [(FAST, FEW), pytest.param(QUICK, MANY, marks=pytest.mark.slow)], ids=["fast", "all"]
)
def test_one_digest_for_processes(calls, count):
    """Fresh processes, each with addresses and hash seeds of its own."""
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        tasks = [(call, count) for call in calls * 2]
        assert set(pool.starmap(digest_of, tasks, chunksize=len(calls))) == {one_digest(count)}


def be_busy() -> None:
    """Work without end, with caches and vector units."""
    block = np.random.default_rng(0).random((400, 400))
    while True:
        block = block @ block / 200.0


@pytest.mark.slow
def test_one_digest_under_load():
    """Two busy processes take the cores away in the middle of parallel sections."""
    busy = [multiprocessing.get_context("spawn").Process(target=be_busy, daemon=True) for _ in range(2)]
    for process in busy:
        process.start()
    try:
        digests = {digest_of(call, MANY) for _ in range(12) for call in CALLS}
        assert all(process.is_alive() for process in busy)
    finally:
        for process in busy:
            process.terminate()
            process.join()
    assert digests == {one_digest(MANY)}


def test_scratch_of_other_views_leaves_no_trace():
    rasterizer = Rasterizer(threads=2)
    for kind in ("wide", "opaque", "behind"):
        scene = make_scene(kind)
        rasterizer.forward(scene.gaussians, scene.camera, scene.T_camera_map)
        rasterizer.backward(scene.image(0, 3), fisher=True)
        assert digest(rasterizer) == one_digest()


def test_order_of_the_arrays_does_not_matter():
    gaussians = random_gaussians(500, seed=4)  # all depths differ
    order = np.random.default_rng(5).permutation(500)
    rasterizer, d_color = Rasterizer(), np.ones((CAMERA.height, CAMERA.width, 3), dtype=np.float32)
    first = rasterizer.forward(gaussians, CAMERA, np.eye(4))
    gradients = rasterizer.backward(d_color)
    second = rasterizer.forward(gaussians.select(order), CAMERA, np.eye(4))
    permuted = rasterizer.backward(d_color)
    np.testing.assert_array_equal(first.color, second.color)
    np.testing.assert_array_equal(gradients.means[order], permuted.means)
