"""Following a camera whose depth is missing or frozen, by its color alone.

The translation that color gives is off by a share of itself, because depth and color of a real camera do not fit
together to the pixel. Against a keyframe this error is there at once, as large as the distance from it: 5 cm in
RedKitchen. So such frames are registered to the last one that had both images, which is near.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.frontend import FailureConfig
from duagc.pipeline.frontend.keyframe_graph import OPEN_DIRECTION
from duagc.pipeline.geometry import se3
from duagc.pipeline.registration import (
    Outcome,
    Reference,
    Registration,
    RegistrationConfig,
    RgbdPyramid,
    register,
)
from duagc.pipeline.registration.align import reach_factor


@dataclass(frozen=True)
class LastGoodFrame:
    """A frame whose depth and color were both good.

    Attributes:
        pyramid: its images.
        strides: of its samples.
        T_keyframe_camera: [4, 4].
        information: [6, 6] of it; None: it is the keyframe.
    """

    pyramid: RgbdPyramid = field(repr=False)
    strides: tuple[int, ...]
    T_keyframe_camera: Array
    information: Array | None

    @cached_property
    def _reference(self) -> Reference:
        return Reference.from_pyramid(self.pyramid, self.strides)

    @cached_property
    def _depth_m(self) -> float:
        """Median depth of the samples."""
        points = next((of.points for of in reversed(self._reference.levels) if len(of)), np.zeros((1, 3)))
        return float(np.median(points[:, 2]))

    def register_color(
        self,
        pyramid: RgbdPyramid,
        T_keyframe_guess: Array,
        registration: RegistrationConfig,
        limits: FailureConfig,
        *,
        prior_information: Array | None,
    ) -> Registration:
        """Register the color of a later frame to this one.

        Args:
            pyramid: of the later frame.
            T_keyframe_guess: where it should be, [4, 4].
            registration: settings of the registration.
            limits: how far and how much of this frame color alone may be followed.
            prior_information: [6, 6] of the guess; None: unknown.

        Returns:
            The registration with T_reference_target and information in the keyframe; overlap and view are shares of
            this frame. JUMP if it is too far from here for color alone, LOW_OVERLAP if too little is shared.
        """
        T_here_guess = se3.inverse(self.T_keyframe_camera) @ T_keyframe_guess
        result = register(
            self._reference,
            pyramid.without_depth(),
            T_here_guess,
            registration,
            prior_information=prior_information,
        )
        T = result.T_reference_target
        translation_m = float(np.linalg.norm(T[:3, 3]))
        outcome = result.outcome
        farthest_m = limits.max_translation_without_depth_m * reach_factor(self._depth_m)
        if result.ok and translation_m > farthest_m:
            outcome = Outcome.JUMP
        elif result.ok and result.view < limits.min_view_without_depth:
            outcome = Outcome.LOW_OVERLAP
        return replace(
            result,
            outcome=outcome,
            T_reference_target=self.T_keyframe_camera @ T,
            information=self._information(result, limits.sigma_of_translation_without_depth * translation_m),
        )

    def translation_m(self, T_keyframe_camera: Array) -> float:
        """Distance from this frame to a pose, meters.

        Args:
            T_keyframe_camera: [4, 4], in the keyframe of this frame.
        """
        return float(se3.distance(self.T_keyframe_camera, T_keyframe_camera)[0])

    def agrees(
        self, T_keyframe_camera: Array, T_color_only: Array, limits: FailureConfig, contradicted: bool
    ) -> bool:
        """Whether color alone puts a frame where color and depth together do.

        If the two images are of different times, or something moves in front of the camera, the answers differ by as
        much as the camera moves. Those of a good camera differ by a share of it; once the two have contradicted each
        other, less of it is allowed.

        Args:
            T_keyframe_camera: [4, 4], by depth and color.
            T_color_only: [4, 4], by color alone, in the same keyframe.
            limits: how much they may differ.
            contradicted: whether an earlier frame's answers differed by more.
        """
        apart_m = float(se3.distance(T_keyframe_camera, T_color_only)[0])
        translation_m = max(self.translation_m(T_keyframe_camera), self.translation_m(T_color_only))
        factor = limits.share_after_contradiction if contradicted else 1.0
        share = limits.max_depth_color_of_translation * factor
        return apart_m <= max(limits.max_depth_color_m, share * translation_m)

    def _information(self, result: Registration, sigma_m: float) -> Array:
        """Of the pose in the keyframe: covariances of registration, of this frame's pose and of the translation add."""
        depth_m = max(self._depth_m, 0.1)
        covariance = _covariance(result.information)
        covariance += sigma_m**2 * np.diag([1.0, 1.0, 1.0, *[depth_m**-2.0] * 3])
        if self.information is not None:
            A = se3.adjoint(se3.inverse(result.T_reference_target))
            covariance += A @ _covariance(self.information) @ A.T
        information = np.linalg.inv(covariance)
        return np.asarray(0.5 * (information + information.T))


def _covariance(information: Array) -> Array:
    return np.asarray(np.linalg.inv(information + OPEN_DIRECTION * np.eye(6)))
