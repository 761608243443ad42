"""Packets that only their sender can have made: Ed25519 (RFC 8032) over header and payload, 64 bytes behind them.

A CRC protects against accidents, a signature against packets that are sent in another robot's name. The keys of a
simulated team are drawn from the seed of the run, so that a replay signs the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.network.packets import MalformedError, Packet, parse, serialize

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

SIGNATURE_BYTES = 64


class Identity:
    """What one robot needs to sign, and to check the others: its private key and all public keys."""

    def __init__(self, private: Ed25519PrivateKey, public: Sequence[Ed25519PublicKey]) -> None:
        """Take the keys.

        Args:
            private: of this robot.
            public: of the sorted team, by index.
        """
        self._private, self._public = private, tuple(public)

    @staticmethod
    def simulated(seed: int, team: Sequence[str], own: str) -> Identity:
        """The keys that a robot of a simulated team was given before the start.

        Args:
            seed: of the run.
            team: names of all robots, in any order.
            own: name of this robot.

        Raises:
            DuagError: the package that signs is not installed.
        """
        try:
            from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
        except ImportError as error:
            raise DuagError(
                "exchange.transport.signatures = 'ed25519': package cryptography not found; "
                "pip install 'duagc[signed]'"
            ) from error
        keys = {
            robot: Ed25519PrivateKey.from_private_bytes(
                random_streams.generator(seed, "signature.key", robot=robot).bytes(32)
            )
            for robot in sorted(team)
        }
        return Identity(keys[own], [keys[robot].public_key() for robot in sorted(team)])

    def seal(self, packet: Packet) -> bytes:
        """Bytes of an own packet with its signature.

        Args:
            packet: whose sender is this robot.

        Returns:
            Header, payload, and 64 bytes of signature.

        Raises:
            ValueError: its payload does not fit.
        """
        data = serialize(packet)
        return data + self._private.sign(data)

    def open(self, sealed: bytes) -> Packet:
        """The packet, if its sender made it.

        Args:
            sealed: bytes of a packet, and then those of its signature.

        Raises:
            MalformedError: it is no packet, or not signed by the robot that it names as its sender.
        """
        from cryptography.exceptions import InvalidSignature

        if len(sealed) <= SIGNATURE_BYTES:
            raise MalformedError(f"{len(sealed)} bytes, expected a packet and its signature")
        data, signature = sealed[:-SIGNATURE_BYTES], sealed[-SIGNATURE_BYTES:]
        packet = parse(data)
        if packet.sender >= len(self._public):
            raise MalformedError("from a robot outside the team")
        try:
            self._public[packet.sender].verify(signature, data)
        except InvalidSignature as error:
            raise MalformedError("not signed by its sender") from error
        return packet
