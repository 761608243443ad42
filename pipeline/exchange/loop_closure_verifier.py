"""The end of a pair that verifies loop closures and decides; `detected_loop_closures` has the protocol."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.consensus.admm_edge import SharedKeyframes
from duagc.pipeline.exchange import injection, place_recognition
from duagc.pipeline.exchange.keyframe_database import KeyframeDatabase, digest_of
from duagc.pipeline.exchange.loop_closing import LoopClosureProtocol, Send, Tried, can_be_sent, join
from duagc.pipeline.exchange.moved_things import without_moved_things
from duagc.pipeline.exchange.place_recognition import Candidate, Planner
from duagc.pipeline.exchange.rectified_search import RectifiedSearch, most_alike
from duagc.pipeline.exchange.verification import Verdict, Verified, verify, within_view
from duagc.pipeline.exchange.wire import loop_closing_wire
from duagc.pipeline.exchange.wire.loop_closing_wire import DescriptorSet, KeyframeSample, Verdicts
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.geometry.statistics import evenly_spaced
from duagc.pipeline.network.packets import Kind, MalformedError
from duagc.pipeline.posegraph.loop_closures import Consistency, Group, KeyframePoses, consistent
from duagc.pipeline.posegraph.relative_poses import LoopClosure
from duagc.pipeline.registration.descriptors import Descriptors, matches

NOTHING_SHARED = SharedKeyframes(np.zeros(0, np.int32), np.zeros((0, 6), np.float32))


class Verifier(LoopClosureProtocol):
    """Chooses candidates, verifies them, and decides."""

    decides = True

    def __init__(self, database: KeyframeDatabase, peer: str, seed: int) -> None:
        """Nothing is known of the neighbor yet.

        Args:
            database: own keyframes.
            peer: name of the neighbor.
            seed: of this run, for RANSAC and injected faults.
        """
        super().__init__(database.graph.robot, peer)
        self.database, self.config, self.seed = database, database.config, seed
        self.planner: Planner | None = None
        self.peer_camera: PinholeCamera | None = None
        self.limits = self.config.verification
        self.waiting: dict[int, list[Candidate]] = {}  # by keyframe of the neighbor
        # of its keyframes, until decided: compact descriptors, those that resemble no own one, samples that arrived
        self.compact: list[Descriptors] = []
        self.unlike: list[Candidate] = []
        self.samples: dict[int, KeyframeSample] = {}
        self.rectified: RectifiedSearch | None = None  # begun where all else joins nobody

    def take(self, kind: Kind, payload: bytes, send: Send) -> None:
        """Use descriptors, a sample or rectified features, and go on with the search.

        Args:
            kind: of the message.
            payload: of the message.
            send: queues a message for the neighbor.
        """
        if kind is Kind.DESCRIPTORS and self.peer_keyframes is None:
            self._choose(loop_closing_wire.read_descriptors(payload), send)
        elif kind is Kind.SAMPLE and self.peer_keyframes is not None:
            sample = loop_closing_wire.read_sample(payload, len(self.peer_keyframes.drift))
            if sample.keyframe not in self.waiting:
                raise MalformedError(f"sample of keyframe {sample.keyframe} was not requested, or came twice")
            self.samples[sample.keyframe] = sample
            for candidate in self.waiting.pop(sample.keyframe):
                self._verify(candidate)
            self._go_on(send)
        elif kind is Kind.RECTIFIED and self.rectified is not None and self.peer_keyframes is not None:
            self.rectified.take(loop_closing_wire.read_rectified(payload, len(self.peer_keyframes.drift)))
            self._go_on(send)
        else:
            raise MalformedError(f"{kind.name} is not for the verifier, or came twice")

    def _go_on(self, send: Send) -> None:
        """With what was requested, once all of it is here."""
        if self.waiting or (self.rectified is not None and self.rectified.wanted):
            return
        if self.rectified is not None and not self.rectified.ended:
            self._compare_rectified(self.rectified)
        self._request(send)

    def _choose(self, received: DescriptorSet, send: Send) -> None:
        """Score all pairs of keyframes and request the samples of the most promising."""
        self.peer_keyframes = KeyframePoses(received.T_first_keyframe, received.drift)
        self.peer_camera = received.camera
        self.limits = within_view(self.config.verification, self.database.data.camera, received.camera)
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
                if self.rectified is not None and candidate.ends in self.rectified.tried:
                    continue
                if candidate.peer_keyframe in self.samples:
                    self._verify(candidate)
                else:
                    self.waiting.setdefault(candidate.peer_keyframe, []).append(candidate)
        if self.waiting:
            send(Kind.REQUEST, loop_closing_wire.write_indices(sorted(self.waiting)))
            return
        if self.rectified is None and self._search_rectified(send):
            return
        for candidate, reason in self.planner.not_requested():
            self.tried.append(Tried(candidate, Verified(Verdict.NOT_REQUESTED, 0, 0, reason)))
        tried = {t.candidate.peer_keyframe for t in self.tried}
        for candidate in self.unlike:
            if candidate.peer_keyframe not in tried:
                detail = f"{candidate.score} descriptors match at best, {self.config.places.min_score} needed"
                self.tried.append(Tried(candidate, Verified(Verdict.UNLIKE, 0, 0, detail)))
        self._decide(send)

    def _search_rectified(self, send: Send) -> bool:
        """If nothing that was found joins the two robots, request rectified features, and samples; whether it did."""
        assert self.planner is not None
        assert self.peer_keyframes is not None
        c = self.config.places
        theirs = len(self.peer_keyframes.drift)
        if not (c.rectified_planes and theirs and self.database.data.keyframes):
            return False
        if self._consistency()[1].T_ownmap_peermap is not None:
            return False
        others = [k for k in range(theirs) if k not in self.samples]
        room = max(0, c.max_requested_keyframes - len(self.samples))
        further = [others[k] for k in evenly_spaced(len(others), min(room, len(others)))]
        self.rectified = RectifiedSearch({*self.samples, *further})
        self.waiting = {keyframe: [] for keyframe in further}
        self.planner.requested |= set(further)
        if further:
            send(Kind.REQUEST, loop_closing_wire.write_indices(further))
        send(Kind.RECTIFIED_REQUEST, loop_closing_wire.write_indices(sorted(self.rectified.wanted)))
        return True

    def _compare_rectified(self, search: RectifiedSearch) -> None:
        """Verify the pairs of keyframes with most features in common that are no loop closures yet."""
        assert self.planner is not None
        search.ended = True
        database, c, between = self.database, self.config.places, f"{self.own} and {self.peer}, rectified"
        inliers: dict[tuple[int, int], int] = {}
        count = database.data.keyframes
        for own in evenly_spaced(count, min(count, c.rectified_keyframes)):
            compare = partial(search.compare, own, database, self.samples, self.seed)
            found = database.recall(f"{between}: {own}", compare)
            inliers |= {(own, peer_keyframe): agree for peer_keyframe, agree in found}
        known = {t.candidate.ends for t in self.tried if t.result.closure is not None}
        for own, peer_keyframe in most_alike(inliers, known, c.candidates_per_keyframe):
            candidate = Candidate(own, peer_keyframe, self._score(own, peer_keyframe))
            sample = self.samples[peer_keyframe]
            check = partial(search.verify, candidate, database, sample, config=self.limits, seed=self.seed)
            result = database.recall(f"{between}: {own} {peer_keyframe}", check)
            search.tried[candidate.ends] = Tried(candidate, result)
            self.planner.take(candidate, result.closure is not None)
        before = [t for t in self.tried if t.candidate.ends not in search.tried]
        self.tried = [*before, *search.tried.values()]

    def _found_again(self) -> list[Candidate]:
        """Further candidates near the loop closures that were verified, or near those that nearly were."""
        assert self.planner is not None
        assert self.peer_keyframes is not None
        assert self.peer_camera is not None
        results = [t.result for t in self.tried]
        verified = [r.closure for r in results if r.closure]
        near = verified or [r.tentative for r in results if r.tentative]
        if not near or len(verified) >= self.config.places.enough_closures:
            return []
        overlaps = self.database.overlaps(near, self.peer_keyframes, self.peer_camera)
        self.planner.expect(overlaps, self._score)
        return self.planner.next()

    def _score(self, own_keyframe: int, peer_keyframe: int) -> int:
        own, ratio = self.database.features[own_keyframe], self.config.places.ratio
        return len(matches(own.descriptors, self.compact[peer_keyframe], ratio))

    def _verify(self, candidate: Candidate) -> None:
        assert self.planner is not None
        sample = self.samples[candidate.peer_keyframe]
        own, peer = digest_of(self.database.features[candidate.own_keyframe]), digest_of(sample.features)
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
            config=self.limits,
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
        own, agreeing = self.database.graph.from_first, self.config.consensus.closures
        self.tried = without_moved_things(self.tried, own, self.peer_keyframes, agreeing)
        self.tried.sort(key=lambda t: (t.candidate.peer_keyframe, t.candidate.own_keyframe))
        closures, consistency = self._consistency()
        found = consistency.keep.tolist(), consistency.unlike.tolist(), consistency.reasons
        outcomes = iter(zip(*found, strict=True))
        for at, t in enumerate(self.tried):
            if t.result.closure is not None:
                keep, unlike, reason = next(outcomes)
                if not keep:
                    if t.result.detail == injection.DETAIL:
                        reason = f"{reason}; {injection.DETAIL}"
                    verdict = Verdict.LOOKS_DIFFERENT if unlike else Verdict.INCONSISTENT
                    result = replace(t.result, verdict=verdict, detail=reason)
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
        self.compact, self.rectified = [], None
        verdicts = Verdicts(
            candidates=sum(t.result.verdict is not Verdict.UNLIKE for t in self.tried),
            verified=len(closures),
            consistent=int(consistency.keep.sum()),
            joined=self.joined is not None,
            shared=NOTHING_SHARED if self.joined is None else self.joined.shared,
        )
        self.decided = True
        send(Kind.CLOSURES, loop_closing_wire.write_verdicts(verdicts))

    def _consistency(self) -> tuple[list[LoopClosure], Consistency]:
        """Loop closures that were verified, and which of them agree."""
        assert self.peer_keyframes is not None
        closures = [t.result.closure for t in self.tried if t.result.closure is not None]
        own, settings = self.database.graph.from_first, self.config.consensus.closures
        if self.rectified is not None:  # weaker evidence of more pairs: one more must agree
            settings = settings.model_copy(update={"min_support": settings.min_support + 1})
        return closures, consistent(closures, own, self.peer_keyframes, settings)

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
