"""Fusion as laws: weighted means, nothing from nothing, every robot counted once, whatever the order."""

import numpy as np
import pytest

from duagc.pipeline.config.consensus import ColorConfig
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.consensus.matching import MapMatching
from duagc.pipeline.consensus.weights import Weights
from duagc.pipeline.fusion.association import association_covariance, weighted_move
from duagc.pipeline.fusion.fuse import OwnMap
from duagc.pipeline.geometry import se3, so3, spd
from duagc.pipeline.splat.gaussians import Gaussians
from duagc.pipeline.splat.information import COLOR, COLOR_INFORMATION, LOG_COVARIANCE, MEAN, pack_information
from tests.fixtures.gaussian_worlds import (
    ALIKE,
    CONFIG,
    MATCHING,
    N,
    World,
    assert_same_map,
    fused,
    random_pose,
)


def test_fused_means_minimize_the_sum_of_all_members():
    """Against the normal equations written out, one place at a time, where these stay among their members."""
    world = World(0)
    fused = world.fuse("alpha", ALIKE)
    there = {n: world.evidence[n].in_world(world.T_world[n]) for n in world.names}
    shapes = spd.log_covariance(fused.gaussians.quats_wxyz, fused.gaussians.log_scales)
    compared = 0
    for k in range(N):
        means, weights, forms, form_weights = [], [], [], []
        for e in there.values():
            spread = association_covariance(e.theta[k : k + 1, LOG_COVARIANCE], CONFIG.spacing_per_sigma)[0]
            spread = spread + 0.5 * ALIKE.scatter_position_m**2 * np.eye(3)
            means.append(e.theta[k, MEAN])
            weights.append(np.linalg.inv(np.linalg.inv(e.position_information()[k]) + spread))
            forms.append(e.theta[k, LOG_COVARIANCE])
            form_weights.append(
                np.linalg.inv(
                    np.linalg.inv(e.shape_information()[k])
                    + 0.5 * ALIKE.scatter_log_covariance**2 * np.eye(6)
                )
            )
        # float32 maps: 6e-8 of a few meters, and of log-scales of about five
        for actual, values, W, atol in (
            (fused.gaussians.means[k], means, weights, 2e-6),
            (shapes[k], forms, form_weights, 5e-5),
        ):
            expected = np.linalg.solve(sum(W), sum(w @ v for w, v in zip(W, values, strict=True)))
            center = np.mean(values, axis=0)
            if np.linalg.norm(expected - center) < 0.99 * np.linalg.norm(values - center, axis=1).max():
                np.testing.assert_allclose(actual, expected, atol=atol)
                compared += 1
        color = [1 / (1 / e.color_information()[k] + 0.5 * ALIKE.scatter_color**2) for e in there.values()]
        mean = sum(w * e.theta[k, 9:12] for w, e in zip(color, there.values(), strict=True)) / sum(color)
        np.testing.assert_allclose(fused.gaussians.colors[k], mean, atol=1e-6)
    assert compared > N
    assert (fused.matched, fused.added) == (N, 0)
    assert np.all(fused.members == 3)


def test_all_robots_arrive_at_the_same_gaussians():
    world = World(1)
    results = [world.fuse(name, ALIKE) for name in world.names]
    for other in results[1:]:
        np.testing.assert_allclose(other.gaussians.means, results[0].gaussians.means, atol=2e-6)
        np.testing.assert_allclose(
            other.gaussians.opacity_logits, results[0].gaussians.opacity_logits, atol=2e-6
        )
        shapes = [
            spd.log_covariance(r.gaussians.quats_wxyz, r.gaussians.log_scales) for r in (other, results[0])
        ]
        np.testing.assert_allclose(*shapes, atol=5e-5)
        np.testing.assert_array_equal(other.information, results[0].information)


def tinted(world, **cameras):
    """The same robots with other cameras: gain and offset [3] by name."""
    maps, evidence = dict(world.maps), dict(world.evidence)
    for name, (gain, offset) in cameras.items():
        e, m = evidence[name], maps[name]
        theta, sums = e.theta.copy(), e.information.copy()
        theta[:, COLOR] = gain * theta[:, COLOR] + offset
        sums[:, COLOR_INFORMATION] /= np.square(gain)
        colors = gain * m.colors + offset
        maps[name], evidence[name] = (
            m.replace(colors=colors.astype(np.float32)),
            Evidence(name, e.ids, e.anchors, theta, sums),
        )
    return maps, evidence


