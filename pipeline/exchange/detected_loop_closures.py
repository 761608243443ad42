"""Loop closures found by two robots from their images, and where one's map lies in the other's.

    provider                                            verifier
    HELLO        digest of what was seen              <->
    DESCRIPTORS  compact descriptors of all keyframes ->
                                                      <- REQUEST   keyframes to examine closely       } as long as
    SAMPLE       one per requested keyframe           ->                                              } it is worth it
                                                      <- CLOSURES  verdict, shared keyframes

What was verified says where further views should overlap, and the search goes on there: with samples that are here
already, or with others if they are worth their bytes.

The verifier is the end with the lower digest (and name, should they be equal): the end that verifies decides which of
two measurements counts, and that must not depend on names. It keeps the loop closures. It has decided when its verdict
has been acknowledged, the provider when the verdict has arrived.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.recall import Recalling, computed
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.consensus.admm_edge import SharedKeyframes
from duagc.pipeline.exchange import injection, place_recognition
from duagc.pipeline.exchange.loop_closing import (
    JoinedPair,
    LoopClosureProtocol,
    Send,
    Tried,
    can_be_sent,
    join,
)
from duagc.pipeline.exchange.own_graph import OwnGraph
from duagc.pipeline.exchange.place_recognition import Candidate, Planner
from duagc.pipeline.exchange.verification import Verdict, Verified, verify
from duagc.pipeline.exchange.view_overlap import overlaps
from duagc.pipeline.exchange.wire import loop_closing_wire
from duagc.pipeline.exchange.wire.loop_closing_wire import DescriptorSet, KeyframeSample, Verdicts
from duagc.pipeline.network.packets import Kind, MalformedError
from duagc.pipeline.posegraph.loop_closures import Group, KeyframePoses, consistent, drift
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses
from duagc.pipeline.posegraph.surface_agreement import coarse_depth, surface_agreement
from duagc.pipeline.registration import Reference, RgbdPyramid
from duagc.pipeline.registration.features import Descriptors, Features, extract, matches
from duagc.pipeline.runs.robot_data import RobotData

VERIFIER_KINDS = frozenset({Kind.DESCRIPTORS, Kind.SAMPLE})
"""Messages that the verifier receives."""
PYRAMIDS_KEPT = 12
NOTHING_SHARED = SharedKeyframes(np.zeros(0, np.int32), np.zeros((0, 6), np.float32))


class KeyframeDatabase:
    """A robot's own keyframes as others may request them; computed when first needed."""

    def __init__(self, data: RobotData, config: ExchangeConfig, recall: Recalling = computed) -> None:
        self.data, self.config, self.recall = data, config, recall
        self._pyramid = lru_cache(maxsize=PYRAMIDS_KEPT)(self._build_pyramid)
        self._features: list[Features] | None = None
        self._coarse_depths: list[NDArray[np.float32]] = []
        odometry = RelativePoses.of(data.odometry)
        self.graph = OwnGraph(
            data.robot,
            data.T_map_keyframe,
            RelativePoses.of(data.registrations),
            drift(odometry, data.keyframes, config.consensus.closures),
        )

    @property
    def features(self) -> list[Features]:
        """All features of every keyframe."""
        if self._features is None:
            self._features = []
            for k in range(self.data.keyframes):
                features, depth_m = self.recall(f"features {self.data.robot} {k}", partial(self._seen, k))
                self._features.append(features)
                self._coarse_depths.append(depth_m)
        return self._features

    def _seen(self, keyframe: int) -> tuple[Features, NDArray[np.float32]]:
        """Features of a keyframe, and its depth at low resolution."""
        color, depth_m, _, mask = self.data.images(keyframe)
        most = self.config.places.features_per_keyframe
        return extract(color, depth_m, self.data.camera, most, mask=mask), coarse_depth(depth_m)

    def agreement(self, samples: Sequence[NDArray[np.floating]], T_first_peer: Array) -> float:
        """How well own depth images agree with a neighbor's samples [m, 3], keyframes at T_first_peer [k, 4, 4]."""
        assert len(self.features) == len(self._coarse_depths)  # which reads the images
        return surface_agreement(
            self._coarse_depths,
            self.data.camera,
            samples,
            T_ownmap_keyframe=self.graph.T_first_keyframe,
            T_ownmap_peer=T_first_peer,
        )

    def overlaps(self, closures: Sequence[LoopClosure], peer: KeyframePoses) -> dict[tuple[int, int], float]:
        """How much of own views a neighbor's keyframes should see, by both, near loop closures with it."""
        return overlaps(closures, self._coarse_depths, self.data.camera, own=self.graph.from_first, peer=peer)

    def pyramid(self, keyframe: int) -> RgbdPyramid:
        """Images of a keyframe at several resolutions."""
        return self._pyramid(keyframe)

    def _build_pyramid(self, keyframe: int) -> RgbdPyramid:
        images = self.data.images(keyframe)
        camera, sigma_m = self.data.camera, images.depth_sigma_m
        return RgbdPyramid.build(
            images.color, images.depth_m, camera, depth_sigma_m=sigma_m, mask=images.mask
        )

    @property
    def digest(self) -> bytes:
        """Eight bytes that depend on what the robot saw, and on nothing else."""
        whole = hashlib.sha256(b"".join(f.descriptors.tobytes() for f in self.features))
        return whole.digest()[: loop_closing_wire.DIGEST_BYTES]

    def descriptors(self) -> DescriptorSet:
        """What a neighbor gets to recognize places."""
        most = self.config.places.features_per_place
        compact = [f.descriptors[:most] for f in self.features]
        return DescriptorSet(compact, self.graph.T_first_keyframe, self.graph.drift)

    def sample(self, keyframe: int) -> KeyframeSample:
        """What a neighbor gets to verify loop closures with one keyframe."""
        reference = Reference.sample(self.pyramid(keyframe), self.config.verification.samples)
        return KeyframeSample(keyframe, self.features[keyframe], reference)


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
        """None: the roles follow from the digests of both ends."""

    def protocol(self, peer: str, kind: Kind, payload: bytes) -> LoopClosureProtocol:
        """The protocol with a neighbor, from its digest or from a message that only one of the two ends receives."""
        verifies = kind in VERIFIER_KINDS
        if kind is Kind.HELLO:
            digest = loop_closing_wire.read_digest(payload)
            verifies = (self.database.digest, self.database.graph.robot) < (digest, peer)
        return (Verifier if verifies else Provider)(self.database, peer, self.seed)


