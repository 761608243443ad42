"""The command `duagc`. Every command imports what it needs when it runs, so that `--help` is quick."""

import errno
import sys
from io import TextIOWrapper

from duagc.pipeline.base import determinism
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.said_lines import open_closed_streams
from duagc.pipeline.base.stop_signals import ending_as_interrupts
from duagc.pipeline.cli.common import EXIT_FAILED, app

# each registers its commands, and `--help` lists them in this order
# isort: off
from duagc.pipeline.cli import new_recordings
from duagc.pipeline.cli import recordings
from duagc.pipeline.cli import runs
from duagc.pipeline.cli import batch
from duagc.pipeline.cli import experiment
from duagc.pipeline.cli import compare
from duagc.pipeline.cli import inspect
from duagc.pipeline.cli import posegraph
from duagc.pipeline.cli import settings
from duagc.pipeline.cli import bench
from duagc.pipeline.cli import bench_runs
from duagc.pipeline.cli import robustness
# isort: on

__all__ = [
    "app",
    "batch",
    "bench",
    "bench_runs",
    "compare",
    "experiment",
    "inspect",
    "main",
    "new_recordings",
    "posegraph",
    "recordings",
    "robustness",
    "runs",
    "settings",
]

TYPER_INTERRUPTED = 130  # what typer makes of Ctrl-C, without a word
COMPILED = ("duagc.pipeline.kernels._raster", "duagc.converters.simulate.render._flat_surfaces")
"""Modules that a source tree lacks before they are built."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # the disk, the user's share of it, a limit on files


def main() -> None:
    """Entry point: one line and exit code 1 for whatever a user can fix."""
    determinism.configure_determinism()
    open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper) and stream.errors in ("strict", "surrogateescape"):
            stream.reconfigure(errors="replace")  # a terminal may lack a letter of a name
    try:
        with ending_as_interrupts():
            app()
    except DuagError as error:
        print(f"duagc: {error}", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except ImportError as error:
        if error.name not in COMPILED:
            raise
        print(f"duagc: {error}", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except OSError as error:
        if error.errno not in NO_ROOM and not error.filename:
            raise
        where = f"{error.filename}: " if error.filename else ""
        expected = ", expected room for the output" if error.errno in NO_ROOM else ""
        print(f"duagc: {where}{error.strerror}{expected}", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except KeyboardInterrupt:
        print("duagc: interrupted", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except SystemExit as stop:
        if stop.code != TYPER_INTERRUPTED:
            raise
        print("duagc: interrupted", file=sys.stderr)
        sys.exit(EXIT_FAILED)
