"""Every folder of tests has a share of the processor time of `make test`, and the shares add up to what it may take."""

from pathlib import Path

from tests.budget import ALL_S, BUDGET_S, folder_of

TESTS = Path(__file__).parent


def test_the_budgets_add_up() -> None:
    assert sum(BUDGET_S.values()) <= ALL_S


def test_every_folder_of_tests_has_a_budget() -> None:
    files = (f"tests/{path.relative_to(TESTS).as_posix()}" for path in TESTS.rglob("test_*.py"))
    assert {folder_of(file) for file in files} == set(BUDGET_S)
