"""The search for loop closures where all else joins nobody: by features of surfaces as if the cameras faced them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.config.exchange import VerificationConfig
from duagc.pipeline.exchange.keyframe_database import KeyframeDatabase, digest_of
from duagc.pipeline.exchange.loop_closing import Tried
from duagc.pipeline.exchange.place_recognition import Candidate
from duagc.pipeline.exchange.verification import Verified, verify
from duagc.pipeline.exchange.wire.loop_closing_wire import KeyframeSample, RectifiedFeatures
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.registration.feature_motion import motion_from_rectified
from duagc.pipeline.registration.features import Features


@dataclass
class RectifiedSearch:
    """What was requested of a neighbor, what arrived, and what became of it.

    Attributes:
        wanted: keyframes of the neighbor whose rectified features are not here yet.
        features: those that arrived, by keyframe.
        tried: pairs of keyframes that were verified, by own keyframe and the neighbor's.
        ended: all pairs were compared.
    """

    wanted: set[int]
    features: dict[int, Features] = field(default_factory=dict)
    tried: dict[tuple[int, int], Tried] = field(default_factory=dict)
    ended: bool = False

    def take(self, found: RectifiedFeatures) -> None:
        """Features of one keyframe.

        Args:
            found: as they arrived.
        Raises:
            MalformedError: they were not requested, or came twice.
        """
        if found.keyframe not in self.wanted:
            raise MalformedError(f"rectified: keyframe {found.keyframe} was not requested, or came twice")
        self.wanted.remove(found.keyframe)
        self.features[found.keyframe] = found.features

    def compare(
        self, own: int, database: KeyframeDatabase, samples: Mapping[int, KeyframeSample], seed: int
    ) -> list[tuple[int, int]]:
        """Look for keyframes of the neighbor whose features agree with those of an own one on a motion.

        Args:
            own: the keyframe.
            database: own keyframes.
            samples: of the neighbor's, by keyframe.
            seed: of this run.
        Returns:
            The neighbor's keyframes and the numbers of features that agree.
        """
        ours, config = (database.features[own], database.rectified(own)), database.config.verification
        found = list[tuple[int, int]]()
        for keyframe, rectified in sorted(self.features.items()):
            theirs = samples[keyframe].features, rectified
            motion = motion_from_rectified(ours, theirs, config, _stream(seed, ours, theirs))
            if motion.accepted:
                found.append((keyframe, motion.inliers))
        return found

    def verify(
        self,
        candidate: Candidate,
        database: KeyframeDatabase,
        sample: KeyframeSample,
        *,
        config: VerificationConfig,
        seed: int,
    ) -> Verified:
        """Verify a pair of keyframes by features of both kinds.

        Args:
            candidate: the pair.
            database: own keyframes.
            sample: of the neighbor's keyframe.
            config: limits of all tests.
            seed: of this run.
        """
        own = candidate.own_keyframe
        ours = database.features[own], database.rectified(own)
        theirs = sample.features, self.features[candidate.peer_keyframe]
        return verify(
            candidate,
            ours[0],
            database.pyramid(own),
            sample,
            config=config,
            rng=_stream(seed, ours, theirs),
            rectified=(ours[1], theirs[1]),
        )


def most_alike(
    inliers: Mapping[tuple[int, int], int], known: Collection[tuple[int, int]], most: int
) -> list[tuple[int, int]]:
    """Of every keyframe of the neighbor the own ones with most features in common, but those of known loop closures.

    Args:
        inliers: features that agree, by own keyframe and the neighbor's.
        known: pairs that are loop closures.
        most: of a keyframe of the neighbor.
    """
    by_peer: dict[int, list[tuple[int, int]]] = {}
    for own, peer in sorted(inliers, key=lambda ends: (-inliers[ends], ends)):
        by_peer.setdefault(peer, []).append((own, peer))
    return sorted(ends for pairs in by_peer.values() for ends in pairs[:most] if ends not in known)


def _stream(
    seed: int, ours: tuple[Features, Features], theirs: tuple[Features, Features]
) -> np.random.Generator:
    return random_streams.generator(seed, "ransac.rectified", own=digest_of(*ours), peer=digest_of(*theirs))
