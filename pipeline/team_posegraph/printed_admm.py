"""The printed iteration (8), (10), (11), (14) on the wire, to compare with: not a solver to use.

Every closure is a constraint with a multiplier at either end. Per round a robot takes one Riemannian gradient step
with Armijo backtracking on its augmented Lagrangian, neighbors' poses held at what last arrived, sends its keyframes,
and adds penalty times residual to its multipliers. As printed the residual vanishes only if the measurement is the
identity; here it is that of the measured relative pose, whitened. Even so the multipliers grow until closures hold as
if they were exact, so that noisy cycles have no fixed point and the limit, if any, is not the least-squares optimum.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.consensus.admm_edge import PosePacket
from duagc.pipeline.exchange.wire.poses_wire import read_poses, write_poses_in_parts
from duagc.pipeline.geometry import se3, so3
from duagc.pipeline.network.packets import MAX_PAYLOAD_BYTES
from duagc.pipeline.posegraph import factors as pose_factors
from duagc.pipeline.posegraph.factors import Factors, retract
from duagc.pipeline.posegraph.loop_closures import closure_factors
from duagc.pipeline.team_posegraph.agent import GraphAgent, Neighbor

Array = NDArray[np.float64]
_ARMIJO = 1e-4
_RESIDUAL = 1e-4  # m, rad: the paper's stopping test
_HALVINGS = 40


class PaperAgent(GraphAgent):
    """A robot with a multiplier per closure."""

    def start(self) -> None:
        """Own keyframes, then what each neighbor told of its own."""
        poses = [self.T_world_map[self.own] @ self.T_map_keyframe]
        count, parts, c = self.graph.keyframes, [], self.config.consensus
        self._slots: dict[int, NDArray[np.int64]] = {}
        for n in self.neighbors.values():
            assert n.told is not None
            slots = self._slots[n.index] = count + np.arange(len(n.told.keyframes))
            copies = slots[np.searchsorted(n.told.keyframes, [k.peer_keyframe for k in n.closures])]
            parts.append(
                closure_factors(n.closures, [k.own_keyframe for k in n.closures], copies, c.closures)
            )
            poses.append(self.T_world_map[n.index] @ n.told.T_map_keyframe)
            count += len(slots)
        self._x = np.concatenate(poses)
        self._own, self._between = self.own_factors(), Factors.concatenate(parts)
        self._multipliers = np.zeros((len(self._between), 6))
        self._length, self._step, self._sent = 1.0, np.inf, 0
        self._newest = dict.fromkeys(self._slots, 0)

    def advance(self) -> None:
        """One gradient step (11), then the multipliers (14)."""
        if self.first_round is None:
            self.first_round = self.round
        if self.settled:
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
        self._multipliers += self.config.paper_penalty * pose_factors.residuals(self._between, self._x)

    def _lagrangian(self, x: Array) -> float:
        """(10): own cost, multipliers times residuals, penalty."""
        r = pose_factors.residuals(self._between, x)
        penalty = 0.5 * self.config.paper_penalty * float((r**2).sum())
        return 0.5 * pose_factors.cost(self._own, x) + float((self._multipliers * r).sum()) + penalty

    def _gradient(self) -> Array:
        """Of the Lagrangian by the own keyframes; zero for the neighbors'."""
        g, _ = pose_factors.gradient(self._own, np.ones(len(self._own)), self._x)
        r, Ji, Jj = pose_factors.linearized(self._between, self._x)
        pull = (self._multipliers + self.config.paper_penalty * r)[..., None]
        np.add.at(g, self._between.i, (np.swapaxes(Ji, -1, -2) @ pull)[..., 0])
        np.add.at(g, self._between.j, (np.swapaxes(Jj, -1, -2) @ pull)[..., 0])
        g[self.graph.keyframes :] = 0.0
        return g

    # --- packets

    def states(self, neighbor: Neighbor) -> list[bytes]:
        named = neighbor.own_keyframes
        T = self._x[named]
        self._sent += 1
        nothing = np.zeros(2, dtype=np.float32)
        quats, t = so3.to_quat_wxyz(T[:, :3, :3]).astype(np.float32), T[:, :3, 3].astype(np.float32)
        packet = PosePacket(self._sent, 0, named, quats, t, nothing, None, self.settled)
        return write_poses_in_parts(packet, MAX_PAYLOAD_BYTES, decides=False)

    def take_state(self, neighbor: Neighbor, payload: bytes) -> None:
        packet = read_poses(payload, neighbor.peer_keyframes, from_decider=False)
        if packet.sequence >= self._newest[neighbor.index]:
            self._newest[neighbor.index] = packet.sequence
            at = np.searchsorted(neighbor.peer_keyframes, packet.keyframes)
            self._x[self._slots[neighbor.index][at]] = se3.from_quat_translation(
                packet.quats_wxyz, packet.translations
            )

    # --- results

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802 (a transform)
        return self._x[: self.graph.keyframes] if self.T_world_map else self.T_map_keyframe

    @property
    def settled(self) -> bool:
        """The paper's primal residual is small, and so is the step."""
        if not self.T_world_map:
            return False
        if not self.neighbors:
            return True
        raw = np.linalg.solve(
            self._between.whitening, pose_factors.residuals(self._between, self._x)[..., None]
        )
        return float(np.abs(raw).max()) < _RESIDUAL and self._step < self.config.consensus.tolerance

    def kept(self) -> tuple[Array, dict[str, Array]]:
        """The printed iteration has no robust weights: everything counts."""
        return np.ones(len(self.graph.loops)), {
            n.name: np.ones(len(n.closures)) for n in self.neighbors.values()
        }
