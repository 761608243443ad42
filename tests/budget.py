"""Processor time of every test, per folder, with the budget of the folder.

`make test` shall take at most eight minutes of processor time, so each folder has a share. A folder over its share is
named in the summary; the session does not fail, because processor time depends on the machine and on its load.
`pytest --cpu 25` also lists the 25 most expensive tests.
"""

from __future__ import annotations

import resource
from collections import defaultdict
from collections.abc import Generator

import pytest

PROPERTY = "cpu_s"
ALL_S = 480
# Seconds of processor time without the tests marked slow, on a core of 2.6 GHz.
BUDGET_S = {
    "base": 3,
    "batch": 2,
    "bench": 18,
    "camera_calibration": 6,
    "checks": 21,
    "cli": 11,
    "cache": 2,
    "comparison": 3,
    "config": 1,
    "consensus": 9,
    "converters": 112,
    "docs": 5,
    "evaluation": 11,
    "examples": 15,
    "exchange": 36,
    "experiments": 4,
    "frontend": 72,
    "fusion": 2,
    "fuzz": 10,
    "geometry": 1,
    "golden": 12,
    "information": 1,
    "kernels": 25,
    "messages": 1,
    "posegraph": 15,
    "recording": 13,
    "registration": 3,
    "report": 6,
    "runs": 2,
    "schemas": 1,
    "splat": 1,
    "viewing": 2,
    "": 53,  # the files in tests/ itself
}


def processor_time_s() -> float:
    """User and system time of this process and of the children it has waited for."""
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


class Meter:
    """Attribute processor time to the phases of each test: setup, call and teardown.

    A fixture of the session counts for the first test that asks for it.
    """

    def __init__(self) -> None:
        self._mark_s = processor_time_s()

    def pytest_runtest_logstart(self) -> None:
        self._mark_s = processor_time_s()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        now_s = processor_time_s()
        report.user_properties = [*report.user_properties, (PROPERTY, now_s - self._mark_s)]
        self._mark_s = now_s
        return report


class Summary:
    """Print the processor time per folder and of the most expensive tests.

    Args:
        listed: how many tests to list.
    """

    def __init__(self, listed: int) -> None:
        self._listed = listed
        self._tests_s: dict[str, float] = defaultdict(float)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._tests_s[report.nodeid] += sum(
            float(s) for name, s in report.user_properties if name == PROPERTY
        )

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if not self._tests_s:
            return
        folders_s: dict[str, float] = defaultdict(float)
        for nodeid, seconds in self._tests_s.items():
            folders_s[folder_of(nodeid)] += seconds
        write = terminalreporter.write_line
        terminalreporter.section("processor time")
        if self._listed:
            for nodeid in sorted(self._tests_s, key=self._tests_s.__getitem__, reverse=True)[: self._listed]:
                write(f"{self._tests_s[nodeid]:8.2f} s  {nodeid}")
            write("")
        for folder in sorted(folders_s):
            budget_s = BUDGET_S.get(folder, 0)
            over = "  over budget" if folders_s[folder] > budget_s else ""
            write(f"{folders_s[folder]:8.1f} s of {budget_s:4d} s  tests/{folder}{over}")
        write(f"{sum(folders_s.values()):8.1f} s of {sum(BUDGET_S.values()):4d} s  all tests")


def folder_of(nodeid: str) -> str:
    """First folder below tests/ of a test, empty for a file in tests/ itself."""
    parts = nodeid.partition("::")[0].split("/")
    return parts[1] if len(parts) > 2 else ""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--cpu", type=int, default=0, metavar="N", help="list the N tests of most processor time"
    )


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Meter(), "processor-time-meter")
    if not hasattr(
        config, "workerinput"
    ):  # a worker of pytest-xdist sends its reports to the process that prints
        config.pluginmanager.register(Summary(config.getoption("cpu")), "processor-time-summary")
