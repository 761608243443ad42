"""Relaxed edge-ADMM on the wire: one `PoseAgent` per robot, its pose packets in the state of every round."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.consensus.admm_edge import SharedKeyframes, link_metric
from duagc.pipeline.consensus.pose_admm import PoseAgent
from duagc.pipeline.exchange.wire.poses_wire import read_poses, write_poses_in_parts
from duagc.pipeline.network.packets import MAX_PAYLOAD_BYTES
from duagc.pipeline.posegraph.loop_closures import holder
from duagc.pipeline.team_posegraph.agent import GraphAgent, Neighbor

Array = NDArray[np.float64]
_STARTED = b"\0"  # told until all neighbors have said the same: poses sent before would be wasted


class AdmmAgent(GraphAgent):
    """A robot that iterates with its neighbors until all of them hold still."""

    poses: PoseAgent

    def start(self) -> None:
        self._started: set[int] = set()  # neighbors that were heard after their own start
        c = self.config.consensus
        self.poses = PoseAgent(
            self.graph.name,
            self.T_map_keyframe,
            self.graph.odometry,
            c,
            loops=self.graph.loops,
            keep_loops=self.keep_loops,
        )
        self.poses.set_frame(self.T_world_map[self.own])
        for n in self.neighbors.values():
            if holder(self.graph.name, n.name, n.closures) == self.graph.name:
                assert n.told is not None
                copies = self.T_world_map[n.index] @ n.told.T_map_keyframe
                known = dict(zip(n.told.keyframes.tolist(), copies, strict=True))
                self.poses.add_link(n.name, n.closures, keep=n.keep, T_world_keyframe_peer=known)
            else:  # both ends know the closures: no message needs to say which keyframes they name
                mirrored = [k.reversed() for k in n.closures]
                metric = link_metric(mirrored, n.own_keyframes.astype(np.int64), c.closures)
                self.poses.add_link(n.name, shared=SharedKeyframes(n.own_keyframes, metric))

    def advance(self) -> None:
        if self._everybody_started():
            self.poses.step()
            if self.first_round is None:
                self.first_round = self.round

    def states(self, neighbor: Neighbor) -> list[bytes]:
        if not self._everybody_started():
            return [_STARTED]
        packet = self.poses.outgoing(neighbor.name)
        return write_poses_in_parts(packet, MAX_PAYLOAD_BYTES, self.own < neighbor.index)

    def take_state(self, neighbor: Neighbor, payload: bytes) -> None:
        self._started.add(neighbor.index)
        if payload != _STARTED:
            shared = self.poses.links[neighbor.name].keyframes
            poses = read_poses(payload, shared, neighbor.index < self.own)
            self.poses.receive(neighbor.name, poses)

    def _everybody_started(self) -> bool:
        return self._started == set(self.neighbors)

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802 (a transform)
        return self.poses.T_world_keyframe if self.T_world_map else self.T_map_keyframe

    @property
    def settled(self) -> bool:
        return bool(self.T_world_map) and (not self.neighbors or self.poses.agreed)

    def kept(self) -> tuple[Array, dict[str, Array]]:
        if not self.T_world_map or not self.neighbors:
            return super().kept()
        held = {peer: link.robust.weights for peer, link in self.poses.links.items() if link.holds}
        return self.poses.loop_weights.weights, held
