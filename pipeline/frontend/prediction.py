"""Where the camera should be when the next frame is taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from duagc.pipeline.base.arrays import Array


@dataclass(frozen=True)
class Prediction:
    """Where the camera should be.

    Attributes:
        T_keyframe_camera: [4, 4], in the keyframe that frames are tracked against.
        information: [6, 6] of its right tangent, from the motion prior of the log; None: it is no measurement.
        sigma_px: how far the view may be from there, pixels of the coarsest image that a registration begins with.
    """

    T_keyframe_camera: Array
    information: Array | None
    sigma_px: float = 0.0


@dataclass
class LastPrediction:
    """The last prediction, which several parts of tracking ask for while they look at one frame.

    Attributes:
        known: the objects that it follows from, and the prediction; None: there is none.
    """

    known: tuple[tuple[object, ...], Prediction] | None = None

    def of(self, basis: tuple[object, ...], predict: Callable[[], Prediction]) -> Prediction:
        """The prediction that follows from some objects: the last one, if these are the same objects as then.

        Args:
            basis: all that it follows from; none of them changes.
            predict: computes it.
        """
        if self.known is not None and all(a is b for a, b in zip(basis, self.known[0], strict=True)):
            return self.known[1]
        self.known = basis, predict()
        return self.known[1]
