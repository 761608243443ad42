"""What a run says about itself: manifest.json and timing.json."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from duagc import __version__
from duagc.pipeline import preparation
from duagc.pipeline.base.files import new_file, read_json
from duagc.pipeline.cache.carrier import Carried
from duagc.pipeline.runs.digest import RESULT_SUFFIXES, digest_file
from duagc.pipeline.runs.folder import SCHEMA

LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "mcap", "protobuf")


def times(done: Iterable[Carried]) -> dict[str, Any]:
    """What each stage took when it was computed, by label.

    Args:
        done: stages.
    """
    return {carried.label: dict(carried.entry.timing) for carried in done}


def write_timing(folder: Path, before: Sequence[Carried], done: Sequence[Carried]) -> None:
    """Write timing.json.

    Args:
        folder: of the run.
        before: stages before those of the run.
        done: stages of the run.
    """
    executed = {carried.label: carried.executed for carried in done}
    rows = {
        name: row | {"executed": executed.get(name, True)} for name, row in times([*before, *done]).items()
    }
    _write_json(folder / "timing.json", {"stages": rows})


def write_manifest(
    folder: Path,
    recording: Path,
    inputs: Mapping[str, str],
    done: Iterable[Carried],
    *,
    stages: Iterable[Carried] | None,
    more: Mapping[str, Any],
) -> None:
    """Write manifest.json: what went in and what came out, by digest.

    Args:
        folder: of the run, with config.toml.
        recording: that the run is of.
        inputs: digests of the logs, by robot.
        done: stages of the run, whose files these are.
        stages: those that have keys, in their order; None: nothing is stored, and none has one.
        more: rows besides these.
    """
    manifest = {
        "schema": SCHEMA,
        "duagc": __version__,
        "libraries": {name: version(name) for name in LIBRARIES},
        "recording": preparation.way(folder, recording),
        "config": digest_file(folder / "config.toml"),
        "inputs": dict(inputs),
        "outputs": _outputs(done),
    }
    if stages is not None:
        manifest["stages"] = {carried.label: _row(carried) for carried in stages}
    _write_json(folder / "manifest.json", manifest | dict(more))


def name_recording(folder: Path, recording: Path) -> None:
    """Let manifest.json of a finished run say where its recording is now.

    Args:
        folder: of the run.
        recording: that the run is of.
    """
    manifest = read_json(folder / "manifest.json", "the manifest of a run")
    _write_json(folder / "manifest.json", manifest | {"recording": preparation.way(folder, recording)})


def add_stages(folder: Path, kept: Sequence[Carried]) -> None:
    """Name stages in manifest.json and timing.json that a run has from an earlier one.

    Args:
        folder: of the run.
        kept: these stages.
    """
    of_run, of_times = (json.loads((folder / name).read_bytes()) for name in ("manifest.json", "timing.json"))
    of_run["outputs"] |= _outputs(kept)
    of_run["stages"] |= {carried.label: _row(carried) for carried in kept}
    of_times["stages"] |= {name: row | {"executed": False} for name, row in times(kept).items()}
    _write_json(folder / "manifest.json", of_run)
    _write_json(folder / "timing.json", of_times)


def _outputs(done: Iterable[Carried]) -> dict[str, str]:
    files = {name: digest.content for carried in done for name, digest in carried.entry.files.items()}
    return {name: digest for name, digest in files.items() if Path(name).suffix in RESULT_SUFFIXES}


def _row(carried: Carried) -> dict[str, Any]:
    entry = carried.entry
    plain = entry.plain()
    return {"key": entry.key.digest, "inputs": dict(entry.key.inputs)} | {
        name: plain[name] for name in ("files", "result", "timing")
    }


def _write_json(path: Path, content: dict[str, Any]) -> None:
    with new_file(path) as part:
        part.write_text(json.dumps(content, indent=2, sort_keys=True) + "\n")
