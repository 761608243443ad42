"""One name is one class: no two packages define the same class name."""

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = ("pipeline", "converters", "schemas")
# Names that an interface gives to several classes.
INTERFACES: frozenset[str] = frozenset(
    [
        "Options",  # the name that the interface of a converter gives: one in every dataset
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
    new = {name: files for name, files in double.items() if name not in INTERFACES}
    assert not new, f"defined more than once: {new}"
