"""What a run knows before its stages begin: what carries them out, and how many robots fit into memory."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from duagc.pipeline.base.ahead import in_order
from duagc.pipeline.base.machine import memory_bytes
from duagc.pipeline.base.said_lines import say_line
from duagc.pipeline.cache.carrier import Carrier
from duagc.pipeline.cache.code_identity import CodeVersion
from duagc.pipeline.cache.footprint import fitting, robot_bytes
from duagc.pipeline.cache.stage_key import StageKey
from duagc.pipeline.cache.store import Store
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.recording import Recording
from duagc.pipeline.run_plan import RunPlan
from duagc.pipeline.runs import stages

MEASURED = 20  # results of front ends that memory is estimated from
LONG_FRAMES = 1000  # a shorter log is tracked, and its keyframes are counted, within seconds
Say = Callable[[str], None]


def say(line: str) -> None:
    """Say something on standard error.

    Args:
        line: what is said.
    """
    say_line(line)


def way(folder: Path, path: Path) -> str:
    """The relative path from one place to another, by the folders that symbolic links lead to.

    Args:
        folder: where it begins; "..", of a folder that is reached by a link, is not the folder of the link.
        path: where it ends.
    """
    return os.path.relpath(os.path.realpath(path), os.path.realpath(folder))


def stages_of(run: Path) -> dict[str, Any]:
    """What the manifest of a run says of its stages; empty if there is none, or none that says it.

    Args:
        run: folder of the run.
    """
    try:
        content = json.loads((run / "manifest.json").read_bytes())
        rows = content["stages"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return rows if isinstance(rows, dict) else {}


def versions(store: Store, known: Mapping[str, CodeVersion] | None = None) -> dict[str, CodeVersion]:
    """Versions of the code of all stages, by entry, read now: results of code that is edited later are not kept.

    Args:
        store: of the run, which remembers them.
        known: those that somebody of the same run has read.
    """
    store.code.adopt(dict(known or {}))
    for stage in (stages.CALIBRATION, *stages.STAGES):
        store.code.version_of(stage.code)
    return store.code.versions


def read_code(store: Path) -> None:
    """Read the code of all stages, so that a run that begins soon finds it read.

    Args:
        store: folder of the store of that run.
    """
    versions(Store(store))


def carrier_of(
    folder: Path,
    config: RunConfig,
    plan: RunPlan,
    *,
    log: Say,
    place: Path,
    looking: bool = False,
    begun: Callable[[StageKey, bool], None] = lambda key, stored: None,
) -> Carrier:
    """What carries out the stages of a run.

    Args:
        folder: of the run.
        config: settings of all stages.
        plan: how it is done.
        log: gets a line when something is unusual.
        place: where an earlier run may be.
        looking: only look what is there: nothing is computed or written.
        begun: called before a stage is computed, or, with True, when it was taken from the store.
    """
    store = None if plan.store is None else Store(plan.store)
    earlier = {} if store is None else stages_of(place)
    return Carrier(
        folder,
        config,
        store,
        log,
        again=plan.again,
        looking=looking,
        earlier=earlier,
        place=place,
        begun=begun,
    )


def with_expected(
    sizes: Mapping[str, Mapping[str, int]], recording: Recording, config: FrontendConfig
) -> dict[str, dict[str, int]]:
    """Sizes of logs, with what is expected of those of `LONG_FRAMES` and more: keyframes, and whether depth is exact.

    Args:
        sizes: `frames`, and the rest of what is known, of every robot.
        recording: of these robots.
        config: of their front ends.
    """

    def counted(robot: str) -> dict[str, int]:
        size = dict(sizes[robot])
        if size["frames"] < LONG_FRAMES:
            return size
        from duagc.pipeline.checks.check import expected_size

        return size | expected_size(recording.log(robot), config)

    return dict(zip(sizes, in_order(counted, sizes), strict=True))


def say_registration(logs: Sequence[Path], log: Say) -> None:
    """Say where color and depth do not belong together.

    Args:
        logs: of robots that are not calibrated.
        log: gets a line for every finding.
    """
    from duagc.pipeline.checks.check import check_registration

    for findings in in_order(check_registration, logs):
        for finding in findings:
            log(finding.line())


def workers_that_fit(
    sizes: Sequence[dict[str, int]], carrier: Carrier, asked: int, *, share: float = 1.0
) -> int:
    """How many of some robots are looked at at the same time, so that they fit into memory.

    Args:
        sizes: `frames` and `pixels` of an image of every robot.
        carrier: of the run, that says so if they are fewer.
        asked: how many the user wants.
        share: of memory, relative to the preparation of a robot.
    """
    asked = min(asked, len(sizes))
    if asked <= 1:
        return 1
    measured = [] if carrier.store is None else carrier.store.recent(stages.FRONTEND.name, MEASURED)
    needed = [share * robot_bytes(size, measured) for size in sizes]
    _, free = memory_bytes()
    workers = fitting(asked, needed, free)
    if workers < asked and free is not None:
        carrier.say(
            f"{workers} at a time instead of {asked}: a robot may take {max(needed) / 1e9:.1f} GB of memory, "
            f"found {free / 1e9:.1f} GB free"
        )
    return workers
