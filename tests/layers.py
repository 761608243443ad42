"""The parts of the tree, lowest first: what each is for, and what it may import.

One table: `tests/test_layers.py` holds the code to it, and `python -m tests.layers` draws it into
docs/explanation/architecture.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "explanation" / "architecture.md"
BEGIN, END = "<!-- layers:begin -->", "<!-- layers:end -->"


@dataclass(frozen=True)
class Part:
    """One part of the tree.

    Attributes:
        name: folder or module of `pipeline/`, or a folder of the root.
        purpose: what it is for.
        uses: parts that it may import, besides itself.
        estimator: whether it computes what robots know; such a part cannot name ground truth.
    """

    name: str
    purpose: str
    uses: frozenset[str]
    estimator: bool = False

    @property
    def folder(self) -> Path:
        """Where it is."""
        top = ROOT / self.name
        return top if top.is_dir() else ROOT / "pipeline" / self.name


def _part(name: str, purpose: str, *uses: str, estimator: bool = False) -> Part:
    return Part(name, purpose, frozenset(word for group in uses for word in group.split()), estimator)


_ARRAYS = "base config geometry"
_MATHEMATICS = "base config geometry splat kernels registration"
_LOGS = "schemas messages recording"

LAYERS: tuple[tuple[Part, ...], ...] = (
    (
        _part("schemas", "messages and topics"),
        _part("base", "errors, files, processes, random streams", estimator=True),
    ),
    (
        _part("config", "every setting", "base", estimator=True),
        _part("geometry", "SO(3), SE(3), cameras, trajectories", "base", estimator=True),
    ),
    (
        _part("splat", "Gaussians, losses, seeding, optimizer", _ARRAYS, estimator=True),
        _part("posegraph", "relative poses, solvers, loop closures", _ARRAYS, estimator=True),
        _part("network", "packets, transport, link model", "base config", estimator=True),
    ),
    (
        _part("kernels", "rasterizer, registration", _ARRAYS, "splat", estimator=True),
        _part("messages", "arrays to messages and back", _ARRAYS, "schemas splat"),
    ),
    (
        _part("registration", "dense RGB-D alignment, features", _ARRAYS, "kernels", estimator=True),
        _part("recording", "logs and recordings", _ARRAYS, "schemas messages kernels"),
    ),
    (
        _part(
            "consensus",
            "pose ADMM, elimination, evidence, matching",
            _ARRAYS,
            "splat registration posegraph",
            estimator=True,
        ),
    ),
    (
        _part("frontend", "stage: track and map", _MATHEMATICS, _LOGS, "posegraph", estimator=True),
        _part("information", "stage: Fisher information", _MATHEMATICS, _LOGS, estimator=True),
        _part("runs", "what stages leave, as arrays", _MATHEMATICS, _LOGS, "posegraph consensus"),
        _part(
            "converters",
            "datasets, logs, simulator",
            "base config geometry kernels schemas messages recording",
        ),
    ),
    (
        _part(
            "exchange",
            "stage: agents and sessions",
            _MATHEMATICS,
            _LOGS,
            "posegraph network consensus runs",
            estimator=True,
        ),
        _part(
            "fusion",
            "stage: fused map",
            _MATHEMATICS,
            _LOGS,
            "posegraph consensus runs",
            estimator=True,
        ),
        _part(
            "camera_calibration", "cameras from images", _MATHEMATICS, _LOGS, "frontend runs", estimator=True
        ),
    ),
    (
        _part("cache", "what was computed before", "base config recording runs"),
        _part("comparison", "what differs between runs", "base config geometry splat recording runs"),
        _part(
            "team_posegraph",
            "public pose graphs by a team",
            _ARRAYS,
            "posegraph network consensus exchange",
            estimator=True,
        ),
        _part(
            "evaluation",
            "the only reader of ground truth",
            _MATHEMATICS,
            _LOGS,
            "posegraph consensus runs exchange fusion",
        ),
    ),
    (
        _part("report", "the page of a run", "base geometry kernels fusion", _LOGS, "runs evaluation"),
        _part(
            "checks",
            "is a recording sound",
            "base config geometry kernels registration",
            _LOGS,
            "frontend evaluation cache runs",
        ),
        _part(
            "bench",
            "speed, side by side",
            _MATHEMATICS,
            "schemas recording runs frontend evaluation converters",
        ),
    ),
    (
        _part(
            "viewing",
            "Rerun, inspection",
            "base geometry splat network consensus",
            _LOGS,
            "runs exchange evaluation report",
        ),
    ),
    (
        _part(
            "recalibration",
            "a recording with calibrated cameras",
            "base config geometry recording converters camera_calibration",
        ),
    ),
    (
        _part(
            "steps",
            "how each stage is called",
            "base config runs frontend information recording network exchange fusion evaluation report viewing",
            "recalibration",
        ),
    ),
    (
        _part("doctor", "what a machine has", "base kernels"),
        _part("run_plan", "how a run is carried out", "base runs"),
        _part("watch", "observers", "base viewing"),
        _part("time_left", "time left", "base config runs cache"),
    ),
    (_part("chain", "the stages in their order", "base schemas recording runs cache steps watch"),),
    (
        _part(
            "preparation",
            "what a run knows first",
            "base config runs recording checks cache run_plan",
        ),
    ),
    (
        _part(
            "robot_processes",
            "robots in processes",
            "base config runs recording cache steps watch chain run_plan preparation",
        ),
        _part("manifest", "what a run says about itself", "base cache runs preparation"),
    ),
    (
        _part(
            "job",
            "a run that is made",
            "base config runs recording evaluation viewing checks cache steps watch time_left chain preparation",
            "robot_processes run_plan manifest",
        ),
    ),
    (
        _part(
            "existing_run",
            "whether an earlier run stands",
            "base config runs recording cache job run_plan preparation manifest",
        ),
    ),
    (_part("runner", "carries a run", "base config recording job run_plan preparation existing_run"),),
    (
        _part(
            "batch",
            "many runs at once",
            "base config recording cache comparison run_plan existing_run runner",
        ),
    ),
    (
        _part(
            "experiments",
            "claims and research that no run depends on",
            _MATHEMATICS,
            _LOGS,
            "posegraph network consensus exchange frontend information fusion runs evaluation bench team_posegraph",
            "converters",
            "batch cache report",
        ),
    ),
    (_part("replay", "computes a robot again", "base config runs recording exchange steps"),),
    (
        _part(
            "cli",
            "the command",
            "base config kernels recording runs converters exchange fusion evaluation",
            "report viewing checks camera_calibration recalibration team_posegraph bench experiments",
            "batch cache comparison doctor steps run_plan existing_run runner replay time_left",
        ),
    ),
)
PARTS = {part.name: part for layer in LAYERS for part in layer}


def picture() -> str:
    """The table as a page shows it: top layer first, a row per layer."""
    rows = ["| layer | parts |", "| --- | --- |"]
    for number, layer in reversed(list(enumerate(LAYERS))):
        rows.append(f"| {number} | " + "; ".join(f"`{p.name}` {p.purpose}" for p in layer) + " |")
    return "\n".join(rows)


def drawn(page: str) -> str:
    """A page with the picture between its markers."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{picture()}\n\n{END}{after}"


if __name__ == "__main__":
    PAGE.write_text(drawn(PAGE.read_text()))
