"""The printed iteration (8), (10), (11), (14) on the wire, to compare with: not a solver to use.

Every loop closure is a constraint with a multiplier at either end. Per round a robot takes one Riemannian gradient step
with Armijo backtracking on its augmented Lagrangian, neighbors' poses held at what last arrived, sends its keyframes,
and adds penalty times residual to its multipliers. As printed the residual vanishes only if the measurement is the
identity; here it is that of the measured relative pose, whitened. Even so the multipliers grow until loop closures hold
as if they were exact, so that noisy cycles have no fixed point and the limit, if any, is not the least-squares optimum.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.config.posegraph import PoseGraphConfig
from duagc.pipeline.consensus.admm_edge import PosePacket
from duagc.pipeline.exchange.pose_solver import LinkStart, SolverStart
from duagc.pipeline.exchange.wire.poses_wire import read_poses, write_poses_in_parts
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.posegraph import least_squares
from duagc.pipeline.posegraph.least_squares import retract
from duagc.pipeline.posegraph.relative_poses import RelativePoses, closures_as_relative_poses

_ARMIJO = 1e-4
_RESIDUAL = 1e-4  # m, rad: the paper's stopping test
_HALVINGS = 40


class PrintedAdmmSolver:
    """A robot with a multiplier per loop closure; both ends of a link hold its loop closures.

    Attributes:
        refused: none, it has no reliable messages.
    """

    def __init__(self, start: SolverStart, config: PoseGraphConfig) -> None:
        """Lay out own keyframes, then what each neighbor sent of its own.

        Args:
            start: what the robot knows.
            config: the same at all robots.
        """
        self.config, self.refused = config, list[str]()
        self.keyframes, self._loops = len(start.own.T_map_keyframe), len(start.own.loops)
        poses = [start.T_world_map @ start.own.T_first_keyframe]
        count, parts = self.keyframes, []
        self._slots: dict[int, NDArray[np.int64]] = {}
        for link in start.links:
            own = [c.own_keyframe for c in link.closures]
            peer = [c.peer_keyframe for c in link.closures]
            named = link.shared.keyframes
            slots = self._slots[link.index] = count + np.arange(len(named))
            copies = slots[np.searchsorted(named, peer)]
            closures = config.consensus.closures
            parts.append(closures_as_relative_poses(link.closures, own, copies, closures))
            poses.append(link.T_world_keyframe[named])
            count += len(slots)
        self._x = np.concatenate(poses)
        self._own = RelativePoses.concatenate([start.own.relative_poses, start.own.loops])
        self._between = RelativePoses.concatenate(parts)
        self._multipliers = np.zeros((len(self._between), 6))
        self._length, self._step, self._sent = 1.0, np.inf, 0
        self._newest = dict.fromkeys(self._slots, 0)
        self._weights = {link.name: np.ones(len(link.closures)) for link in start.links}

    def advance(self) -> None:
        """One gradient step (11), then the multipliers (14)."""
        if self.converged:
            return
        g = self._gradient()
        before, slope = self._lagrangian(self._x), float((g**2).sum())
        self._length *= 4.0
        for _ in range(_HALVINGS):
            moved = retract(self._x, -self._length * g)
            if self._lagrangian(moved) <= before - _ARMIJO * self._length * slope:
                self._x, self._step = moved, self._length * float(np.abs(g).max())
                break
            self._length /= 2.0
        self._multipliers += self.config.paper_penalty * least_squares.residuals(self._between, self._x)

    def _lagrangian(self, x: Array) -> float:
        """(10): own cost, multipliers times residuals, penalty."""
        r = least_squares.residuals(self._between, x)
        penalty = 0.5 * self.config.paper_penalty * float((r**2).sum())
        return 0.5 * least_squares.cost(self._own, x) + float((self._multipliers * r).sum()) + penalty

    def _gradient(self) -> Array:
        """Of the Lagrangian by the own keyframes; zero for the neighbors'."""
        g, _ = least_squares.gradient(self._own, np.ones(len(self._own)), self._x)
        r, Ji, Jj = least_squares.linearized(self._between, self._x)
        pull = (self._multipliers + self.config.paper_penalty * r)[..., None]
        np.add.at(g, self._between.i, (np.swapaxes(Ji, -1, -2) @ pull)[..., 0])
        np.add.at(g, self._between.j, (np.swapaxes(Jj, -1, -2) @ pull)[..., 0])
        g[self.keyframes :] = 0.0
        return g

    # --- packets

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        """Own keyframes that loop closures with a neighbor name, in float32.

        Args:
            neighbor: receiver of the packets.
            room_bytes: most bytes of each part.
        """
        named = np.unique([c.own_keyframe for c in neighbor.closures]).astype(np.int32)
        T = self._x[named]
        self._sent += 1
        nothing = np.zeros(2, dtype=np.float32)
        quats, t = so3.to_quat_wxyz(T[:, :3, :3]).astype(np.float32), T[:, :3, 3].astype(np.float32)
        packet = PosePacket(
            sequence=self._sent,
            version=0,
            keyframes=named,
            quats_wxyz=quats,
            translations=t,
            penalties=nothing,
            curvature=None,
            converged=self.converged,
        )
        return write_poses_in_parts(packet, room_bytes, decides=False)

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        """Use keyframes that are not older than the last ones.

        Args:
            neighbor: sender of the packet.
            payload: some of its keyframes in the common frame, from `states`.

        Raises:
            MalformedError: it is not what it should be.
        """
        expected = neighbor.shared.keyframes
        packet = read_poses(payload, expected, from_decider=False)
        if packet.sequence >= self._newest[neighbor.index]:
            self._newest[neighbor.index] = packet.sequence
            at = np.searchsorted(expected, packet.keyframes)
            self._x[self._slots[neighbor.index][at]] = se3.from_quat_translation(
                packet.quats_wxyz, packet.translations
            )

    def messages(self) -> list[tuple[int, bytes]]:
        return []

    def take_message(self, sender: int, payload: bytes) -> None:
        """The printed iteration has no reliable messages; there is nothing to keep.

        Args:
            sender: index of the neighbor.
            payload: not read.
        """

    # --- results

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802 (a transform)
        return self._x[: self.keyframes].copy()

    @property
    def converged(self) -> bool:
        """The paper's primal residual is small, and so is the step."""
        return self._primal() < _RESIDUAL and self._step < self.config.consensus.tolerance

    def _primal(self) -> float:
        """Largest residual of a loop closure, not whitened."""
        r = least_squares.residuals(self._between, self._x)
        return float(np.abs(np.linalg.solve(self._between.whitening, r[..., None])).max())

    @property
    def largest_change(self) -> float:
        return self._step

    def weights(self, peer: str) -> Array:
        """The printed iteration has no robust weights: everything counts.

        Args:
            peer: name of the neighbor.

        Returns:
            [m], all one.
        """
        return self._weights[peer].copy()

    @property
    def loop_weights(self) -> Array:
        return np.ones(self._loops)

    def refuted(self, peer: str) -> bool:
        """Never.

        Args:
            peer: name of the neighbor.
        """
        return False

    def residuals(self) -> dict[str, Any]:
        return {
            "primal": self._primal(),
            "dual": 0.0,
            "cost": least_squares.cost(self._own, self._x),
            "step": self._step,
            "penalties": dict.fromkeys(self._weights, (self.config.paper_penalty,) * 2),
            "versions": dict.fromkeys(self._weights, 0),
            "weights": {peer: weights.tolist() for peer, weights in self._weights.items()},
            "factorizations": 0,
        }
