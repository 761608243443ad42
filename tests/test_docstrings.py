"""Every public function says what it takes: one `Args:` line for each parameter."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fixtures.commands import ROOT

COMMANDS = ROOT / "pipeline" / "cli"  # `--help` says what their parameters are
MODULES = [
    path
    for folder in ("pipeline", "converters", "schemas")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if COMMANDS not in path.parents
]


def public_functions(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Functions of a module, and methods and constructors of its classes, that others may call."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for inner in node.body:
                if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef) and (
                    inner.name == "__init__" or not inner.name.startswith("_")
                ):
                    yield f"{node.name}.{inner.name}", inner
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_"):
            yield node.name, node


def undocumented(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """Parameters without a line of their own."""
    given = function.args
    names = [
        a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg) if a
    ]
    text = ast.get_docstring(function) or ""
    known = set(re.findall(r"^ +\**(\w+): \S", text, re.MULTILINE))
    return [name for name in names if name not in ("self", "cls") and name not in known]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_parameter_of_a_public_function_has_a_line_of_its_own(path: Path) -> None:
    lacking = {
        f"{path.relative_to(ROOT)}:{function.lineno} {name}": missing
        for name, function in public_functions(ast.parse(path.read_text(encoding="utf-8")))
        if (missing := undocumented(function))
    }
    assert not lacking


def test_a_missing_line_is_found() -> None:
    text = 'def f(a, *, b):\n    """Add.\n\n    Args:\n        a: a number.\n    """\n'
    ((name, function),) = public_functions(ast.parse(text))
    assert (name, undocumented(function)) == ("f", ["b"])
