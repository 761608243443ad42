"""How a run is carried out: its workers, its store, and which of its stages are done."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from duagc.pipeline.base.errors import DuagError, closest
from duagc.pipeline.runs import stages

NAMES = tuple(stage.name for stage in stages.STAGES)
LAST: str = stages.VIEW.name


@dataclass(frozen=True)
class RunPlan:
    """How a run is carried out; nothing here changes a bit of its results.

    Attributes:
        workers: robots prepared at the same time.
        force: replace an earlier run in the same place.
        calibrate: calibrate the cameras from the recording's own images first. Where views that were not used say
            that it is better, the run is of the calibrated recording, which is kept in its folder `calibrated`.
        store: folder of results that are not computed again; None: everything is computed, and nothing is kept.
        since: the first stage that is computed whatever the store has; None: none is.
        until: the last stage that is done.
        evaluated: whether the run is measured, and gets a report.
        follow: serve the run to Rerun while it is computed.
    """

    workers: int = 2
    force: bool = False
    calibrate: bool = False
    store: Path | None = None
    since: str | None = None
    until: str = LAST
    evaluated: bool = True
    follow: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.workers, int) or self.workers < 1:
            raise DuagError(f"workers is {self.workers!r}, expected a whole number, 1 or more")
        for option, name in (("--from", self.since), ("--until", self.until)):
            if name is not None and name not in NAMES:
                raise DuagError(f"{option} {name}: is no stage, {closest(name, NAMES, 'a stage')}")
        if self.since is not None and NAMES.index(self.since) > NAMES.index(self.until):
            raise DuagError(f"--from {self.since}: comes after --until {self.until}, expected it before")

    @property
    def again(self) -> frozenset[str]:
        """Stages that are computed whatever the store has."""
        return frozenset() if self.since is None else frozenset(NAMES[NAMES.index(self.since) :])

    def has(self, stage: stages.Stage) -> bool:
        """Whether a stage is done.

        Args:
            stage: of the run.
        """
        wanted = self.evaluated or stage not in (stages.EVALUATION, stages.REPORT)
        return wanted and NAMES.index(stage.name) <= NAMES.index(self.until)
