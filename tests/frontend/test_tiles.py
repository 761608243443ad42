"""Tiles of a map: which keyframes make one, what their views see, and that only its own images change a Gaussian."""

from collections.abc import Iterable, Sequence

import numpy as np
import pytest

from duagc.pipeline.base import shelf
from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import SparseStepsConfig
from duagc.pipeline.frontend.growing_map import GrowingMap
from duagc.pipeline.frontend.mapping import Mapper
from duagc.pipeline.frontend.tiles import border_keyframes, make_tiles, take_tile
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.projection import back_project
from duagc.pipeline.geometry.view_extent import ViewExtent
from duagc.pipeline.kernels import LossWeights, Rasterizer
from duagc.pipeline.kernels.training import ScaleLimits, TrainingStep, TrainingView
from duagc.pipeline.splat.gaussians import Gaussians
from tests.frontend.test_mapping import CAMERA, POSES, QUICK, drawn, posed, same, shot


def test_every_keyframe_is_in_one_tile_with_its_neighbors() -> None:
    rooms = np.array([[0.0, 0, 0], [20, 0, 0], [0, 9, 0]])
    centers = np.concatenate(
        [rooms + 0.1 * k for k in range(12)]
    )  # the rooms are visited in turn, again and again
    tiles = make_tiles(centers, 12)
    assert sorted(k for tile in tiles for k in tile) == list(range(len(centers)))
    assert tiles[0][0] == 0
    assert max(map(len, tiles)) <= 12
    assert all(tile == sorted(tile) for tile in tiles)
    far = next(tile for tile in tiles if 1 in tile)
    assert {k % 3 for k in far} <= {1, 2} or len(far) > 6
    assert make_tiles(centers, 36) == [list(range(36))]
    assert [len(tile) for tile in make_tiles(centers, 14)] == [12] * 3


def test_the_border_looks_into_the_tile_from_all_sides() -> None:
    sight = ViewExtent.of(np.full((CAMERA.height, CAMERA.width), 2.0, np.float32), CAMERA)
    along = [(sight, se3.exp(np.array([0.5 * k, 0, 0, 0, 0, 0]))) for k in range(20)]
    assert border_keyframes([9, 10], range(20), along, 100) == [*range(5, 9), *range(11, 15)]
    assert border_keyframes([9, 10], range(20), along, 4) == [6, 8, 12, 14]
    assert border_keyframes([9, 10], range(3), along, 4) == []
    assert border_keyframes([9, 10], range(20), along, 0) == []


@pytest.mark.parametrize(
    ("point", "radius_m", "seen"),
    [
        ((0.0, 0.0, 1.9), 0.01, True),
        ((0.0, 0.0, 2.5), 0.01, False),  # behind the wall
        ((0.0, 0.0, 2.5), 0.6, True),  # but reaches through it
        ((0.9, 0.0, 2.5), 0.01, True),  # where nothing was measured
        ((0.0, 0.0, -1.0), 0.01, False),
        ((3.0, 0.0, 1.5), 0.01, False),  # outside of the image
        ((3.0, 0.0, 1.5), 2.5, True),
    ],
)
def test_a_view_sees_what_is_in_it_and_not_behind_its_depth(
    point: tuple[float, float, float], radius_m: float, seen: bool
) -> None:
    depth_m = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    depth_m[:, 44:] = 0.0
    T_map_camera = se3.exp(np.array([0.3, -0.2, 0.1, 0.2, 0.4, -0.1]))
    means = se3.transform(T_map_camera, np.array([point])).astype(np.float32)
    found = ViewExtent.of(depth_m, CAMERA).sees(means, np.array([radius_m], np.float32), T_map_camera)
    assert found.tolist() == [seen]


def _grown(views: int) -> GrowingMap:
    mapper = Mapper(CAMERA, QUICK, seed=5)
    for k in range(views):
        mapper.add_keyframe(k, posed(POSES[k]))
    return mapper.growing_map


def _sights(keyframes: Iterable[int]) -> list[tuple[ViewExtent, np.ndarray]]:
    return [(ViewExtent.of(shot(POSES[k])[1], CAMERA), POSES[k]) for k in keyframes]


