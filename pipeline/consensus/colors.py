"""How the cameras of a team see the same colors, from matched Gaussians alone.

Every robot keeps the colors of its own camera; there is no right one. Per channel, a camera shows the color s of a
surface as c = (s - b) / a: gain (exposure, white balance) and offset. The matched Gaussians of every pair of robots
give the ratio of the gains and the colors that correspond; over the team these make one linear problem. All robots with
the same evidence and pair lists solve the same problem, so nothing more is sent, and a robot converts what it received
from a peer to its own colors (`ColorMap`).

Two robots' splats of one place differ in color by noise in both; `geometry.color_comparison` compares them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.consensus import ColorConfig
from duagc.pipeline.consensus.evidence import Evidence, PlacedGaussians, rows_by_id
from duagc.pipeline.geometry.color_comparison import ComparedColors, compare_colors
from duagc.pipeline.splat.information import COLOR, COLOR_INFORMATION

Pairs = Mapping[tuple[str, str], NDArray[np.int64]]


@dataclass(frozen=True)
class ColorMap:
    """How another camera shows one camera's colors c: gain * c + offset; the identity where nothing was compared.

    Attributes:
        gain: [3], by channel.
        offset: [3], colors 0..1.
        sigma_gain: [3], relative standard deviation.
        sigma_offset: [3], standard deviation of the other camera's color in the middle of the compared colors.
        matches: pairs of Gaussians of these two robots that were compared.
    """

    gain: Array
    offset: Array
    sigma_gain: Array
    sigma_offset: Array
    matches: int

    @property
    def is_identity(self) -> bool:
        """Whether it changes nothing."""
        return bool(np.all(self.gain == 1) and np.all(self.offset == 0))

    def to_other(self, colors: NDArray[np.floating]) -> Array:
        """Colors [n, 3] as the other camera shows them.

        Args:
            colors: [n, 3], of this camera, 0..1.
        """
        return np.asarray(self.gain * colors + self.offset, dtype=np.float64)

    def from_other(self, colors: NDArray[np.floating]) -> Array:
        """Colors [n, 3] of the other camera as this one shows them.

        Args:
            colors: [n, 3], of the other camera, 0..1.
        """
        return np.asarray((colors - self.offset) / self.gain, dtype=np.float64)

    def parameters(self, evidence: Evidence) -> Array:
        """theta [n, 13] of evidence in the other camera's colors.

        Args:
            evidence: on n Gaussians, in this camera's colors.

        Returns:
            In the frame of the evidence; not a copy if the map is the identity.
        """
        if self.is_identity:
            return evidence.theta
        theta = evidence.theta.copy()
        theta[:, COLOR] = self.to_other(theta[:, COLOR])
        return theta

    def of(self, evidence: Evidence) -> Evidence:
        """Evidence in the other camera's colors; every bit is kept by the identity.

        Args:
            evidence: on n Gaussians, in this camera's colors.

        Returns:
            In the same frame; the information on colors is divided by the square of the gain.
        """
        if self.is_identity:
            return evidence
        information = evidence.information.copy()
        information[:, COLOR_INFORMATION] /= self.gain**2
        return replace(evidence, theta=self.parameters(evidence), information=information)


@dataclass(frozen=True)
class TeamColors:
    """Every robot's map from its own colors c to common ones: scale * c + shift.

    The common colors only serve that all robots compute the same: in them no robot's gain and offset is far from one
    and zero.

    Attributes:
        robots: names, sorted.
        scale: [3] by name.
        shift: [3] by name.
        covariance_scale: [r, r, 3], between robots, of the log scale.
        covariance_shift: [r, r, 3], between robots, of the shift.
        matches: by pair of robots, compared pairs of Gaussians.
    """

    robots: tuple[str, ...]
    scale: dict[str, Array]
    shift: dict[str, Array]
    covariance_scale: Array
    covariance_shift: Array
    matches: dict[tuple[str, str], int]

    def to_common(self, robot: str) -> ColorMap:
        """From a robot's colors to the common ones.

        Args:
            robot: its name.
        """
        i = self.robots.index(robot)
        return ColorMap(
            self.scale[robot],
            self.shift[robot],
            np.sqrt(self.covariance_scale[i, i]),
            np.sqrt(self.covariance_shift[i, i]),
            sum(n for pair, n in self.matches.items() if robot in pair),
        )

    def between(self, robot: str, other: str) -> ColorMap:
        """From a robot's colors to another's.

        Args:
            robot: name of the one whose colors are converted.
            other: name of the one whose colors they become.
        """
        i, j = self.robots.index(robot), self.robots.index(other)
        scale = self.scale[other]
        return ColorMap(
            self.scale[robot] / scale,
            (self.shift[robot] - self.shift[other]) / scale,
            _sigma_of_difference(self.covariance_scale, i, j),
            _sigma_of_difference(self.covariance_shift, i, j) / scale,
            sum(n for pair, n in self.matches.items() if set(pair) == {robot, other}),
        )


def team_colors(
    evidence: Mapping[str, Evidence | PlacedGaussians], pairs: Pairs, config: ColorConfig
) -> TeamColors:
    """How the cameras of a team differ.

    Args:
        evidence: of every robot.
        pairs: (robot a, robot b) -> ids int64 [m, 2] of matched Gaussians; those that `evidence` lacks, or of
            whose colors one of the two has no information, are left out.
        config: limits and priors.
    """
    robots = tuple(sorted(evidence))
    matches: dict[tuple[str, str], int] = {}
    found: list[tuple[int, int, ComparedColors]] = []
    for a, b in sorted(p for p in pairs if p[0] in evidence and p[1] in evidence):
        own, other = _colors_of(evidence[a], evidence[b], pairs[a, b])
        if config.enabled and len(own) >= config.min_matches:
            matches[a, b] = len(own)
            compared = compare_colors(
                own,
                other,
                per_sample=config.splats_per_sample,
                sigma_floor=config.sigma_floor,
                sigma_floor_middle=config.sigma_floor,
            )
            found.append((robots.index(a), robots.index(b), compared))
    scale, shift = np.ones((len(robots), 3)), np.zeros((len(robots), 3))
    of_scale, of_shift = (
        np.zeros((len(robots), len(robots), 3)) + s**2 * np.eye(len(robots))[..., None]
        for s in (config.prior_gain, config.prior_offset)
    )
    for k in range(3 if found else 0):
        rows = [(i, j, c.log_ratio[k], c.variance[k]) for i, j, c in found]
        log_gain, of_scale[..., k] = _differences(len(robots), rows, config.prior_gain)
        scale[:, k] = np.exp(-log_gain)
        rows = []
        for i, j, c in found:
            apart = scale[i, k] * c.middle_own[k] - scale[j, k] * c.middle_other[k]
            rows.append((i, j, apart, scale[i, k] * scale[j, k] * c.variance_middle[k]))
        shift[:, k], of_shift[..., k] = _differences(len(robots), rows, config.prior_offset)
    return TeamColors(
        robots,
        dict(zip(robots, scale, strict=True)),
        dict(zip(robots, shift, strict=True)),
        of_scale,
        of_shift,
        matches,
    )


def _colors_of(
    own: Evidence | PlacedGaussians, other: Evidence | PlacedGaussians, ids: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Colors [m, 3] of matched Gaussians on which both robots have information."""
    i, j = rows_by_id(ids[:, 0], own.ids), rows_by_id(ids[:, 1], other.ids)
    here = (i >= 0) & (j >= 0)
    i, j = i[here], j[here]
    known = np.all(own.color_information()[i] > 0, axis=1) & np.all(other.color_information()[j] > 0, axis=1)
    return own.theta[i[known], COLOR], other.theta[j[known], COLOR]


def _differences(robots: int, rows: list[tuple[int, int, float, float]], prior: float) -> tuple[Array, Array]:
    """Values [r] of least squares of their differences x_j - x_i with variances, each (i, j, x_j - x_i, variance),
    and of their own being zero within the prior; their covariance [r, r]."""
    matrix, right = np.eye(robots) / prior**2, np.zeros(robots)
    for i, j, difference, variance in rows:
        matrix[[i, j], [i, j]] += 1 / variance
        matrix[[i, j], [j, i]] -= 1 / variance
        right[i] -= difference / variance
        right[j] += difference / variance
    covariance = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return covariance @ right, covariance


def _sigma_of_difference(covariance: Array, i: int, j: int) -> Array:
    return np.sqrt(np.maximum(covariance[i, i] + covariance[j, j] - 2 * covariance[i, j], 0.0))
