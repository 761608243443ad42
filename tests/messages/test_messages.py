"""Messages read back bit for bit, and broken ones say what is wrong."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duagc import schemas
from duagc.pipeline import messages as m
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import Lens
from duagc.pipeline.splat.gaussians import Gaussians

SEEDS = st.integers(0, 2**32 - 1)


def pose(rng: np.random.Generator) -> np.ndarray:
    return se3.exp(rng.normal(size=6))


def information(rng: np.random.Generator) -> np.ndarray:
    A = rng.normal(size=(6, 6))
    return A @ A.T


def gaussians(rng: np.random.Generator, n: int) -> Gaussians:
    tails = {"means": (3,), "quats_wxyz": (4,), "log_scales": (3,), "colors": (3,), "opacity_logits": ()}
    arrays: dict[str, Any] = {
        name: rng.normal(size=(n, *tail)).astype(np.float32) for name, tail in tails.items()
    }
    return Gaussians(ids=rng.permutation(n), anchors=rng.integers(0, 9, n).astype(np.int32), **arrays)


def gaussian_information(rng: np.random.Generator, n: int) -> m.GaussianInformation:
    return m.GaussianInformation(
        stamp_ns=int(rng.integers(2**62)),
        robot="alpha",
        kind="gauss_newton",
        window="all keyframes",
        ids=rng.integers(-(2**63), 2**63 - 1, n),
        geometry=rng.normal(size=(n, 45)).astype(np.float32),
        color=rng.normal(size=(n, 3)).astype(np.float32),
        opacity=rng.normal(size=n).astype(np.float32),
        observations=rng.integers(0, 2**32 - 1, n).astype(np.uint32),
        color_sigma=0.03,
        depth_sigma="0.0012 + 0.0019 (z - 0.4)^2",
        deviation_m=rng.random(n).astype(np.float32),
        color_pixels_per_sample=9.5,
        depth_pixels_per_sample=25.0,
        overlap=12.25,
        stated_scale=1.75,
        frame_id="alpha/map",
    )


def all_messages(seed: int, n: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    stamp = int(rng.integers(2**62))
    k = n % 5
    status = ("ok", "lost", "relocalized")[seed % 3]
    T = np.array([pose(rng) for _ in range(k)]).reshape(k, 4, 4)
    component = ["alpha", "bravo"]
    return [
        m.Odometry(
            stamp, "alpha", 4, True, 0, pose(rng), pose(rng), information(rng), status, 0.5, 0.01, 0.02
        ),
        m.Keyframe(stamp, "alpha", 3, 40, pose(rng), 2, pose(rng), information(rng), (0.1, -0.02)),
        m.KeyframeFactor(stamp, "alpha", 2, 5, pose(rng), information(rng), 0.75),
        m.Submap(stamp, "alpha-2", 2, 70, 160, 81, 12, 5),
        m.Keyframe(stamp, "alpha", 0, 0, np.eye(4), -1, np.eye(4), np.zeros((6, 6)), (0.0, 0.0)),
        m.FrameExposure(stamp, "alpha", 3, 0.5 + rng.random(3), rng.normal(size=3)),
        m.MapUpdate(stamp, "alpha", 3, n, 2, 2**40, 0.1, 0.05),
        gaussian_information(rng, n),
        m.GaussianMap(stamp, "alpha", "world", gaussians(rng, n), gaussian_information(rng, n)),
        m.GaussianMap(stamp, "alpha", "alpha/map", gaussians(rng, n)),
        m.CorrectedKeyframes(stamp, "alpha", component, np.arange(k, dtype=np.int32), T),
        m.PeerColors(stamp, "alpha", "bravo", *rng.random((4, 3)), matches=n),
        m.RejectedMatches(stamp, "charlie", "alpha", "bravo", rng.integers(0, 2**62, (n, 2))),
        m.PeerMapReport(
            stamp_ns=stamp,
            robot="alpha",
            peer="bravo",
            gaussians=n,
            too_large=1,
            contradicted=2,
            matches=3,
            rejected_matches=1,
            compared_px=500,
            own_px=2**31,
            color_mse=0.125,
            color_variance=0.5,
            used=n % 2 == 0,
            reason="" if n % 2 == 0 else "explains too little",
        ),
    ]


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    if is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes()
        assert b.flags.writeable
    else:
        assert a == b


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS, n=st.integers(0, 20))
def test_messages_read_back_bit_for_bit(seed: int, n: int) -> None:
    for message in all_messages(seed, n):
        packed = message.pack()
        read = type(packed).FromString(packed.SerializeToString(deterministic=True))
        assert_same(message, m.unpack(read))
        assert packed.DESCRIPTOR.full_name == message.schema


def test_every_dataclass_is_read_by_the_name_of_its_schema() -> None:
    assert {c.schema for c in (type(x) for x in all_messages(0, 1))} == set(m.estimates._UNPACK)


def test_a_message_without_dataclass_stays_as_it_is() -> None:
    proto = schemas.new("Vector3", x=1.0)
    assert m.unpack(proto) is proto


@pytest.mark.parametrize(
    ("schema", "fields", "words"),
    [
        ("Odometry", {}, "status"),
        ("Odometry", {"status": 1}, "rotation"),
        ("GaussianArrays", {"count": 2, "ids_int64": b"1234567"}, "ids_int64 has 7 bytes, expected 16"),
        ("GaussianArrays", {"count": 2**63}, "ids_int64 has 0 bytes"),
        ("CorrectedKeyframes", {"count": 2**62}, "poses_world_keyframe_float64 has 0 bytes"),
        (
            "GaussianInformation",
            {"count": 1, "ids_int64": b"12345678"},
            "geometry_float32 has 0 bytes, expected 180",
        ),
    ],
)
def test_broken_messages_say_what_is_wrong(schema: str, fields: dict[str, Any], words: str) -> None:
    message = schemas.new(schema, **fields)
    with pytest.raises(DuagError, match=words):
        m.maps.unpack_gaussians(message) if schema == "GaussianArrays" else m.unpack(message)


def test_wrong_shapes_are_bugs() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"\[4, 4\]"):
        m.pack_pose(np.eye(3))
    good = gaussian_information(rng, 3)
    with pytest.raises(ValueError, match="geometry"):
        m.GaussianInformation(**{**vars(good), "geometry": good.geometry[:2]})


def test_cameras_and_depth_read_back() -> None:
    camera = PinholeCamera(7, 5, 3.5, 3.25, 2.9, 2.1)
    assert m.unpack_calibration(m.pack_calibration(5, "alpha", camera)) == camera
    depth = np.arange(35, dtype=np.uint16).reshape(5, 7) * 1000
    assert np.array_equal(m.unpack_depth(m.pack_depth(5, "alpha", depth), "here"), depth)


def test_rows_of_depth_may_be_padded() -> None:
    message = m.pack_depth(5, "alpha", np.arange(12, dtype=np.uint16).reshape(3, 4))
    message.width, message.step = 3, 8
    assert m.unpack_depth(message, "here").tolist() == [[0, 1, 2], [4, 5, 6], [8, 9, 10]]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"encoding": "32FC1"}, "here is 32FC1, expected 16UC1"),
        ({"step": 6}, "rows of 6 bytes"),
        ({"height": 4}, "expected 32"),
        ({"height": 0}, "4x0"),
    ],
)
def test_other_depth_is_refused(change: dict[str, Any], words: str) -> None:
    message = m.pack_depth(5, "alpha", np.zeros((3, 4), np.uint16))
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(DuagError, match=words):
        m.unpack_depth(message, "here")


CAMERA = PinholeCamera(7, 5, 3.5, 3.25, 2.9, 2.1)


@pytest.mark.parametrize(
    ("lens", "model"),
    [
        (Lens(CAMERA, (0.1, -0.2, 0.003, 0.004, 0.05)), "plumb_bob"),
        (Lens(PinholeCamera(7, 5, 4.0, 3.0, 3.0, 2.0), (0.1, -0.2, 0.0, 0.0)), "plumb_bob"),
        (Lens(CAMERA, (0.1, -0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6)), "rational_polynomial"),
        (Lens(CAMERA, (0.1, -0.2, 0.0, 0.0), fisheye=True), "kannala_brandt"),
        (Lens(CAMERA, (0.0, 0.0, 0.0, 0.0), fisheye=True), "kannala_brandt"),
        (Lens(CAMERA, (), rotation_rad=(0.01, -0.02, 0.03)), ""),
        (Lens(PinholeCamera(7, 5, 4.0, 3.0, 3.0, 2.0)), ""),
    ],
)
def test_a_lens_is_stated_as_ros_does_and_reads_back(lens: Lens, model: str) -> None:
    """K and D are of the images, P of the pinhole camera that they are seen by, turned by R."""
    message = m.pack_calibration(5, "alpha", CAMERA, lens)
    assert message.distortion_model == model
    assert list(message.K) == lens.source.matrix().ravel().tolist()
    assert np.reshape(message.P, (3, 4))[:, :3].tolist() == CAMERA.matrix().tolist()
    turned = np.reshape(message.R, (3, 3)) @ so3.exp(np.array(lens.rotation_rad))
    np.testing.assert_allclose(turned, np.eye(3), atol=1e-15)
    camera, found = m.unpack_camera(message)
    assert camera == CAMERA
    assert found is not None
    assert (found.source, found.fisheye) == (lens.source, lens.fisheye)
    assert found.distortion[: len(lens.distortion)] == lens.distortion
    assert not any(found.distortion[len(lens.distortion) :])
    np.testing.assert_allclose(found.rotation_rad, lens.rotation_rad, atol=1e-15)
    with pytest.raises(DuagError, match="expected undistorted images"):
        m.unpack_calibration(message)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"distortion_model": "unified"}, "'unified'.*expected 'plumb_bob'"),
        ({"D": [0.1, 0.2]}, "expected 'plumb_bob'"),
        ({"D": [np.nan, 0, 0, 0, 0]}, "finite"),
        ({"R": [2.0, 0, 0, 0, 1, 0, 0, 0, 1]}, "expected a rotation"),
        ({"R": [1.0]}, "R has 1 numbers"),
        ({"P": [0.0] * 12}, "P is .*positive focal"),
        ({"P": [1.0, 0, 1, -3, 0, 1, 1, 0, 0, 0, 1, 0]}, "at the place of K"),
    ],
)
def test_a_lens_that_says_something_else_is_refused(change: dict[str, Any], words: str) -> None:
    message = m.pack_calibration(5, "alpha", CAMERA, Lens(CAMERA, (0.1, -0.2, 0.0, 0.0, 0.3)))
    for name, value in change.items():
        if name == "distortion_model":
            message.distortion_model = value
        else:
            getattr(message, name)[:] = value
    with pytest.raises(DuagError, match=words):
        m.unpack_camera(message)


def test_images_of_another_size_than_the_camera_are_a_bug() -> None:
    with pytest.raises(ValueError, match="same size"):
        m.pack_calibration(5, "alpha", CAMERA, Lens(CAMERA.halved(), (0.1,) * 5))


@pytest.mark.parametrize(
    ("K", "words"),
    [
        ([1.0], "1 numbers"),
        ([np.nan, 0, 1, 0, 1, 1, 0, 0, 1], "finite"),
        ([-1, 0, 1, 0, 1, 1, 0, 0, 1], "positive"),
        ([1, 0.1, 1, 0, 1, 1, 0, 0, 1], "skew"),
        ([1, 0, 1, 0, 1, 1, 0, 0, 2], "skew"),
    ],
)
def test_other_calibrations_are_refused(K: list[float], words: str) -> None:
    message = m.pack_calibration(5, "alpha", PinholeCamera(4, 3, 2, 2, 1, 1))
    message.K[:] = K
    with pytest.raises(DuagError, match=words):
        m.unpack_calibration(message)
    message = m.pack_calibration(5, "alpha", PinholeCamera(4, 3, 2, 2, 1, 1))
    message.D[:] = [0.1]
    with pytest.raises(DuagError, match="distortion"):
        m.unpack_calibration(message)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_poses_in_frames_read_back(seed: int) -> None:
    T = pose(np.random.default_rng(seed))
    message = m.pack_pose_in_frame(123, "world", T)
    np.testing.assert_allclose(m.unpack_pose_in_frame(message), T, atol=1e-14)  # one unit quaternion away
    assert m.unpack_stamp(message) == 123


def test_poses_that_are_none_are_refused() -> None:
    message = m.pack_pose_in_frame(123, "world", np.eye(4))
    message.pose.position.x = np.inf
    with pytest.raises(DuagError, match="finite"):
        m.unpack_pose_in_frame(message)
    message = m.pack_pose_in_frame(123, "world", np.eye(4))
    message.pose.orientation.w = 0.0
    with pytest.raises(DuagError, match="rigid"):
        m.unpack_pose_in_frame(message)