def test_every_robot_keeps_its_own_colors_and_the_maps_agree():
    """Against the same team with equal cameras: all else is fused alike, and colors, put into one camera's, too."""
    world = World(20)
    rng = np.random.default_rng(20)
    shared = rng.uniform(size=(N, 3))
    for k, name in enumerate(world.names):  # splats of one place have nearly one color
        world.evidence[name].theta[:, COLOR] = shared + 0.01 * np.random.default_rng(k).normal(size=(N, 3))
        colors = world.evidence[name].theta[:, COLOR].astype(np.float32)
        world.maps[name] = world.maps[name].replace(colors=colors)
    gain, offset = np.array([0.7, 0.8, 1.3]), np.array([0.02, -0.03, 0.01])
    compared = MapMatching(colors=ColorConfig(min_matches=N, splats_per_sample=1))
    alike = {name: world.fuse(name, ALIKE, matching=compared) for name in world.names}
    world.maps, evidence = tinted(world, bravo=(gain, offset))
    differ = {name: world.fuse(name, ALIKE, evidence=evidence, matching=compared) for name in world.names}
    for name in world.names:
        np.testing.assert_allclose(differ[name].gaussians.means, alike[name].gaussians.means, atol=1e-6)
        expected = alike[name].gaussians.colors
        if name == "bravo":
            expected = gain * expected + offset
        np.testing.assert_allclose(differ[name].gaussians.colors, expected, atol=0.01)
        there = differ[name].colors["charlie" if name == "bravo" else "bravo"]
        true = (1 / gain) if name != "bravo" else gain
        np.testing.assert_allclose(there.gain, true, rtol=0.03)
    in_alphas = differ["alpha"].colors["bravo"].to_other(differ["bravo"].gaussians.colors)
    np.testing.assert_allclose(in_alphas, differ["alpha"].gaussians.colors, atol=1e-6)
    converted = differ["alpha"].information[:, COLOR_INFORMATION] * differ["alpha"].colors["bravo"].gain ** 2
    np.testing.assert_allclose(converted, differ["bravo"].information[:, COLOR_INFORMATION], rtol=1e-6)


def test_order_of_arrival_does_not_change_a_bit():
    world = World(2)
    first = world.fuse("bravo")
    rng = np.random.default_rng(3)
    evidence = {}
    for name in reversed(world.names):
        evidence[name] = world.evidence[name].select(rng.permutation(N))
    pairs = {p: world.pairs[p][rng.permutation(N)] for p in reversed(world.pairs)}
    again = world.fuse("bravo", evidence=evidence, pairs=pairs)
    assert_same_map(again, first)


def test_by_default_a_well_known_splat_keeps_its_place_on_the_surface():
    """Partners 8 mm along and 4 mm across the surface: the own one stays where it is sure and goes where it is not."""
    maps, evidence = tilted_discs(0.0, 0.004, 100.0)
    lifted = evidence["bravo"].theta.copy()
    lifted[:, MEAN] += [0.008, 0, 0]
    e = evidence["bravo"]
    evidence["bravo"] = Evidence("bravo", e.ids, e.anchors, lifted, e.information)
    own = np.array([0, 0, -0.002])
    along, _, across = fuse_discs(maps, evidence).gaussians.means[0] - own
    assert 0 <= along < 0.004
    assert 0 <= across < 1e-4
    alike = fuse_discs(maps, evidence, ALIKE).gaussians.means[0] - own
    np.testing.assert_allclose(alike, [0.004, 0, 0.002], atol=3e-4)
    a = evidence["alpha"]
    vague = Evidence("alpha", a.ids, a.anchors, a.theta, 1e-6 * a.information)
    moved = fuse_discs(maps, evidence, self_information=vague).gaussians.means[0] - own
    np.testing.assert_allclose(moved, [0.008, 0, 0.004], atol=3e-4)


def test_no_information_is_lost():
    world = World(4)
    fused = world.fuse("charlie")
    total = sum(world.evidence[n].in_world(world.T_world[n]).information for n in world.names)
    np.testing.assert_allclose(fused.information, total, rtol=1e-12)


