"""Neighbors whose maps contradict own images, in whole or in part, whose Gaussians or matches are impossible."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.consensus import MapMatching
from duagc.pipeline.config.fusion import FusionConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.fusion.context import MapContext
from duagc.pipeline.fusion.peer_validation import ValidatedPeers, validate_peer_maps
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.posed_rgbd import PosedRgbd
from duagc.pipeline.kernels import Rasterizer
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import COLOR, LOG_COVARIANCE, MEAN, OPACITY, theta_of
from tests.fixtures.speckled_wall import CAMERA, POSES
from tests.fixtures.speckled_wall import wall as speckled


def wall() -> Gaussians:
    """Discs on a wall whose colors change smoothly, so that it matters little which of them is in front."""
    discs = speckled()
    return discs.replace(colors=0.5 + 0.4 * np.sin(1.5 * discs.means[:, [0, 1, 0]] + [0, 0, 1]))


N = len(wall())
HERE = np.eye(4)[None]


@pytest.fixture(scope="module")
def views() -> list[PosedRgbd]:
    return seen_from_poses(wall())


def seen_from_poses(discs: Gaussians) -> list[PosedRgbd]:
    out = []
    for T in POSES:
        render = Rasterizer().forward(discs, CAMERA, se3.inverse(T))
        alpha = np.maximum(render.alpha, 1e-6)
        color = np.rint(255 * np.clip(render.color / alpha[..., None], 0, 1)).astype(np.uint8)
        depth = np.where(render.alpha > 0.5, render.depth / alpha, 0).astype(np.float32)
        out.append(PosedRgbd(color, depth, T))
    return out


def map_of(robot: str, change=lambda theta: None, discs=()) -> Evidence:
    """The wall as a robot shares it, with small errors, changed; and discs (center, size, color) next to it."""
    rng = np.random.default_rng(len(robot))
    theta = theta_of(wall())
    theta[:, MEAN] += rng.normal(0, 0.002, (N, 3))
    theta[:, COLOR] += rng.normal(0, 0.02, (N, 3))
    change(theta)
    more = np.zeros((len(discs), 13))
    for row, (center, size_m, color) in zip(more, discs, strict=True):
        row[MEAN], row[COLOR], row[OPACITY] = center, color, 6.0
        row[LOG_COVARIANCE] = 2 * np.log(size_m) * np.array([1, 1, 1, 0, 0, 0])
    theta = np.concatenate([theta, more])
    ids = 10 + np.arange(len(theta))
    return Evidence(robot, ids, np.zeros(len(theta), np.int32), theta, np.ones((len(theta), 31)))


def validated_by_alpha(
    views: list[PosedRgbd],
    bravo: Evidence,
    pairs=None,
    threads: int = 1,
    arrived: float = 1.0,
    empty: bool = False,
) -> ValidatedPeers:
    ids = 10 + np.arange(N)
    pairs = {("alpha", "bravo"): np.stack([ids, ids], axis=1)} if pairs is None else pairs
    return validate_peer_maps(
        map_of("alpha").select(slice(0 if empty else None)).in_world(HERE),
        {"bravo": bravo.in_world(HERE)},
        pairs,
        MapContext(CAMERA, FusionConfig(), MapMatching(), threads=threads),
        views=views,
        depth_kinds={"bravo": "blended"},
        arrived={"bravo": arrived},
    )


def test_an_honest_peer_is_trusted(views):
    validated = validated_by_alpha(views, map_of("bravo"))
    (check,) = validated.checks
    assert check.trusted
    assert check.reason == ""
    assert (check.too_large, check.contradicted, check.rejected_matches) == (0, 0, 0)
    assert check.color_mse < 0.1 * check.color_variance
    assert check.compared_px > 0.5 * check.own_px
    assert len(validated.evidence["bravo"]) == len(validated.pairs["alpha", "bravo"]) == check.matches == N


def repaint(color):
    def change(theta):
        theta[:, COLOR] = color(theta[:, COLOR].copy())

    return change


@pytest.mark.parametrize("color", [lambda c: 1 - c, np.zeros_like, lambda c: c[::-1]])
def test_made_up_colors_leave_a_neighbor_out(views, color):
    validated = validated_by_alpha(views, map_of("bravo", repaint(color)))
    (check,) = validated.checks
    assert not check.trusted
    assert "contradicts own images" in check.reason
    assert len(validated.evidence["bravo"]) == len(validated.pairs["alpha", "bravo"]) == 0


@pytest.mark.parametrize(("share", "trusted"), [(1.0, False), (0.3, True)])
def test_of_a_part_of_a_map_less_is_expected(views, share, trusted):
    """Colors that explain a seventh of the variance: too little for a map, enough for a third of one."""
    noise = np.random.default_rng(0).normal(size=(N, 3))
    part = map_of("bravo", repaint(lambda c: c + 2.25 * c.std() * noise))
    (check,) = validated_by_alpha(views, part, arrived=share).checks
    assert 0.7 < check.color_mse / check.color_variance < 0.9
    assert check.trusted == trusted


@pytest.mark.parametrize("color", [lambda c: 1 - c, lambda c: np.zeros_like(c) + c.mean(axis=0)])
def test_a_small_part_of_a_lie_is_a_lie(views, color):
    assert not validated_by_alpha(views, map_of("bravo", repaint(color)), arrived=0.02).checks[0].trusted


def test_another_camera_is_no_lie(views):
    assert validated_by_alpha(views, map_of("bravo", repaint(lambda c: 0.6 * c + 0.05))).checks[0].trusted


def test_discs_before_own_cameras_are_contradicted_and_the_rest_is_trusted(views):
    """In free space, and next to the view of the first camera but reaching into it."""
    discs = [
        ((0.2, 0.1, 0.8), 0.05, (0, 0, 0)),
        ((-0.62, 0, 1.0), 0.15, (1, 1, 1)),
        ((0, 0, -3), 0.05, (0, 0, 0)),
    ]
    validated = validated_by_alpha(views, map_of("bravo", discs=discs))
    assert validated.checks[0].trusted
    assert validated.contradicted["bravo"][N:].tolist() == [True, True, False]
    assert np.mean(validated.contradicted["bravo"][:N]) < 0.05  # those that share pixels with them


def test_what_lies_behind_own_surfaces_is_not_judged(views):
    validated = validated_by_alpha(views, map_of("bravo", discs=[((0, 0, 4), 0.1, (0, 0, 0))]))
    assert not validated.contradicted["bravo"].any()


def test_gaussians_of_impossible_size_are_left_out(views):
    """Also those that no rasterizer can draw."""
    discs = [((0, 0, 4), 1.0, (0, 0, 0)), ((0, 0, 4), 1e13, (0, 0, 0)), ((0, 0, 4), 1e30, (0, 0, 0))]
    validated = validated_by_alpha(views, map_of("bravo", discs=discs))
    assert validated.checks[0].too_large == 3
    assert len(validated.evidence["bravo"]) == N


def test_matches_far_apart_unlike_or_of_nothing_are_refused(views):
    ids = 10 + np.arange(N)
    wrong = np.stack([ids, np.roll(ids, 1)], axis=1)
    validated = validated_by_alpha(views, map_of("bravo"), {("alpha", "bravo"): wrong})
    assert validated.checks[0].rejected_matches > 0.95 * N
    assert (
        validated_by_alpha(views, map_of("bravo"), {("alpha", "bravo"): wrong + 10_000})
        .checks[0]
        .rejected_matches
        == N
    )
    white = map_of("bravo", lambda theta: theta.__setitem__((slice(0, 20), COLOR), 2.0))
    assert validated_by_alpha(views, white).checks[0].rejected_matches == 20


def test_rejected_are_matches_of_what_was_received_and_no_others(views):
    """Of a refused map all of them; a match with a Gaussian that never arrived is no decision of the robot."""
    ids = 10 + np.arange(N)
    everyone = {("alpha", "bravo"): np.stack([ids, ids], axis=1)}
    assert validated_by_alpha(views, map_of("bravo"), everyone).rejected == {}
    inverted = map_of("bravo", repaint(lambda c: 1 - c))
    rejected = validated_by_alpha(views, inverted, everyone).rejected
    np.testing.assert_array_equal(rejected["alpha", "bravo"], everyone["alpha", "bravo"])
    late = inverted.select(slice(0, N - 30))
    rejected = validated_by_alpha(views, late, everyone).rejected
    np.testing.assert_array_equal(rejected["alpha", "bravo"], everyone["alpha", "bravo"][: N - 30])


def test_a_neighbor_that_shares_no_view_is_not_judged(views):
    away = map_of("bravo", lambda theta: theta.__setitem__((slice(None), 2), -5.0))
    check = validated_by_alpha(views, replace(away, theta=away.theta)).checks[0]
    assert check.trusted
    assert check.compared_px == check.contradicted == 0


def test_threads_do_not_show(views):
    bravo = map_of("bravo", discs=[((0.2, 0.1, 0.8), 0.05, (0, 0, 0))])
    one, three = validated_by_alpha(views, bravo), validated_by_alpha(views, bravo, threads=3)
    assert one.checks == three.checks
    np.testing.assert_array_equal(one.contradicted["bravo"], three.contradicted["bravo"])


def test_an_empty_own_map_takes_no_gaussian_for_too_large(views):
    check = validated_by_alpha(views, map_of("bravo"), empty=True).checks[0]
    assert (check.gaussians, check.too_large) == (N, 0)
    assert check.trusted


def shrunk(robot: str, factor: float) -> Evidence:
    evidence = map_of(robot)
    theta = evidence.theta.copy()
    theta[:, LOG_COVARIANCE] += 2 * np.log(factor) * np.array([1, 1, 1, 0, 0, 0])
    return replace(evidence, theta=theta)


def test_a_robot_with_small_gaussians_takes_a_peer_s_of_usual_size(views):
    """A camera near its surfaces makes small discs; twice the largest of them is less than others' usual ones."""
    ids = 10 + np.arange(N)
    bravo = map_of("bravo")
    validated = validate_peer_maps(
        shrunk("alpha", 0.2).in_world(HERE),
        {"bravo": bravo.in_world(HERE)},
        {("alpha", "bravo"): np.stack([ids, ids], axis=1)},
        MapContext(CAMERA, FusionConfig(), MapMatching()),
        views=views,
        depth_kinds={"bravo": "blended"},
        arrived={"bravo": 1.0},
    )
    assert (validated.checks[0].too_large, len(validated.evidence["bravo"])) == (0, N)


