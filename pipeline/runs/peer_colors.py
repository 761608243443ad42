"""How a robot reads its peers' colors, as its fusion stage found out."""

from __future__ import annotations

from pathlib import Path

from duagc.pipeline.consensus.colors import ColorMap
from duagc.pipeline.messages import PeerColors
from duagc.pipeline.recording import read_log
from duagc.schemas import topics


def read_peer_colors(fused: Path, robot: str) -> dict[str, ColorMap]:
    """From every peer's colors to the robot's, by name of the peer.

    Args:
        fused: the robot's fused.mcap.
        robot: its name.
    Returns:
        Empty if the robot met no other.
    """
    found: list[PeerColors] = [
        record.message() for record in read_log(fused, (topics.PEER_COLORS.of(robot),))
    ]
    return {
        m.peer: ColorMap(m.gain, m.offset, m.gain_sigma, m.offset_sigma, matches=m.matches) for m in found
    }
