"""The exchange of a finished run once more, under faults and other conditions: what they do to the team's error.

The front ends are those of the run; the exchange is done again with few of the Gaussians, on which poses do not
depend. Ground truth is read here alone. Each check says what it compares with and what the largest difference was.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from duagc.pipeline.base import random_streams
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.progress import track
from duagc.pipeline.bench.tables import markdown
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.evaluation import groundtruth, trajectory_errors
from duagc.pipeline.evaluation.results import Absent
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.geometry import se3
from duagc.pipeline.geometry.trajectory import Trajectory
from duagc.pipeline.recording import Recording, read_log
from duagc.pipeline.runs.folder import RunFolder
from duagc.pipeline.runs.robot_data import AgentInput, RobotData, SessionResult, load
from duagc.schemas import topics

CHECKS = ("frames", "names", "closures", "loss", "silence", "solver")
FALSE_CLOSURES = 0.2
LOSSES = (0.3, 0.6, 0.9)
GAUSSIANS = 300  # of each map that are exchanged
MOST_ORDERS = 24  # of names
MAP_OFFSET_M = 10.0


@dataclass(frozen=True)
class FaultySession:
    """One exchange: what it is called, with which data, settings and seed; names by the run's own names."""

    name: str
    data: Sequence[RobotData]
    config: ExchangeConfig
    seed: int
    names: dict[str, str]


