"""Every folder of tests goes to one worker, and the one that takes longest goes first."""

from types import SimpleNamespace

import pytest

from tests.budget import folder_of
from tests.distribution import pytest_collection_modifyitems, pytest_xdist_make_scheduler

TESTS = [
    "tests/test_run.py::test_a",
    "tests/config/test_x.py::test_a",
    "tests/converters/logs/test_y.py::test_a[1]",
    "tests/converters/test_z.py::test_a",
    "tests/exchange/test_v.py::test_a",
    "tests/frontend/test_w.py::test_a",
    "tests/frontend/test_w.py::test_b",
    "tests/frontend/test_w.py::test_c",
]


class Worker:
    """What a scheduler asks of a worker."""

    def __init__(self, name: str) -> None:
        self.gateway = SimpleNamespace(id=name)
        self.shutting_down = False
        self.runs: list[int] = []

    def send_runtest_some(self, tests: list[int]) -> None:
        self.runs += tests

    def shutdown(self) -> None:
        self.shutting_down = True


def test_a_folder_is_run_by_one_worker() -> None:
    options = {"dist": "loadscope", "tx": ["2*popen"]}
    config = SimpleNamespace(getvalue=options.get, option=SimpleNamespace(loadscopereorder=False))
    log = SimpleNamespace(loadscopesched=lambda *words: None)
    scheduler, workers = pytest_xdist_make_scheduler(config, log), [Worker("a"), Worker("b")]  # type: ignore[arg-type]
    for worker in workers:
        scheduler.add_node(worker)
        scheduler.add_node_collection(worker, TESTS)
    scheduler.schedule()
    while any(not worker.shutting_down for worker in workers):
        for worker in workers:
            for test in [test for tests in scheduler.assigned_work[worker].values() for test in tests]:
                scheduler.mark_test_complete(worker, TESTS.index(test))
    ran = [{TESTS[test] for test in worker.runs} for worker in workers]
    assert ran[0] | ran[1] == set(TESTS)
    assert all(ran)
    assert not {folder_of(test) for test in ran[0]} & {folder_of(test) for test in ran[1]}


def test_long_folders_begin() -> None:
    items = [SimpleNamespace(nodeid=test) for test in TESTS]
    pytest_collection_modifyitems(items)  # type: ignore[arg-type]
    order = [item.nodeid for item in items]
    assert order[:2] == TESTS[2:4]
    assert order[-1] == TESTS[1]
    assert order[2:5] == TESTS[5:8]


@pytest.mark.parametrize("dist", ["no", "load"])
def test_another_distribution_is_left_alone(dist: str) -> None:
    assert pytest_xdist_make_scheduler(SimpleNamespace(getvalue={"dist": dist}.get), None) is None  # type: ignore[arg-type]
