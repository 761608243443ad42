"""A robot's end of all its radio links: who its neighbors are, and what goes to and comes from each."""

from __future__ import annotations

from collections.abc import Sequence

from duagc.pipeline.config.network import TransportConfig
from duagc.pipeline.exchange.loop_closing import LoopClosing, Send
from duagc.pipeline.exchange.neighbor import Neighbor
from duagc.pipeline.network.messages import Arrival, Message
from duagc.pipeline.network.packets import Kind, MalformedError, Packet, parse
from duagc.pipeline.network.signatures import Identity
from duagc.pipeline.network.transport import Transport


class Radio:
    """Numbers the messages of a robot, and opens the packets that are for it.

    Attributes:
        team: names of all robots that may exist, sorted.
        own: index of this robot in the team.
        neighbors: robots that this one has a radio link to, by index.
    """

    def __init__(
        self,
        robot: str,
        team: Sequence[str],
        neighbors: Sequence[str],
        config: TransportConfig,
        *,
        seed: int,
        loop_closing: LoopClosing,
    ) -> None:
        """Begin with the first messages to every neighbor.

        Args:
            robot: name of this one.
            team: names of all robots that may exist.
            neighbors: names of those that this robot has a radio link to.
            config: of the transport.
            seed: of this run.
            loop_closing: where loop closures come from; it knows the first messages.
        """
        self.team = sorted(team)
        self.own = self.team.index(robot)
        self._config = config
        self._identity = None
        if config.signatures == "ed25519":
            self._identity = Identity.simulated(seed, self.team, robot)
        self._messages = 0
        self.neighbors = {self.team.index(name): self._met(name, loop_closing) for name in sorted(neighbors)}

    def _met(self, name: str, loop_closing: LoopClosing) -> Neighbor:
        index = self.team.index(name)
        transport = Transport(
            self.own, index, name, self._config, new_id=self.new_id, identity=self._identity
        )
        neighbor = Neighbor(index, name, transport, loop_closing.initial(name))
        if neighbor.loop_closing is not None:
            neighbor.loop_closing.begin(self.sender(neighbor))
        return neighbor

    @property
    def in_contact(self) -> list[Neighbor]:
        """Neighbors that were not given up."""
        return [n for n in self.neighbors.values() if not n.lost]

    @property
    def joined(self) -> list[Neighbor]:
        """Neighbors that share a frame with this robot."""
        return [n for n in self.neighbors.values() if n.joined]

    # --- incoming

    def open(self, data: bytes, round_index: int) -> tuple[Neighbor, Arrival | None]:
        """Parse one packet, and give its payload to the transport of the link that it came on.

        Args:
            data: its bytes.
            round_index: the current round.
        Returns:
            The neighbor that sent it, and the message that it completes, if it does.
        Raises:
            ValueError: it cannot be used; the message says why.
        """
        packet = parse(data) if self._identity is None else self._identity.open(data)
        neighbor = self._addressed(packet)
        return neighbor, neighbor.transport.receive(packet, round_index)

    def _addressed(self, packet: Packet) -> Neighbor:
        if packet.receiver != self.own:
            raise MalformedError("addressed to another robot")
        if packet.sender not in self.neighbors:
            raise MalformedError("from a robot that is no neighbor")
        if self.neighbors[packet.sender].lost:
            raise MalformedError("from a neighbor that was given up")
        return self.neighbors[packet.sender]

    # --- outgoing

    def new_id(self) -> int:
        """The next number of a message."""
        self._messages += 1
        return self._messages

    def send(self, neighbor: Neighbor, kind: Kind, payload: bytes) -> int:
        """Queue one reliable message; returns its id."""
        message = Message(self.new_id(), kind, payload)
        neighbor.transport.send(message)
        return message.id

    def sender(self, neighbor: Neighbor) -> Send:
        """What queues the messages of the loop-closing protocol with a neighbor."""

        def send(kind: Kind, payload: bytes) -> None:
            message = self.send(neighbor, kind, payload)
            if kind is Kind.CLOSURES:
                neighbor.verdict_message = message

        return send