class TeamBench:
    """A run's team, ready to meet again and again."""

    def __init__(self, run: RunFolder, recording: Recording, config: ExchangeConfig, seed: int) -> None:
        """Load the robots of the run, each with few of its Gaussians, and their ground truth.

        Args:
            run: a finished run.
            recording: that the run was made of.
            config: of the run's exchange.
            seed: of the run.

        Raises:
            DuagError: the run has one robot, or a robot has no ground truth.
        """
        if len(run.robots) < 2:
            raise DuagError(f"{run.path}: has one robot, expected two or more")
        self.run, self.config, self.seed = run, config, seed
        self.data = [thinned(load(_input(run, recording, robot))) for robot in run.robots]
        self.truth = {}
        for robot in run.robots:
            true = groundtruth.trajectory(recording, robot)
            if isinstance(true, Absent):
                raise DuagError(
                    f"{recording.path}: {robot} has no ground truth, expected a trajectory to measure"
                )
            self.truth[robot] = true

    def measure(self, session: FaultySession) -> dict[str, Any]:
        """Let the team meet and measure the result; lengths in meters.

        Args:
            session: data, settings and seed.
        """
        with tempfile.TemporaryDirectory(prefix="duagc-bench-") as folder:
            exchange = Path(folder) / "exchange.mcap"
            results = run_session_of(
                session.data,
                session.config,
                seed=session.seed,
                exchange_path=exchange,
                consensus_path=Path(folder) / "consensus.mcap",
            )
            topic = topics.EXCHANGE_SUMMARY.pattern
            summary = next(record.message() for record in read_log(exchange, topics=[topic]))
        found = {robot: results[name] for robot, name in session.names.items()}
        closures = [c for r in results.values() for c in r.closures if c.T_own_peer is not None]
        rounds = [r.rounds_to_agreement for r in results.values()]
        return {
            "case": session.name,
            "seed": session.seed,
            "robots_together": max(len(r.component) for r in results.values()),
            "team_ate_rmse_m": self._team_ate(found, session.names),
            "rounds_to_agreement": None if None in rounds else max(r for r in rounds if r is not None),
            "converged": all(r.converged for r in results.values()),
            "bytes": summary.bytes_sent,
            "closures_kept": sum(c.verdict == "kept" for c in closures),
            "closures_measured": len(closures),
            "false_closures_kept": sum(c.verdict == "kept" and "injected" in c.detail for c in closures),
            "as_if_alone": all(
                np.array_equal(r.T_world_keyframe, d.T_map_keyframe) and len(r.component) == 1
                for d, r in ((d, results[d.robot]) for d in session.data)
            ),
        }

    def _team_ate(self, found: dict[str, SessionResult], names: dict[str, str]) -> float | None:
        """One alignment for all; None unless all robots share one world."""
        if any(len(r.component) < len(names) for r in found.values()):
            return None
        pairs = {}
        for robot, result in found.items():
            frames = [f for f in self.run.robots[robot].frames if f.status != "lost"]
            stamps = np.array([f.stamp_ns for f in frames], dtype=np.int64)
            T_world_camera = np.array(
                [result.T_world_keyframe[f.keyframe_index] @ f.T_keyframe_camera for f in frames]
            )
            pairs[robot] = trajectory_errors.pair(self.truth[robot], Trajectory(stamps, T_world_camera))
        error = trajectory_errors.team_error(pairs)
        return None if isinstance(error, Absent) else float(error.ate_rmse_m)

    # --- what is tried

    def session(self, name: str, seed: int | None = None, **changes: Any) -> FaultySession:
        """The run's own exchange with some settings changed.

        Args:
            name: of the case.
            seed: of the session; None: that of the run.
            changes: settings of the exchange by name.
        """
        config = self.config.model_copy(update=changes)
        same = {d.robot: d.robot for d in self.data}
        return FaultySession(name, self.data, config, self.seed if seed is None else seed, same)

    def frames(self, seeds: int) -> Iterator[FaultySession]:
        """Every map in a frame of its own, drawn anew.

        Args:
            seeds: how many times.
        """
        for seed in range(seeds):
            base = self.session("frames")
            yield replace(base, data=[moved(d, seed) for d in self.data])

    def names(self, seeds: int) -> Iterator[FaultySession]:
        """The robots under each other's names.

        Args:
            seeds: not used.
        """
        names = [d.robot for d in self.data]
        for order in itertools.islice(itertools.permutations(names), 1, MOST_ORDERS):
            new = dict(zip(names, order, strict=True))
            base = self.session("names")
            yield replace(base, data=[renamed(d, new[d.robot]) for d in self.data], names=new)

    def closures(self, seeds: int) -> Iterator[FaultySession]:
        """False closures among the true ones.

        Args:
            seeds: how many times, each with other false closures.
        """
        faults = self.config.injection.model_copy(update={"false_closures": FALSE_CLOSURES})
        for seed in range(seeds):
            yield self.session("closures", seed, injection=faults)

    def loss(self, seeds: int) -> Iterator[FaultySession]:
        """Packets lost independently; as many rounds as it takes.

        Args:
            seeds: how many times at each loss.
        """
        for loss in LOSSES:
            for seed in range(seeds):
                link = self.config.link.model_copy(update={"loss_probability": loss})
                yield self.session(f"loss {loss:g}", seed, link=link, max_rounds=20_000)

    def silence(self, seeds: int) -> Iterator[FaultySession]:
        """Everything is lost.

        Args:
            seeds: not used.
        """
        yield self.session("silence", link=self.config.link.model_copy(update={"loss_probability": 1.0}))

    def solver(self, seeds: int) -> Iterator[FaultySession]:
        """The other solver of the poses.

        Args:
            seeds: not used.
        """
        other = "elimination" if self.config.solver == "admm" else "admm"
        yield self.session(other, solver=other)


