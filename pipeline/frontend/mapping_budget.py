"""How many training steps a map may take: counted in the pixels that they look at, so that no clock decides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from duagc.pipeline.config.mapping import MappingConfig
from duagc.pipeline.config.training import DepthKind
from duagc.pipeline.geometry.camera import PinholeCamera


@dataclass(frozen=True)
class MappingBudget:
    """Steps by the time that a log took to record.

    Attributes:
        config: of the mapping.
        camera: of all views.
        depth: of the Gaussians, as it is drawn.
    """

    config: MappingConfig
    camera: PinholeCamera
    depth: DepthKind

    def keyframe_steps(self, stamps_ns: Sequence[int]) -> list[int]:
        """Steps at each keyframe, by the time since the one before; at the first one all.

        Args:
            stamps_ns: of the keyframes.
        """
        most, camera = self.config.steps(self.depth).keyframe, self.camera
        limit = self.config.keyframe_megapixels_s
        if limit is None:
            return [most] * len(stamps_ns)
        pixels = camera.width * camera.height / 4**self.config.iterations_level
        since_s = [1e-9 * (b - a) for a, b in pairwise(stamps_ns)]
        return [most, *(min(most, int(1e6 * limit * s / pixels)) for s in since_s)][: len(stamps_ns)]

    def final_steps(self, keyframes: int, views: int, log_s: float) -> tuple[int, int]:
        """Steps of the final optimization: as many as wanted, and as many as the budget allows of them.

        Args:
            keyframes: how many there are.
            views: how many there are, keyframes too.
            log_s: time that the log took to record.
        """
        config = self.config
        wanted = int(config.final_steps(keyframes, views, self.depth))
        if config.final_megapixels_s is None:
            return wanted, wanted
        seen = 0.5 if config.sparse.checkerboard else 1.0
        pixels = seen * self.camera.width * self.camera.height
        return wanted, int(min(wanted, 1e6 * config.final_megapixels_s * log_s / pixels))

    def say_left_out(
        self, say: Callable[[str], None], name: str, steps: tuple[int, int], setting: str
    ) -> None:
        """Say what a budget leaves out, if anything.

        Args:
            say: gets the line.
            name: of the component.
            steps: how many are left out, and of how many.
            setting: of the mapping that is the budget.
        """
        left_out, wanted = steps
        if left_out:
            which = "at keyframes" if setting == "keyframe_megapixels_s" else "of the final optimization"
            say(
                f"warning: {name}: {left_out} of {wanted} training steps {which} are left out "
                f"by frontend.mapping.{setting}"
            )


def alone_steps(steps: int, joint_share: float) -> int:
    """Steps of the final optimization of a tile that it takes alone.

    Args:
        steps: in all.
        joint_share: last share that all tiles take together.
    """
    return round((1 - joint_share) * steps)
