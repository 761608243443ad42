"""How two robots find out whether they have been in the same place, and where one's map lies in the other's.

    higher end                                          lower end
    HELLO        digest of what was seen              <->
    DESCRIPTORS  compact descriptors of all keyframes ->
                                                      <- REQUEST   keyframes worth a closer look    } until nothing
    SAMPLE       one per requested keyframe           ->                                            } is worth it
                                                      <- CLOSURES  verdict, shared keyframes

The lower end is the one with the lower digest (and name, should they be equal): who verifies decides which of two
measurements counts, and that must not depend on names. It keeps the closures. It has decided when its verdict has been
acknowledged, the other end when the verdict has arrived.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.consensus.admm_edge import SharedKeyframes, link_metric
from duagc.pipeline.exchange import injection, place_recognition
from duagc.pipeline.exchange.convergence import agreement, coarse_depth
from duagc.pipeline.exchange.place_recognition import Candidate, Planner
from duagc.pipeline.exchange.verification import Verdict, Verified, verify
from duagc.pipeline.exchange.wire import places_wire
from duagc.pipeline.exchange.wire.places_wire import KeyframeSample, PlaceBook, Verdicts
from duagc.pipeline.geometry import se3
from duagc.pipeline.network.packets import Kind, MalformedError
from duagc.pipeline.posegraph.cycle_consistency import Proposal
from duagc.pipeline.posegraph.loop_closures import Closure, Group, consistent, drift, frame_variance
from duagc.pipeline.registration import Reference, RgbdPyramid
from duagc.pipeline.registration.features import Features, extract
from duagc.pipeline.runs.robot_data import RobotData, factors_of

Array = NDArray[np.float64]
Send = Callable[[Kind, bytes], None]
PYRAMIDS_KEPT = 12


class OwnPlaces:
    """A robot's own keyframes as others may ask for them; computed when first needed."""

    def __init__(self, data: RobotData, config: ExchangeConfig) -> None:
        self.data, self.config = data, config
        self._pyramid = lru_cache(maxsize=PYRAMIDS_KEPT)(self._build_pyramid)
        self._features: list[Features] | None = None
        self._coarse_depths: list[NDArray[np.float32]] = []
        self.registrations = factors_of(data.registrations)

    @property
    def features(self) -> list[Features]:
        """All features of every keyframe."""
        if self._features is None:
            self._features = []
            for k in range(self.data.keyframes):
                color, depth_m, _ = self.data.images(k)
                most = self.config.places.features_per_keyframe
                self._features.append(extract(color, depth_m, self.data.camera, most))
                self._coarse_depths.append(coarse_depth(depth_m))
        return self._features

    def agreement(self, samples: Sequence[NDArray[np.floating]], T_first_peer: Array) -> float:
        """How well own depth images agree with a neighbor's samples [m, 3], keyframes at T_first_peer [k, 4, 4]."""
        assert len(self.features) == len(self._coarse_depths)  # which reads the images
        return agreement(self._coarse_depths, self.data.camera, self.T_first_keyframe, samples, T_first_peer)

    def pyramid(self, keyframe: int) -> RgbdPyramid:
        """Images of a keyframe at several resolutions."""
        return self._pyramid(keyframe)

    def _build_pyramid(self, keyframe: int) -> RgbdPyramid:
        images = self.data.images(keyframe)
        color = images.color.astype(np.float32) / np.float32(255)
        camera, sigma_m = self.data.camera, images.depth_sigma_m
        return RgbdPyramid.build(color, images.depth_m, camera, depth_sigma_m=sigma_m)

    @property
    def digest(self) -> bytes:
        """Eight bytes that depend on what the robot saw, and on nothing else."""
        whole = hashlib.sha256(b"".join(f.descriptors.tobytes() for f in self.features))
        return whole.digest()[: places_wire.DIGEST_BYTES]

    @property
    def T_first_keyframe(self) -> Array:  # noqa: N802 (transforms)
        """Keyframes [n, 4, 4] as seen from the first: no result depends on where a robot's map has its origin."""
        T = self.data.T_map_keyframe
        return se3.inverse(T[0]) @ T if len(T) else T

    @property
    def drift(self) -> Array:
        """Accumulated variance of the own odometry, [n, 2]."""
        return drift(factors_of(self.data.odometry), self.data.keyframes, self.config.consensus.closures)

    def book(self) -> PlaceBook:
        """What a neighbor gets to recognize places."""
        most = self.config.places.features_per_place
        compact = [f.descriptors[:most] for f in self.features]
        return PlaceBook(compact, self.T_first_keyframe, self.drift)

    def sample(self, keyframe: int) -> KeyframeSample:
        """What a neighbor gets to verify closures with one keyframe."""
        reference = Reference.sample(self.pyramid(keyframe), self.config.verification.samples)
        return KeyframeSample(keyframe, self.features[keyframe], reference)


