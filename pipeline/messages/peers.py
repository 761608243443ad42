"""Messages of what a robot found out about its peers' maps and cameras."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from duagc import schemas
from duagc.pipeline.base.arrays import Array, array_bytes
from duagc.pipeline.messages.parts import numbers, pack_stamp, unpack_array, unpack_stamp


@dataclass(frozen=True)
class PeerMapReport:
    """The check of one peer's map against own images.

    Attributes:
        stamp_ns: end of the run.
        robot: that checked.
        peer: robot that sent the map.
        gaussians: Gaussians that it sent.
        too_large: of them, not used because no mapper makes any that large.
        contradicted: of them, not used because own images contradict them.
        matches: of the peer with this robot.
        rejected_matches: of them, found to be false.
        compared_px: own pixels on which the map was compared.
        own_px: all own pixels.
        color_mse: mean squared error of the map's colors on the compared pixels, colors 0..1.
        color_variance: of the own colors there.
        used: whether anything of the map is used.
        reason: why nothing of the map is used; empty if it is used.
    """

    schema: ClassVar[str] = "duagc.v1.PeerMapReport"

    stamp_ns: int
    robot: str
    peer: str
    gaussians: int
    too_large: int
    contradicted: int
    matches: int
    rejected_matches: int
    compared_px: int
    own_px: int
    color_mse: float
    color_variance: float
    used: bool
    reason: str

    def pack(self) -> Any:
        """duagc.v1.PeerMapReport."""
        message = schemas.new("PeerMapReport", **{name: getattr(self, name) for name in _reported()})
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> PeerMapReport:
        """From duagc.v1.PeerMapReport.

        Args:
            m: the protobuf message.
        """
        return PeerMapReport(stamp_ns=unpack_stamp(m), **{name: getattr(m, name) for name in _reported()})


def _reported() -> list[str]:
    """Fields of a PeerMapReport that have the same name and type in the message."""
    return [field.name for field in fields(PeerMapReport) if field.name != "stamp_ns"]


@dataclass(frozen=True, eq=False)
class RejectedMatches:
    """Matches of two robots that a robot did not use, though it has both Gaussians of each.

    Attributes:
        stamp_ns: end of the run.
        robot: that decided.
        lower: one of the matched robots.
        higher: the other one, the later name.
        ids: int64 [n, 2], of the Gaussians of the two.
    """

    schema: ClassVar[str] = "duagc.v1.RejectedMatches"

    stamp_ns: int
    robot: str
    lower: str
    higher: str
    ids: NDArray[np.int64]

    def pack(self) -> Any:
        """duagc.v1.RejectedMatches."""
        message = schemas.new(
            "RejectedMatches",
            robot=self.robot,
            lower=self.lower,
            higher=self.higher,
            count=len(self.ids),
            ids_int64=array_bytes(self.ids, "int64"),
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> RejectedMatches:
        """From duagc.v1.RejectedMatches.

        Args:
            m: the protobuf message.

        Raises:
            DuagError: an array of another length than the number of matches asks for.
        """
        ids = unpack_array(m.ids_int64, "int64", (m.count, 2), "RejectedMatches.ids")
        return RejectedMatches(unpack_stamp(m), m.robot, m.lower, m.higher, ids)


@dataclass(frozen=True, eq=False)
class PeerColors:
    """How a peer's camera shows colors in the robot's own: a color c of the peer's is gain * c + offset here.

    Attributes:
        stamp_ns: end of the run.
        robot: by whose estimate.
        peer: whose camera.
        gain: [3], by channel.
        offset: [3], colors 0..1.
        gain_sigma: [3], relative standard deviation.
        offset_sigma: [3], standard deviation in the middle of the colors that were compared.
        matches: pairs of Gaussians that were compared.
    """

    schema: ClassVar[str] = "duagc.v1.PeerColors"

    stamp_ns: int
    robot: str
    peer: str
    gain: Array
    offset: Array
    gain_sigma: Array
    offset_sigma: Array
    matches: int

    def pack(self) -> Any:
        """duagc.v1.PeerColors."""
        message = schemas.new(
            "PeerColors",
            robot=self.robot,
            peer=self.peer,
            gain=self.gain,
            offset=self.offset,
            gain_sigma=self.gain_sigma,
            offset_sigma=self.offset_sigma,
            matches=self.matches,
        )
        pack_stamp(message, self.stamp_ns)
        return message

    @staticmethod
    def unpack(m: Any) -> PeerColors:
        """From duagc.v1.PeerColors.

        Args:
            m: the protobuf message.

        Raises:
            DuagError: a gain, offset or deviation of other than three numbers.
        """

        def channels(field: str) -> Array:
            return numbers(getattr(m, field), (3,), f"PeerColors.{field}")

        return PeerColors(
            stamp_ns=unpack_stamp(m),
            robot=m.robot,
            peer=m.peer,
            gain=channels("gain"),
            offset=channels("offset"),
            gain_sigma=channels("gain_sigma"),
            offset_sigma=channels("offset_sigma"),
            matches=m.matches,
        )