def run(
    run_folder: RunFolder,
    recording: Recording,
    config: ExchangeConfig,
    *,
    seed: int,
    checks: Sequence[str],
    seeds: int,
) -> dict[str, Any]:
    """Every session of the checks asked for, compared with the undisturbed one.

    Args:
        run_folder: of a finished run.
        recording: that the run was made of.
        config: of the run's exchange.
        seed: of the run.
        checks: some of CHECKS.
        seeds: how often what is drawn is drawn.
    Returns:
        "base" and "rows", a row per session; "worst" per case: the largest difference of the team's error (m, share).
    """
    bench = TeamBench(run_folder, recording, config, seed)
    base = bench.measure(bench.session("base"))
    makers: dict[str, Callable[[int], Iterator[FaultySession]]] = {
        name: getattr(bench, name) for name in CHECKS
    }
    sessions = [session for check in checks for session in makers[check](seeds)]
    rows = [bench.measure(session) for session in track(iter(sessions), "bench team", total=len(sessions))]
    worst: dict[str, Any] = {}
    for row in rows:
        ate, of = row["team_ate_rmse_m"], base["team_ate_rmse_m"]
        entry = worst.setdefault(
            row["case"], {"sessions": 0, "apart": 0, "difference_m": None, "share": None}
        )
        entry["sessions"] += 1
        if ate is None or of is None:
            entry["apart"] += 1
            continue
        for name, value in (("difference_m", abs(ate - of)), ("share", ate / of - 1)):
            entry[name] = value if entry[name] is None else max(entry[name], value)
    return {"base": base, "worst": worst, "rows": rows}


def thinned(data: RobotData) -> RobotData:
    """The same robot with few of its Gaussians, evenly spread.

    Args:
        data: of a robot.
    """
    count = len(data.gaussians)
    keep = np.unique(np.linspace(0, count - 1, min(count, GAUSSIANS)).astype(np.int64))
    i = data.information
    information = replace(
        i,
        ids=i.ids[keep],
        geometry=i.geometry[keep],
        color=i.color[keep],
        opacity=i.opacity[keep],
        observations=i.observations[keep],
        deviation_m=i.deviation_m[keep],
    )
    return replace(data, gaussians=data.gaussians.select(keep), information=information)


def moved(data: RobotData, seed: int) -> RobotData:
    """The same robot with another map frame.

    Args:
        data: of a robot.
        seed: of the frame's offset and rotation.
    """
    rng = random_streams.generator(seed, "bench.map_frame", robot=data.robot)
    offset = MAP_OFFSET_M * rng.normal(size=(1, 3))
    T = se3.from_quat_translation(rng.normal(size=(1, 4)), offset) @ data.T_map_keyframe
    return replace(data, T_map_keyframe=T, gaussians=data.gaussians.moved(data.T_map_keyframe, T))


def renamed(data: RobotData, name: str) -> RobotData:
    """The same robot under another name.

    Args:
        data: of a robot.
        name: the other name.
    """
    return replace(data, robot=name, information=replace(data.information, robot=name))


def _input(run: RunFolder, recording: Recording, robot: str) -> AgentInput:
    folder = run.robots[robot].folder
    files = recording.log(robot), folder / "frontend.mcap", folder / "information.mcap"
    return AgentInput(robot, *files, thickness_floor_m=run.config.thickness_floor_m)


def format_table(result: dict[str, Any]) -> str:
    """One line per session, then the worst of every case.

    Args:
        result: of `run`.
    """
    head = ["case", "seed", "together", "team ATE, mm", "rounds", "MB", "closures", "false kept", "alone"]
    rows = []
    for row in [result["base"], *result["rows"]]:
        ate = row["team_ate_rmse_m"]
        cells = [
            row["case"],
            row["seed"],
            row["robots_together"],
            None if ate is None else f"{1e3 * ate:.6f}",
            row["rounds_to_agreement"],
            f"{row['bytes'] / 1e6:.2f}",
            f"{row['closures_kept']} of {row['closures_measured']}",
            row["false_closures_kept"],
            "yes" if row["as_if_alone"] else "no",
        ]
        rows.append(cells)
    lines = markdown(head, rows)
    for case, entry in result["worst"].items():
        found = "nothing to compare"
        if entry["difference_m"] is not None:
            found = (
                f"team ATE differs by {entry['difference_m']:.1e} m at most, "
                f"is larger by {100 * entry['share']:.2f} % at most"
            )
        lines.append(f"{case}: {entry['sessions']} sessions, {entry['apart']} not together; {found}")
    return "\n".join(lines)
