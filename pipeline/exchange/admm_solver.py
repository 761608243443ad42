"""Relaxed edge-ADMM as a solver of the poses: its packets are part of the states of the rounds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.config.consensus import PoseConsensusConfig
from duagc.pipeline.config.exchange import InjectionConfig
from duagc.pipeline.consensus.pose_admm import PoseAgent
from duagc.pipeline.exchange.injection import sent_positions
from duagc.pipeline.exchange.pose_solver import LinkStart, SolverStart
from duagc.pipeline.exchange.wire import poses_wire
from duagc.pipeline.exchange.wire.poses_wire import read_poses, write_poses_in_parts

ROUNDING_STEPS = 4.0
NO_INJECTION = InjectionConfig()


class AdmmSolver:
    """`PoseAgent` with its packets in the states of the rounds."""

    def __init__(
        self,
        start: SolverStart,
        config: PoseConsensusConfig,
        injection: InjectionConfig = NO_INJECTION,
        *,
        seed: int = 0,
    ) -> None:
        """Lay out the graph.

        Args:
            start: what the robot knows.
            config: the same at all robots.
            injection: faults made on purpose.
            seed: of these.
        """
        self.own, self.config, self.injection, self.seed = start.index, config, injection, seed
        self.refused: list[str] = []
        self._arrived: list[tuple[int, bytes]] = []
        self._names = {link.index: link.name for link in start.links}
        own = start.own
        self.agent = PoseAgent(
            own.robot,
            own.T_first_keyframe,
            own.relative_poses,
            config,
            loops=own.loops,
            keep_loops=own.keep_loops,
        )
        self.agent.set_frame(start.T_world_map)
        for link in start.links:
            if link.closures:
                known = dict(enumerate(link.T_world_keyframe))
                self.agent.add_link(link.name, link.closures, keep=link.keep, T_world_keyframe_peer=known)
            else:
                self.agent.add_link(link.name, shared=link.shared)

    def advance(self) -> None:
        """Take the masks that arrived, then one step of the agent."""
        for sender, payload in self._arrived:
            name = self._names.get(sender, "")
            try:
                self.agent.take_mask(name, *poses_wire.read_mask(payload, self.agent.shared_with(name)))
            except ValueError as error:
                self.refused.append(str(error))
        self._arrived.clear()
        try:
            self.agent.step()
        except DuagError as error:  # numbers that a neighbor sent; the poses stay
            self.agent.step_change = np.inf
            self.refused.append(str(error))

    def states(self, neighbor: LinkStart, room_bytes: int) -> list[bytes]:
        """Shared keyframes as this end has them, with the penalties of the link.

        Args:
            neighbor: the receiver.
            room_bytes: most bytes of each part.
        """
        packet = self.agent.outgoing(neighbor.name)
        sent = sent_positions(
            packet.translations, packet.keyframes, self.injection, seed=self.seed, robot=self.agent.robot
        )
        packet = replace(packet, translations=sent)
        return write_poses_in_parts(packet, room_bytes, self.own < neighbor.index)

    def take_state(self, neighbor: LinkStart, payload: bytes) -> None:
        """Use a part of the packet of a neighbor.

        Args:
            neighbor: the sender.
            payload: some of the shared keyframes, from `states`.
        """
        poses = read_poses(payload, neighbor.shared.keyframes, neighbor.index < self.own)
        self.agent.receive(neighbor.name, poses)

    def messages(self) -> list[tuple[int, bytes]]:
        """Masks of shared keyframes that changed, by receiver."""
        index = {name: k for k, name in self._names.items()}
        sent = [(index[peer], poses_wire.write_mask(*mask)) for peer, mask in self.agent.masks.items()]
        self.agent.masks.clear()
        return sent

    def take_message(self, sender: int, payload: bytes) -> None:
        """Keep a mask of shared keyframes for the next round.

        Args:
            sender: index of the neighbor.
            payload: the mask; `advance` reads it.
        """
        self._arrived.append((sender, payload))

    @property
    def converged(self) -> bool:
        """Whether this robot changes less than the tolerance, or than rounding does, and its weights are final."""
        return self.agent.converged or (self.agent.robust_done and self._recent_change() < self._rounding_m())

    def _recent_change(self) -> float:
        """Largest change of a pose or an edge variable, by the last arrivals too (m, rad)."""
        links = (link.largest_recent_change() for link in self.agent.links.values())
        return max([self.agent.step_change, *links])

    def _rounding_m(self) -> float:
        """By what poses in float32 keep changing, however well robots agree: some steps of the largest coordinate."""
        if self.config.wire != "float32":
            return 0.0
        largest = np.float32(np.abs(self.agent.T_world_keyframe[:, :3, 3]).max())
        return ROUNDING_STEPS * float(np.spacing(largest))

    @property
    def largest_change(self) -> float:
        """Largest change of a pose or an edge variable in the last round (m, rad)."""
        return self.agent.largest_change

    @property
    def T_world_keyframe(self) -> Array:  # noqa: N802
        """Own keyframes [n, 4, 4] in the common frame."""
        return self.agent.T_world_keyframe

    def weights(self, peer: str) -> Array:
        """Robust weight of every loop closure held with a neighbor, in the order given.

        Args:
            peer: name of the neighbor.
        """
        return self.agent.weights(peer)

    @property
    def loop_weights(self) -> Array:
        """Robust weight of every own loop."""
        return self.agent.loop_weights.weights.copy()

    def refuted(self, peer: str) -> bool:
        """Whether final weights leave too few of the loop closures that this end holds with a neighbor.

        Args:
            peer: name of the neighbor.
        """
        return self.agent.refuted(peer)

    def residuals(self) -> dict[str, Any]:
        """What the round looked like, from the agent."""
        return self.agent.residuals()