def test_zero_information_moves_nothing():
    """Two know, one does not: exactly as if the third was not there."""
    world = World(5)
    evidence = world.evidence | {"charlie": world.without_information("charlie")}
    pair = {("alpha", "bravo"): world.pairs["alpha", "bravo"]}
    without = {n: world.evidence[n] for n in ("alpha", "bravo")}
    fused = world.fuse("alpha", evidence=evidence)
    expected = world.fuse("alpha", evidence=without, pairs=pair)
    np.testing.assert_array_equal(fused.gaussians.means, expected.gaussians.means)
    np.testing.assert_array_equal(fused.gaussians.quats_wxyz, expected.gaussians.quats_wxyz)
    np.testing.assert_array_equal(fused.information, expected.information)


def test_where_neighbors_know_nothing_every_bit_stays():
    world = World(6)
    blind = {n: world.without_information(n) for n in ("bravo", "charlie")}
    T_world = world.T_world | {"alpha": world.T_map["alpha"]}  # alpha is the root and did not move
    fused = world.fuse("alpha", evidence=world.evidence | blind, T_world_keyframe=T_world)
    for name in ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits"):
        np.testing.assert_array_equal(getattr(fused.gaussians, name), getattr(world.maps["alpha"], name))


def test_nobody_knows_anything_the_own_value_stays():
    world = World(7)
    blind = {n: world.without_information(n) for n in world.names}
    fused = world.fuse("bravo", evidence=blind)
    moved = world.maps["bravo"].moved(world.T_map["bravo"], world.T_world["bravo"])
    np.testing.assert_array_equal(fused.gaussians.means, moved.means)
    np.testing.assert_array_equal(fused.information, 0)


def test_alone_a_map_stays_bit_for_bit():
    world = World(8, robots=1)
    fused = world.fuse("alpha", T_world_keyframe={"alpha": world.T_map["alpha"]})
    for name in ("ids", "anchors", "means", "quats_wxyz", "log_scales", "colors", "opacity_logits"):
        np.testing.assert_array_equal(getattr(fused.gaussians, name), getattr(world.maps["alpha"], name))
    assert (fused.matched, fused.added) == (0, 0)


def test_agreement_is_a_fixed_point():
    """Members that say the same leave it so, whatever their information: fusing again changes nothing."""
    world = World(9, robots=2)
    there = world.evidence["alpha"].in_world(world.T_world["alpha"])
    copy = Evidence(
        "bravo", world.maps["bravo"].ids, np.zeros(N), there.theta, world.evidence["bravo"].information
    )
    fused = world.fuse(
        "alpha",
        evidence={"alpha": world.evidence["alpha"], "bravo": copy},
        T_world_keyframe={"alpha": world.T_world["alpha"], "bravo": np.eye(4)[None]},
    )
    moved = world.maps["alpha"].moved(world.T_map["alpha"], world.T_world["alpha"])
    np.testing.assert_allclose(fused.gaussians.means, moved.means, atol=1e-6)
    np.testing.assert_allclose(fused.gaussians.opacity_logits, moved.opacity_logits, atol=1e-6)


def test_turning_the_world_turns_the_fused_map():
    world = World(10)
    T = random_pose(np.random.default_rng(11))
    fused = world.fuse("alpha")
    turned = world.fuse("alpha", T_world_keyframe={n: T @ world.T_world[n] for n in world.names})
    expected = se3.transform(T, fused.gaussians.means.astype(np.float64))
    np.testing.assert_allclose(turned.gaussians.means, expected, atol=3e-6)


def test_unknown_directions_keep_the_own_value():
    """One axis known to both, one to the neighbor only, one to none."""
    weights = np.array([np.diag([1.0, 0.0, 0.0]), np.diag([3.0, 2.0, 0.0])])
    values = np.array([[0.0, 0.0, 0.0], [4.0, 5.0, 6.0]])
    move = weighted_move(weights, values, np.array([0]), 1e-12)
    np.testing.assert_allclose(move, [[3.0, 5.0, 0.0]], atol=1e-9)


