"""Pytest plugin: test the extension of another build instead of the installed one.

DUAGC_RASTER=path/of/_raster.so python -m pytest -p tests.kernels.other_build tests/kernels
"""

import importlib.util
import os
import sys
from pathlib import Path

NAME = "duagc.pipeline.kernels._raster"
PATH = Path(os.environ["DUAGC_RASTER"]).resolve(strict=True)

assert NAME not in sys.modules, "the installed extension was imported first"
_spec = importlib.util.spec_from_file_location(NAME, PATH)
assert _spec is not None
assert _spec.loader is not None
sys.modules[NAME] = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(sys.modules[NAME])


def pytest_report_header() -> str:
    return f"extension: {PATH}"