class Provider(LoopClosureProtocol):
    """Sends descriptors and the samples that are requested; gets the verdict."""

    def __init__(self, database: KeyframeDatabase, peer: str, seed: int) -> None:
        super().__init__(database.graph.robot, peer)
        self.database, self.config, self.seed = database, database.config, seed
        self.answered: set[int] = set()

    def begin(self, send: Send) -> None:
        send(Kind.DESCRIPTORS, loop_closing_wire.write_descriptors(self.database.descriptors()))

    def take(self, kind: Kind, payload: bytes, send: Send) -> None:
        limit = self.database.data.keyframes
        if kind is Kind.REQUEST:
            for keyframe in loop_closing_wire.read_indices(payload, limit):
                if keyframe in self.answered:
                    raise MalformedError(f"request: keyframe {keyframe} was requested before")
                self.answered.add(keyframe)
                send(Kind.SAMPLE, loop_closing_wire.write_sample(self.database.sample(keyframe)))
        elif kind is Kind.CLOSURES and not self.decided:
            verdicts = loop_closing_wire.read_verdicts(payload, limit)
            self.decided = True
            if verdicts.joined:
                self.joined = JoinedPair(verdicts.shared)
        else:
            raise MalformedError(f"{kind.name} is not for the provider, or came twice")


