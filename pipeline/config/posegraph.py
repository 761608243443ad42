"""Settings of a run on a pose graph."""

from typing import Literal

from pydantic import Field

from duagc.pipeline.config.base import Config
from duagc.pipeline.config.consensus import LoopClosureConfig, PoseConsensusConfig, TeamSchedule

Solver = Literal["admm", "elimination", "paper"]
Robust = Literal["none", "gnc"]

_ROBUST_PENALTY = 0.1


class GivenLoopClosureConfig(LoopClosureConfig):
    """Loop closures with covariances that count as they are."""

    sigma_floor_m: float = Field(default=0.0, ge=0.0)
    """Added to every loop closure's covariance (m)."""
    sigma_floor_rad: float = Field(default=0.0, ge=0.0)
    """The same for its rotation (rad)."""


_OF_A_FILE = GivenLoopClosureConfig(
    drift_floor_m=0, drift_floor_rad=0, min_support=1, frame_sigma_m=5.0, frame_sigma_rad=0.1
)


class TeamConsensusConfig(PoseConsensusConfig):
    """Pose consensus where loop closures come from a file, and most of them may be false."""

    first_mu: float = Field(default=1e-3, gt=0.0)
    """Least first mu between robots, whose own graphs and relative frames are robust already; a robot alone begins at
    the least mu."""
    checks: int = Field(default=12, ge=0)
    """After the schedule, truncate anew at most so often, until nothing changes any more and the link is steady."""
    check_packets: int = Field(default=10, ge=1)
    """Packets received between two of these."""
    drop_idle: bool = True
    """After the schedule, share only keyframes that a loop closure with weight names: the others slow the rest."""
    closures: GivenLoopClosureConfig = GivenLoopClosureConfig()
    """Noise and consistency of loop closures."""

    def team_schedule(self) -> TeamSchedule:
        """What is added to the schedule of robust weights."""
        if not self.robust:
            return TeamSchedule()
        return TeamSchedule(self.first_mu, self.checks, self.check_packets, self.drop_idle)


class PoseGraphConfig(Config):
    """One run: the same at every robot. The weights of the file count as they are, without floors."""

    solver: Solver = "admm"
    """admm: relaxed edge-ADMM; elimination: exact steps along a tree of robots; paper: the printed iteration."""
    loss_probability: float = Field(default=0.0, ge=0.0, le=1.0)
    """Chance that a packet is lost, independent of every other packet."""
    seed: int = 0
    """Of the losses; nothing else is random."""
    max_rounds: int = Field(default=5000, ge=1)
    """A round is one burst of every robot to every neighbor; the run ends here whatever has been agreed."""
    consensus: TeamConsensusConfig = TeamConsensusConfig(
        tolerance=1e-5,
        wire="float32",
        odometry_floor_m=0,
        odometry_floor_rad=0,
        closures=_OF_A_FILE,
        robust=False,
        robust_skip=False,
        robust_convexity=0.0,
    )
    """Shared by all solvers: robust weights, tolerance, and what only edge-ADMM uses."""
    elimination_tolerance: float = Field(default=1e-7, gt=0.0)
    """The exact steps end when nothing moves more than this (m, rad)."""
    elimination_wire: Literal["float32", "float64"] = "float64"
    """Precision of the matrices on the wire; float32 halves the bytes, and slows ill-conditioned graphs."""
    paper_penalty: float = Field(default=0.01, gt=0.0)
    """rho of the printed iteration, as a multiple of the closures' information; larger ones diverge sooner."""


def settings(
    solver: Solver = "admm",
    robust: Robust = "none",
    *,
    loss: float = 0.0,
    seed: int = 0,
    max_rounds: int = 5000,
) -> PoseGraphConfig:
    """Settings of the command line.

    Args:
        solver: of the distributed problem.
        robust: "gnc": loop closures get robust weights; "none": all count.
        loss: probability that a packet is lost, 0..1.
        seed: of all random streams.
        max_rounds: after which the run ends.

    Raises:
        pydantic.ValidationError: a value out of range.
    """
    default = PoseGraphConfig()
    consensus = default.consensus
    if robust == "gnc":  # penalties stay as they are while weights change, and long chains want small ones
        consensus = consensus.model_copy(
            update={
                "robust": True,
                "penalty_start": _ROBUST_PENALTY,
            }
        )
    return PoseGraphConfig(
        solver=solver, loss_probability=loss, seed=seed, max_rounds=max_rounds, consensus=consensus
    )
