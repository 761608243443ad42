"""Imports go one way, and ground truth is out of reach of the estimator."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.layers import LAYERS, PARTS, ROOT, Part

SOURCES = ("pipeline", "converters", "schemas")


def modules(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]


def imports_of(path: Path) -> set[str]:
    """Full names of everything that a file imports, at top level or inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def part_of(name: str) -> str | None:
    """The part that a dotted name belongs to; None if it is nobody's."""
    words = name.split(".")
    if words[0] != "duagc" or len(words) < 2:
        return None
    if words[1] == "pipeline":
        return words[2] if len(words) > 2 else None
    return words[1] if words[1] in PARTS else None


ALL = [path for source in SOURCES for path in modules(ROOT / source)]


def test_every_module_belongs_to_a_part_of_the_table() -> None:
    named = {path for part in PARTS.values() for path in modules(part.folder)}
    assert set(ALL) - named == {ROOT / "pipeline" / "__init__.py"}


def test_the_table_itself_goes_one_way() -> None:
    below: set[str] = set()
    for layer in LAYERS:
        for part in layer:
            assert part.uses <= below, f"{part.name} uses {sorted(part.uses - below)}, expected lower layers"
        below |= {part.name for part in layer}


@pytest.mark.parametrize("part", PARTS.values(), ids=lambda part: part.name)
def test_imports_go_one_way(part: Part) -> None:
    for path in modules(part.folder):
        imported = {found for name in imports_of(path) if (found := part_of(name)) is not None}
        wrong = imported - part.uses - {part.name}
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"
        if part.name != "viewing":
            assert not any(name.split(".")[0] == "rerun" for name in imports_of(path)), path


@pytest.mark.parametrize("part", [p for p in PARTS.values() if p.estimator], ids=lambda part: part.name)
def test_the_estimator_knows_no_ground_truth(part: Part) -> None:
    for path in modules(part.folder):
        text = path.read_text().lower()
        for word in ("groundtruth", "ground_truth"):
            assert word not in text, f"{path.relative_to(ROOT)} mentions {word}"


@pytest.mark.parametrize("folder", [*SOURCES, "tests", "examples"])
def test_nothing_is_imported_by_a_bare_name(folder: str) -> None:
    """From a checkout `import pipeline` works as well, and gives a second copy of every class."""
    for path in modules(ROOT / folder):
        bare = sorted(name for name in imports_of(path) if name.split(".")[0] in SOURCES)
        assert not bare, f"{path.relative_to(ROOT)} imports {bare}, expected duagc.{bare[0]}"


def test_the_command_starts_light() -> None:
    heavy = {"numpy", "torch", "cv2", "rerun", "open3d", "scipy", "mcap"}
    code = f"import sys, duagc.pipeline.cli; print(sorted({heavy} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert out.stdout.strip() == "[]"
