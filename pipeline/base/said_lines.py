"""Lines on standard error."""

import sys


def say_line(line: str) -> None:
    """Write a line at once and in one piece, so that those of several processes do not run together.

    Args:
        line: without its end.
    """
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()
