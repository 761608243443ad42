"""An earlier run in the place of a new one: whether it is what the new one would be, and what would change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.cache.carrier import intact, words
from duagc.pipeline.cache.file_digests import FileDigest
from duagc.pipeline.cache.stage_key import StageKey
from duagc.pipeline.cache.store import Store, StoredResults
from duagc.pipeline.config.run import RunConfig
from duagc.pipeline.job import READERS, Job
from duagc.pipeline.preparation import Say, stages_of
from duagc.pipeline.recording import Recording
from duagc.pipeline.run_plan import NAMES, RunPlan
from duagc.pipeline.runs import stages
from duagc.pipeline.runs.timing import label


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
        known = earlier[name].get("key") if isinstance(earlier.get(name), dict) else None
        if name in earlier and known != key.digest:
            changes = "; ".join(job.carrier.changes(key, str(known)))
            raise DuagError(
                f"{out}: exists already, and {words(key)} differs ({changes}); choose another --out or give --force"
            )
    if keys or plan.since is not None or any(carried.label not in earlier for carried in done):
        return False
    for carried in done:
        if carried.entry.key.stage in READERS:  # `duagc evaluate` and `duagc report` write these again
            name = next((name for name in carried.entry.files if not (out / name).is_file()), "")
        else:
            name = intact(out, carried.entry, job.digests)
        if name:
            log(f"{out / name}: is not what was computed; taken from the store")
            return False
    return True


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
