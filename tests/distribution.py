"""Which worker of pytest-xdist runs which tests: those of a folder stay together, the longest folder begins.

Tests of a folder share what is made once for a session or a module; two workers would make it twice. The groups of
`--dist loadgroup` are not used: pytest-xdist 3.8 writes them where pytest 9.2 no longer looks, and says nothing.
"""

from __future__ import annotations

from typing import Any

import pytest

from tests.budget import BUDGET_S, folder_of


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the folders that take longest: the workers then end at about the same time."""
    items.sort(key=lambda item: -BUDGET_S.get(folder_of(item.nodeid), 0))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Hand out whole folders, in the order of the tests (`--dist loadscope --no-loadscope-reorder`)."""
    if config.getvalue("dist") != "loadscope":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class FolderScheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return folder_of(nodeid)

    return FolderScheduling(config, log)
