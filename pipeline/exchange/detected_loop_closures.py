"""Loop closures found by two robots from their images, and where one's map lies in the other's.

    provider                                            verifier
    HELLO        digest of what was seen              <->
    DESCRIPTORS  compact descriptors of all keyframes ->
                                                      <- REQUEST   keyframes to examine closely       } as long as
    SAMPLE       one per requested keyframe           ->                                              } it is worth it
                                                      <- RECTIFIED_REQUEST  keyframes                 } unless what was
    RECTIFIED    features of surfaces of each         ->                                              } found joins them
                                                      <- CLOSURES  verdict, shared keyframes

What was verified says where further views should overlap, and the search goes on there: with samples that are here
already, or with others if they are worth their bytes. If that does not join the two robots, pairs of all keyframes, or
of as many as may be requested, are compared by features of surfaces as if the cameras faced them.

The verifier is the end with the lower digest (and name, should they be equal): the end that verifies decides which of
two measurements counts, and that must not depend on names. It keeps the loop closures. It has decided when its verdict
has been acknowledged, the provider when the verdict has arrived.
"""

from __future__ import annotations

from duagc.pipeline.base.recall import Recalling, computed
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange.keyframe_database import KeyframeDatabase
from duagc.pipeline.exchange.loop_closing import JoinedPair, LoopClosureProtocol, Send
from duagc.pipeline.exchange.loop_closure_verifier import Verifier
from duagc.pipeline.exchange.wire import loop_closing_wire
from duagc.pipeline.exchange.wire.loop_closing_wire import RectifiedFeatures
from duagc.pipeline.network.packets import Kind, MalformedError
from duagc.pipeline.runs.robot_data import RobotData

VERIFIER_KINDS = frozenset({Kind.DESCRIPTORS, Kind.SAMPLE, Kind.RECTIFIED})
"""Messages that the verifier receives."""


class DetectedLoopClosures:
    """Recognizes places in images and verifies what it finds; the source of loop closures in runs."""

    trusted = False
    revokes = True

    def __init__(
        self, data: RobotData, config: ExchangeConfig, seed: int, recall: Recalling = computed
    ) -> None:
        """Start from a robot's own images.

        Args:
            data: of this robot.
            config: the same at all robots.
            seed: of this run.
            recall: slow results; they change no bit.
        """
        self.config, self.seed = config, seed
        self.database = KeyframeDatabase(data, config, recall)

    @property
    def greeting(self) -> bytes:
        """The digest of what the robot saw."""
        return self.database.digest

    def initial(self, peer: str) -> None:
        """None: the roles follow from the digests of both ends.

        Args:
            peer: not used.
        """

    def protocol(self, peer: str, kind: Kind, payload: bytes) -> LoopClosureProtocol:
        """The protocol with a neighbor, from its digest or from a message that only one of the two ends receives.

        Args:
            peer: name of the neighbor.
            kind: of its first message.
            payload: of that message; the digest of HELLO is read.
        """
        verifies = kind in VERIFIER_KINDS
        if kind is Kind.HELLO:
            digest = loop_closing_wire.read_digest(payload)
            verifies = (self.database.digest, self.database.graph.robot) < (digest, peer)
        return (Verifier if verifies else Provider)(self.database, peer, self.seed)


class Provider(LoopClosureProtocol):
    """Sends descriptors and the samples that are requested; gets the verdict."""

    def __init__(self, database: KeyframeDatabase, peer: str, seed: int) -> None:
        """Nothing was requested yet.

        Args:
            database: own keyframes.
            peer: name of the neighbor.
            seed: of this run.
        """
        super().__init__(database.graph.robot, peer)
        self.database, self.config, self.seed = database, database.config, seed
        self.answered: set[int] = set()
        self.rectified = False  # rectified features were requested, which happens once

    def begin(self, send: Send) -> None:
        """Send the descriptors of all own keyframes.

        Args:
            send: queues a message for the neighbor.
        """
        send(Kind.DESCRIPTORS, loop_closing_wire.write_descriptors(self.database.descriptors()))

    def take(self, kind: Kind, payload: bytes, send: Send) -> None:
        """Answer a request, or take the verdict.

        Args:
            kind: of the message.
            payload: named keyframes, or the verdict.
            send: queues a message for the neighbor.
        """
        limit = self.database.data.keyframes
        if kind is Kind.REQUEST:
            for keyframe in loop_closing_wire.read_indices(payload, limit):
                if keyframe in self.answered:
                    raise MalformedError(f"request: keyframe {keyframe} was requested before")
                self.answered.add(keyframe)
                send(Kind.SAMPLE, loop_closing_wire.write_sample(self.database.sample(keyframe)))
        elif kind is Kind.RECTIFIED_REQUEST and not self.rectified:
            for keyframe in loop_closing_wire.read_indices(payload, limit):
                self.rectified = True
                found = RectifiedFeatures(keyframe, self.database.rectified(keyframe))
                send(Kind.RECTIFIED, loop_closing_wire.write_rectified(found))
        elif kind is Kind.CLOSURES and not self.decided:
            verdicts = loop_closing_wire.read_verdicts(payload, limit)
            self.decided = True
            if verdicts.joined:
                self.joined = JoinedPair(verdicts.shared)
        else:
            raise MalformedError(f"{kind.name} is not for the provider, or came twice")
