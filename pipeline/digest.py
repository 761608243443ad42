"""Digests of results: what a run computed, whatever the file encoders, clocks and folders around it."""

import hashlib
from pathlib import Path

from pipeline.errors import DuagError
from pipeline.recording import content_digest

RESULT_SUFFIXES = (".mcap", ".ply", ".tum")


def result_files(run: Path) -> list[Path]:
    """Files of a run that its digest covers, relative to the run, sorted."""
    top = [run / "exchange.mcap", run / "consensus.mcap"]
    found = [p for p in top if p.is_file()]
    found += [p for p in (run / "robots").rglob("*") if p.suffix in RESULT_SUFFIXES]
    return sorted(p.relative_to(run) for p in found)


def digest_file(path: Path) -> str:
    """64 hex characters: over the messages of a log, over the bytes of any other file."""
    if path.suffix == ".mcap":
        return content_digest(path)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def digest(path: Path) -> str:
    """64 hex characters of a log, a recording, a run, or one of its files.

    Raises:
        DuagError: the path is absent or is neither a file, a recording nor a run.
    """
    if path.is_file():
        return digest_file(path)
    if (path / "recording.json").is_file():
        names = sorted(p.relative_to(path) for p in path.glob("*.mcap"))
    elif (path / "robots").is_dir():
        names = result_files(path)
    else:
        raise DuagError(f"{path}: expected a log, a recording (recording.json) or a run (robots/)")
    whole = hashlib.sha256()
    for name in names:
        whole.update(f"{name.as_posix()} {digest_file(path / name)}\n".encode())
    return whole.hexdigest()
