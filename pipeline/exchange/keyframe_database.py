"""A robot's own keyframes as loop closing needs them: features, pyramids of images, what others may request."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from duagc.pipeline.base.ahead import in_order
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.recall import Recalling, computed
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange.own_graph import OwnGraph
from duagc.pipeline.exchange.view_overlap import overlaps
from duagc.pipeline.exchange.wire import loop_closing_wire
from duagc.pipeline.exchange.wire.loop_closing_wire import DescriptorSet, KeyframeSample
from duagc.pipeline.geometry.camera import PinholeCamera
from duagc.pipeline.posegraph.loop_closures import KeyframePoses, drift
from duagc.pipeline.posegraph.relative_poses import LoopClosure, RelativePoses
from duagc.pipeline.posegraph.surface_agreement import coarse_depth, surface_agreement
from duagc.pipeline.registration import Reference, RgbdPyramid
from duagc.pipeline.registration.features import Features, extract, gray_of
from duagc.pipeline.registration.rectified_features import extract_rectified
from duagc.pipeline.runs.keyframe_images import Images
from duagc.pipeline.runs.robot_data import RobotData

PYRAMIDS_KEPT = 12
KEYFRAMES_TOGETHER = 16
"""Keyframes whose features are computed, and kept for an exchange that begins again, together."""


class KeyframeDatabase:
    """A robot's own keyframes as others may request them; computed when first needed."""

    def __init__(self, data: RobotData, config: ExchangeConfig, recall: Recalling = computed) -> None:
        """Lay out the own graph; images are read when they are needed.

        Args:
            data: of this robot.
            config: the same at all robots.
            recall: slow results; they change no bit.
        """
        self.data, self.config, self.recall = data, config, recall
        self._pyramid = lru_cache(maxsize=PYRAMIDS_KEPT)(self._build_pyramid)
        self._features: list[Features] | None = None
        self._rectified: dict[int, Features] = {}
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
            for first in range(0, self.data.keyframes, KEYFRAMES_TOGETHER):
                keyframes = range(first, min(first + KEYFRAMES_TOGETHER, self.data.keyframes))
                name = f"features {self.data.robot} {first}"
                for features, depth_m in self.recall(name, partial(self._all_seen, keyframes)):
                    self._features.append(features)
                    self._coarse_depths.append(depth_m)
        return self._features

    @property
    def coarse_depths(self) -> list[NDArray[np.float32]]:
        """Depth of every keyframe at low resolution, meters; found together with the features."""
        if self._features is None:
            _ = self.features
        return self._coarse_depths

    def _all_seen(self, keyframes: range) -> list[tuple[Features, NDArray[np.float32]]]:
        """Features of keyframes, and their depth at low resolution; by threads."""
        return list(in_order(self._seen, map(self.data.images, keyframes)))

    def _seen(self, images: Images) -> tuple[Features, NDArray[np.float32]]:
        most = self.config.places.features_per_keyframe
        features = extract(images.color, images.depth_m, self.data.camera, most, mask=images.mask)
        return features, coarse_depth(images.depth_m)

    def rectified(self, keyframe: int) -> Features:
        """Features of the surfaces that a keyframe sees from the side, as if the camera faced them.

        Args:
            keyframe: its index.
        """
        if keyframe not in self._rectified:
            self._rectified[keyframe] = self.recall(
                f"rectified features {self.data.robot} {keyframe}", partial(self._faced, keyframe)
            )
        return self._rectified[keyframe]

    def _faced(self, keyframe: int) -> Features:
        c = self.config.places
        gray = gray_of(self.data.images(keyframe).color)
        return extract_rectified(gray, self.pyramid(keyframe), c.features_per_keyframe, c.rectified_planes)

    def agreement(self, samples: Sequence[NDArray[np.floating]], T_first_peer: Array) -> float:
        """How well own depth images agree with a neighbor's samples.

        Args:
            samples: of each of the k keyframes, points [m, 3], meters, in its camera frame.
            T_first_peer: [k, 4, 4], these keyframes as seen from the first own keyframe.

        Returns:
            Share of the samples that own keyframes see at the same place, 0 to 1.
        """
        return surface_agreement(
            self.coarse_depths,
            self.data.camera,
            samples,
            T_ownmap_keyframe=self.graph.T_first_keyframe,
            T_ownmap_peer=T_first_peer,
        )

    def overlaps(
        self, closures: Sequence[LoopClosure], peer: KeyframePoses, peer_camera: PinholeCamera
    ) -> dict[tuple[int, int], float]:
        """How much of own views a neighbor's keyframes should see, by both, near loop closures with it.

        Args:
            closures: verified, from the own side.
            peer: the neighbor's keyframes, in any one frame.
            peer_camera: of the neighbor.

        Returns:
            Share of the own view, 0 to 1, by own keyframe and the neighbor's.
        """
        return overlaps(
            closures,
            self.coarse_depths,
            self.data.camera,
            peer_camera,
            own=self.graph.from_first,
            peer=peer,
        )

    def pyramid(self, keyframe: int) -> RgbdPyramid:
        """Images of a keyframe at several resolutions.

        Args:
            keyframe: its index.
        """
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
        return bytes.fromhex(digest_of(*self.features))[: loop_closing_wire.DIGEST_BYTES]

    def descriptors(self) -> DescriptorSet:
        """What a neighbor gets to recognize places."""
        most = self.config.places.features_per_place
        compact = [f.descriptors[:most] for f in self.features]
        return DescriptorSet(compact, self.graph.T_first_keyframe, self.graph.drift, self.data.camera)

    def sample(self, keyframe: int) -> KeyframeSample:
        """What a neighbor gets to verify loop closures with one keyframe.

        Args:
            keyframe: its index.
        """
        reference = Reference.sample(self.pyramid(keyframe), self.config.verification.samples)
        return KeyframeSample(keyframe, self.features[keyframe], reference)


def digest_of(*features: Features) -> str:
    """SHA-256 of descriptors, which names what a robot or a view shows.

    Args:
        features: of some views, or of several kinds.
    """
    return hashlib.sha256(b"".join(f.descriptors.tobytes() for f in features)).hexdigest()