def test_association_spreads_along_the_surface_only():
    quat, sigma = np.array([0.9, 0.1, -0.3, 0.2]), np.array([0.02, 0.01, 0.001])
    spread = association_covariance(spd.log_covariance(quat, np.log(sigma))[None], 2.0)[0]
    values, vectors = np.linalg.eigh(spread)
    np.testing.assert_allclose(
        values, np.array([0.0, 0.01**2 - 0.001**2, 0.02**2 - 0.001**2]) * 4 / 12, atol=1e-15
    )
    normal = np.linalg.eigh(spd.vec_to_sym(spd.log_covariance(quat, np.log(sigma))))[1][:, 0]
    np.testing.assert_allclose(np.abs(vectors[:, 0] @ normal), 1.0, atol=1e-9)


def tilted_discs(tilt_rad, offset_m, shape_information):
    """Two discs at the thickness floor, `offset_m` apart along their normals, sure of them to 0.1 mm."""
    maps, evidence = {}, {}
    for name, sign in (("alpha", -1.0), ("bravo", 1.0)):
        quat = so3.quat_from_rotvec([[0.5 * sign * tilt_rad, 0, 0]])
        scales = np.log([[0.02, 0.02, MATCHING.thickness_floor_m]])
        mean = np.array([[0, 0, 0.5 * sign * offset_m]])
        maps[name] = Gaussians([0], [0], mean, quat, scales, np.zeros((1, 3)), [0.0])
        bare = Evidence.from_map(name, maps[name], None, np.eye(4)[None])
        R = so3.from_quat_wxyz(quat)
        position = R @ np.diag([1e4, 1e4, 1e8]) @ R.swapaxes(-1, -2)
        normal = spd.sym_to_vec(R[:, :, 2, None] * R[:, None, :, 2])
        P = np.eye(6) - normal[:, :, None] * normal[:, None, :]  # as the information stage hands it over
        shape = shape_information * P
        packed = pack_information(position, shape, np.ones((1, 3)), np.ones(1))
        evidence[name] = Evidence(name, bare.ids, bare.anchors, bare.theta, packed)
    return maps, evidence


def fuse_discs(maps, evidence, config=CONFIG, self_information=None):
    origin = np.eye(4)[None]
    pairs = {("alpha", "bravo"): np.array([[0, 0]])}
    still = dict.fromkeys(maps, origin)
    own = OwnMap("alpha", maps["alpha"], origin, origin)
    return fused(
        own,
        evidence=evidence,
        T_world_keyframe=still,
        pairs=pairs,
        config=config,
        self_information=self_information,
    )


def test_tilted_discs_do_not_slide_to_where_their_planes_cross():
    maps, evidence = tilted_discs(0.05, 0.004, 1.0)
    fused = fuse_discs(maps, evidence, ALIKE)
    assert np.linalg.norm(fused.gaussians.means[0]) < 0.002  # between the two
    sure = fuse_discs(maps, evidence, ALIKE.model_copy(update={"scatter_position_m": 1e-6}))
    assert np.linalg.norm(sure.gaussians.means[0]) <= 0.0021  # not beyond either
    e = evidence["alpha"], evidence["bravo"]
    W = [x.position_information()[0] for x in e]
    crossing = np.linalg.solve(sum(W), sum(w @ x.theta[0, MEAN] for w, x in zip(W, e, strict=True)))
    assert np.linalg.norm(crossing) > 0.05  # where they would meet otherwise


def test_a_fused_value_never_leaves_its_members():
    """Farther from their weighted center than all of them; hostile weights: rank one, contradicting each other."""
    rng = np.random.default_rng(16)
    for d in (3, 6):
        axes, values = rng.normal(size=(4000, d, 1)), rng.normal(size=(4000, d))
        weights = 1e6 * axes @ axes.swapaxes(-1, -2) + 1e-3 * np.eye(d)
        first = np.arange(0, 4000, 4)
        values[first] = 0.0
        move = weighted_move(weights, values, first, 1e-9)
        groups = values.reshape(-1, 4, d)
        trace = np.trace(weights, axis1=1, axis2=2).reshape(-1, 4, 1)
        center = (trace * groups).sum(axis=1) / trace.sum(axis=1)
        reach = np.linalg.norm(groups - center[:, None], axis=-1).max(axis=1)
        assert np.all(np.linalg.norm(move - center, axis=1) <= reach * (1 + 1e-6))


