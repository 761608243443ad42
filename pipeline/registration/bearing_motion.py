"""The motion that matched features agree on where most of them have no depth.

A camera whose depth ends at two meters sees far more than it measures. A feature without depth still has a bearing: in
the other view it lies on a segment of a line, from where it would be infinitely far away to where it would be near. So
it says how the camera turned, and in which direction it went; how far, those with depth say, in whichever view they
have it, and dense registration.

Where most features lie on one plane, a wall, two motions fit these as well (Longuet-Higgins 1986), others nearly so.
The motions by which most would lie on a plane are tried as well, and the deepest minimum counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.registration.descriptors import matches
from duagc.pipeline.registration.features import Features

LARGEST_INVERSE_DEPTH = 1 / 0.3
"""1/m: what has no depth may be so near; few sensors measure nearer."""
COARSE_PX = (20.0, 20.0, 10.0, 10.0, 5.0, 5.0, 2.5, 2.5)
"""Scales of the Geman-McClure weights, step by step, from where a prediction may be."""
FINE_PX = 2.5
FINE_STEPS = 14
"""Steps after these: the first two with that scale, the others with `SIGMAS`."""
CONVERGED = 1e-4  # m, rad
SIGMAS = 3.0
"""Scale of the last weights, in standard deviations, and distance within which a match agrees."""
LEAST_SIGMA_PX = 0.2
"""Least standard deviation of a place in the image where a feature is found."""
SHARED_SIGMA_PX = 0.5
"""Least standard deviation that a motion is stated by: neighbors share what lenses and shutters move."""
RELATIVE_DEPTH_SIGMA = 0.05
"""Least standard deviation of the depth of a feature, as a share of it: many lie at edges."""
LENGTH_SIGMA_M = 0.1
"""Standard deviation of the length of a start: without depth, nothing else says how far a camera went."""
DAMPING = 1e-6  # of the normal equations, as a share of their largest entry, besides 1
MIN_INLIERS = 20
"""Matches that must agree; twice as many as where all have depth, for a segment is met by chance more easily."""
MIN_SHARE = 0.5
"""The same as a share of the matches."""
STILL_PX, FAR_OF_STILL = 1.0, 3.0
"""Distance within which a match stays at its pixel, and from how many of it on others move far."""
MOST_SIGMA_PX = 2.0
"""Largest standard deviation of a match that agrees."""
ON_PLANE_PX = 3.0  # distance within which matches lie on one plane
NEAREST = 0.05  # least depth of a match in front of a camera, of its place at a depth of 1
OFF_PX = 1e3  # of a match that cannot be
MEDIAN_OF_ONE, MEDIAN_OF_TWO = 0.6745, 1.1774  # of the length of one normal number, and of two


@dataclass(frozen=True)
class BearingMatches:
    """Matched features of two views, those that the first view has a depth of, or neither, before the others.

    Attributes:
        given: [n, 3], where one view has them, at a depth of 1: the first one, of the others the second one.
        sought: [n, 2], where the other view has them, at a depth of 1.
        inverse_depth: [n], 1/m, of `given`; NaN: unknown in either view.
        relative_depth_sigma: [n], standard deviation of their depth, as a share of it; NaN: unknown.
        forward: how many come first.
        pixel_width: width of a pixel at a depth of 1.
    """

    given: Array
    sought: Array
    inverse_depth: Array
    relative_depth_sigma: Array
    forward: int
    pixel_width: float

    def __len__(self) -> int:
        return len(self.given)

    @staticmethod
    def of(
        first: Features, second: Features, ratio: float, *, whatever_has_depth: bool = False
    ) -> BearingMatches | None:
        """Matches of all features.

        Of matches between the same two places one counts: a blob of several orientations has several. None: features
        without depth were not looked for in both views, too few match and move, or most of those have depth in both
        views, and so have most pixels.

        Args:
            first: features of the first view.
            second: features of the second view.
            ratio: of the ratio test.
            whatever_has_depth: whether matches are wanted though most have depth.
        """
        if min(first.bearings.pixel_width, second.bearings.pixel_width) == 0:
            return None
        ours, theirs = (np.concatenate([f.descriptors, f.bearings.descriptors]) for f in (first, second))
        pairs = matches(ours, theirs, ratio)
        (a, rho_a), (b, rho_b) = _places(first, pairs[:, 0]), _places(second, pairs[:, 1])
        backward = np.isnan(rho_a) & ~np.isnan(rho_b)
        pixel_width = max(first.bearings.pixel_width, second.bearings.pixel_width)
        left = _once(a, b)
        left = left[_moving(np.linalg.norm(a - b, axis=1)[left] / pixel_width)]
        few = whatever_has_depth or first.bearings.few_depths or second.bearings.few_depths
        in_both = np.count_nonzero(~np.isnan(rho_a + rho_b)[left])
        if len(left) < MIN_INLIERS or (in_both > len(left) / 2 and not few):
            return None
        order = left[np.argsort(backward[left], kind="stable")]
        inverse_depth = np.where(backward, rho_b, rho_a)
        sigma = np.where(backward, second.bearings.inverse_depth_sigma, first.bearings.inverse_depth_sigma)
        return BearingMatches(
            np.where(backward[:, None], b, a)[order],
            np.where(backward[:, None], a, b)[order, :2],
            inverse_depth[order],
            np.maximum(RELATIVE_DEPTH_SIGMA, sigma / inverse_depth)[order],
            int(np.count_nonzero(~backward[left])),
            pixel_width,
        )


@dataclass(frozen=True)
class BearingMotion:
    """A motion that matched features, with and without depth, agree on.

    Attributes:
        T_first_second: [4, 4].
        information: [6, 6] of its right tangent.
        matches: number of matches.
        inliers: how many agree.
        sigma_px: standard deviation of either coordinate of a match.
    """

    T_first_second: Array
    information: Array
    matches: int
    inliers: int
    sigma_px: float

    @property
    def accepted(self) -> bool:
        """Whether enough matches agree."""
        return self.inliers >= max(MIN_INLIERS, MIN_SHARE * self.matches)


def motion_from_bearings(matched: BearingMatches, starts: Sequence[Array]) -> BearingMotion:
    """The motion that most matches agree on near some starts.

    Args:
        matched: of two views.
        starts: T_first_second [4, 4] each.
    """
    anchors = np.asarray(starts, dtype=np.float64)
    lengths_m = np.linalg.norm(anchors[:, :3, 3], axis=1)
    coarse = _refined(matched, anchors, lengths_m, COARSE_PX)
    best = _best(matched, coarse, lengths_m)
    length_m = lengths_m[best]
    nearby = np.concatenate([coarse[best][None], _by_plane(matched, coarse[best])])
    motions = _refined(matched, nearby, length_m, (FINE_PX, FINE_PX, *[None] * (FINE_STEPS - 2)))
    T = motions[_best(matched, motions, length_m)]
    return bearings_at(matched, se3.from_rotation_translation(so3.project(T[:3, :3]), T[:3, 3]))


def bearings_at(matched: BearingMatches, T_first_second: Array) -> BearingMotion:
    """What matches say of a motion: how many agree, and how well they determine it.

    Args:
        matched: of two views.
        T_first_second: [4, 4], the motion.
    """
    at = _Residuals.at(matched, T_first_second[None])
    sigma_px = float(at.sigmas_px()[0])
    H, _ = at.normal_equations(np.array([SIGMAS * sigma_px]))
    agree = int(np.count_nonzero(at.off_px[0] < SIGMAS * min(sigma_px, MOST_SIGMA_PX)))
    information = H[0] / max(sigma_px, SHARED_SIGMA_PX) ** 2
    return BearingMotion(T_first_second, information, len(matched), agree, sigma_px)


def distances_px(matched: BearingMatches, T_first_second: Array) -> Array:
    """How far matches are from where a motion has them, [n], pixels.

    Args:
        matched: of two views.
        T_first_second: [4, 4], the motion.
    """
    return _Residuals.at(matched, T_first_second[None]).off_px[0]


def _refined(
    matched: BearingMatches, T_first_second: Array, lengths_m: Array, scales_px: Sequence[float | None]
) -> Array:
    """The motions [s, 4, 4] that most matches agree on near others, of lengths [s] where nothing else says so.

    A scale of None: by the spread of what agrees.
    """
    T = T_first_second
    for scale_px in scales_px:
        at = _Residuals.at(matched, T)
        sigmas_px = at.sigmas_px()
        H, gradient = at.normal_equations(
            SIGMAS * sigmas_px if scale_px is None else np.full(len(T), scale_px)
        )
        too_long, ahead = _too_long(T, lengths_m)
        held = (sigmas_px / LENGTH_SIGMA_M) ** 2
        H = H + held[:, None, None] * ahead[:, :, None] * ahead[:, None, :]
        H = H + (1.0 + DAMPING * H.max(axis=(1, 2), keepdims=True)) * np.eye(6)
        gradient = gradient + (held * too_long)[:, None] * ahead
        step = -np.linalg.solve(H, gradient[..., None])[..., 0]
        T = T @ se3.exp(step)
        if scale_px is None and np.max(np.abs(step)) < CONVERGED:
            break
    return T


def _too_long(motions: Array, lengths_m: Array) -> tuple[Array, Array]:
    """By how much motions [s, 4, 4] exceed lengths, meters, and the tangents [s, 6] by which they get longer."""
    t = motions[:, :3, 3]
    length_m = np.linalg.norm(t, axis=1)
    ahead = np.zeros((len(t), 6))
    ahead[:, :3] = (np.swapaxes(motions[:, :3, :3], 1, 2) @ t[..., None])[..., 0]
    return length_m - lengths_m, ahead / np.maximum(length_m, 1e-9)[:, None]


def _best(matched: BearingMatches, motions: Array, lengths_m: Array) -> int:
    """The most likely one of motions [s, 4, 4], by the least spread of all."""
    at = _Residuals.at(matched, motions)
    squared, scale = at.off_px**2, SIGMAS * float(at.sigmas_px().min())
    cost = SIGMAS**2 * np.sum(squared / (scale**2 + squared), axis=1)
    return int(np.argmin(cost + (_too_long(motions, lengths_m)[0] / LENGTH_SIGMA_M) ** 2))


def _by_plane(matched: BearingMatches, T_first_second: Array) -> Array:
    """The motions [s, 4, 4] by which matches would lie on one plane: two at most are not behind a camera.

    Args:
        matched: of two views.
        T_first_second: [4, 4], a motion that is as long.
    """
    import cv2

    given, sought = matched.given[: matched.forward, :2], matched.sought[: matched.forward]
    none = np.zeros((0, 4, 4))
    if len(given) < MIN_INLIERS:
        return none
    H, _ = cv2.findHomography(given, sought, cv2.RANSAC, ON_PLANE_PX * matched.pixel_width)
    if H is None:
        return none
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    length_m = float(np.linalg.norm(T_first_second[:3, 3]))
    motions = [
        se3.inverse(
            se3.from_rotation_translation(R, length_m * t[:, 0] / max(float(np.linalg.norm(t)), 1e-9))
        )
        for R, t in zip(rotations, translations, strict=True)
    ]
    return np.array(motions).reshape(-1, 4, 4)


def _moving(moved_px: Array) -> NDArray[np.bool_]:
    """Which matches [n] may tell of a motion, by how far they moved in the image [n].

    What stays at its pixel may be of the camera's own body. So where others move far, it does not count, and where most
    stays nothing does: the camera stands or sees its body.
    """
    moving = moved_px > STILL_PX
    count = int(np.count_nonzero(moving))
    if count < MIN_INLIERS:
        return np.zeros_like(moving)
    far = np.median(moved_px[moving]) > FAR_OF_STILL * STILL_PX
    return moving if far else np.full_like(moving, count > len(moving) / 2)


def _once(a: Array, b: Array) -> NDArray[np.int64]:
    """The first [k] of all matches [n] between the same places [n, 3]: of a blob that has several orientations."""
    _, first = np.unique(np.concatenate([a[:, :2], b[:, :2]], axis=1), axis=0, return_index=True)
    return np.sort(first)


def _places(features: Features, index: NDArray[np.int64]) -> tuple[Array, Array]:
    """Where a view has features, [n, 3] at a depth of 1, and their inverse depth [n], NaN where it is unknown."""
    points, rays = features.points.astype(np.float64), features.bearings.rays.astype(np.float64)
    places = np.concatenate([points / points[:, 2:], rays])
    inverse_depth = np.concatenate([1 / points[:, 2], np.full(len(rays), np.nan)])
    return places[index], inverse_depth[index]


@dataclass(frozen=True)
class _Residuals:
    """How far matches are from where s motions have them.

    Attributes:
        residual: [s, n, 2], px, across and along the segment; 0 along it where an unknown depth explains it.
        jacobian: [s, n, 2, 6], by the right tangents of the motions.
        off_px: [s, n], lengths of the residuals.
        open: bool [s, n], where an unknown depth explains the residual along the segment.
    """

    residual: Array
    jacobian: Array
    off_px: Array
    open: NDArray[np.bool_]

    def sigmas_px(self) -> Array:
        """Standard deviations [s] of either coordinate, by the median."""
        medians = np.where(self.open, MEDIAN_OF_ONE, MEDIAN_OF_TWO)
        if not self.off_px.size:
            return np.full(len(self.off_px), LEAST_SIGMA_PX)
        return np.maximum(np.median(self.off_px / medians, axis=1), LEAST_SIGMA_PX)

    def normal_equations(self, scales_px: Array) -> tuple[Array, Array]:
        """H [s, 6, 6] and gradients [s, 6] of residuals of 1 px, by weights of scales [s]."""
        squared = scales_px[:, None] ** 2
        weight = (squared / (squared + self.off_px**2)) ** 2
        J = self.jacobian.reshape(len(weight), -1, 6)
        weighted = np.swapaxes((self.jacobian * weight[..., None, None]).reshape(J.shape), 1, 2)
        gradient = weighted @ self.residual.reshape(len(weight), -1, 1)
        return weighted @ J, gradient[..., 0]

    @staticmethod
    def at(matched: BearingMatches, T_first_second: Array) -> _Residuals:
        """At motions [s, 4, 4]."""
        R, t = T_first_second[:, :3, :3], T_first_second[:, None, :3, 3]
        k, given = matched.forward, matched.given
        # the place at a depth of 1 moves along `along` with the inverse depth
        far = np.concatenate([given[:k] @ R, given[k:] @ np.swapaxes(R, 1, 2)], axis=1)
        along = np.empty_like(far)
        along[:, :k], along[:, k:] = -t @ R, t
        unit, rho = _segments(matched, far, along)
        unknown = np.isnan(matched.inverse_depth)
        is_open = unknown & (rho > 0) & (rho < LARGEST_INVERSE_DEPTH)
        impossible = unknown & (rho >= LARGEST_INVERSE_DEPTH)
        rho = np.where(unknown, np.clip(rho, 0.0, LARGEST_INVERSE_DEPTH), matched.inverse_depth)
        q = far + rho[..., None] * along
        behind = q[..., 2] < NEAREST
        z = np.where(behind, 1.0, q[..., 2])
        place = q[..., :2] / z[..., None]
        moved = place - far[..., :2] / np.maximum(far[..., 2:], NEAREST)
        by_depth = np.hypot(
            1.0, matched.relative_depth_sigma / LEAST_SIGMA_PX / matched.pixel_width * _length(moved)
        )
        share = np.where(is_open, 0.0, np.where(unknown, 1.0, 1 / by_depth))
        axes = np.stack([np.stack([-unit[..., 1], unit[..., 0]], axis=-1), share[..., None] * unit], axis=-2)
        axes /= matched.pixel_width
        off = place - matched.sought
        residual = axes[..., 0] * off[..., :1] + axes[..., 1] * off[..., 1:]
        by_place = _derivatives(matched, R, place, z, rho=rho)
        jacobian = axes[..., :1] * by_place[..., :1, :] + axes[..., 1:] * by_place[..., 1:, :]
        impossible |= behind
        residual[impossible], jacobian[impossible] = OFF_PX, 0.0
        return _Residuals(residual, jacobian, _length(residual), is_open)


def _length(vectors: Array) -> Array:
    """Of vectors [..., 2]."""
    return np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2)


def _segments(matched: BearingMatches, far: Array, along: Array) -> tuple[Array, Array]:
    """Directions [s, n, 2] in which places move with the inverse depth, and inverse depths [s, n] that fit best."""
    direction = along[..., :2] * far[..., 2:] - far[..., :2] * along[..., 2:]
    length = _length(direction)[..., None]
    unit = np.where(length > 1e-12, direction / np.maximum(length, 1e-12), [1.0, 0.0])
    u, v = unit[..., 0], unit[..., 1]
    at = u * matched.sought[:, 0] + v * matched.sought[:, 1]
    top = at * far[..., 2] - (u * far[..., 0] + v * far[..., 1])
    bottom = u * along[..., 0] + v * along[..., 1] - at * along[..., 2]
    fits = np.abs(bottom) > 1e-9
    return unit, np.where(fits, top / np.where(fits, bottom, 1.0), 0.0)


def _derivatives(matched: BearingMatches, R: Array, place: Array, z: Array, *, rho: Array) -> Array:
    """Of places [s, n, 2], z times nearer than their inverse depths, by the right tangents, [s, n, 2, 6]."""
    k, x, y = matched.forward, place[..., 0], place[..., 1]
    nearness = rho / z
    J = np.empty((*x.shape, 2, 6))
    rows = np.empty((*x.shape, 2, 3))  # by the point, z times
    rows[..., 0, 0] = rows[..., 1, 1] = 1.0
    rows[..., 0, 1] = rows[..., 1, 0] = 0.0
    np.negative(place, out=rows[..., 2])
    J[:, :k, :, :3] = -nearness[:, :k, None, None] * rows[:, :k]
    # the cross products of these rows and (x, y, 1)
    x, y, turn = x[:, :k], y[:, :k], J[:, :k, :, 3:]
    turn[..., 0, 0], turn[..., 0, 1], turn[..., 0, 2] = x * y, -x * x - 1.0, y
    turn[..., 1, 0], turn[..., 1, 1], turn[..., 1, 2] = 1.0 + y * y, -x * y, -x
    if k < len(matched):
        turned, (a, b, c) = rows[:, k:] @ R[:, None], matched.given[k:].T[..., None]
        J[:, k:, :, :3] = nearness[:, k:, None, None] * turned
        p, q, r = np.moveaxis(turned, -1, 0)
        J[:, k:, :, 3:] = np.stack([b * r - c * q, c * p - a * r, a * q - b * p], axis=-1)
        J[:, k:, :, 3:] /= z[:, k:, None, None]
    return J
