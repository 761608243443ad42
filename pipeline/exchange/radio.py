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

LOOP_CLOSING_KINDS = frozenset(
    {
        Kind.HELLO,
        Kind.DESCRIPTORS,
        Kind.SAMPLE,
        Kind.REQUEST,
        Kind.CLOSURES,
        Kind.KEYFRAMES,
        Kind.RECTIFIED_REQUEST,
        Kind.RECTIFIED,
    }
)


class Radio:
    """Numbers the messages of a robot, opens the packets that are for it, and begins the loop-closing protocols.

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
        self._loop_closing = loop_closing
        self._messages = 0
        self.neighbors = {self.team.index(name): self._met(name) for name in sorted(neighbors)}

    def _met(self, name: str) -> Neighbor:
        index = self.team.index(name)
        transport = Transport(
            self.own, index, name, self._config, new_id=self.new_id, identity=self._identity
        )
        neighbor = Neighbor(index, name, transport, self._loop_closing.initial(name))
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

    def take_loop_closing(self, n: Neighbor, kind: Kind, payload: bytes) -> None:
        """A message of the protocol with a neighbor, which begins when it is known which end has which role.

        Args:
            n: the neighbor.
            kind: one of LOOP_CLOSING_KINDS.
            payload: of the message.
        Raises:
            ValueError: it cannot be used; the message says why.
        """
        if n.loop_closing is None or kind is Kind.HELLO:
            protocol = self._loop_closing.protocol(n.name, kind, payload)
            if n.loop_closing is None:
                n.loop_closing = protocol
                protocol.begin(self.sender(n))
        if kind is not Kind.HELLO:
            n.loop_closing.take(kind, payload, self.sender(n))

    # --- outgoing

    def greet(self) -> None:
        """Greet every neighbor that was heard for the first time."""
        for neighbor in self.in_contact:
            if neighbor.transport.last_heard is not None and not neighbor.hello_sent:
                neighbor.hello_sent = True
                if self._loop_closing.greeting is not None:
                    self.send(neighbor, Kind.HELLO, self._loop_closing.greeting)

    def new_id(self) -> int:
        """The next number of a message."""
        self._messages += 1
        return self._messages

    def send(self, neighbor: Neighbor, kind: Kind, payload: bytes) -> int:
        """Queue one reliable message; returns its id.

        Args:
            neighbor: its receiver.
            kind: of its content.
            payload: its bytes.

        Raises:
            DuagError: it is longer than `max_message_bytes`.
        """
        message = Message(self.new_id(), kind, payload)
        neighbor.transport.send(message)
        return message.id

    def sender(self, neighbor: Neighbor) -> Send:
        """What queues the messages of the loop-closing protocol with a neighbor.

        Args:
            neighbor: the receiver.
        """

        def send(kind: Kind, payload: bytes) -> None:
            message = self.send(neighbor, kind, payload)
            if kind is Kind.CLOSURES:
                neighbor.verdict_message = message

        return send