def _by_id(gaussians: Gaussians) -> Gaussians:
    return gaussians.select(np.argsort(gaussians.ids, kind="stable"))


def test_what_is_taken_out_and_put_back_is_the_same_map(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shelf, "LEAST_BYTES", 0)  # this map is small
    whole = _grown(4)
    before, moments = whole.gaussians, whole.adam.state()[1]["means"]
    part = take_tile(whole, [3], _sights([3]), ())
    assert 0 < part.guests < len(part)
    assert (part.gaussians.anchors[part.guests :] == 3).all()
    assert len(whole)
    assert not (whole.gaussians.anchors == 3).any()
    whole.shelve()
    assert not whole.gaussians.means.flags.writeable
    assert not whole.adam.state()[1]["means"].flags.writeable
    whole.put_back(part)
    assert whole.gaussians.means.flags.writeable
    assert whole.adam.state()[1]["means"].flags.writeable
    order = np.argsort(whole.gaussians.ids, kind="stable")
    assert same(whole.gaussians.select(order), before)
    assert np.array_equal(whole.adam.state()[1]["means"][order], moments)
    assert whole.next_id == part.next_id


def _border(mapper: Mapper, keyframes: Iterable[int]) -> None:
    for k in keyframes:
        mapper.add_border(k, posed(POSES[k]))


def test_only_the_images_of_its_tile_change_a_gaussian_in_the_end() -> None:
    whole = _grown(2)
    ids = whole.gaussians.ids
    part = take_tile(whole, [2, 3], _sights([2, 3]), _sights([1]))
    assert part.guests == len(part) > 0
    mapper = Mapper(CAMERA, QUICK, seed=5, begun=part, tile=1)
    _border(mapper, [1])
    for k in (2, 3):
        mapper.add_keyframe(k, posed(POSES[k]))
    mapper.add_view(3, posed(POSES[3] @ se3.exp(np.full(6, 0.01))))
    guests = _by_id(mapper.gaussians.select(mapper.growing_map.is_guest))
    stats = mapper.finalize()
    assert stats.loss_after < stats.loss_before
    whole.put_back(mapper.growing_map)
    old = np.isin(whole.gaussians.ids, ids)
    assert same(_by_id(whole.gaussians.select(np.isin(whole.gaussians.ids, guests.ids))), guests)
    assert set(whole.gaussians.anchors[~old].tolist()) == {2, 3}


def test_views_at_the_border_are_drawn_as_their_camera_moved() -> None:
    config = QUICK.model_copy(update={"sparse": SparseStepsConfig(moving_from=0.7)})
    moments = se3.exp(np.linspace(-0.02, 0.02, 3)[:, None] * np.array([1.0, 0, 0, 0, 1, 0]))
    maps = []
    for given in (None, moments):
        part = take_tile(_grown(2), [2, 3], _sights([2, 3]), _sights([0, 1]))
        mapper = Mapper(CAMERA, config, seed=5, begun=part, tile=1)
        _border(mapper, [0, 1])
        for k in (2, 3):
            mapper.add_keyframe(k, posed(POSES[k]))
        assert mapper.border_keyframes == [0, 1]
        mapper.open_shutter([None, None, given, given])
        mapper.finalize()
        maps.append(mapper.gaussians)
    assert not same(*maps)


def _tiled(config: MappingConfig, tiles: Sequence[Sequence[int]], threads: int = 1) -> Mapper:
    """A mapper of the whole map that tiles were made of."""
    whole = GrowingMap(config)
    for final in (False, True):
        for number, tile in enumerate(tiles):
            others = [k for t in (tiles if final else tiles[:number]) for k in t if k not in tile]
            part = take_tile(whole, tile, _sights(tile), _sights(others))
            mapper = Mapper(CAMERA, config, seed=5, threads=threads, begun=part, tile=number)
            _border(mapper, others)
            for k in tile:
                if final:
                    mapper.put_back(k, posed(POSES[k]))
                else:
                    mapper.add_keyframe(k, posed(POSES[k]))
            if final:
                mapper.finalize()
            whole.put_back(mapper.growing_map)
    return Mapper(CAMERA, config, seed=5, begun=whole)


