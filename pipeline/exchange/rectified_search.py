"""The search for loop closures where all else joins nobody: by features of surfaces as if the cameras faced them."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from duagc.pipeline.base import random_streams
from duagc.pipeline.exchange.keyframe_database import KeyframeDatabase
from duagc.pipeline.exchange.loop_closing import Tried
from duagc.pipeline.exchange.place_recognition import Candidate
from duagc.pipeline.exchange.verification import Verdict, Verified, verify
from duagc.pipeline.exchange.wire.loop_closing_wire import KeyframeSample, RectifiedFeatures
from duagc.pipeline.network.packets import MalformedError
from duagc.pipeline.registration.features import Features


@dataclass
class RectifiedSearch:
    """What was requested of a neighbor, what arrived, and what became of it.

    Attributes:
        wanted: keyframes of the neighbor whose rectified features are not here yet.
        features: those that arrived, by keyframe.
        tried: pairs of keyframes whose features agree on a motion, by own keyframe and the neighbor's.
        ended: all pairs were compared.
    """

    wanted: set[int]
    features: dict[int, Features] = field(default_factory=dict)
    tried: dict[tuple[int, int], Tried] = field(default_factory=dict)
    ended: bool = False

    def take(self, found: RectifiedFeatures) -> None:
        """Features of one keyframe.

        Raises:
            MalformedError: they were not requested, or came twice.
        """
        if found.keyframe not in self.wanted:
            raise MalformedError(f"rectified: keyframe {found.keyframe} was not requested, or came twice")
        self.wanted.remove(found.keyframe)
        self.features[found.keyframe] = found.features

    def compare(
        self,
        own: int,
        database: KeyframeDatabase,
        samples: Mapping[int, KeyframeSample],
        *,
        known: Collection[tuple[int, int]],
        seed: int,
    ) -> list[tuple[int, Verified]]:
        """Verify an own keyframe with every one of the neighbor.

        Args:
            own: the keyframe.
            database: own keyframes.
            samples: of the neighbor's, by keyframe.
            known: pairs that are loop closures already.
            seed: of this run.
        Returns:
            Keyframes of the neighbor whose features agree with the own ones on a motion, and what became of them.
        """
        found = list[tuple[int, Verified]]()
        plain, rectified = database.features[own], database.rectified(own)
        for keyframe, theirs in sorted(self.features.items()):
            if (own, keyframe) in known:
                continue
            ends = {"own": digest_of(plain, rectified), "peer": digest_of(samples[keyframe].features, theirs)}
            result = verify(
                Candidate(own, keyframe, 0),
                plain,
                database.pyramid(own),
                samples[keyframe],
                config=database.config.verification,
                rng=random_streams.generator(seed, "ransac.rectified", **ends),
                rectified=(rectified, theirs),
            )
            if result.verdict not in (Verdict.FEW_MATCHES, Verdict.FEW_INLIERS):
                found.append((keyframe, result))
        return found


def digest_of(*features: Features) -> str:
    """What a random stream of a pair of views is named by.

    Args:
        features: of one view.
    """
    return hashlib.sha256(b"".join(f.descriptors.tobytes() for f in features)).hexdigest()