@dataclass(frozen=True)
class Tried:
    """One candidate and what became of it, for the record."""

    candidate: Candidate
    result: Verified


@dataclass(frozen=True)
class Joined:
    """Two robots that share a frame: shared keyframes at both ends, the rest at the end that holds the closures.

    groups: bool per closure, one array for each group that agrees on a frame. proposals: what they agree on.
    """

    shared: SharedKeyframes
    closures: tuple[Closure, ...] = ()
    groups: tuple[NDArray[np.bool_], ...] = ()
    proposals: tuple[Proposal, ...] = ()


class Meeting:
    """The lower end of a pair, or the higher one: two subclasses."""

    def __init__(self, own: str, peer: str, places_: OwnPlaces, config: ExchangeConfig, seed: int) -> None:
        self.own, self.peer, self.places, self.config, self.seed = own, peer, places_, config, seed
        self.verdicts: Verdicts | None = None
        self.joined: Joined | None = None
        self.tried: list[Tried] = []

    def begin(self, send: Send) -> None:
        """Called once, when the ends know which is which."""

    def take(self, kind: Kind, payload: bytes, send: Send) -> None:
        """Take one complete message of this meeting."""
        raise NotImplementedError


class HigherEnd(Meeting):
    """Sends descriptors and the samples it is asked for; gets the verdict."""

    def __init__(self, own: str, peer: str, places_: OwnPlaces, config: ExchangeConfig, seed: int) -> None:
        super().__init__(own, peer, places_, config, seed)
        self.answered: set[int] = set()

    def begin(self, send: Send) -> None:
        send(Kind.DESCRIPTORS, places_wire.write_places(self.places.book()))

    def take(self, kind: Kind, payload: bytes, send: Send) -> None:
        limit = self.places.data.keyframes
        if kind is Kind.REQUEST:
            for keyframe in places_wire.read_indices(payload, limit):
                if keyframe in self.answered:
                    raise MalformedError(f"request: keyframe {keyframe} was asked for before")
                self.answered.add(keyframe)
                send(Kind.SAMPLE, places_wire.write_sample(self.places.sample(keyframe)))
        elif kind is Kind.CLOSURES and self.verdicts is None:
            verdicts = places_wire.read_verdicts(payload, limit)
            self.verdicts = verdicts
            if verdicts.joined:
                self.joined = Joined(verdicts.shared)
        else:
            raise MalformedError(f"{kind.name} is not for the higher end, or came twice")


