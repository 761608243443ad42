"""Two views are verified where they show one place, each failed test has its name, and directions must agree."""

from dataclasses import replace

import numpy as np
import pytest

from duagc.pipeline.config.exchange import VerificationConfig
from duagc.pipeline.config.frontend import LoopConfig, RelocalizationConfig
from duagc.pipeline.config.registration import GeometricVerificationConfig, RegistrationConfig
from duagc.pipeline.geometry import projection, se3
from duagc.pipeline.registration import Reference, RgbdPyramid
from duagc.pipeline.registration.feature_motion import features_agree, motion_from_features
from duagc.pipeline.registration.features import Features
from duagc.pipeline.registration.geometric_verification import (
    Failure,
    GeometricVerification,
    VerificationView,
    verify,
)
from tests.fixtures.room import CAMERA, pose, render

CONFIG, REGISTRATION = GeometricVerificationConfig(), RegistrationConfig()
FIRST, SECOND = pose(), pose(x=0.08, y=-0.03, yaw=0.06)
TRUTH = se3.inverse(FIRST) @ SECOND


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def landmarks(T_world_camera: np.ndarray, points_world: np.ndarray, seed: int = 0) -> Features:
    """Features at known points of the room: point k has one descriptor wherever it is seen from."""
    points = se3.transform(se3.inverse(T_world_camera), points_world)
    descriptors = np.random.default_rng(seed).integers(0, 120, (len(points), 128), dtype=np.uint8)
    return Features(descriptors, points.astype(np.float32))


@pytest.fixture(scope="module")
def views() -> tuple[VerificationView, VerificationView]:
    _, depth = render(FIRST)
    v, u = (axis.ravel() for axis in np.mgrid[10:110:20, 10:150:20])
    points = se3.transform(FIRST, projection.back_project(CAMERA, u, v, depth[v, u].astype(np.float64)))

    def view(T: np.ndarray, noise: int) -> VerificationView:
        pyramid = RgbdPyramid.build(*render(T, np.random.default_rng(noise)), CAMERA)
        return VerificationView(landmarks(T, points), Reference.from_pyramid(pyramid), lambda: pyramid)

    return view(FIRST, 1), view(SECOND, 2)


def checked(found: GeometricVerification) -> None:
    assert found.failure is None
    assert se3.distance(found.T_first_second, TRUTH)[0] < 3e-3
    assert np.linalg.eigvalsh(found.information)[0] > 0
    assert 0 < found.correction_m < 0.01


def test_both_directions_confirm_what_the_features_say(
    views: tuple[VerificationView, VerificationView],
) -> None:
    checked(verify(*views, CONFIG, registration=REGISTRATION, rng=rng()))


def test_one_direction_is_enough_where_the_other_is_not_possible(
    views: tuple[VerificationView, VerificationView],
) -> None:
    first, second = views
    forward = verify(first, replace(second, reference=None), CONFIG, registration=REGISTRATION, rng=rng())
    backward = verify(replace(first, reference=None), second, CONFIG, registration=REGISTRATION, rng=rng())
    checked(forward)
    checked(backward)
    assert not np.array_equal(forward.T_first_second, backward.T_first_second)
    xi = np.linalg.cholesky(np.linalg.inv(backward.information))[:, 0]
    assert xi @ forward.information @ xi == pytest.approx(1, rel=0.5)
    with pytest.raises(ValueError, match="samples"):
        verify(
            replace(first, images=None),
            replace(second, images=None),
            CONFIG,
            registration=REGISTRATION,
            rng=rng(),
        )


def test_every_failed_test_has_its_name(views: tuple[VerificationView, VerificationView]) -> None:
    first, second = views
    scattered = replace(
        second.features, points=np.random.default_rng(3).uniform(1, 3, second.features.points.shape)
    )
    moved = replace(second.features, points=second.features.points + np.float32([0.05, 0, 0]))
    limits = {"max_refinement_m": 0.02, "max_disagreement_m": 0.1}

    def failure(features: Features = second.features, **changed: float) -> Failure | None:
        config = CONFIG.model_copy(update=changed)
        return verify(
            first, replace(second, features=features), config, registration=REGISTRATION, rng=rng()
        ).failure

    assert failure() is None
    assert failure(min_inliers=1000) is Failure.FEW_MATCHES
    assert failure(scattered) is Failure.FEW_INLIERS
    assert failure(min_overlap=0.999) is Failure.LOW_OVERLAP
    assert failure(max_disagreement_m=1e-7) is Failure.DIRECTIONS_DISAGREE
    assert failure(moved, **limits) is Failure.FAR_FROM_FEATURES
    strict = REGISTRATION.model_copy(update={"max_gray_rms": 1e-6})
    assert verify(first, second, CONFIG, registration=strict, rng=rng()).failure is Failure.NOT_REGISTERED


