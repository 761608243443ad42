"""The signals by which a command is stopped; all end it as Ctrl-C does, and it removes what is half written."""

import signal

ENDING = (signal.SIGTERM, signal.SIGHUP)  # of who wants a process to end, and of a terminal that closes
STOPPING = {signal.SIGINT, *ENDING}


def stop_by_ending() -> None:
    """Take the signals of ENDING for Ctrl-C, unless they are ignored, as nohup does."""
    for name in ENDING:
        if signal.getsignal(name) is signal.SIG_DFL:
            signal.signal(name, signal.default_int_handler)
