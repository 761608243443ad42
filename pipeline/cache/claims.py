"""Claims on a computation: several processes on one file system do it once.

No locks, which some file systems lack: making and renaming a folder is all it takes. No clocks are compared either: who
waits counts by its own clock for how long the owner gave no sign.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType

BEAT_S = 2.0
SILENT_S = 60.0
"""An owner on another machine that gave no sign for so long is dead."""
POLL_S = 0.1


class Claim:
    """A claim that is held; use it as a context manager."""

    def __init__(self, folder: Path) -> None:
        """Begin to give signs.

        Args:
            folder: of the claim, made by this process.
        """
        self._folder = folder
        self._ended = threading.Event()
        (folder / "owner.json").write_text(json.dumps(this_process()))
        self._beating = threading.Thread(target=self._beat, daemon=True)
        self._beating.start()

    def _beat(self) -> None:
        count = 0
        while not self._ended.wait(BEAT_S):
            count += 1
            with suppress(OSError):
                (self._folder / "beat").write_text(str(count))

    def __enter__(self) -> Claim:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._beating.join()
        with suppress(OSError):
            if (
                _read_owner(self._folder) == this_process()
            ):  # another one may have taken this process for dead
                shutil.rmtree(self._folder)


def claim(folder: Path, done: Callable[[], bool], waiting: Callable[[], None]) -> Claim | None:
    """Take a claim, or wait until its owner has done the work.

    Args:
        folder: of the claim; folders above it exist.
        done: whether the work is done.
        waiting: called once if somebody else has the claim.

    Returns:
        The claim; None if the work is done.

    Raises:
        OSError: no folder can be made there.
    """
    announced = False
    watch = _Watch(folder)
    while True:
        try:
            folder.mkdir()
        except FileExistsError:
            pass
        else:
            try:
                return Claim(folder)
            except OSError:  # without its owner others would wait for it until it counts as dead
                shutil.rmtree(folder, ignore_errors=True)
                raise
        if done():
            return None
        if watch.is_dead():
            _remove(folder, watch.owner)
            continue
        if not announced:
            announced = True
            waiting()
        time.sleep(POLL_S)


class _Watch:
    """Watches the owner of a claim."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._sign: tuple[object, str] | None = None
        self._since_s = time.monotonic()
        self.owner: dict[str, object] | None = None

    def is_dead(self) -> bool:
        """Whether the owner ended without giving the claim back."""
        self.owner = _read_owner(self._folder)
        if self.owner is not None and self.owner.get("host") == _host():
            return has_ended(self.owner)
        beat = ""
        with suppress(OSError):
            beat = (self._folder / "beat").read_text()
        sign = (self.owner, beat)
        if sign != self._sign:
            self._sign, self._since_s = sign, time.monotonic()
        return time.monotonic() - self._since_s > SILENT_S


def _remove(folder: Path, owner: dict[str, object] | None) -> None:
    """Take away a dead claim, unless it is somebody else's by now."""
    aside = folder.with_name(f"{folder.name}.{uuid.uuid4().hex}.dead")
    with suppress(OSError):
        folder.rename(aside)
        if _read_owner(aside) != owner:
            aside.rename(folder)
            return
        shutil.rmtree(aside)


def _read_owner(folder: Path) -> dict[str, object] | None:
    try:
        owner = json.loads((folder / "owner.json").read_bytes())
    except (OSError, ValueError):
        return None
    return owner if isinstance(owner, dict) else None


def this_process() -> dict[str, object]:
    """This process, so that a later one of its number is not taken for it."""
    return {"host": _host(), "pid": os.getpid(), "started": _started(os.getpid())}


def _host() -> str:
    """A name of this machine since it was switched on, and of what its process numbers are counted in."""
    boot, numbers = "", ""
    with suppress(OSError):
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    with suppress(OSError):
        numbers = os.readlink("/proc/self/ns/pid")
    return f"{socket.gethostname()} {boot} {numbers}"


def _started(pid: int) -> str:
    """When a process began, by the kernel's own count; "" if there is none or the kernel does not say."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(
            errors="replace"
        )  # the name of a program may be cut in a letter
    except OSError:
        return ""
    fields = text[text.rfind(")") + 2 :].split()
    return "" if fields[0] in "ZX" else fields[19]


def has_ended(process: dict[str, object]) -> bool:
    """Whether a process is known to have ended: False for one of another machine, of which nothing is known.

    Args:
        process: as `this_process` described it.
    """
    return process.get("host") == _host() and not _is_alive(process)


def _is_alive(owner: dict[str, object]) -> bool:
    pid = owner.get("pid")
    if not isinstance(pid, int):
        return False
    if Path("/proc/self/stat").exists():
        return bool(_started(pid)) and _started(pid) == owner.get("started")
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