def test_tiles_are_drawn_as_well_as_one_map_with_the_same_bits_whatever_the_threads() -> None:
    config = MappingConfig(max_gaussians=4000, iterations=20, final_iterations=15)
    one = Mapper(CAMERA, config, seed=5)
    for k in range(4):
        one.add_keyframe(k, posed(POSES[k]))
    one.finalize()
    tiled = _tiled(config, ([0, 1], [2, 3]))
    between = POSES[1] @ se3.exp(0.5 * se3.log(se3.inverse(POSES[1]) @ POSES[2]))
    for T_map_camera in (POSES[0], between, POSES[3]):
        assert drawn(tiled, T_map_camera)[0] > drawn(one, T_map_camera)[0] - 1.0
    assert same(tiled.gaussians, _tiled(config, ([0, 1], [2, 3]), threads=3).gaussians)


@pytest.mark.parametrize("keep_guests", [True, False])
def test_a_step_of_what_a_view_sees_is_that_of_all(keep_guests: bool) -> None:
    config, step, limits = (
        QUICK,
        TrainingStep(Rasterizer(), LossWeights(0.1, 1.0, 0.02, 0.04), "blended"),
        ScaleLimits(np.float32(-7.0)),
    )
    maps = [take_tile(_grown(2), [1], _sights([1]), []) for _ in range(2)]
    view = TrainingView(shot(POSES[1])[0].astype(np.float32) / 255, shot(POSES[1])[1], POSES[1])
    part, count = maps[0], maps[0].guests
    seen = np.flatnonzero((step.gradients(part.gaussians, CAMERA, view)[1].colors[:count] != 0).any(axis=1))
    assert 0 < len(seen) < count < len(part)

    for _ in range(3):
        _, gradients = step.gradients(part.seen_with(seen), CAMERA, view)
        part.step(seen, gradients, config.rates, limits=limits, keep_guests=keep_guests)
        _, gradients = step.gradients(maps[1].gaussians, CAMERA, view)
        for array in (gradients.colors, gradients.opacity_logits):
            array[: count if keep_guests else 0] = 0
        maps[1].step_all(gradients, config.rates, limits=limits)
    assert same(part.gaussians, maps[1].gaussians)
    assert all(np.array_equal(a, b) for a, b in zip(*(m.adam.state()[1].values() for m in maps), strict=True))
    begun = take_tile(_grown(2), [1], _sights([1]), []).gaussians
    assert same(part.gaussians.select(slice(count)), begun.select(slice(count))) == keep_guests
    assert not same(part.gaussians.select(slice(count, None)), begun.select(slice(count, None)))


def test_guests_leave_room_for_what_a_tile_adds() -> None:
    config = QUICK.model_copy(update={"max_gaussians": 100, "seen_gaussians": 200})
    crowded = GrowingMap(config)
    crowded.append(_grown(1).gaussians)
    guests = len(crowded)
    assert guests > 200
    none = np.zeros(0, np.int64)
    part = crowded.take(np.arange(guests), none, uncounted=0)
    assert part.cap == guests + 50
    assert part.room == 0
    assert part.prune_least(10) == 0  # there are only guests
    part.put_back(crowded)
    part = part.take(np.arange(guests), none, uncounted=guests - 120)
    assert (part.cap, part.room) == (guests + 80, 80)  # 200, all that views see
    free = part.take(np.arange(guests), none, uncounted=guests)
    assert (free.cap, free.room) == (guests + 100, 100)


@pytest.mark.parametrize("size", [(1280, 720), (752, 480), (640, 480), (4000, 60)])
def test_the_last_rows_and_columns_of_any_image_count(size: tuple[int, int]) -> None:
    """What lies far away in the last rows alone, below something near, is seen."""
    width, height = size
    camera = PinholeCamera(width, height, 500.0, 500.0, width / 2 - 0.5, height / 2 - 0.5)
    depth_m = np.full((height, width), 1.0, np.float32)
    depth_m[-4:] = 4.0
    u = np.linspace(10, width - 10, 20)
    last = back_project(camera, u, np.full(20, height - 2.0), np.full(20, 3.9)).astype(np.float32)
    seen = ViewExtent.of(depth_m, camera).sees(last, np.full(20, 0.01, np.float32), np.eye(4))
    assert seen.all()
