"""Writing an .rrd file so that an error of the disk is an error here."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from duagc.pipeline.base.files import new_file

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

COPY = """
import os, sys
failed, pipe = 0, os.open(sys.argv[1], os.O_RDONLY)
while block := os.read(pipe, 1 << 20):
    try:
        while block and not failed:
            block = block[os.write(1, block) :]
    except OSError as error:
        failed = error.errno  # the rest is read and dropped
sys.exit(failed)
"""


@contextmanager
def written(stream: rr.RecordingStream, blueprint: rrb.Blueprint, out: Path) -> Iterator[None]:
    """While the block logs to a stream, what it logs goes into a file; the stream ends with the block.

    Rerun says nothing when a file cannot be written, and a flush may then wait for ever. So it writes into a pipe, and
    another process, which needs no lock that Rerun holds while it waits, writes the bytes.

    Args:
        stream: new.
        blueprint: the layout.
        out: the file; appears when it is complete.

    Raises:
        DuagError: it cannot be written.
    """
    with new_file(out) as part, tempfile.TemporaryDirectory(prefix="duagc-rrd-") as folder:
        pipe = Path(folder) / "pipe"
        os.mkfifo(pipe)
        with part.open("wb") as target:
            copying = subprocess.Popen([sys.executable, "-ISc", COPY, str(pipe)], stdout=target)
        try:
            stream.save(pipe, default_blueprint=blueprint)
        except BaseException:
            copying.kill()
            copying.wait()
            raise
        try:
            yield
            stream.flush()
        finally:
            stream.disconnect()
            code = copying.wait()
        if code:
            raise OSError(code, os.strerror(code) if code > 0 else f"its writer ended with {code}")
