"""A batch that is stopped is one line, its cells leave nothing half written, and the same command goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fixtures.commands import ROOT, listen_to_interrupts

SUITE = """
[recordings]
room = "{recording}"
[configurations.plain]
[configurations.other]
set = ["frontend.mapping.iterations=5"]
"""


@pytest.mark.parametrize(
    ("stop", "send"),
    [
        (signal.SIGINT, os.killpg),  # as a terminal does: all processes
        (signal.SIGHUP, os.killpg),
        (signal.SIGTERM, os.kill),
    ],
)
def test_a_stopped_batch_is_one_line(
    tmp_path: Path, small_recording: Path, stop: signal.Signals, send: Callable[[int, int], None]
) -> None:
    suite, out = tmp_path / "suite.toml", tmp_path / "out"
    suite.write_text(SUITE.format(recording=small_recording))
    command = [sys.executable, "-c", "from duagc.pipeline.cli import main; main()", "batch", str(suite)]
    process = subprocess.Popen(
        [*command, "--out", str(out), "--workers", "2", "--store", str(tmp_path / "store")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        start_new_session=True,
        preexec_fn=listen_to_interrupts,
    )
    deadline = time.monotonic() + 120
    while len(list(out.glob("runs/*.part/config.toml"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    send(process.pid, stop)
    printed, said = process.communicate(timeout=60)
    assert (process.returncode, said.splitlines()[-1]) == (1, "duagc: interrupted"), (printed, said)
    assert "resource_tracker" not in said
    assert [path.name for path in out.glob("runs/*")] == []
    for log in out.glob("cells/*.log"):
        assert log.read_text().splitlines()[-1] == "duagc: interrupted"
        state = json.loads(log.with_suffix(".json").read_text())
        assert state["state"] == "running"  # of a process that has ended, so that it waits again