@pytest.mark.parametrize("own", [0, 1])
def test_without_neighbors_of_its_own_a_robot_believes_matches_of_two_peers(views, own):
    """tau_G of an own map without neighbors is zero: no two Gaussians are that much alike."""
    ids = 10 + np.arange(N)
    peers = {name: map_of(name).in_world(HERE) for name in ("bravo", "charlie")}
    validated = validate_peer_maps(
        map_of("alpha").select(slice(own)).in_world(HERE),
        peers,
        {("bravo", "charlie"): np.stack([ids, ids], axis=1)},
        MapContext(CAMERA, FusionConfig(), MapMatching()),
        views=views,
        depth_kinds=dict.fromkeys(peers, "blended"),
        arrived=dict.fromkeys(peers, 1.0),
    )
    assert len(validated.pairs["bravo", "charlie"]) > 0.9 * N


@pytest.mark.parametrize(("veils", "trusted"), [(60, True), (150, True), (400, False)])
def test_what_is_contradicted_counts_once(views, veils, trusted):
    """Gaussians in free space that hide much of the map do not make the rest a lie, unless they are many."""
    rng = np.random.default_rng(1)
    at = np.column_stack([rng.uniform(-1.2, 1.2, (veils, 2)), rng.uniform(0.9, 1.1, veils)])
    few = [(tuple(center), 0.08, tuple(rng.integers(0, 2, 3))) for center in at]
    validated = validated_by_alpha(views, map_of("bravo", discs=few))
    (check,) = validated.checks
    assert check.trusted == trusted
    used = validated.uncontradicted["bravo"].ids if trusted else []
    assert len(used) > 0.8 * N or not trusted
    assert not trusted or check.color_mse < 0.5 * check.color_variance