class Verifier(LoopClosureProtocol):
    """Chooses candidates, verifies them, and decides."""

    decides = True

    def __init__(self, database: KeyframeDatabase, peer: str, seed: int) -> None:
        super().__init__(database.graph.robot, peer)
        self.database, self.config, self.seed = database, database.config, seed
        self.planner: Planner | None = None
        self.waiting: dict[int, list[Candidate]] = {}  # by keyframe of the neighbor
        # of its keyframes, until decided: compact descriptors, those that resemble no own one, samples that arrived
        self.compact: list[Descriptors] = []
        self.unlike: list[Candidate] = []
        self.samples: dict[int, KeyframeSample] = {}

    def take(self, kind: Kind, payload: bytes, send: Send) -> None:
        if kind is Kind.DESCRIPTORS and self.peer_keyframes is None:
            self._choose(loop_closing_wire.read_descriptors(payload), send)
        elif kind is Kind.SAMPLE and self.peer_keyframes is not None:
            sample = loop_closing_wire.read_sample(payload, len(self.peer_keyframes.drift))
            if sample.keyframe not in self.waiting:
                raise MalformedError(f"sample of keyframe {sample.keyframe} was not requested, or came twice")
            self.samples[sample.keyframe] = sample
            for candidate in self.waiting.pop(sample.keyframe):
                self._verify(candidate)
            if not self.waiting:
                self._request(send)
        else:
            raise MalformedError(f"{kind.name} is not for the verifier, or came twice")

    def _choose(self, received: DescriptorSet, send: Send) -> None:
        """Score all pairs of keyframes and request the samples of the most promising."""
        self.peer_keyframes = KeyframePoses(received.T_first_keyframe, received.drift)
        self.compact = received.descriptors
        c = self.config.places
        candidates, self.unlike = place_recognition.scored(
            self.database.features, received.descriptors, c.ratio, c.min_score
        )
        self.planner = Planner(
            candidates,
            c,
            drift_own=self.database.graph.drift,
            drift_peer=received.drift,
            closures=self.config.consensus.closures,
        )
        self._request(send)

    def _request(self, send: Send) -> None:
        """Verify what is worth most now, and request what that needs; decide when nothing is worth it any more."""
        assert self.planner is not None
        while not self.waiting:
            chosen = self.planner.next() or self._found_again()
            if not chosen:
                break
            for candidate in chosen:
                if candidate.peer_keyframe in self.samples:
                    self._verify(candidate)
                else:
                    self.waiting.setdefault(candidate.peer_keyframe, []).append(candidate)
        if self.waiting:
            send(Kind.REQUEST, loop_closing_wire.write_indices(sorted(self.waiting)))
            return
        for candidate, reason in self.planner.not_requested():
            self.tried.append(Tried(candidate, Verified(Verdict.NOT_REQUESTED, 0, 0, reason)))
        for candidate in self.unlike:
            if candidate.peer_keyframe not in self.samples:
                detail = f"{candidate.score} descriptors match at best, {self.config.places.min_score} needed"
                self.tried.append(Tried(candidate, Verified(Verdict.UNLIKE, 0, 0, detail)))
        self._decide(send)

    def _found_again(self) -> list[Candidate]:
        """Further candidates near the loop closures that were verified, or near those that nearly were."""
        assert self.planner is not None
        assert self.peer_keyframes is not None
        results = [t.result for t in self.tried]
        verified = [r.closure for r in results if r.closure]
        near = verified or [r.tentative for r in results if r.tentative]
        if not near or len(verified) >= self.config.places.enough_closures:
            return []
        self.planner.expect(self.database.overlaps(near, self.peer_keyframes), self._score)
        return self.planner.next()

    def _score(self, own_keyframe: int, peer_keyframe: int) -> int:
        own, ratio = self.database.features[own_keyframe], self.config.places.ratio
        return len(matches(own.descriptors, self.compact[peer_keyframe], ratio))

    def _verify(self, candidate: Candidate) -> None:
        assert self.planner is not None
        sample = self.samples[candidate.peer_keyframe]
        ends = (self.database.features[candidate.own_keyframe], sample.features)
        own, peer = (hashlib.sha256(f.descriptors.tobytes()).hexdigest() for f in ends)
        rng = random_streams.generator(self.seed, "ransac", own=own, peer=peer)
        result = self.database.recall(
            f"{self.own} verifies {candidate.own_keyframe}, {self.peer} {candidate.peer_keyframe}",
            partial(self._verified, candidate, sample, rng),
        )
        self.tried.append(Tried(candidate, result))
        self.planner.take(candidate, result.closure is not None)

    def _verified(self, candidate: Candidate, sample: KeyframeSample, rng: np.random.Generator) -> Verified:
        own = candidate.own_keyframe
        return verify(
            candidate,
            self.database.features[own],
            self.database.pyramid(own),
            sample,
            config=self.config.verification,
            rng=rng,
        )

    def _inject(self) -> None:
        """Add the false loop closures that the configuration wants."""
        assert self.peer_keyframes is not None
        found = [t.result.closure for t in self.tried if t.result.closure is not None]
        ends = self.database.data.keyframes, len(self.peer_keyframes.drift)
        for c in injection.false_closures(
            found, *ends, self.config.injection, seed=self.seed, robot=self.own, peer=self.peer
        ):
            result = Verified(Verdict.KEPT, 0, 0, injection.DETAIL, c)
            self.tried.append(Tried(Candidate(c.own_keyframe, c.peer_keyframe, 0), result))

    def _decide(self, send: Send) -> None:
        """Pairwise consistency, the relative frame, and the message with the verdict."""
        assert self.peer_keyframes is not None
        self._inject()
        self.tried.sort(key=lambda t: (t.candidate.peer_keyframe, t.candidate.own_keyframe))
        closures = [t.result.closure for t in self.tried if t.result.closure is not None]
        consistency = consistent(
            closures, self.database.graph.from_first, self.peer_keyframes, self.config.consensus.closures
        )
        outcomes = iter(zip(consistency.keep.tolist(), consistency.reasons, strict=True))
        for at, t in enumerate(self.tried):
            if t.result.closure is not None:
                keep, reason = next(outcomes)
                if not keep:
                    if t.result.detail == injection.DETAIL:
                        reason = f"{reason}; {injection.DETAIL}"
                    result = replace(t.result, verdict=Verdict.INCONSISTENT, detail=reason)
                    self.tried[at] = Tried(t.candidate, result)
        if consistency.T_ownmap_peermap is not None:
            groups = (Group(consistency.keep, consistency.T_ownmap_peermap), *consistency.others)
            joined = join(
                closures,
                groups,
                self.database.graph.from_first,
                self.peer_keyframes,
                agreement=self._agreement,
                config=self.config.consensus.closures,
            )
            if can_be_sent(self.own, self.peer, joined.proposals):
                self.joined = joined
            else:
                self._refuse("the map of the neighbor would lie beyond what can be sent")
        self.samples.clear()
        self.compact = []
        verdicts = Verdicts(
            candidates=sum(t.result.verdict is not Verdict.UNLIKE for t in self.tried),
            verified=len(closures),
            consistent=int(consistency.keep.sum()),
            joined=self.joined is not None,
            shared=NOTHING_SHARED if self.joined is None else self.joined.shared,
        )
        self.decided = True
        send(Kind.CLOSURES, loop_closing_wire.write_verdicts(verdicts))

    def _refuse(self, reason: str) -> None:
        """No loop closure counts."""
        for at, t in enumerate(self.tried):
            if t.result.closure is not None and t.result.verdict is Verdict.KEPT:
                result = replace(t.result, verdict=Verdict.INCONSISTENT, detail=reason)
                self.tried[at] = Tried(t.candidate, result)

    def _agreement(self, group: Group) -> float:
        """Share of the neighbor's samples that own depth images confirm, where a group places its map."""
        assert self.peer_keyframes is not None
        placed = group.T_ownmap_peermap @ self.peer_keyframes.T_frame_keyframe[sorted(self.samples)]
        points = [self.samples[k].reference.levels[0].points for k in sorted(self.samples)]
        return self.database.agreement(points, placed)
