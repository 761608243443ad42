"""Digests of results: what a run computed, whatever the file encoders, clocks and folders around it."""

import hashlib
import json
from pathlib import Path

from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.files import kind_of_path, read_text
from duagc.pipeline.recording import Recording, content_digest

RESULT_SUFFIXES = (".mcap", ".ply", ".tum")
TEAM_RESULTS = ("consensus.mcap", "exchange.mcap")
ROBOT_RESULTS = (
    "frontend.mcap",
    "information.mcap",
    "fused.mcap",
    "fused.ply",
    "refined.ply",
    "trajectory.tum",
    "odometry.tum",
)


def result_files(run: Path) -> list[Path]:
    """Files of a run that its digest covers, relative to the run, sorted.

    Args:
        run: its folder.
    """
    found = [p for name in TEAM_RESULTS if (p := run / name).is_file()]
    found += [p for p in (run / "robots").rglob("*") if p.suffix in RESULT_SUFFIXES]
    return sorted(p.relative_to(run) for p in found)


def digest_file(path: Path) -> str:
    """64 hex characters: over the messages of a log, over the bytes of any other file.

    Args:
        path: of the file.

    Raises:
        DuagError: it cannot be read, or the log is damaged.
    """
    if path.suffix == ".mcap":
        return content_digest(path)
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise DuagError(f"{path}: {error.strerror or error}, expected a result of a run") from error


def digest(path: str | Path) -> str:
    """64 hex characters of a log, a recording, a run, or one of its files.

    Args:
        path: folder of the recording or run, or the file.

    Raises:
        DuagError: the path is absent, or is neither a file, a recording nor a whole run.
    """
    path = Path(path)
    if path.is_file():
        return digest_file(path)
    if (path / "recording.json").is_file():
        recording = Recording(path)
        for robot in recording.robots:
            recording.log(robot)
        names = sorted(p.relative_to(path) for p in path.glob("*.mcap"))
    elif (path / "robots").is_dir():
        names = result_files(path)
        _check_complete(path)
    else:
        found = kind_of_path(path)
        raise DuagError(f"{path}: {found}, expected a log, a recording (recording.json) or a run (robots/)")
    whole = hashlib.sha256()
    for name in names:
        whole.update(f"{name.as_posix()} {digest_file(path / name)}\n".encode())
    return whole.hexdigest()


def _named_outputs(manifest: Path) -> list[str]:
    """Results that a manifest names; none if there is no manifest."""
    if not manifest.is_file():
        return []
    try:
        outputs = json.loads(read_text(manifest, "the manifest of a run")).get("outputs", {})
        return sorted(outputs.keys())
    except (ValueError, AttributeError) as error:
        raise DuagError(f"{manifest}: is damaged ({error}), expected the manifest of a run") from error


def _check_complete(run: Path) -> None:
    """An unfinished or damaged run has no digest: it would equal nothing and say nothing."""
    folders = sorted(p for p in (run / "robots").iterdir() if p.is_dir())
    if not folders:
        raise DuagError(f"{run}: found no folder robots/<robot>, expected a run")
    wanted = [run / name for name in TEAM_RESULTS]
    wanted += [folder / name for folder in folders for name in ROBOT_RESULTS]
    wanted += [run / name for name in _named_outputs(run / "manifest.json")]
    for path in wanted:
        if not path.is_file():
            raise DuagError(f"{path}: not found, expected every result of a finished run")
