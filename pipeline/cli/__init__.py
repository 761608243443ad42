"""The command `duagc`. Every command imports what it needs when it runs, so that `--help` is quick."""

import os
import sys
from io import TextIOWrapper

from duagc.pipeline.base import determinism
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.said_lines import open_closed_streams
from duagc.pipeline.base.stop_signals import ending_as_interrupts
from duagc.pipeline.cli.common import EXIT_FAILED, app
from duagc.pipeline.cli.failures import line_of

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


def main() -> None:
    """Entry point: one line and exit code 1 for whatever a user can fix."""
    determinism.configure_determinism()
    open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper) and stream.errors in ("strict", "surrogateescape"):
            stream.reconfigure(errors="replace")  # a terminal may lack a letter of a name
    if os.environ.get("COLUMNS", "").strip("0") == "":
        os.environ.pop(
            "COLUMNS", None
        )  # of a terminal that does not know its width; Rich would take it at its word
    try:
        with ending_as_interrupts():
            app()
    except DuagError as error:
        print(f"duagc: {error}", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except Exception as error:
        line = line_of(error)
        if line is None:
            raise
        print(f"duagc: {line}", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except KeyboardInterrupt:
        print("duagc: interrupted", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except SystemExit as stop:
        if stop.code != TYPER_INTERRUPTED:
            raise
        print("duagc: interrupted", file=sys.stderr)
        sys.exit(EXIT_FAILED)
