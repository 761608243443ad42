"""The signals by which a command is stopped; all end it as Ctrl-C does, and it removes what is half written."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

ENDING = (signal.SIGTERM, signal.SIGHUP)  # of who wants a process to end, and of a terminal that closes
STOPPING = {signal.SIGINT, *ENDING}


@contextmanager
def ending_as_interrupts() -> Iterator[None]:
    """Take the signals of ENDING for Ctrl-C meanwhile, unless they are ignored, as nohup does."""
    taken = [name for name in ENDING if signal.getsignal(name) is signal.SIG_DFL]
    for name in taken:
        signal.signal(name, signal.default_int_handler)
    try:
        yield
    finally:
        for name in taken:
            signal.signal(name, signal.SIG_DFL)
