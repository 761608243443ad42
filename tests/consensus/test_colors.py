"""Gain and offset between cameras from matched Gaussians: found, symmetric, one for the team, no surer than known."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.consensus import ColorConfig
from duagc.pipeline.consensus import colors
from duagc.pipeline.consensus.colors import TeamColors, team_colors
from duagc.pipeline.consensus.evidence import Evidence
from duagc.pipeline.splat.information import COLOR

CONFIG = ColorConfig()
GAIN = {"alpha": [1.0, 1.0, 1.0], "bravo": [0.7, 0.8, 0.9], "charlie": [1.2, 1.0, 0.85]}
OFFSET = {"alpha": [0.0, 0.0, 0.0], "bravo": [0.02, -0.03, 0.01], "charlie": [-0.02, 0.03, 0.0]}
LINKS = (("alpha", "bravo"), ("alpha", "charlie"), ("bravo", "charlie"))


def world(n=4000, noise=0.05, seed=0, outliers=0.0, gain=GAIN, offset=OFFSET):
    """Robots that all see the same n Gaussians, each with splats and a camera of its own; ids count from zero."""
    rng = np.random.default_rng(seed)
    scene = rng.beta(1.2, 1.5, (n, 3))
    evidence = {}
    for name in sorted(gain):
        seen = scene + noise * rng.normal(size=(n, 3))
        wrong = rng.random(n) < outliers
        seen[wrong] = rng.random((wrong.sum(), 3))
        theta, information = np.zeros((n, 13)), np.zeros((n, 31))
        theta[:, COLOR] = seen * gain[name] + offset[name]
        information[:, 27:30] = 400.0
        evidence[name] = Evidence(name, np.arange(n), np.zeros(n), theta, information)
    ids = np.repeat(np.arange(n)[:, None], 2, axis=1)
    return evidence, {link: ids for link in LINKS if set(link) <= set(gain)}


def true_map(robot, other):
    gain = np.divide(GAIN[other], GAIN[robot])
    return gain, np.subtract(OFFSET[other], gain * OFFSET[robot])


@pytest.mark.parametrize("outliers", [0.0, 0.2])
def test_gain_and_offset_are_found_within_their_sigma(outliers):
    cameras = team_colors(*world(outliers=outliers), CONFIG)
    for robot, other in itertools.permutations(GAIN, 2):
        found, (gain, offset) = cameras.between(robot, other), true_map(robot, other)
        assert found.matches == 4000
        assert (np.abs(np.log(found.gain / gain)) < 2 * found.sigma_gain).all()
        assert (np.abs(np.log(found.gain / gain)) < 0.03).all()
        middle = np.full((1, 3), 0.45)
        assert np.abs(found.to_other(middle) - (gain * middle + offset)).max() < 0.01


def test_equal_cameras_are_found_equal():
    """A regression of one on the other would find gains of 0.93 here."""
    alike = {"alpha": [1.0] * 3, "bravo": [1.0] * 3}
    dark = {"alpha": [0.0] * 3, "bravo": [0.0] * 3}
    for seed in range(5):
        found = team_colors(*world(noise=0.07, seed=seed, gain=alike, offset=dark), CONFIG).between(
            "bravo", "alpha"
        )
        assert (np.abs(np.log(found.gain)) < found.sigma_gain).all()
        assert (np.abs(np.log(found.gain)) < 0.02).all()
        assert (np.abs(found.to_other(np.full((1, 3), 0.45)) - 0.45) < 0.005).all()


def test_there_and_back_and_around_is_the_same():
    cameras = team_colors(*world(noise=0.1), CONFIG)
    c = np.random.default_rng(1).random((5, 3))
    for a, b in itertools.permutations(GAIN, 2):
        there, back = cameras.between(a, b), cameras.between(b, a)
        np.testing.assert_allclose(back.to_other(there.to_other(c)), c, atol=1e-12)
        np.testing.assert_allclose(there.from_other(there.to_other(c)), c, atol=1e-12)
    around = c
    for a, b in (("alpha", "bravo"), ("bravo", "charlie"), ("charlie", "alpha")):
        around = cameras.between(a, b).to_other(around)
    np.testing.assert_allclose(around, c, atol=1e-12)


def test_names_and_order_of_pairs_change_nothing():
    evidence, pairs = world()
    cameras = team_colors(evidence, pairs, CONFIG)
    shuffled = team_colors(dict(reversed(evidence.items())), dict(reversed(pairs.items())), CONFIG)
    renamed = {"alpha": "zulu", "bravo": "mike", "charlie": "alpha"}
    others = team_colors(
        {renamed[n]: replace(e, owner=renamed[n]) for n, e in evidence.items()},
        {(renamed[b], renamed[a]): ids[:, ::-1] for (a, b), ids in pairs.items()},
        CONFIG,
    )
    for a, b in itertools.permutations(GAIN, 2):
        expected = cameras.between(a, b)
        assert np.array_equal(shuffled.between(a, b).gain, expected.gain)
        assert np.array_equal(shuffled.between(a, b).offset, expected.offset)
        found = others.between(renamed[a], renamed[b])
        np.testing.assert_allclose(found.gain, expected.gain, rtol=1e-9)
        np.testing.assert_allclose(found.offset, expected.offset, atol=1e-9)


def test_a_robot_is_told_through_another():
    """A chain: alpha and charlie have never met."""
    evidence, pairs = world()
    found = team_colors(evidence, {k: v for k, v in pairs.items() if k != LINKS[1]}, CONFIG).between(
        "charlie", "alpha"
    )
    gain, _ = true_map("charlie", "alpha")
    assert found.matches == 0
    assert (np.abs(np.log(found.gain / gain)) < 0.04).all()


def test_what_nobody_compared_stays():
    evidence, pairs = world()
    few = {link: ids[: CONFIG.min_matches - 1] for link, ids in pairs.items()}
    silent = {n: replace(e, information=np.zeros_like(e.information)) for n, e in evidence.items()}
    off = CONFIG.model_copy(update={"enabled": False})
    for cameras in (
        team_colors(evidence, {}, CONFIG),
        team_colors(evidence, few, CONFIG),
        team_colors(silent, pairs, CONFIG),
        team_colors(evidence, pairs, off),
    ):
        between = cameras.between("bravo", "alpha")
        assert between.is_identity
        assert between.matches == 0
        assert (between.sigma_gain > 0.3).all()
        assert between.of(evidence["bravo"]) is evidence["bravo"]


def test_without_contrast_the_gain_stays_unsure():
    """A gray wall determines the middle, and of the gains only noise, here three times as much in one robot."""
    rng = np.random.default_rng(0)
    evidence, pairs = world(gain={k: GAIN[k] for k in ("alpha", "bravo")})
    for e in evidence.values():
        e.theta[:, COLOR] = 0.4 + 0.01 * rng.normal(size=(len(e), 3))
    evidence["bravo"].theta[:, COLOR] = 0.2 + 0.03 * rng.normal(size=(len(evidence["bravo"]), 3))
    found = team_colors(evidence, pairs, CONFIG).between("bravo", "alpha")
    assert (np.abs(np.log(found.gain)) < 0.6 * found.sigma_gain).all()
    assert (found.sigma_gain > 0.5).all()
    np.testing.assert_allclose(found.to_other(np.full((1, 3), 0.2)), 0.4, atol=0.02)


def test_information_scales_with_the_gain():
    evidence, pairs = world()
    cameras = team_colors(evidence, pairs, CONFIG)
    there = cameras.between("bravo", "alpha")
    moved = there.of(evidence["bravo"])
    np.testing.assert_allclose(moved.color_information() * there.gain**2, 400.0)
    untouched = np.r_[0:9, 12]
    assert np.array_equal(moved.theta[:, untouched], evidence["bravo"].theta[:, untouched])
    assert np.array_equal(moved.information[:, :27], evidence["bravo"].information[:, :27])


def test_colors_that_change_a_little_change_the_answer_a_little():
    evidence, pairs = world(outliers=0.1)
    before = team_colors(evidence, pairs, CONFIG).between("bravo", "alpha")
    rng = np.random.default_rng(3)
    rounded = {
        n: replace(e, theta=e.theta + 1e-6 * rng.normal(size=e.theta.shape)) for n, e in evidence.items()
    }
    after = team_colors(rounded, pairs, CONFIG).between("bravo", "alpha")
    np.testing.assert_allclose(after.gain, before.gain, atol=3e-6)
    np.testing.assert_allclose(after.offset, before.offset, atol=3e-6)


def test_the_deviation_of_a_difference_is_that_of_least_squares():
    """Of a robot's gain against another's, both of which are known from the same comparisons."""
    rng = np.random.default_rng(4)
    rows = [(0, 1, 0.3, 0.01), (1, 2, -0.1, 0.02), (0, 2, 0.25, 0.04)]
    design = np.zeros((6, 3))
    for k, (i, j, _, variance) in enumerate(rows):
        design[k, [i, j]] = np.array([-1.0, 1.0]) / np.sqrt(variance)
    design[3:] = np.eye(3) / 0.5
    right = np.array([d / np.sqrt(v) for _, _, d, v in rows] + [0.0] * 3)
    values, covariance = colors._differences(3, rows, 0.5)
    np.testing.assert_allclose(values, np.linalg.lstsq(design, right, rcond=None)[0], atol=1e-12)
    np.testing.assert_allclose(covariance, np.linalg.inv(design.T @ design), atol=1e-12)

    names, scale = ("alpha", "bravo", "charlie"), dict(zip(GAIN, rng.uniform(0.5, 2.0, (3, 3)), strict=True))
    shift = dict(zip(GAIN, rng.normal(size=(3, 3)), strict=True))
    of_channels = np.repeat(covariance[..., None], 3, axis=-1)
    team = TeamColors(names, scale, shift, of_channels, 4.0 * of_channels, {})
    for i, j in itertools.permutations(range(3), 2):
        contrast = np.eye(3)[i] - np.eye(3)[j]
        sigma = np.sqrt(contrast @ covariance @ contrast)
        found = team.between(names[i], names[j])
        np.testing.assert_allclose(found.sigma_gain, sigma)
        np.testing.assert_allclose(found.sigma_offset, 2.0 * sigma / scale[names[j]])


@pytest.mark.parametrize("blind", ["alpha", "bravo"])
def test_colors_without_information_are_not_compared_whosever_they_are(blind):
    evidence, pairs = world(gain={k: GAIN[k] for k in ("alpha", "bravo")})
    wrong = np.arange(4000) % 2 == 0
    information = evidence[blind].information.copy()
    information[wrong, 28] = 0.0
    theta = evidence[blind].theta.copy()
    theta[wrong, COLOR] = 0.9
    evidence[blind] = replace(evidence[blind], theta=theta, information=information)
    found = team_colors(evidence, pairs, CONFIG).between("bravo", "alpha")
    gain, _ = true_map("bravo", "alpha")
    assert found.matches == 2000
    assert (np.abs(np.log(found.gain / gain)) < 0.03).all()
