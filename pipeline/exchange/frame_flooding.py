"""Flooding of relative frames: what a robot decided or heard of a pair goes to every joined neighbor that lacks it."""

from __future__ import annotations

from duagc.pipeline.exchange.map_alignment import MapAlignment
from duagc.pipeline.exchange.neighbor import Neighbor, Pair
from duagc.pipeline.exchange.radio import Radio
from duagc.pipeline.exchange.wire.state_wire import RelativeFrames
from duagc.pipeline.network.packets import Kind


class FrameFlooding:
    """One robot's part of the flooding."""

    def __init__(self, radio: Radio, alignment: MapAlignment) -> None:
        """Nothing was sent.

        Args:
            radio: own end of all radio links.
            alignment: gets the frames, and has those that are sent.
        """
        self._radio, self._alignment = radio, alignment

    def take(self, n: Neighbor, payload: bytes) -> None:
        """Use a relative frame that a neighbor sent.

        Args:
            n: the neighbor.
            payload: of its message.
        Raises:
            MalformedError: it is not what it should be, or decides on a pair of this robot.
        """
        n.passed.frames.setdefault(self._alignment.receive(payload, self._decides), 0)

    def _decides(self, pair: Pair) -> bool:
        """Whether this robot decides on a pair, or may still."""
        if self._radio.own not in pair:
            return False
        n = self._radio.neighbors.get(sum(pair) - self._radio.own)
        return n is not None and (n.loop_closing is None or n.loop_closing.decides)

    def pair_with(self, n: Neighbor) -> Pair:
        """This robot and a neighbor.

        Args:
            n: the neighbor.
        """
        return min(self._radio.own, n.index), max(self._radio.own, n.index)

    def advance(self) -> bool:
        """Add what was decided here, send what joined neighbors lack; whether they have received all of it."""
        joined = self._radio.joined
        for n in joined:
            self._add_decision(n)
        known = self._alignment.payloads
        for n in joined:
            for pair in sorted(known.keys() - n.passed.frames.keys()):
                n.passed.frames[pair] = self._radio.send(n, Kind.RELATIVE_FRAME, known[pair])
        busy = (n for n in joined if not n.transport.idle)
        return not any(n.transport.is_open(m) for n in busy for m in n.passed.frames.values())

    def _add_decision(self, n: Neighbor) -> None:
        """Add the relative frame of the pair with a joined neighbor, if this end has decided on it."""
        pair = self.pair_with(n)
        assert n.loop_closing is not None
        assert n.loop_closing.joined is not None
        proposals = n.loop_closing.joined.proposals
        if proposals and pair not in self._alignment.pairs:
            if pair[0] != self._radio.own:
                proposals = tuple(p.reversed() for p in proposals)
            self._alignment.add(RelativeFrames(*pair, proposals))
