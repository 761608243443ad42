"""Messages of sensors, in Foxglove's schemas where it has one: images, masks, cameras, transforms, points, inertia."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc import schemas
from duagc.pipeline.base.arrays import Array, array_bytes
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import decode_image, encode_png
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.lens import FISHEYE_NUMBERS, POLYNOMIAL_NUMBERS, Lens
from duagc.pipeline.messages.parts import camera_frame, numbers, pack_stamp, unpack_array

PLUMB_BOB, RATIONAL, FISHEYE = "plumb_bob", "rational_polynomial", "kannala_brandt"  # as Foxglove calls them


def _foxglove(name: str, stamp_ns: int, frame_id: str, **fields: Any) -> Any:
    message: Any = schemas.message_class(f"foxglove.{name}")(frame_id=frame_id, **fields)
    pack_stamp(message, stamp_ns)
    return message


def pack_color(stamp_ns: int, robot: str, data: bytes, image_format: str) -> Any:
    """foxglove.CompressedImage of encoded bytes.

    Args:
        stamp_ns: time of the image, ns.
        robot: whose color camera took it.
        data: encoded image.
        image_format: "jpeg" or "png".
    """
    return _foxglove("CompressedImage", stamp_ns, camera_frame(robot), data=data, format=image_format)


def pack_depth(stamp_ns: int, robot: str, depth: NDArray[np.uint16]) -> Any:
    """foxglove.RawImage, 16UC1 little-endian, of a depth image.

    Args:
        stamp_ns: time of the image, ns.
        robot: in whose color camera it is.
        depth: uint16 [H, W], in units of the channel's depth_scale, 0 = unknown.

    Raises:
        ValueError: another type or number of axes.
    """
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise ValueError(f"depth is {depth.dtype} {depth.shape}, expected uint16 [H, W]")
    height, width = depth.shape
    data = array_bytes(depth, "uint16")
    fields = {"width": width, "height": height, "encoding": "16UC1", "step": 2 * width, "data": data}
    return _foxglove("RawImage", stamp_ns, camera_frame(robot), **fields)


def unpack_depth(m: Any, where: str) -> NDArray[np.uint16]:
    """uint16 [H, W] of a foxglove.RawImage.

    Args:
        m: the protobuf message.
        where: begins the line of an error.

    Raises:
        DuagError: another encoding, or a number of bytes that does not fit the size.
    """
    if m.encoding != "16UC1":
        raise DuagError(f"{where} is {m.encoding or 'without encoding'}, expected 16UC1")
    if m.step < 2 * m.width or m.step % 2 or m.height * m.width == 0:
        raise DuagError(
            f"{where} has rows of {m.step} bytes for {m.width}x{m.height} pixels, expected two per pixel"
        )
    return unpack_array(m.data, "uint16", (m.height, m.step // 2), where)[:, : m.width]


def pack_mask(stamp_ns: int, robot: str, usable: NDArray[np.bool_]) -> Any:
    """foxglove.RawImage, 8UC1, of the pixels that may be used: 255 = yes, 0 = no.

    Args:
        stamp_ns: time of the image, ns.
        robot: in whose color camera it is.
        usable: bool [H, W].

    Raises:
        ValueError: another type or number of axes.
    """
    if usable.dtype != np.bool_ or usable.ndim != 2:
        raise ValueError(f"mask is {usable.dtype} {usable.shape}, expected bool [H, W]")
    height, width = usable.shape
    data = np.where(usable, np.uint8(255), np.uint8(0)).tobytes()
    fields = {"width": width, "height": height, "encoding": "8UC1", "step": width, "data": data}
    return _foxglove("RawImage", stamp_ns, camera_frame(robot), **fields)


def unpack_mask(m: Any, where: str) -> NDArray[np.bool_]:
    """bool [H, W], True = usable, of a foxglove.RawImage.

    Args:
        m: the protobuf message.
        where: begins the line of an error.

    Raises:
        DuagError: another encoding, a number of bytes that does not fit the size, or values other than 0 and
            255.
    """
    if m.encoding != "8UC1":
        raise DuagError(f"{where} is {m.encoding or 'without encoding'}, expected 8UC1")
    if m.step < m.width or m.height * m.width == 0:
        raise DuagError(
            f"{where} has rows of {m.step} bytes for {m.width}x{m.height} pixels, expected one per pixel"
        )
    values = unpack_array(m.data, "uint8", (m.height, m.step), where)[:, : m.width]
    odd = values[(values != 0) & (values != 255)]
    if len(odd):
        raise DuagError(f"{where} has the value {odd[0]}, expected 0 (ignore) and 255 (usable) only")
    return values == 255


def pack_valid(stamp_ns: int, robot: str, valid: NDArray[np.bool_]) -> Any:
    """foxglove.CompressedImage, PNG of 8 bits, of the pixels that show the scene: 255 = yes, 0 = no.

    Args:
        stamp_ns: time of the image, ns.
        robot: in whose color camera it is.
        valid: bool [H, W].

    Raises:
        ValueError: another type or number of axes.
    """

    if valid.dtype != np.bool_ or valid.ndim != 2:
        raise ValueError(f"mask is {valid.dtype} {valid.shape}, expected bool [H, W]")
    data = encode_png(np.where(valid, np.uint8(255), np.uint8(0)))
    return pack_color(stamp_ns, robot, data, "png")


def unpack_valid(m: Any, where: str) -> NDArray[np.bool_]:
    """bool [H, W], True = shows the scene, of a foxglove.CompressedImage.

    Args:
        m: the protobuf message.
        where: begins the line of an error.

    Raises:
        DuagError: no PNG of 8 bits and one channel, or values other than 0 and 255.
    """
    import cv2

    image = decode_image(m.data, cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8 or image.ndim != 2:
        raise DuagError(f"{where} has {len(m.data)} bytes, expected a PNG of 8 bits and one channel")
    odd = image[(image != 0) & (image != 255)]
    if len(odd):
        raise DuagError(f"{where} has the value {odd[0]}, expected 0 (no scene) and 255 (scene) only")
    return np.asarray(image == 255)


def pack_calibration(stamp_ns: int, robot: str, camera: PinholeCamera, lens: Lens | None = None) -> Any:
    """foxglove.CameraCalibration, as ROS has it: K and D of the images, P of the pinhole camera that they are seen by.

    Args:
        stamp_ns: time of the message.
        robot: whose camera it is.
        camera: the pinhole camera.
        lens: of the images, which are as large as those of the pinhole camera; None: they are its own.
    """
    source = camera if lens is None else lens.source
    if (source.width, source.height) != (camera.width, camera.height):
        raise ValueError(f"images of {source} are to be seen by {camera}, expected the same size")
    fields: dict[str, Any] = {}
    if lens is not None and lens.distortion:
        # the polynomial of fewer numbers is that whose other numbers are 0
        numbers_of = max(5, len(lens.distortion)) if not lens.fisheye else len(lens.distortion)
        coefficients = [*lens.distortion, *(0.0,) * (numbers_of - len(lens.distortion))]
        model = FISHEYE if lens.fisheye else PLUMB_BOB if numbers_of == 5 else RATIONAL
        fields = {"distortion_model": model, "D": coefficients}
    turn = np.eye(3) if lens is None else lens.rotation().T
    return _foxglove(
        "CameraCalibration",
        stamp_ns,
        camera_frame(robot),
        width=camera.width,
        height=camera.height,
        K=source.matrix().ravel().tolist(),
        R=turn.ravel().tolist(),
        P=np.hstack([camera.matrix(), np.zeros((3, 1))]).ravel().tolist(),
        **fields,
    )


def unpack_calibration(m: Any) -> PinholeCamera:
    """Camera of a foxglove.CameraCalibration whose images have no distortion.

    Args:
        m: the protobuf message.

    Raises:
        DuagError: lens distortion, numbers that are not finite, or no image size.
    """
    camera, lens = unpack_camera(m)
    if lens is not None:
        raise DuagError(
            f"K, R and P state a lens, with distortion {m.distortion_model!r} {list(m.D)}, expected undistorted images"
        )
    return camera


def unpack_camera(m: Any) -> tuple[PinholeCamera, Lens | None]:
    """The pinhole camera of a foxglove.CameraCalibration, and the lens of its images.

    Args:
        m: the protobuf message.

    Returns:
        The camera by whose pixels images are read, and how they were taken; None: by this camera.

    Raises:
        DuagError: an unknown distortion, numbers that are not finite, or no image size.
    """
    source = _pinhole(m, numbers(m.K, (3, 3), "K"), "K")
    turn = numbers(m.R, (3, 3), "R") if any(m.R) else np.eye(3)
    P = numbers(m.P, (3, 4), "P") if any(m.P) or any(m.D) else np.hstack([source.matrix(), np.zeros((3, 1))])
    D, fisheye = tuple(float(d) for d in m.D), m.distortion_model == FISHEYE
    is_bent = any(D) or (fisheye and len(D) > 0)  # a fisheye whose numbers are 0 is no pinhole
    if not is_bent and np.array_equal(turn, np.eye(3)) and np.array_equal(P[:, :3], source.matrix()):
        return source, None
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-6 or np.linalg.det(turn) < 0:
        raise DuagError(f"R is {turn.ravel().tolist()}, expected a rotation")
    if np.any(P[:, 3]):
        raise DuagError(f"P is {P.ravel().tolist()}, expected a camera at the place of K")
    lengths = FISHEYE_NUMBERS if fisheye else POLYNOMIAL_NUMBERS
    known = m.distortion_model in (FISHEYE, PLUMB_BOB, RATIONAL) and len(D) in lengths
    if is_bent and not (known and np.isfinite(D).all()):
        raise DuagError(
            f"found lens distortion {m.distortion_model!r} {list(D)}, expected {PLUMB_BOB!r}, {RATIONAL!r} or "
            f"{FISHEYE!r} and finite numbers as OpenCV has them"
        )
    x, y, z = so3.log(turn.T).tolist()
    lens = Lens(source, D if is_bent else (), fisheye and is_bent, (x, y, z))
    return _pinhole(m, P[:, :3], "P"), lens


def _pinhole(m: Any, K: Array, name: str) -> PinholeCamera:
    """The camera of a matrix [3, 3] of a foxglove.CameraCalibration."""
    if not np.all(np.isfinite(K)) or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise DuagError(f"{name} is {K.ravel().tolist()}, expected finite numbers and positive focal lengths")
    if K[0, 1] != 0 or not np.array_equal(np.delete(K.ravel(), [0, 1, 2, 4, 5]), [0, 0, 0, 1]):
        raise DuagError(f"{name} is {K.ravel().tolist()}, expected a camera without skew")
    if m.width == 0 or m.height == 0:
        raise DuagError(f"image size is {m.width}x{m.height}, expected at least one pixel")
    return PinholeCamera(m.width, m.height, *(float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))))


def pack_transform(stamp_ns: int, parent: str, child: str, T_parent_child: ArrayLike) -> Any:
    """foxglove.FrameTransform of a motion that takes coordinates of frame `child` to frame `parent`.

    Args:
        stamp_ns: time, ns.
        parent: name of the frame.
        child: name of the frame.
        T_parent_child: [4, 4], translation in meters.
    """
    T = np.asarray(T_parent_child, dtype=np.float64)
    w, x, y, z = so3.to_quat_wxyz(T[:3, :3]).tolist()
    tx, ty, tz = T[:3, 3].tolist()
    message: Any = schemas.message_class("foxglove.FrameTransform")(
        parent_frame_id=parent,
        child_frame_id=child,
        translation={"x": tx, "y": ty, "z": tz},
        rotation={"x": x, "y": y, "z": z, "w": w},
    )
    pack_stamp(message, stamp_ns)
    return message


def unpack_transform(m: Any) -> Array:
    """Motion T_parent_child [4, 4] of a foxglove.FrameTransform.

    Args:
        m: the protobuf message.

    Raises:
        DuagError: numbers that are not finite, or a quaternion of no length.
    """
    return _rigid(m.translation, m.rotation, "transform")


_NUMBER_TYPES = {7: "float32", 8: "float64"}  # foxglove.PackedElementField.NumericType


def pack_points(stamp_ns: int, frame_id: str, points_m: ArrayLike) -> Any:
    """foxglove.PointCloud of points, in float32.

    Args:
        stamp_ns: time, ns.
        frame_id: frame of the points.
        points_m: [n, 3], meters.
    """
    fields = [{"name": name, "offset": 4 * k, "type": 7} for k, name in enumerate("xyz")]
    data = array_bytes(points_m, "float32")
    pose = {"orientation": {"w": 1.0}}
    return _foxglove("PointCloud", stamp_ns, frame_id, pose=pose, point_stride=12, fields=fields, data=data)


def unpack_points(m: Any, where: str) -> Array:
    """Points [n, 3] in meters, in the frame of the message, of a foxglove.PointCloud; not finite ones are left out.

    `where` begins the line of an error.

    Args:
        m: the protobuf message.
        where: begins the line of an error.

    Raises:
        DuagError: no fields x, y, z of floating point, or a number of bytes that does not fit.
    """
    fields = {field.name: field for field in m.fields}
    missing = [name for name in "xyz" if name not in fields or fields[name].type not in _NUMBER_TYPES]
    if missing or m.point_stride == 0 or len(m.data) % m.point_stride:
        raise DuagError(
            f"{where} has fields {sorted(fields)} and {len(m.data)} bytes at {m.point_stride} per point, "
            "expected x, y, z as float32 or float64"
        )
    columns = []
    rows = np.frombuffer(m.data, np.uint8).reshape(-1, m.point_stride)
    for name in "xyz":
        dtype = np.dtype(_NUMBER_TYPES[fields[name].type]).newbyteorder("<")
        offset = fields[name].offset
        if offset + dtype.itemsize > m.point_stride:
            raise DuagError(f"{where}: field {name} ends beyond the {m.point_stride} bytes of a point")
        column = np.ascontiguousarray(rows[:, offset : offset + dtype.itemsize]).view(dtype).ravel()
        columns.append(column.astype(np.float64))
    points = np.stack(columns, axis=-1)
    points = points[np.isfinite(points).all(axis=1)]
    if not m.HasField("pose"):
        return points
    return se3.transform(_rigid(m.pose.position, m.pose.orientation, where), points)


def _rigid(p: Any, q: Any, what: str) -> Array:
    """T [4, 4] of a translation and a quaternion message."""
    quat = np.array([q.w, q.x, q.y, q.z])
    if not np.all(np.isfinite([p.x, p.y, p.z, *quat])) or not 0.9 < np.linalg.norm(quat) < 1.1:
        raise DuagError(
            f"{what} is {(p.x, p.y, p.z)}, wxyz {tuple(quat.tolist())}, expected a finite rigid motion"
        )
    return se3.from_quat_translation(quat, [p.x, p.y, p.z])


def pack_imu(stamp_ns: int, robot: str, rates_rad_s: ArrayLike, accelerations_m_s2: ArrayLike) -> Any:
    """duagc.v1.Imu of angular velocity and linear acceleration in the frame of the unit.

    Args:
        stamp_ns: time, ns.
        robot: whose unit it is.
        rates_rad_s: [3], rad/s.
        accelerations_m_s2: [3], m/s^2.
    """
    message = schemas.new(
        "Imu",
        frame_id=f"{robot}/imu",
        robot=robot,
        angular_velocity=dict(zip("xyz", np.asarray(rates_rad_s, np.float64).tolist(), strict=True)),
        linear_acceleration=dict(
            zip("xyz", np.asarray(accelerations_m_s2, np.float64).tolist(), strict=True)
        ),
    )
    pack_stamp(message, stamp_ns)
    return message


def pack_pose_in_frame(stamp_ns: int, frame_id: str, T_frame_body: ArrayLike) -> Any:
    """foxglove.PoseInFrame of a motion; its rotation is kept as a unit quaternion.

    Args:
        stamp_ns: time, ns.
        frame_id: name of the frame.
        T_frame_body: [4, 4], translation in meters.
    """
    T = np.asarray(T_frame_body, dtype=np.float64)
    w, x, y, z = so3.to_quat_wxyz(T[:3, :3]).tolist()
    tx, ty, tz = T[:3, 3].tolist()
    pose = {"position": {"x": tx, "y": ty, "z": tz}, "orientation": {"x": x, "y": y, "z": z, "w": w}}
    return _foxglove("PoseInFrame", stamp_ns, frame_id, pose=pose)


def unpack_pose_in_frame(m: Any) -> Array:
    """Motion T_frame_body [4, 4] of a foxglove.PoseInFrame.

    Args:
        m: the protobuf message.

    Raises:
        DuagError: numbers that are not finite, or a quaternion of no length.
    """
    return _rigid(m.pose.position, m.pose.orientation, "pose")
