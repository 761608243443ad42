"""Poses, landmarks and cameras adjusted together to what the views show.

Residuals: where features fall in color (Cauchy), their distance from the surface that the depth image has there, and
point-to-plane distances between depth images that overlap (both Huber). Each is divided by its scale, the median
absolute deviation. Landmarks are eliminated (Schur complement), the rest is solved densely by Gauss-Newton.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.camera_calibration.rig import NAMES, CameraRig
from duagc.pipeline.camera_calibration.views import Views, look_up, normals_at
from duagc.pipeline.config.registration import RegistrationConfig
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.geometry.depth_noise import DepthNoise
from duagc.pipeline.geometry.statistics import huber_divisor, mad_sigma

ROUNDS = 30
CONVERGED, CONVERGED_OF_PRIOR = (
    2e-4,
    0.01,
)  # steps: of poses (m, rad), of the cameras' numbers (of the prior)
CAUCHY, HUBER = 2.5, 1.5  # scales
SAME_ERROR = 50.0  # errors of neighbors are correlated, and no model is exact: so many residuals count as one
PRIOR = dict(zip(NAMES, (15, 15, 15, 15, 0.3, 0.5, 0.5, 0.01, 0.01, 0.01, 0.02, *[0.02] * 6), strict=True))
"""Prior standard deviations of the cameras' numbers from the recording's: pixels at a width of 640, rad, s, 1/m."""
NEIGHBORS, MIN_OVERLAP = 4, 0.3  # views that the depth of a view is compared with
GATE_M, GATE_RELATIVE = 0.08, 0.05
FEATURE_GATE_M = 0.15
NOISE = DepthNoise.stated(RegistrationConfig())


@dataclass(frozen=True)
class Quality:
    """How well views agree: medians of the features' distances in px, scales of depth in units of its noise sigma(z).

    Attributes:
        features_px: of the features.
        depth_of_features: of the features' distances from the surface.
        depth: of point-to-plane distances.
    """

    features_px: float
    depth_of_features: float
    depth: float


@dataclass(frozen=True)
class Adjusted:
    """Result of an adjustment.

    Attributes:
        rig: the cameras.
        covariance: of their numbers, [17, 17]; None: they were held fixed.
        quality: agreement of every part.
    """

    rig: CameraRig
    covariance: Array | None
    quality: list[Quality]


def adjust(parts: Sequence[Views], rig: CameraRig, calibrate: bool) -> Adjusted:
    """Adjust poses and landmarks (in place), and the cameras too if asked, until it has converged.

    Args:
        parts: of the recording.
        rig: cameras to begin with.
        calibrate: whether they are adjusted.
    """
    start, pairs = CameraRig.of(rig.camera), [overlapping(part) for part in parts]
    ends = np.cumsum([0] + [6 * len(part.T_map_camera) for part in parts])
    size = len(NAMES) if calibrate else 0
    scale = rig.camera.width / 640
    prior = np.array([PRIOR[name] * (scale if k < 4 else 1) for k, name in enumerate(NAMES)])[:size]
    total = int(ends[-1]) + size
    for _ in range(ROUNDS):
        H, g = np.zeros((total, total)), np.zeros(total)
        steps = [_linearized(part, pair, rig, calibrate) for part, pair in zip(parts, pairs, strict=True)]
        for step, a, b in zip(steps, ends[:-1], ends[1:], strict=True):
            at = np.r_[a:b, ends[-1] : total]
            S, force = step.H.copy(), step.g.copy()
            S[:6], S[:, :6], force[:6] = 0, 0, 0  # the first view stays
            S[:6, :6] = np.eye(6)
            H[np.ix_(at, at)] += S
            g[at] += force
        if calibrate:
            H[range(ends[-1], total), range(ends[-1], total)] += SAME_ERROR / prior**2
            g[ends[-1] :] += SAME_ERROR * (rig.values() - start.values()) / prior**2
        d = np.sqrt(np.maximum(np.diag(H), 1e-12))
        scaled = H / d[:, None] / d + 1e-9 * np.eye(total)  # nothing moves a view that shows nothing
        x = -np.linalg.solve(scaled, g / d) / d
        for part, step, a, b in zip(parts, steps, ends[:-1], ends[1:], strict=True):
            part.points_map = part.points_map + step.landmarks(np.concatenate([x[a:b], x[ends[-1] :]]))
            part.T_map_camera = part.T_map_camera @ se3.exp(x[a:b].reshape(-1, 6))
        if calibrate:
            rig = rig.moved(x[ends[-1] :])
        converged = not calibrate or np.abs(x[ends[-1] :] / prior).max() < CONVERGED_OF_PRIOR
        if converged and np.abs(x[: ends[-1]]).max() < CONVERGED:
            break
    covariance = None
    if calibrate:
        inverse = np.linalg.inv(scaled)[ends[-1] :, ends[-1] :]
        covariance = SAME_ERROR * inverse / d[ends[-1] :, None] / d[ends[-1] :]
    return Adjusted(
        rig, covariance, [quality(part, pair, rig) for part, pair in zip(parts, pairs, strict=True)]
    )


def overlapping(views: Views) -> NDArray[np.int64]:
    """Pairs of views [p, 2], in both orders, that overlap: those that overlap most, and some that overlap less.

    Args:
        views: of one part.
    """
    n, rig = len(views.T_map_camera), CameraRig.of(views.camera)
    share = np.zeros((n, n))
    for a in range(n):
        others = np.stack([np.full(n - 1, a), np.delete(np.arange(n), a)], axis=-1)
        share[a, others[:, 1]] = _planes(views, others, rig).used.mean(axis=1)
    share = np.minimum(share, share.T)
    found = set()
    for a in range(n):
        order = [
            b for b in np.argsort(-share[a], kind="stable").tolist() if b != a and share[a, b] > MIN_OVERLAP
        ]
        near, far = order[: NEIGHBORS // 2 + 1], order[NEIGHBORS // 2 + 1 :]
        far = far[:: max(1, len(far) // max(NEIGHBORS - len(near), 1))][: NEIGHBORS - len(near)]
        found |= {(min(a, b), max(a, b)) for b in near + far}
    pairs = np.array(sorted(found), dtype=np.int64).reshape(-1, 2)
    return np.concatenate([pairs, pairs[:, ::-1]])


def quality(views: Views, pairs: NDArray[np.int64], rig: CameraRig) -> Quality:
    """How well the views agree as they are.

    Args:
        views: of one part.
        pairs: `overlapping` ones, [p, 2].
        rig: the cameras.
    """
    features, planes = _features(views, rig), _planes(views, pairs, rig)
    return Quality(
        float(np.median(np.linalg.norm(features.off_px, axis=-1))),
        _scale(features.distance[features.used], 0.0),
        _scale(planes.distance[planes.used], 0.0),
    )


# --- residuals ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Planes:
    """Point-to-plane distances of samples of one view from the surface of another, [p, s], in units of sigma(z)."""

    distance: Array
    used: NDArray[np.bool_]
    by_first: Array  # [p, s, 6]
    by_second: Array
    by_depth: Array  # [p, s, 6]


def _planes(views: Views, pairs: NDArray[np.int64], rig: CameraRig) -> _Planes:
    c = views.camera
    first, second = pairs.T
    column, row = np.moveaxis(views.samples[first], -1, 0)
    at = first[:, None], row, column
    rays = c.rays_at(column, row)
    z = rig.depth(views.inverse_depth[at].astype(np.float64), rays)
    p, normals = rays * z[..., None], normals_at(views, *at)
    along = (normals * rays).sum(axis=-1)
    read_s = views.readout.depth_s
    if read_s:
        late_s = read_s * views.share_of_readout(column, row)[..., None]
        p, normals = _seen_later(p, normals, late_s, views.velocity[first, None])
    M = se3.inverse(views.T_map_camera[second]) @ views.T_map_camera[first]
    q = se3.transform(M, p)
    m = normals @ np.swapaxes(M[:, :3, :3], 1, 2)
    there, m_there = q, m
    front = q[..., 2] > 0.05
    uv = c.project(np.where(front[..., None], q, 1.0))
    if read_s:
        late_s = read_s * views.share_of_readout(uv[..., 0], uv[..., 1])[..., None]
        there, m_there = _seen_later(q, m, -late_s, views.velocity[second, None])
        front = there[..., 2] > 0.05
        uv = c.project(np.where(front[..., None], there, 1.0))
    inverse = look_up(views, np.broadcast_to(second[:, None], front.shape), uv[..., 0], uv[..., 1])
    seen = front & np.isfinite(inverse)
    rays_there = c.rays_at(uv[..., 0], uv[..., 1])
    z_there = rig.depth(np.where(seen, inverse, 1.0), rays_there)
    z_seen = there[..., 2]
    used = seen & (np.abs(z_there - z_seen) < np.maximum(GATE_M, GATE_RELATIVE * z_seen))
    surface = rays_there * z_there[..., None]
    sigma = _sigma(z_there)[..., None]
    toward = (m_there * rays_there).sum(axis=-1)[..., None]
    # derivatives at the mean of both views' depths, with which the residual, their difference, does not vary
    between = np.sqrt(np.where(used, z_there / z_seen, 1.0))
    z_there_by, z_by = rig.depth_by(z_there / between, rays_there), rig.depth_by(z * between, rays)
    return _Planes(
        (m_there * (surface - there)).sum(axis=-1) / sigma[..., 0],
        used,
        -np.concatenate([normals, np.cross(p, normals)], axis=-1) / sigma,
        np.concatenate([m, np.cross(q, m)], axis=-1) / sigma,
        (toward * z_there_by - along[..., None] * z_by) / sigma,
    )


def _seen_later(p: Array, normals: Array, late_s: Array, velocity: Array) -> tuple[Array, Array]:
    """Points and normals in the frame of the camera at another time, to first order.

    Args:
        p: points [..., 3] in the frame of the camera `late_s` after that time.
        normals: [..., 3].
        late_s: [..., 1].
        velocity: of the camera, [..., 6].
    """
    translation, rotation = velocity[..., :3], velocity[..., 3:]
    return (
        p + late_s * (translation + np.cross(rotation, p)),
        normals + late_s * np.cross(rotation, normals),
    )


@dataclass(frozen=True)
class _Features:
    """Of every observation: its distance in the image [k, 2] and from the surface [k] (sigma(z)), and derivatives."""

    off_px: Array
    distance: Array
    used: NDArray[np.bool_]  # whether the depth image shows a surface there
    by_view: Array  # [k, 3, 6]: two of the image, one of depth
    by_point: Array  # [k, 3, 3]
    by_rig: Array  # [k, 3, 17]


def _features(views: Views, rig: CameraRig) -> _Features:
    c, view = views.camera, views.view
    T = se3.inverse(views.T_map_camera[view])
    q = se3.transform(T, views.points_map[views.landmark][:, None])[:, 0]
    q[:, 2] = np.maximum(q[:, 2], 0.05)
    velocity = views.velocity[view]
    share = views.share_of_readout(views.pixel[:, 0], views.pixel[:, 1])
    late_s = rig.delay_s + views.late_s[view] + views.readout.color_s * share
    T_color_time = se3.exp(-late_s[:, None] * velocity)
    R = rig.R_color_depth @ T_color_time[:, :3, :3]
    p = se3.transform(T_color_time, q[:, None])[:, 0] @ rig.R_color_depth.T
    p[:, 2] = np.maximum(p[:, 2], 0.05)
    pixel, by_p, by_lens = rig.project(p)
    there, depth_late_s = q, (views.readout.depth_s * share)[:, None]
    if views.readout.depth_s:
        there, _ = _seen_later(q, q, -depth_late_s, velocity)
        there[:, 2] = np.maximum(there[:, 2], 0.05)
    uv = c.project(there)
    inverse = look_up(views, view, uv[:, 0], uv[:, 1])
    seen = np.isfinite(inverse)
    rays = c.rays_at(uv[:, 0], uv[:, 1])
    z, z_by = rig.depth(np.where(seen, inverse, 1.0), rays), rig.depth_by(there[:, 2], rays)
    at = np.rint(np.where(seen[:, None], uv, 0)).astype(np.int64)
    n = normals_at(views, view, at[:, 1], at[:, 0])
    used = seen & (np.abs(z - there[:, 2]) < FEATURE_GATE_M) & (np.abs(n).sum(axis=-1) > 0)
    n = np.where(used[:, None], n, 0.0)
    sigma = _sigma(z)[:, None]
    n_middle = _seen_later(n, n, depth_late_s, velocity)[1] if views.readout.depth_s else n
    by_q = np.concatenate([by_p @ R, -(n_middle / sigma)[:, None]], axis=1)  # [k, 3, 3]
    by_motion = np.concatenate([-np.broadcast_to(np.eye(3), (len(q), 3, 3)), so3.hat(q)], axis=-1)
    by_rig = np.zeros((len(q), 3, len(NAMES)))
    by_rig[:, :2, :7] = by_lens
    by_rig[:, :2, 7:10] = by_p @ -so3.hat(p)
    moved = velocity[:, :3] + np.cross(velocity[:, 3:], q)
    by_rig[:, :2, 10] = (by_p @ (-(R @ moved[..., None])))[..., 0]
    by_rig[:, 2, 11:] = (n * rays).sum(axis=-1)[:, None] * z_by / sigma
    distance = (n * (rays * z[:, None] - there)).sum(axis=-1) / sigma[:, 0]
    return _Features(pixel - views.pixel, distance, used, by_q @ by_motion, by_q @ T[:, :3, :3], by_rig)


def _sigma(z: Array) -> Array:
    """Shape of the noise of depth, meters, as in the registration."""
    return np.asarray(NOISE.sigma_m(z))


def _scale(residual: Array, least: float) -> float:
    return max(mad_sigma(residual), least) if residual.size else max(least, 1.0)


# --- normal equations -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Step:
    """Normal equations over the poses of a part and the cameras; landmarks follow."""

    H: Array
    g: Array
    _V_inverse: Array  # [m, 3, 3]
    _force: Array  # [m, 3]
    _by_landmark: Array  # W^T, a sparse matrix

    def landmarks(self, x: Array) -> Array:
        """Steps [m, 3] of the landmarks, meters, for a step of everything else."""
        right = self._force + np.asarray(self._by_landmark @ x).reshape(-1, 3)
        return np.clip(-(self._V_inverse @ right[..., None])[..., 0], -0.1, 0.1)


def _linearized(views: Views, pairs: NDArray[np.int64], rig: CameraRig, calibrate: bool) -> _Step:
    from scipy import sparse

    count, cameras = 6 * len(views.T_map_camera), len(NAMES) if calibrate else 0
    f = _features(views, rig)
    px, sigmas = _scale(f.off_px, 0.2), _scale(f.distance[f.used], 0.3)
    image = 1 / (1 + ((f.off_px**2).sum(axis=-1) / (CAUCHY * px) ** 2)) / px**2
    surface = np.where(f.used, _huber(f.distance, sigmas), 0.0)
    root = np.sqrt(np.stack([image, image, surface], axis=-1))[..., None]
    r = (np.concatenate([f.off_px, f.distance[:, None]], axis=-1) * root[..., 0]).reshape(-1)
    rows = np.arange(len(r)).reshape(-1, 3)

    def matrix(J: Array, columns: NDArray[np.int64], width: int) -> sparse.csr_matrix:
        where = np.broadcast_to(rows[..., None], J.shape), np.broadcast_to(columns[:, None], J.shape)
        return sparse.csr_matrix(
            ((J * root).reshape(-1), tuple(w.reshape(-1) for w in where)), shape=(len(r), width)
        )

    A = matrix(f.by_view, 6 * views.view[:, None] + np.arange(6), count)
    if calibrate:
        A = sparse.hstack([A, sparse.csr_matrix((f.by_rig * root).reshape(len(r), -1))]).tocsr()
    landmarks = len(views.points_map)
    B = matrix(f.by_point, 3 * views.landmark[:, None] + np.arange(3), 3 * landmarks)
    V = np.zeros((landmarks, 3, 3))
    weighted = f.by_point * root
    np.add.at(V, views.landmark, np.swapaxes(weighted, 1, 2) @ weighted)
    V += (1e-8 * np.trace(V, axis1=1, axis2=2)[:, None, None] + 1e-6) * np.eye(3)
    V_inverse = np.asarray(np.linalg.inv(V), dtype=np.float64)
    W = (A.T @ B).tocsr()
    blocks = sparse.bsr_matrix((V_inverse, np.arange(landmarks), np.arange(landmarks + 1)))
    WV = W @ blocks.tocsr()
    force = np.asarray(B.T @ r, dtype=np.float64)
    H = (A.T @ A - WV @ W.T).toarray()
    g = np.asarray(A.T @ r - WV @ force, dtype=np.float64)

    H_planes, g_planes = _of_planes(views, pairs, rig, cameras)
    return _Step(H + H_planes, g + g_planes, V_inverse, force.reshape(-1, 3), W.T.tocsr())


def _of_planes(views: Views, pairs: NDArray[np.int64], rig: CameraRig, cameras: int) -> tuple[Array, Array]:
    """Normal equations of the depth images over poses and the last `cameras` numbers: H [n, n] and g [n]."""
    count = 6 * len(views.T_map_camera)
    H, g = np.zeros((count + cameras, count + cameras)), np.zeros(count + cameras)
    s = _planes(views, pairs, rig)
    weight = np.where(s.used, _huber(s.distance, _scale(s.distance[s.used], 0.1)), 0.0)
    J = [s.by_first, s.by_second]
    if cameras:
        J.append(np.zeros((*weight.shape, cameras)))
        J[-1][..., 11:] = s.by_depth
    J_all = np.concatenate(J, axis=-1)
    Jw = np.swapaxes(J_all * weight[..., None], 1, 2)
    residual = np.where(s.used, s.distance, 0.0)
    for (a, b), H_pair, g_pair in zip(pairs, Jw @ J_all, (Jw @ residual[..., None])[..., 0], strict=True):
        at = np.r_[6 * a : 6 * a + 6, 6 * b : 6 * b + 6, count : count + cameras]
        H[np.ix_(at, at)] += H_pair
        g[at] += g_pair
    return H, g


def _huber(residual: Array, scale: float) -> Array:
    return np.asarray(1 / huber_divisor(residual, HUBER * scale) / scale**2)
