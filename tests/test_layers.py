"""Imports go one way, and ground truth is out of reach of the estimator."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# what each part of pipeline/ may import from pipeline/, besides itself
FOUNDATION = {"__init__", "errors", "files", "config", "numeric", "streams", "progress", "geometry"}
MATHEMATICS = FOUNDATION | {"kernels", "splat", "registration"}
LOGS = {"messages", "recording"}
ALLOWED = {
    "geometry": FOUNDATION,
    "kernels": FOUNDATION | {"splat"},  # the Gaussians' structure of arrays
    "splat": FOUNDATION | {"kernels"},
    "registration": FOUNDATION,
    "messages": FOUNDATION | {"splat"},
    "recording": FOUNDATION | {"messages"},
    "digest": FOUNDATION | LOGS,
    "frontend": MATHEMATICS | LOGS,
    "calibration": MATHEMATICS | LOGS | {"frontend", "run_folder"},
    "information": MATHEMATICS | LOGS,
    "consensus": MATHEMATICS,
    "robot": MATHEMATICS | LOGS | {"consensus"},
    "fusion": MATHEMATICS | LOGS | {"consensus", "robot"},
    "exchange": MATHEMATICS | LOGS | {"consensus", "robot"},
    "posegraph": FOUNDATION | {"consensus", "exchange"},
}
ESTIMATOR = sorted(set(ALLOWED) - {"messages", "recording", "digest"})


def modules(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def imports_of(path: Path) -> set[str]:
    """Full names of everything that a file imports, at top level or inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def part_of(path: Path) -> str:
    return path.relative_to(ROOT / "pipeline").parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", modules("pipeline"), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_one_way(path: Path) -> None:
    part = part_of(path)
    imported = {name.split(".")[1] for name in imports_of(path) if name.startswith("pipeline.")}
    allowed = ALLOWED.get(part)
    if allowed is not None:
        assert imported <= allowed | {part}, f"{part} imports {sorted(imported - allowed - {part})}"
    assert part == "viewer" or not any(n.split(".")[0] == "rerun" for n in imports_of(path))
    assert part in ("bench", "cli") or "bench" not in imported, f"{part} imports what only measures"


@pytest.mark.parametrize("part", ESTIMATOR)
def test_the_estimator_knows_no_ground_truth(part: str) -> None:
    paths = modules(f"pipeline/{part}") or [ROOT / "pipeline" / f"{part}.py"]
    for path in paths:
        text = path.read_text().lower()
        for word in ("groundtruth", "ground_truth"):
            assert word not in text, f"{path.relative_to(ROOT)} mentions {word}"


def test_the_command_starts_light() -> None:
    heavy = {"numpy", "torch", "cv2", "rerun", "open3d", "scipy", "mcap"}
    code = f"import sys, pipeline.cli; print(sorted({heavy} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert out.stdout.strip() == "[]"
