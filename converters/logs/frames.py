"""Where the sensors of a robot are: the transforms of a log that do not change."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from duagc.converters.logs.entries import Entry, stamp_ns
from duagc.converters.logs.files import Log, is_below
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.geometry import se3

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
FARTHEST_M = 1e8  # also from the origin of a map of the earth
UNIT, ROUGH_UNIT = 0.01, 0.1  # by which a quaternion may miss the length 1; and be normalized with a warning
UPRIGHT = np.sqrt(0.5)  # cosine of the angle between two z axes
SAME = 1e-6  # meters and radians up to which a transform has not changed


class Transforms:
    """Frames tied together by constant transforms.

    Those of `tf_static` (latched or not, anywhere in the log) are constant; others only if all their messages say the
    same, as for the joints of a camera, or in Foxglove's logs, which know no `tf_static`.
    """

    def __init__(self, log: Log, namespace: str = "", warnings: list[str] | None = None) -> None:
        """Read the constant transforms of `tf_static`; other topics are read when they are needed.

        Args:
            log: the log.
            namespace: of the robot; transforms that other namespaces publish are not its own.
            warnings: gets what was left out.
        """
        self._log = log
        self.warnings = [] if warnings is None else warnings
        topics = log.of_type(*TF_TYPES)
        own = [t for t in topics if is_below(t, namespace) or "/" not in t.lstrip("/")]
        self._static_topics = [t for t in own if t.endswith("tf_static")]
        self._other_topics = [t for t in own if not t.endswith("tf_static")]
        self._topics = own
        self.moving: set[tuple[str, str]] = set()
        self._known: dict[tuple[str, str], Array] = {}
        self._broken: dict[tuple[str, str], str] = {}  # why, of those that no message states well
        for namespaced in (False, True):  # the robot's own word counts last
            stating = [t for t in self._static_topics if ("/" in t.lstrip("/")) is namespaced]
            self._known.update(self._constant(stating))
        self._known = {pair: T for pair, T in self._known.items() if pair not in self.moving}
        self._complete = not self._other_topics

    def _constant(self, topics: list[str]) -> dict[tuple[str, str], Array]:
        """The transforms of some topics of which all messages say the same; what differs is `moving`.

        On /tf_static too: two robots may have published there, or on topics of their own, each its own frames by the
        same names.
        """
        found: dict[tuple[str, str], Array] = {}
        changed = set()
        for topic in topics:
            unsound = Unsound()
            for entry in self._log.entries(topic):
                with self._log.invalid.left_out(entry):
                    for _, parent, child, T in transforms_in(entry, f"{self._log.name}: {topic}", unsound):
                        first = found.setdefault((parent, child), T)
                        if np.abs(first - T).max() > SAME:
                            changed.add((parent, child))
            self.warnings += [*unsound.words(topic, "transforms"), *self._log.invalid.words([topic])]
            self._broken.update(unsound.broken)
        self._broken = {pair: why for pair, why in self._broken.items() if pair not in found}
        constant = {pair: T for pair, T in found.items() if pair not in changed}
        self.moving = (self.moving | changed) - set(constant)
        return constant

    def lookup(self, target: str, source: str) -> Array | None:
        """T_target_source [4, 4]; None if nothing constant ties them together, or one has no name.

        Args:
            target: frame, with or without a slash before it.
            source: frame, the same.

        Raises:
            DuagError: only a transform that is none does, or nothing does and most messages of transforms are none.
        """
        if not (frame_name(target) and frame_name(source)):
            return None
        T = self._search(frame_name(target), frame_name(source))
        if T is None and not self._complete:
            self._complete = True
            self._known = {**self._constant(self._other_topics), **self._known}
            T = self._search(frame_name(target), frame_name(source))
        if T is None and self._broken:
            known, self._known = self._known, {**self._known, **dict.fromkeys(self._broken, np.eye(4))}
            needed = self._search(frame_name(target), frame_name(source)) is not None
            self._known = known
            if needed:
                raise DuagError("; ".join(sorted(set(self._broken.values()))))
        if T is None:
            self._log.invalid.check(self._topics)
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


class Unsound:
    """Counts poses and transforms that are none, and those whose quaternion is not quite of length 1."""

    def __init__(self) -> None:
        self.count = self.rough = 0
        self.broken: dict[tuple[str, str], str] = {}  # by parent and child: why

    def matrix(self, position: Any, orientation: Any, where: str, pair: tuple[str, str]) -> Array | None:
        """As `pose_matrix`; None where that is none.

        Args:
            position: with fields x, y, z.
            orientation: with fields x, y, z, w.
            where: begins the line of an error.
            pair: parent and child, whose transform it is.
        """
        try:
            T = pose_matrix(position, orientation, where)
        except DuagError as error:
            self.count += 1
            self.broken.setdefault(pair, str(error))
            return None
        length = np.linalg.norm([orientation.w, orientation.x, orientation.y, orientation.z])
        self.rough += bool(abs(length - 1) > UNIT)
        return T

    def words(self, topic: str, what: str) -> list[str]:
        """What to warn of.

        Args:
            topic: of the messages.
            what: they hold.
        """
        out = []
        if self.count:
            names = sorted({f" ({' '.join(pair)})" for pair in self.broken if any(pair)})
            out.append(
                f"{topic}: {self.count} {what} without a rotation or a finite position{''.join(names[:3])}; left out"
            )
        if self.rough:
            out.append(f"{topic}: {self.rough} {what} whose quaternion has not length 1; normalized")
        return out


def transforms_in(entry: Entry, where: str, unsound: Unsound) -> Iterator[tuple[int, str, str, Array]]:
    """Time of the header (ns), parent, child and T_parent_child [4, 4] of every sound transform of a message.

    Args:
        entry: a message of transforms.
        where: begins the line of an error or warning.
        unsound: gets the transforms that are none; they are left out.
    """
    for t in entry.read().transforms:
        parent, child = frame_name(t.header.frame_id), frame_name(t.child_frame_id)
        T = unsound.matrix(t.transform.translation, t.transform.rotation, where, (parent, child))
        if T is not None:
            yield stamp_ns(t), parent, child, T


def body_axes_of_camera(color_frame: str, frame: str, T: Array, option: str) -> list[str]:
    """What to warn of where the color camera's frame may have x forward and z up, which images never have.

    Args:
        color_frame: of the color camera.
        frame: of a body or an IMU.
        T: [4, 4], ties them, by the log's transforms.
        option: states the same.
    """
    named = any("optical" in name.lower() for name in (color_frame, frame))
    if named or frame_name(color_frame) == frame_name(frame) or T[2, 2] < UPRIGHT:
        return []
    return [
        f"{color_frame!r} is taken as an optical frame (z forward), but its z axis is that of {frame!r}: "
        f"if that is up, expected --set {option}='x y z qw qx qy qz' of the optical frame"
    ]


def frame_name(name: str) -> str:
    """A frame without the slash that ROS 1 may put before it.

    Args:
        name: as a message has it.
    """
    return name.removeprefix("/")


def pose_matrix(position: Any, orientation: Any, where: str) -> Array:
    """Matrix [4, 4] of a position and a quaternion with fields x, y, z, w.

    Args:
        position: fields x, y, z, meters.
        orientation: quaternion of unit length, fields x, y, z, w.
        where: begins the line of an error.

    Raises:
        DuagError: the quaternion is no rotation, or the position is not finite.
    """
    q = np.array([orientation.w, orientation.x, orientation.y, orientation.z], dtype=np.float64)
    if not np.isfinite(q).all() or np.abs(q).max() > 2 or abs(np.linalg.norm(q) - 1) > ROUGH_UNIT:
        raise DuagError(f"{where}: quaternion wxyz {q.tolist()}, expected one of length 1")
    t = np.array([position.x, position.y, position.z], dtype=np.float64)
    if not np.abs(t).max() < FARTHEST_M:
        raise DuagError(f"{where}: position {t.tolist()}, expected meters, less than {FARTHEST_M:g}")
    return np.asarray(se3.from_quat_translation(q, t))
