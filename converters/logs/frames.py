"""Where the sensors of a robot are: the transforms of a log that do not change."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from duagc.converters.logs.entries import Entry, stamp_ns
from duagc.converters.logs.files import Log
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
FARTHEST_M = 1e8  # also from the origin of a map of the earth
SAME = 1e-6  # meters and radians up to which a transform has not changed


class Transforms:
    """Frames tied together by constant transforms.

    Those of `tf_static` (latched or not, anywhere in the log) are constant; others only if all their messages say the
    same, as for the joints of a camera, or in Foxglove's logs, which know no `tf_static`.
    """

    def __init__(self, log: Log, namespace: str = "") -> None:
        """namespace: of the robot; transforms that other namespaces publish are not its own."""
        self._log = log
        topics = log.of_type(*TF_TYPES)
        own = [t for t in topics if t.startswith(f"{namespace}/") or t.count("/") == 1]
        own.sort(key=lambda t: t.count("/") > 1)  # the robot's own word counts last
        self._static_topics = [t for t in own if t.endswith("tf_static")]
        self._other_topics = [t for t in own if not t.endswith("tf_static")]
        self.moving: set[tuple[str, str]] = set()
        self._known: dict[tuple[str, str], Array] = {}
        for topic in self._static_topics:
            self._known.update(self._constant([topic]))
        self._complete = not self._other_topics

    def _constant(self, topics: list[str]) -> dict[tuple[str, str], Array]:
        """The transforms of some topics of which all messages say the same; what differs is `moving`.

        On /tf_static too: two robots may have published there, each its own frames by the same names.
        """
        found: dict[tuple[str, str], Array] = {}
        changed = set()
        for topic in topics:
            for entry in self._log.entries(topic):
                for _, parent, child, T in transforms_in(entry, f"{self._log.name}: {topic}"):
                    first = found.setdefault((parent, child), T)
                    if np.abs(first - T).max() > SAME:
                        changed.add((parent, child))
        constant = {pair: T for pair, T in found.items() if pair not in changed}
        self.moving = (self.moving | changed) - set(constant)
        return constant

    def lookup(self, target: str, source: str) -> Array | None:
        """T_target_source [4, 4]; None if nothing constant ties them together."""
        T = self._search(frame_name(target), frame_name(source))
        if T is None and not self._complete:
            self._complete = True
            self._known = {**self._constant(self._other_topics), **self._known}
            T = self._search(frame_name(target), frame_name(source))
        return T

    def moving_words(self) -> str:
        """What to add to a complaint that frames are not tied: those that are tied by what moves."""
        some = ", ".join(f"{parent} to {child}" for parent, child in sorted(self.moving)[:3])
        return f" (what changes is no extrinsic: {some})" if some else ""

    def _search(self, target: str, source: str) -> Array | None:
        reached = {target: np.eye(4)}
        queue = [target]
        while queue:
            at = queue.pop(0)
            for (parent, child), T in self._known.items():
                for other, step in ((child, T), (parent, se3.inverse(T))):
                    if at == (parent if other == child else child) and other not in reached:
                        reached[other] = reached[at] @ step
                        queue.append(other)
        return reached.get(source)


def transforms_in(entry: Entry, where: str) -> Iterator[tuple[int, str, str, Array]]:
    """Time of the header (ns), parent, child and T_parent_child [4, 4] of every transform of a message."""
    for t in entry.read().transforms:
        T = pose_matrix(t.transform.translation, t.transform.rotation, where)
        yield stamp_ns(t), frame_name(t.header.frame_id), frame_name(t.child_frame_id), T


def frame_name(name: str) -> str:
    """A frame without the slash that ROS 1 may put before it."""
    return name.removeprefix("/")


def pose_matrix(position: Any, orientation: Any, where: str) -> Array:
    """Matrix [4, 4] of a position and a quaternion with fields x, y, z, w.

    Raises:
        DuagError: the quaternion is no rotation, or the position is not finite.
    """
    q = np.array([orientation.w, orientation.x, orientation.y, orientation.z], dtype=np.float64)
    if not np.isfinite(q).all() or np.abs(q).max() > 2 or abs(np.linalg.norm(q) - 1) > 0.01:
        raise DuagError(f"{where}: quaternion wxyz {q.tolist()}, expected one of length 1")
    t = np.array([position.x, position.y, position.z], dtype=np.float64)
    if not np.abs(t).max() < FARTHEST_M:
        raise DuagError(f"{where}: position {t.tolist()}, expected meters, less than {FARTHEST_M:g}")
    return np.asarray(se3.from_quat_translation(q, t))
