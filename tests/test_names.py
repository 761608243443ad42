"""One name is one class: no two packages define the same class name."""

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = ("pipeline", "converters", "schemas")
# Names that still stand for several classes; the list only shrinks.
STILL_DOUBLE: frozenset[str] = frozenset(
    [
        "Calibration",
        "Candidate",
        "Edges",
        "FrameFiles",
        "FreeSpace",
        "Lidar",
        "Message",
        "Options",
        "Plan",
        "Registration",
        "Rig",
        "Row",
        "Scene",
        "Session",
        "Topic",
        "View",
        "Work",
    ]
)


def definitions() -> dict[str, set[str]]:
    """Files that define a public class, by its name."""
    found: dict[str, set[str]] = defaultdict(set)
    for source in SOURCES:
        for path in sorted((ROOT / source).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    found[node.name].add(str(path.relative_to(ROOT)))
    return found


def test_no_public_class_name_is_defined_twice() -> None:
    double = {name: sorted(files) for name, files in definitions().items() if len(files) > 1}
    new = {name: files for name, files in double.items() if name not in STILL_DOUBLE}
    assert not new, f"defined more than once: {new}"
