"""Legs of a robot that is steered: short moves from where it is, clear of every surface, that turn its camera.

Legs are drawn at random; which one the robot takes is chosen elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from duagc.converters.simulate.trajectories.loops import look_at
from duagc.converters.simulate.trajectories.walks import Terrain
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError

FIRST_FRAMES, LEG_FRAMES = 16, 24  # of a steered robot, before its first choice and after each
LEAST_SHARE = 0.4  # of the way that the usual speed allows
MAX_TURN_RAD = np.deg2rad(2.5)  # a frame, on average
PITCHES_RAD = (np.deg2rad(-25.0), np.deg2rad(5.0))
HEIGHT_M = 0.1  # up or down
MIN_CLEARANCE_M = 0.4
TRIES = 100  # a leg


@dataclass(frozen=True)
class LegPlanner:
    """Draws legs.

    Attributes:
        terrain: where the robot moves.
        frames: of a leg.
    """

    terrain: Terrain
    frames: int

    def draw(self, T_world_camera: Array, count: int, rng: np.random.Generator) -> list[Array]:
        """Legs [frames, 4, 4], T_world_camera, the first pose one frame after the given one; at rest in the end.

        Args:
            T_world_camera: [4, 4], where the robot is.
            count: how many.
            rng: draws them.

        Raises:
            DuagError: there is no room for so many.
        """
        legs: list[Array] = []
        for _ in range(TRIES * count):
            leg = self._drawn(T_world_camera, rng)
            if self.terrain.clearance(leg[:, :3, 3]).min() > MIN_CLEARANCE_M:
                legs.append(leg)
            if len(legs) == count:
                return legs
        raise DuagError(
            f"simulate: found {len(legs)} legs with {MIN_CLEARANCE_M} m of room around them in {TRIES * count} tries, "
            f"expected {count}"
        )

    def _drawn(self, T_world_camera: Array, rng: np.random.Generator) -> Array:
        forward, begin = T_world_camera[:3, 2], T_world_camera[:3, 3]
        yaw, pitch = np.arctan2(forward[1], forward[0]), np.arcsin(np.clip(forward[2], -1.0, 1.0))
        heading = rng.uniform(0, 2 * np.pi)
        length = self.frames * self.terrain.step_m * rng.uniform(LEAST_SHARE, 1.0)
        way = np.array([length * np.cos(heading), length * np.sin(heading), rng.uniform(-HEIGHT_M, HEIGHT_M)])
        turn = self.frames * rng.uniform(-MAX_TURN_RAD, MAX_TURN_RAD)
        nod = rng.uniform(*PITCHES_RAD) - pitch
        t = np.arange(1, self.frames + 1) / self.frames
        share = t * t * (3 - 2 * t)
        positions = begin + share[:, None] * way
        yaws, pitches = yaw + share * turn, pitch + share * nod
        gaze = np.stack(
            [np.cos(yaws) * np.cos(pitches), np.sin(yaws) * np.cos(pitches), np.sin(pitches)], axis=1
        )
        return look_at(positions, positions + gaze)
