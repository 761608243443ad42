"""What the links of a robot start from when the poses begin: selected loop closures, weights and copies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from duagc.pipeline.config.consensus import LoopClosureConfig
from duagc.pipeline.exchange.map_alignment import MapAlignment
from duagc.pipeline.exchange.neighbor import Neighbor
from duagc.pipeline.exchange.own_graph import OwnGraph
from duagc.pipeline.exchange.pose_solver import LinkStart
from duagc.pipeline.exchange.radio import Radio
from duagc.pipeline.posegraph.loop_closures import plausible


def closures_selected(radio: Radio, alignment: MapAlignment) -> bool:
    """Whether both ends of all links know which loop closures the solver gets; they are selected where they do not.

    Args:
        radio: own end of all radio links.
        alignment: where the maps of the team lie.
    """
    joined = radio.joined
    waiting = [n.loop_closing for n in joined if n.loop_closing and not n.loop_closing.selected]
    if waiting:
        own = alignment.T_world_first(alignment.own)
        for n in joined:
            if n.loop_closing in waiting:
                n.loop_closing.select(own, alignment.T_world_first(n.index), radio.sender(n))
    return all(protocol.selected for protocol in waiting)


@dataclass(frozen=True)
class LinkStarts:
    """What all links of a robot start from.

    Attributes:
        graph: own keyframes and the relative poses between them.
        alignment: where the maps of the team lie.
        config: which loop closures are plausible.
        trusted: whether all loop closures count from the start.
    """

    graph: OwnGraph
    alignment: MapAlignment
    config: LoopClosureConfig
    trusted: bool

    def of(self, n: Neighbor) -> LinkStart:
        """A joined neighbor; loop closures start with weight if they fit to where both robots were placed.

        Args:
            n: the neighbor; its protocol has ended, and joined the two robots.

        Returns:
            The link, with the neighbor's keyframes in the common frame where this end holds the loop
            closures.
        """
        protocol = n.loop_closing
        assert protocol is not None
        assert protocol.joined is not None
        joined = protocol.joined
        if not joined.closures:
            return LinkStart(n.index, n.name, joined.shared, (), np.zeros(0, bool), np.zeros((0, 4, 4)))
        assert protocol.peer_keyframes is not None
        peer = protocol.peer_keyframes.moved(self.alignment.T_world_first(n.index))
        keep = np.ones(len(joined.closures), bool)
        if not self.trusted:
            pair = (min(self.graph.robot, n.name), max(self.graph.robot, n.name))
            chosen = self.alignment.placement.chosen[pair]
            n.link.contradiction = self.alignment.placement.contradictions.get(pair, "")
            keep = np.zeros(len(joined.closures), bool) if chosen is None else joined.groups[chosen]
            keep = keep & plausible(
                joined.closures,
                self.graph.from_first.moved(self.alignment.T_world_first(self.alignment.own)),
                peer,
                self.config,
            )
        return LinkStart(n.index, n.name, joined.shared, joined.closures, keep, peer.T_frame_keyframe)
