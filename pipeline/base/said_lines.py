"""Lines on standard error, and standard streams that are closed."""

import os
import sys


def say_line(line: str) -> None:
    """Write a line at once and in one piece, so that those of several processes do not run together.

    Args:
        line: without its end.
    """
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()


def open_closed_streams() -> None:
    """Open to nowhere those of the standard streams that whoever started this process has closed, as `2>&-` does.

    Else there is none to write to, and the next file that is opened takes its number: lines of a library land there.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode)  # noqa: SIM115 (of the whole process); it gets the lowest free number
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)
