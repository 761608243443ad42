"""Meetings of up to three robots in the small room of `make_robot`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.geometry import se3
from duagc.pipeline.runs.robot_data import RobotData, SessionResult

Team = dict[str, tuple[RobotData, np.ndarray]]
"""Data of robots by name, and the truth: T_world_camera of their keyframes."""
NAMES = ("alpha", "bravo", "charlie")


def meet(team: Team, robots: int, folder: Path, seed: int = 0, **config: Any) -> dict[str, SessionResult]:
    data = [team[name][0] for name in NAMES[:robots]]
    return run_session_of(
        data,
        ExchangeConfig(**config),
        seed=seed,
        exchange_path=folder / "exchange.mcap",
        consensus_path=folder / "consensus.mcap",
    )


def error_m(result: SessionResult, team: Team) -> float:
    """Largest distance of an own keyframe from the truth, in the map frame of the lowest-named robot."""
    T_true = se3.inverse(team[result.component[0]][1][0]) @ team[result.robot][1]
    return float(se3.distance(T_true, result.T_world_keyframe)[0].max())