@pytest.mark.parametrize(("wrong", "trusted"), [(0.5, True), (0.9, False)])
def test_a_map_that_is_right_in_many_places_is_used_there(wrong, trusted):
    """As one that is seen from behind: more of it is wrong than right, and blocks of the images decide."""
    discs = speckled()
    seen = seen_from_poses(discs)
    theta, across = theta_of(discs), discs.means[:, 0]
    false = across < np.quantile(across, wrong)
    theta[false, COLOR] = np.random.default_rng(3).random((int(false.sum()), 3)).round()
    ids = 10 + np.arange(len(theta))
    peer = Evidence("bravo", ids, np.zeros(len(ids), np.int32), theta, np.ones((len(ids), 31)))
    (check,) = validated_by_alpha(seen, peer).checks
    assert check.color_mse > 0.7 * check.color_variance
    assert check.trusted == trusted


@pytest.mark.parametrize(("layers", "trusted"), [(2, True), (4, True), (20, False)])
def test_layers_in_free_space_that_hide_all_else_are_left_out(views, layers, trusted):
    """The map is judged by what stands where own depth images measured it, unless they are many."""
    rng = np.random.default_rng(2)
    x, y = (c.ravel() for c in np.meshgrid(np.linspace(-1.1, 1.1, 4), np.linspace(-0.8, 0.8, 3)))
    veils = []
    for z in np.linspace(0.5, 1.5, layers):
        # as wide as its part of the view
        places = zip(0.6 * z * x, 0.6 * z * y, strict=True)
        veils += [((*place, z), 0.25 * z, tuple(rng.integers(0, 2, 3))) for place in places]
    validated = validated_by_alpha(views, map_of("bravo", discs=veils))
    (check,) = validated.checks
    assert check.trusted == trusted
    assert not trusted or np.mean(validated.contradicted["bravo"][N:]) > 0.7
    assert not trusted or np.mean(validated.contradicted["bravo"][:N]) < 0.2
