"""The signals by which a command is stopped; all end it as Ctrl-C does, and it removes what is half written."""

import errno
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from duagc.pipeline.base.errors import DuagError

ENDING = (signal.SIGTERM, signal.SIGHUP)  # of who wants a process to end, and of a terminal that closes
STOPPING = {signal.SIGINT, *ENDING}
SHARED = "/dev/shm"  # where the system keeps locks of processes
OF_PROCESS = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)  # limits that are not of that folder


def start_resource_tracker() -> None:
    """Start the process with which Python cleans up after others, where no signal of ENDING reaches it.

    It outlives the others to do so, but a terminal that closes would end it with them.

    Raises:
        DuagError: this machine has no place where processes can share locks.
    """
    from multiprocessing import get_context, resource_tracker

    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        resource_tracker.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        get_context("spawn").Lock()
    except OSError as error:  # it names no file
        if error.errno in OF_PROCESS:
            raise
        raise DuagError(
            f"{SHARED}: {error.strerror or error}, expected a folder in which processes can share locks"
        ) from error


@contextmanager
def held_back() -> Iterator[None]:
    """Stopping waits meanwhile; a process that is started meanwhile begins so, until `leave_to_parent`."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave_to_parent() -> None:
    """In a process of ours: leave what a terminal sends to all processes to the one that started this one."""
    for stop in (signal.SIGINT, signal.SIGHUP):
        signal.signal(stop, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)


@contextmanager
def ending_as_interrupts() -> Iterator[None]:
    """Take the signals of ENDING for Ctrl-C meanwhile, unless they are ignored, as nohup does."""
    here = threading.current_thread() is threading.main_thread()  # no other one may handle signals
    taken = [name for name in ENDING if here and signal.getsignal(name) is signal.SIG_DFL]
    for name in taken:
        signal.signal(name, signal.default_int_handler)
    try:
        yield
    finally:
        for name in taken:
            signal.signal(name, signal.SIG_DFL)
