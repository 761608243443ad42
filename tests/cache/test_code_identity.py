"""The version of a stage's code changes with what it computes by, and with nothing else."""

from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path

import pytest

from duagc.pipeline import preparation
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.library_versions import DISTRIBUTIONS, library_version
from duagc.pipeline.bench import cell_digests
from duagc.pipeline.cache import code_identity
from duagc.pipeline.cache.code_identity import CodeReader
from duagc.pipeline.cache.store import Store
from duagc.pipeline.cli import runs as commands
from duagc.pipeline.experiments.carry_out import SIMULATOR
from duagc.pipeline.runs import stages

ENTRY = "duagc.steps:track"
STEPS = '''"""How stages are called."""
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from duagc.unread import Nothing


def track():
    """Track."""
    from duagc.front.stage import run
    return helper(run())


def helper(value):
    return value


def fuse():
    from duagc.fusion import run
    return run()
'''


@pytest.fixture
def package(tmp_path: Path) -> Path:
    files = {
        "__init__.py": "",
        "steps.py": STEPS,
        "front/__init__.py": "",
        "front/stage.py": "import numpy as np\nfrom duagc.base import two\n\ndef run():\n    return two() + np.pi\n",
        "front/page.j2": "<p>",
        "base.py": "def two():\n    return 2\n",
        "fusion.py": "def run():\n    return 1\n",
        "unread.py": "class Nothing: ...\n",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return tmp_path


def version(package: Path) -> dict[str, str]:
    return CodeReader(root=package).version_of(ENTRY).modules


def change(package: Path, name: str, old: str, new: str) -> None:
    text = (package / name).read_text()
    assert old in text
    (package / name).write_text(text.replace(old, new))


def test_it_has_what_is_imported_also_inside_functions_and_nothing_else(package: Path) -> None:
    assert list(version(package)) == [
        "__init__.py",
        "base.py",
        "front/__init__.py",
        "front/page.j2",
        "front/stage.py",
        "steps.py:track",
    ]
    assert CodeReader(root=package).version_of(ENTRY).libraries.keys() == {"python", "numpy"}


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("base.py", "def two():\n", 'def two():\n    """Two."""\n'),
        ("base.py", "return 2", "return  2  # as ever"),
        ("steps.py", '"""Track."""', '"""Track and map."""'),
        ("steps.py", "return run()\n", "return 2 * run()\n"),  # of another stage
        ("fusion.py", "return 1", "return 2"),
        ("unread.py", "...", "x = 1"),
    ],
)
def test_words_and_other_stages_change_nothing(package: Path, name: str, old: str, new: str) -> None:
    before = version(package)
    change(package, name, old, new)
    assert version(package) == before


@pytest.mark.parametrize(
    ("name", "old", "new", "changed"),
    [
        ("base.py", "return 2", "return 3", "base.py"),
        ("front/page.j2", "<p>", "<b>", "front/page.j2"),
        ("steps.py", "return value", "return -value", "steps.py:track"),
    ],
)
def test_what_it_computes_by_changes_it(package: Path, name: str, old: str, new: str, changed: str) -> None:
    before = version(package)
    change(package, name, old, new)
    after = version(package)
    assert [name for name in before if before[name] != after[name]] == [changed]


def test_what_was_parsed_is_found_again_and_damage_there_changes_nothing(package: Path) -> None:
    known = package / "code.json"
    fresh = CodeReader(known, package).version_of(ENTRY)
    assert known.is_file()
    assert CodeReader(known, package).version_of(ENTRY) == fresh
    known.write_text(known.read_text()[:100])
    assert CodeReader(known, package).version_of(ENTRY) == fresh


def test_code_that_was_read_before_a_run_is_not_parsed_by_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ThreadPoolExecutor(1) as meanwhile:  # as the demo does
        meanwhile.submit(commands._read_code, tmp_path / "store").result()
    counted = code_identity._count
    parsed: list[int] = []
    monkeypatch.setattr(code_identity, "_count", lambda body: parsed.append(len(body)) or counted(body))
    versions = preparation.versions(Store(tmp_path / "store"))
    entries = len(stages.STAGES) + 1
    assert len(parsed) == entries  # of each stage's entry what it uses; no whole module
    assert versions == preparation.versions(Store(tmp_path / "store"), versions)
    assert len(parsed) == entries


def test_a_step_that_is_not_there_is_one_line(package: Path) -> None:
    for entry in ("duagc.steps:nothing", "duagc.nowhere:track"):
        with pytest.raises(DuagError, match="expected the code of a stage"):
            CodeReader(root=package).version_of(entry)


def test_every_stage_counts_its_own_folder_and_the_compiled_kernels() -> None:
    reader = CodeReader()
    of = {stage.name: reader.version_of(stage.code).modules for stage in stages.STAGES}
    assert any("/_raster." in name for name in of["frontend"])
    assert "pipeline/frontend/tracking.py" in of["frontend"]
    assert "pipeline/report/page.html.j2" in of["report"]
    assert "schemas/descriptors.binpb" in of["exchange"]
    for name, other in (("frontend", "fusion"), ("information", "frontend"), ("fusion", "exchange")):
        assert not [module for module in of[name] if module.startswith(f"pipeline/{other}/")]


def test_results_depend_on_the_version_of_open3d_where_it_is_used() -> None:
    reader = CodeReader()
    assert "open3d" in reader.version_of("duagc.pipeline.steps:frontend").libraries
    until = 1 + stages.STAGES.index(stages.EVALUATION)
    entries = [SIMULATOR, *(stage.code for stage in stages.STAGES[:until])]
    used = {name for entry in entries for name in reader.version_of(entry).libraries}
    assert used - {"python"} <= set(cell_digests.LIBRARIES)


def test_a_library_of_another_distribution_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert library_version("numpy") == metadata.version("numpy")
    assert library_version("cv2") == metadata.version("opencv-python-headless")
    monkeypatch.setitem(DISTRIBUTIONS, "cv2", "opencv-of-nobody")
    assert library_version("cv2") == f"opencv-python-headless {metadata.version('opencv-python-headless')}"
    assert library_version("no_such_library") == ""
    (tmp_path / "copied_library.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    assert library_version("copied_library") == "unknown"
