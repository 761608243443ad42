"""An earlier run in the place of a new one: whether it is what the new one would be, what would change, what stays."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from duagc.pipeline import manifest
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import read_json
from duagc.pipeline.cache.carrier import Carried, intact, words
from duagc.pipeline.cache.file_digests import FileDigest, FileDigests
from duagc.pipeline.cache.stage_key import StageKey
from duagc.pipeline.cache.store import Store, StoredResults
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.job import Job
from duagc.pipeline.preparation import Say, stages_of
from duagc.pipeline.recording import Recording
from duagc.pipeline.run_plan import LAST, NAMES, RunPlan
from duagc.pipeline.runs import stages
from duagc.pipeline.runs.folder import RunFolder
from duagc.pipeline.runs.timing import label

REWRITTEN = (stages.EVALUATION.name, stages.REPORT.name)
"""Stages whose results users write again as they like, by `duagc evaluate` and `duagc report`."""


def is_up_to_date(recording: Recording, out: Path, config: RunConfig, plan: RunPlan, *, log: Say) -> bool:
    """Whether a run is what it would be now; False: it is the beginning of that, or a file of it is damaged.

    Args:
        recording: that the run is of.
        out: folder of an earlier run.
        config: settings of all stages.
        plan: how it is done; with a store.
        log: gets a line about what is damaged.

    Raises:
        DuagError: it is another run, or none.
    """
    earlier = stages_of(out)
    if not earlier:
        raise DuagError(f"{out}: exists already; choose another --out or give --force")
    evaluated = stages.EVALUATION.name in earlier
    looked_for = replace(plan, since=None, evaluated=plan.evaluated or evaluated)
    job = Job(recording, out, config, looked_for, log=log, place=out, looking=True)
    done, keys = job.look()
    for key in [*(carried.entry.key for carried in done), *keys]:
        name = label(key.stage, key.robot)
        if key.stage == stages.VIEW.name and not evaluated:
            continue  # it shows the metrics, which the earlier run did not have
        known = _key(earlier, name)
        if name in earlier and known != key.digest:
            changes = "; ".join(job.carrier.changes(key, str(known)))
            raise DuagError(
                f"{out}: exists already, and {words(key)} differs ({changes}); choose another --out or give --force"
            )
    if keys or plan.since is not None or any(carried.label not in earlier for carried in done):
        return False
    for name in (_damaged_table(out), *(_damaged_result(out, carried, job.digests) for carried in done)):
        if name:
            log(f"{out / name}: is not what was computed; taken from the store")
            return False
    return plan.until == LAST or len(_that_hold(recording, out, config, plan, place=out)) == len(earlier)


def _that_hold(
    recording: Recording, folder: Path, config: RunConfig, plan: RunPlan, *, place: Path
) -> list[Carried]:
    """Stages of the run in a place, also those after the plan's, whose keys are what they would be now."""
    earlier = stages_of(place)
    every = replace(plan, since=None, until=LAST, evaluated=stages.EVALUATION.name in earlier)
    job = Job(recording, folder, config, every, log=lambda line: None, place=place, looking=True)
    job.carrier.earlier = earlier | stages_of(folder)  # a report shows what the stages of its own run took
    done, _ = job.look()
    return [carried for carried in done if _key(earlier, carried.label) == carried.entry.key.digest]


def follow_recording(recording: Recording, out: Path) -> None:
    """Let a run that is up to date know its recording, where that is no longer at the place that it names.

    Args:
        recording: that the run is of.
        out: folder of the run.
    """
    named = read_json(out / "manifest.json", "the manifest of a run").get("recording", "")
    if not (out / str(named)).is_dir() or not named:
        manifest.name_recording(out, recording.path)


def _damaged_table(out: Path) -> str:
    """The first table about the run itself that is not as it was written; "" if both are."""
    run = RunFolder(out)
    tables: dict[str, Callable[[], object]] = {
        "config.toml": lambda: run.config_text,
        "timing.json": lambda: run.timing,
    }
    for name, read in tables.items():
        try:
            if not read():
                return name
        except DuagError:
            return name
    return ""


def _damaged_result(out: Path, carried: Carried, digests: FileDigests) -> str:
    """The first file of a stage that is not as it was computed; "" if all are."""
    if carried.entry.key.stage not in REWRITTEN:
        return intact(out, carried.entry, digests)
    files = {name: out / name for name in carried.entry.files}
    return next((name for name, path in files.items() if not (path.is_file() and path.stat().st_size)), "")