def test_a_thickness_at_the_floor_stays_there():
    """However the others are tilted, and however sure of all but their own thickness."""
    for tilt_rad in (1e-3, 1e-2, 0.1, 0.3):
        maps, evidence = tilted_discs(tilt_rad, 0.0, 1e4)
        e = evidence["bravo"]
        larger = spd.log_covariance(
            maps["bravo"].quats_wxyz, np.add(maps["bravo"].log_scales, [0.3, 0.3, 0.0])
        )
        theta = e.theta.copy()
        theta[:, LOG_COVARIANCE] = larger
        fused = fuse_discs(
            maps, evidence | {"bravo": Evidence("bravo", e.ids, e.anchors, theta, e.information)}, ALIKE
        )
        scales = np.sort(fused.gaussians.log_scales[0])
        assert abs(scales[0] - np.log(MATCHING.thickness_floor_m)) < 0.1
        np.testing.assert_allclose(scales[1:], np.log(0.02) + 0.15, atol=0.1)


@pytest.mark.parametrize(("config", "most_sigma"), [(CONFIG, 3e-3), (ALIKE, 0.05)])
def test_what_is_fused_changes_no_faster_than_what_is_known(config, most_sigma):
    """No decision that rounding could tip: hostile evidence, changed by a millionth, moves nothing by more than a small
    part of a standard deviation, though members are hundreds apart and directions are known up to 1e8 apart."""
    rng = np.random.default_rng(17)
    n = 4000
    quats, scales = rng.normal(size=(n, 4)), rng.uniform(-7, -3, (n, 3))
    scales[::4, 1] = scales[::4, 2]  # axes alike: discs that could as well lie another way
    scales[::5] = scales[::5, :1]  # balls
    scales[::3, 0] = np.log(MATCHING.thickness_floor_m) + rng.normal(
        scale=2e-3, size=len(scales[::3])
    )  # at the floor
    places = rng.normal(size=(n, 3))
    maps, evidence = {}, {}
    for name in ("alpha", "bravo"):
        maps[name] = Gaussians(
            np.arange(n), np.zeros(n), places + 0.01 * rng.normal(size=(n, 3)),
            quats + 0.1 * rng.normal(size=(n, 4)), scales, rng.uniform(size=(n, 3)), rng.normal(size=n),
        )  # fmt: skip
        blocks = []
        for d, least in ((3, 1e0), (6, 1e-3)):
            Q = np.linalg.qr(rng.normal(size=(n, d, d)))[0]
            blocks.append((Q * (least * 10 ** rng.uniform(0, 8, (n, 1, d)))) @ Q.swapaxes(1, 2))
        packed = pack_information(*blocks, 10 ** rng.uniform(0, 5, (n, 3)), 10 ** rng.uniform(-2, 3, n))
        bare = Evidence.from_map(name, maps[name], None, np.eye(4)[None])
        evidence[name] = Evidence(name, bare.ids, bare.anchors, bare.theta, packed)

    def fused_once(evidence):
        pairs, still = {("alpha", "bravo"): np.stack([np.arange(n)] * 2, axis=1)}, np.eye(4)[None]
        return fused(
            OwnMap("alpha", maps["alpha"], still, still),
            evidence=evidence,
            T_world_keyframe={"alpha": still, "bravo": still},
            pairs=pairs,
            config=config.model_copy(update={"coverage": "overlap"}),
        )

    def shaken(e):
        less, theta = 1 + 1e-6 * rng.uniform(-1, 1, (n, 1)), e.theta.copy()
        if e.owner == "bravo":
            theta[:, LOG_COVARIANCE] += 1e-6 * rng.uniform(-1, 1, (n, 6))
        return Evidence(e.owner, e.ids, e.anchors, theta, e.information * less)

    one, other = fused_once(evidence), fused_once({name: shaken(e) for name, e in evidence.items()})
    sigma = 1 / np.sqrt(
        Weights.of(Evidence("", np.arange(n), np.zeros(n), one.theta, one.information)).diagonal()
    )
    assert np.max(np.abs(one.theta - other.theta) / sigma) < most_sigma


def test_evidence_of_other_gaussians_is_refused():
    world = World(15, robots=2)
    wrong = world.evidence["alpha"].select(slice(1, None))
    with pytest.raises(ValueError, match="own evidence"):
        world.fuse("alpha", evidence=world.evidence | {"alpha": wrong})
