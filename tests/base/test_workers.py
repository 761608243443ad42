"""Worker processes end with their task, with their parent, and never silently."""

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from duagc.pipeline.base import worker_reports
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.thread_share import ThreadShare
from duagc.pipeline.base.workers import LOW_PRIORITY, when_idle, worker_pool

ROOT = Path(__file__).parents[2]


def alive(pid: int) -> bool:
    """Whether a process runs; a zombie does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def wait_until_gone(pid: int) -> bool:
    deadline = time.monotonic() + 20
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not alive(pid)


def test_a_killed_worker_is_one_line() -> None:
    with pytest.raises(DuagError, match="worker process ended"), worker_pool(1) as pool:
        pool.submit(os.kill, pool.submit(os.getpid).result(), signal.SIGKILL).result()


@pytest.mark.parametrize("how", ["file", "input"])
def test_a_script_that_workers_cannot_import_is_said_to_be_one(tmp_path: Path, how: str) -> None:
    """Without a guard it would begin again in each of them; standard input is no file that they could read."""
    text = "import os\nfrom duagc.pipeline.base.workers import worker_pool\n"
    text += "with worker_pool(1) as pool:\n    pool.submit(os.getpid).result()\n"
    script = tmp_path / "script.py"
    script.write_text(text)
    words = [sys.executable, str(script) if how == "file" else "-"]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, env=env, input=text, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.endswith('expected a file with its work under `if __name__ == "__main__":`')


@pytest.mark.parametrize("begin", [lambda: worker_pool(1).__enter__(), lambda: ThreadShare(1, 1)])
def test_a_machine_without_shared_memory_is_one_line(
    monkeypatch: pytest.MonkeyPatch, begin: Callable[[], object]
) -> None:
    """Its locks are files there; of a folder that is missing the system names none."""

    def refuse(*_: object) -> None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))

    monkeypatch.setattr("_multiprocessing.SemLock", refuse)
    with pytest.raises(DuagError, match=r"^/dev/shm: No such file or directory, expected a folder"):
        begin()


def test_an_error_ends_the_tasks_of_the_others() -> None:
    class BadRobotError(Exception):
        pass

    pids = []

    def one_fails_while_another_works() -> None:
        with worker_pool(1) as pool:
            pids.append(pool.submit(os.getpid).result())
            pool.submit(time.sleep, 100)
            raise BadRobotError

    start = time.monotonic()
    with pytest.raises(BadRobotError):
        one_fails_while_another_works()
    assert wait_until_gone(pids[0])
    assert time.monotonic() - start < 60


def test_workers_end_with_a_killed_parent() -> None:
    code = """
import os, time
from duagc.pipeline.base.workers import LOW_PRIORITY, when_idle, worker_pool
if __name__ == "__main__":
    with worker_pool(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 100).result()
"""
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # Python says there that it cleared the semaphores of the killed parent
        text=True,
        cwd=ROOT,
    )
    assert parent.stdout is not None
    with parent.stdout as lines:
        pid = int(lines.readline())
        assert alive(pid)
        parent.kill()
        parent.wait(20)
    assert wait_until_gone(pid)


def say_and_report(count: int) -> None:
    """Say a line that stays in a buffer, and report steps that other threads have still to send."""
    print("said by a worker", end="")
    for done in range(count):
        worker_reports.tell(("alpha", "x" * 1000, done, count))


def test_what_a_worker_said_and_reported_is_not_lost_at_its_end(capfd: pytest.CaptureFixture[str]) -> None:
    """A worker ends without taking its objects apart."""
    heard: list[worker_reports.Step] = []
    with (
        worker_reports.listening(heard.append) as queue,
        worker_pool(1, worker_reports.keep_queue, (queue,)) as pool,
    ):
        pool.submit(say_and_report, 500)
    assert [step[2] for step in heard] == list(range(500))
    assert capfd.readouterr().out == "said by a worker"


def test_an_error_of_who_listens_is_raised_and_keeps_no_worker_waiting() -> None:
    def fail(step: worker_reports.Step) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    with (
        pytest.raises(BrokenPipeError),
        worker_reports.listening(fail) as queue,
        worker_pool(1, worker_reports.keep_queue, (queue,)) as pool,
    ):
        pool.submit(say_and_report, 500).result(timeout=60)  # more than a pipe holds


def test_what_can_wait_leaves_the_processors_to_others() -> None:
    found: list[int] = []
    when_idle(lambda: found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id())))
    own = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    assert own < LOW_PRIORITY
    assert found == [LOW_PRIORITY if sys.platform == "linux" else own]


def test_an_error_of_what_can_wait_is_an_error_here() -> None:
    def fail() -> None:
        raise DuagError("no frame")

    with pytest.raises(DuagError, match="no frame"):
        when_idle(fail)