def keep_what_holds(
    recording: Recording, folder: Path, config: RunConfig, plan: RunPlan, *, out: Path, log: Say
) -> None:
    """Bring over to a run what the earlier one in its place has besides, but no result of another configuration.

    Files that somebody else put there are kept. A result that the new run does not have is kept if its stage has the
    key that it would have now; what is kept of later stages is named in the manifest.

    Args:
        recording: that the run is of.
        folder: of the new run, which is done.
        config: settings of all stages.
        plan: how it was done; with a store.
        out: folder of the earlier run.
        log: gets a line if results are left out, or replaced though `duagc evaluate` wrote them.
    """
    earlier, made = stages_of(out), stages_of(folder)
    hold = _that_hold(recording, folder, config, plan, place=out)
    if stages.EVALUATION.name in made and plan.store is not None:
        other = measured_otherwise(out, plan.store)
        if other in made[stages.EVALUATION.name]["files"] and (out / other).is_file():
            log(
                f"warning: {out / other}: was written by another evaluation since; replaced by that of this run"
            )
    left_out = _results(out, earlier) - {name for carried in hold for name in carried.entry.files}
    lost = []
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out)
        if os.path.lexists(folder / name) or (
            path.is_dir() and not path.is_symlink() and any(path.iterdir())
        ):
            continue  # there already, or it comes with what it holds
        if name.as_posix() in left_out:
            lost.append(name.as_posix())
            continue
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink():
            (folder / name).symlink_to(path.readlink())
        elif path.is_dir():
            (folder / name).mkdir()
        else:
            shutil.copy2(path, folder / name)
    if lost:
        more = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
        log(f"warning: {out}: left out results of other settings or inputs: {lost[0]}{more}")
    if plan.until != LAST:  # else it is only not evaluated, and shown without metrics
        manifest.add_stages(folder, [carried for carried in hold if carried.label not in made])


def _key(rows: Mapping[str, Any], name: str) -> str | None:
    """Digest of the key of a stage in a manifest; None if somebody has written into that."""
    return rows[name].get("key") if isinstance(rows.get(name), dict) else None


def _results(run: Path, rows: Mapping[str, Any]) -> set[str]:
    """Names of what stages wrote into a run: what its manifest says, and what is called like a result."""

    def found() -> Iterator[Path]:
        for stage in stages.STAGES:
            for pattern in stage.writes_files:
                yield from run.glob(f"robots/*/{pattern}" if stage.per_robot else pattern)

    files = [row["files"] for row in rows.values() if isinstance(row, dict) and "files" in row]
    named = {name for names in files if isinstance(names, dict) for name in names}
    return named | {path.relative_to(run).as_posix() for path in found()}


def measured_otherwise(out: Path, store: Path) -> str:
    """The first file of the evaluation that is not as the manifest names it; "" if all are.

    Users may measure a run again as they like, but a batch compares runs that were measured alike.

    Args:
        out: folder of a run that is up to date.
        store: of results, which remembers digests of files.
    """
    row = stages_of(out).get(stages.EVALUATION.name, {"files": {}})
    try:
        files = {name: FileDigest(**digest) for name, digest in row["files"].items()}
    except (KeyError, TypeError, AttributeError):  # somebody has written into that manifest
        return "manifest.json"
    named = StoredResults(StageKey(stages.EVALUATION.name, None, {}, {}, {}, {}), files)
    return intact(out, named, Store(store).files)


def why(recording_path: Path, out: Path, config: RunConfig, plan: RunPlan) -> list[str]:
    """What a run would compute, and what changed; nothing is computed.

    Args:
        recording_path: folder of the recording.
        out: folder of the run.
        config: settings of all stages.
        plan: how it is done.

    Returns:
        A line for every stage that can be named now.
    """
    if plan.store is None:
        return ["every stage is computed: there is no store"]
    job = Job(Recording(recording_path), out, config, plan, log=lambda line: None, place=out, looking=True)
    done, missing = job.look()
    lines = [f"{words(carried.entry.key)}: in the store" for carried in done]
    for key in missing:
        reason = "--from" if key.stage in plan.again else "; ".join(job.carrier.changes(key))
        lines.append(f"{words(key)}: computed: {reason}")
    if missing:
        last = max(NAMES.index(key.stage) if key.stage in NAMES else -1 for key in missing)
        later = [stage.name for stage in stages.STAGES[last + 1 :] if plan.has(stage)]
        if later:
            lines.append(f"{', '.join(later)}: computed unless the results before turn out as they were")
    return lines
