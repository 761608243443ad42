"""How fast this machine and this version are: what stages took here, next to what was predicted of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from duagc.pipeline.cache import durations
from duagc.pipeline.cache.store import Store, StoredResults
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.runs.declared_settings import DeclaredSettings
from duagc.pipeline.runs.stages import EVALUATION, FRONTEND, FUSION, Stage

LAST = 20  # results of a stage that are looked at: a machine and a version change


@dataclass(frozen=True)
class MachineSpeed:
    """What stages took here, as a share of what they take where they were measured.

    Attributes:
        ratios: median by name of the stage; a stage that is not there was not computed here.
        stages: how many results that is from.
    """

    ratios: Mapping[str, float] = field(default_factory=dict)
    stages: int = 0


def speed_of(store: Path) -> MachineSpeed:
    """What stages with the default settings took, as the results in a store say.

    Args:
        store: its folder; may be absent.
    """
    if not store.is_dir():
        return MachineSpeed()
    opened = Store(store)
    fronts = [entry for entry in opened.recent(FRONTEND.name, LAST) if _is_default(entry, FRONTEND)]
    fronts = [entry for entry in fronts if _says(entry, "frames", "pixels", "keyframes")]
    fronts = [entry for entry in fronts if entry.result["keyframes"]]  # else no map could be begun
    sizes = {entry.key.inputs["log"]: entry.result for entry in fronts}
    measured = {
        FRONTEND.name: [entry.timing["cpu_s"] / durations.front_end_s(entry.result) for entry in fronts],
        FUSION.name: list(_fusions(opened, sizes)),
        EVALUATION.name: list(_evaluations(opened, sizes)),
    }
    found = {name: values for name, values in measured.items() if values}
    return MachineSpeed(
        {name: median(values) for name, values in found.items()}, sum(map(len, found.values()))
    )


def _fusions(store: Store, sizes: Mapping[str, Mapping[str, Any]]) -> Iterator[float]:
    """Of robots that had peers."""
    for entry in store.recent(FUSION.name, LAST):
        size = sizes.get(entry.key.inputs["log"])
        if size is None or not _says(entry, "robots"):
            continue
        if entry.result["robots"] > 1 and _is_default(entry, FUSION):
            yield entry.timing["cpu_s"] / durations.fusion_s(size)


def _evaluations(store: Store, sizes: Mapping[str, Mapping[str, Any]]) -> Iterator[float]:
    """Of recordings whose logs are known by their size."""
    for entry in store.recent(EVALUATION.name, LAST):
        logs = {digest for digest in entry.key.inputs.values() if digest in sizes}
        predicted = sum(durations.evaluation_s(sizes[digest], len(logs)) for digest in logs)
        robots = {name.split("/")[1] for name in entry.key.inputs if name.startswith("robots/")}
        if len(logs) == len(robots) and predicted and _is_default(entry, EVALUATION) and _says(entry):
            yield entry.timing["cpu_s"] / predicted


def _says(entry: StoredResults, *names: str) -> bool:
    """Whether results say these things of themselves, and what they took; those of earlier versions may not."""
    result = entry.result if isinstance(entry.result, Mapping) else {}
    return "cpu_s" in entry.timing and all(name in result for name in names)


def _is_default(entry: StoredResults, stage: Stage) -> bool:
    """Whether a stage was done with the settings that the prediction is of; the seed does not count."""
    default = DeclaredSettings(RunConfig(), stage.name, stage.settings).plain()
    return {**entry.key.settings, "seed": 0} == {**default, "seed": 0}