def test_what_is_all_of_a_nearer_view_is_enough_for_robots() -> None:
    near = pose(z=0.7)
    both = []
    _, depth = render(near)
    v, u = (axis.ravel() for axis in np.mgrid[10:110:20, 10:150:20])
    points = se3.transform(near, projection.back_project(CAMERA, u, v, depth[v, u].astype(np.float64)))
    for T, noise in ((near, 1), (FIRST, 2)):
        pyramid = RgbdPyramid.build(*render(T, np.random.default_rng(noise)), CAMERA)
        both.append(
            VerificationView(landmarks(T, points), Reference.from_pyramid(pyramid), lambda p=pyramid: p)
        )
    first, second = replace(both[0], reference=None), both[1]

    def found(config: VerificationConfig) -> GeometricVerification:
        return verify(first, second, config, registration=config.registration, rng=rng())

    robots = VerificationConfig()
    assert found(robots.model_copy(update={"min_covered": 1.1})).failure is Failure.LOW_OVERLAP
    enough = found(robots)
    assert enough.failure is None
    assert enough.registration is not None
    assert robots.registration.min_overlap < enough.registration.overlap < robots.min_overlap
    assert se3.distance(enough.T_first_second, se3.inverse(near) @ FIRST)[0] < 0.02


def test_a_correction_counts_where_it_is_least(views: tuple[VerificationView, VerificationView]) -> None:
    """Features turned about their middle: the camera moves by more than they do."""
    first, second = views
    middle = second.features.points.mean(axis=0).astype(np.float64)
    turn = se3.exp(np.array([0, 0, 0, 0, 0.03, 0]))
    turned = se3.transform(turn, second.features.points - middle) + middle
    second = replace(second, features=replace(second.features, points=turned.astype(np.float32)))
    found = verify(first, second, CONFIG, registration=REGISTRATION, rng=rng())
    assert found.failure is None
    of_camera = 2 * np.sin(0.015) * float(np.hypot(middle[0], middle[2]))
    assert 0.005 < found.correction_m < 0.6 * of_camera


def test_outdoors_limits_of_distances_grow_with_the_depth() -> None:
    """The same views eight times as large; features are 0.1 m off in both."""

    def failure(factor: float) -> Failure | None:
        both = []
        for T, noise in ((FIRST, 1), (SECOND, 2)):
            gray, depth = render(T, np.random.default_rng(noise))
            pyramid = RgbdPyramid.build(gray, (factor * depth).astype(np.float32), CAMERA)
            v, u = (axis.ravel() for axis in np.mgrid[10:110:20, 10:150:20])
            points = se3.transform(FIRST, projection.back_project(CAMERA, u, v, render(FIRST)[1][v, u]))
            features = landmarks(T, points)
            features = replace(features, points=factor * features.points)
            both.append(VerificationView(features, Reference.from_pyramid(pyramid), lambda p=pyramid: p))
        first, second = both
        moved = second.features.points + np.float32([0.1, 0, 0])
        second = replace(second, features=replace(second.features, points=moved))
        config = CONFIG.model_copy(update={"max_refinement_m": 0.06, "inlier_m": 0.2})
        return verify(first, second, config, registration=REGISTRATION, rng=rng()).failure

    assert failure(1.0) is Failure.FAR_FROM_FEATURES
    assert failure(8.0) is None


def test_images_are_read_only_after_the_features_agree(
    views: tuple[VerificationView, VerificationView],
) -> None:
    def unread() -> RgbdPyramid:
        raise AssertionError("images were read")

    first, second = (replace(view, images=unread) for view in views)
    strict = CONFIG.model_copy(update={"min_inliers": 1000})
    assert verify(first, second, strict, registration=REGISTRATION, rng=rng()).failure is Failure.FEW_MATCHES


def test_features_agree_at_the_true_motion_only(views: tuple[VerificationView, VerificationView]) -> None:
    first, second = (view.features for view in views)
    assert features_agree(first, second, TRUTH, CONFIG)
    assert not features_agree(first, second, TRUTH @ se3.exp(np.array([0.3, 0, 0, 0, 0, 0])), CONFIG)
    found = motion_from_features(first, second, CONFIG, rng())
    assert found.accepted
    assert found.T_first_second is not None
    assert found.inliers == found.matches == len(first)
    assert se3.distance(found.T_first_second, TRUTH)[0] < 1e-5


def test_three_uses_share_one_section() -> None:
    names = set(GeometricVerificationConfig.model_fields)
    for section in (LoopConfig, RelocalizationConfig):
        assert issubclass(section, GeometricVerificationConfig)
        assert names < set(section.model_fields)