class LowerEnd(Meeting):
    """Chooses candidates, verifies them, and decides."""

    def __init__(self, own: str, peer: str, places_: OwnPlaces, config: ExchangeConfig, seed: int) -> None:
        super().__init__(own, peer, places_, config, seed)
        self.book: PlaceBook | None = None
        self.planner: Planner | None = None
        self.waiting: dict[int, list[Candidate]] = {}  # by keyframe of the neighbor
        self.samples: dict[int, NDArray[np.floating]] = {}  # until decided: points [m, 3] of its keyframes

    def take(self, kind: Kind, payload: bytes, send: Send) -> None:
        if kind is Kind.DESCRIPTORS and self.book is None:
            self._choose(places_wire.read_places(payload), send)
        elif kind is Kind.SAMPLE and self.book is not None:
            sample = places_wire.read_sample(payload, len(self.book.descriptors))
            if sample.keyframe not in self.waiting:
                raise MalformedError(f"sample of keyframe {sample.keyframe} was not asked for, or came twice")
            self.samples[sample.keyframe] = sample.reference.levels[0].points
            self._verify(sample)
            if not self.waiting:
                self._ask(send)
        else:
            raise MalformedError(f"{kind.name} is not for the lower end, or came twice")

    def _choose(self, book: PlaceBook, send: Send) -> None:
        """Score all pairs of keyframes and ask for the samples of the most promising."""
        self.book = book
        c = self.config.places
        candidates, unlike = place_recognition.scored(
            self.places.features, book.descriptors, c.ratio, c.min_score
        )
        for candidate in unlike:
            detail = f"{candidate.score} descriptors match at best, {c.min_score} needed"
            self.tried.append(Tried(candidate, Verified(Verdict.UNLIKE, 0, 0, detail)))
        self.planner = Planner(candidates, self.places.drift, book.drift, c, self.config.consensus.closures)
        self._ask(send)

    def _ask(self, send: Send) -> None:
        """Ask for what is worth most now; decide when nothing is worth a sample any more."""
        assert self.planner is not None
        for candidate in self.planner.next():
            self.waiting.setdefault(candidate.peer_keyframe, []).append(candidate)
        if self.waiting:
            send(Kind.REQUEST, places_wire.write_indices(sorted(self.waiting)))
            return
        for candidate, reason in self.planner.not_asked_for():
            self.tried.append(Tried(candidate, Verified(Verdict.NOT_ASKED_FOR, 0, 0, reason)))
        self._decide(send)

    def _verify(self, sample: KeyframeSample) -> None:
        assert self.planner is not None
        for candidate in self.waiting.pop(sample.keyframe):
            ends = (self.places.features[candidate.own_keyframe], sample.features)
            own, peer = (hashlib.sha256(f.descriptors.tobytes()).hexdigest() for f in ends)
            rng = random_streams.generator(self.seed, "ransac", own=own, peer=peer)
            result = verify(
                candidate.own_keyframe,
                candidate.peer_keyframe,
                self.places.features[candidate.own_keyframe],
                self.places.pyramid(candidate.own_keyframe),
                sample.features,
                sample.reference,
                self.config.verification,
                rng,
            )
            self.tried.append(Tried(candidate, result))
            self.planner.take(candidate, result.closure is not None)

    def _inject(self) -> None:
        """Add the false closures that the configuration asks for."""
        assert self.book is not None
        found = [t.result.closure for t in self.tried if t.result.closure is not None]
        ends = self.places.data.keyframes, len(self.book.descriptors)
        for c in injection.false_closures(
            found, *ends, self.config.injection, self.seed, self.own, self.peer
        ):
            result = Verified(Verdict.KEPT, 0, 0, injection.DETAIL, c)
            self.tried.append(Tried(Candidate(c.own_keyframe, c.peer_keyframe, 0), result))

    def _decide(self, send: Send) -> None:
        """Pairwise consistency, the relative frame, and the message that says so."""
        assert self.book is not None
        self._inject()
        self.tried.sort(key=lambda t: (t.candidate.peer_keyframe, t.candidate.own_keyframe))
        closures = [t.result.closure for t in self.tried if t.result.closure is not None]
        consistency = consistent(
            closures,
            self.places.T_first_keyframe,
            self.book.T_first_keyframe,
            self.places.drift,
            self.book.drift,
            self.config.consensus.closures,
        )
        verdicts = iter(zip(consistency.keep.tolist(), consistency.reasons, strict=True))
        for at, t in enumerate(self.tried):
            if t.result.closure is not None:
                keep, reason = next(verdicts)
                if not keep:
                    if t.result.detail == injection.DETAIL:
                        reason = f"{reason}; {injection.DETAIL}"
                    result = replace(t.result, verdict=Verdict.INCONSISTENT, detail=reason)
                    self.tried[at] = Tried(t.candidate, result)
        shared = SharedKeyframes(np.zeros(0, np.int32), np.zeros((0, 6), np.float32))
        if consistency.T_ownmap_peermap is not None:
            keyframes = np.unique([c.peer_keyframe for c in closures])
            metric = link_metric(closures, keyframes, self.config.consensus.closures)
            shared = SharedKeyframes(keyframes.astype(np.int32), metric)
            groups = (Group(consistency.keep, consistency.T_ownmap_peermap), *consistency.others)
            proposals = tuple(self._proposal(closures, group) for group in groups)
            self.joined = Joined(shared, tuple(closures), tuple(g.keep for g in groups), proposals)
        self.samples.clear()
        self.verdicts = Verdicts(
            candidates=sum(t.result.verdict is not Verdict.UNLIKE for t in self.tried),
            verified=len(closures),
            consistent=int(consistency.keep.sum()),
            joined=self.joined is not None,
            shared=shared,
        )
        send(Kind.CLOSURES, places_wire.write_verdicts(self.verdicts))

    def _proposal(self, closures: Sequence[Closure], group: Group) -> Proposal:
        """What a group of closures says of the first keyframe of either robot in that of the other, own frame first."""
        assert self.book is not None
        own, peer = self.places.T_first_keyframe, self.book.T_first_keyframe
        agreeing = [c for c, keep in zip(closures, group.keep.tolist(), strict=True) if keep]
        variance = frame_variance(
            agreeing, own, peer, self.places.drift, self.book.drift, self.config.consensus.closures
        )
        placed = group.T_ownmap_peermap @ peer[sorted(self.samples)]
        alike = self.places.agreement([self.samples[k] for k in sorted(self.samples)], placed)
        return Proposal(len(agreeing), group.T_ownmap_peermap, variance, alike)
