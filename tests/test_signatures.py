"""Calls can be read without looking up the function: few positional arguments, everything else by its name."""

import ast

import pytest

from tests.layers import ROOT

SOURCES = ("pipeline", "converters", "schemas", "examples")
MOST_PARAMETERS, MOST_ARGUMENTS = 4, 6
FILES = [path for source in SOURCES for path in sorted((ROOT / source).rglob("*.py"))]


def is_command(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Typer reads the parameters of a command, and calls it by their names."""
    return any(
        isinstance(d, ast.Call) and isinstance(d.func, ast.Attribute) and d.func.attr == "command"
        for d in function.decorator_list
    )


def wrong_functions(tree: ast.AST) -> list[str]:
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not is_command(node):
            names = [a.arg for a in (*node.args.posonlyargs, *node.args.args)]
            count = len(names) - (names[:1] in (["self"], ["cls"]))
            if count > MOST_PARAMETERS:
                found.append(f"line {node.lineno}: {node.name} has {count} positional parameters")
    return found


def wrong_calls(tree: ast.AST) -> list[str]:
    return [
        f"line {node.lineno}: {ast.unparse(node.func)} is called with {len(node.args)} positional arguments"
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and len(node.args) > MOST_ARGUMENTS
    ]


@pytest.mark.parametrize("source", SOURCES)
def test_parameters_beyond_four_are_keyword_only(source: str) -> None:
    for path in FILES:
        if path.is_relative_to(ROOT / source):
            assert not wrong_functions(ast.parse(path.read_text())), path


@pytest.mark.parametrize("source", SOURCES)
def test_no_call_has_more_than_six_positional_arguments(source: str) -> None:
    for path in FILES:
        if path.is_relative_to(ROOT / source):
            assert not wrong_calls(ast.parse(path.read_text())), path


def test_both_rules_see_what_breaks_them() -> None:
    tree = ast.parse("class A:\n    def f(self, a, b, c, d, e, *, g): ...\nf(1, 2, 3, 4, 5, 6, *seven)")
    assert wrong_functions(tree) == ["line 2: f has 5 positional parameters"]
    assert wrong_calls(tree) == ["line 3: f is called with 7 positional arguments"]
    fine = ast.parse("@app.command()\ndef f(a, b, c, d, e): ...\nf(1, 2, 3, 4, 5, 6, seven=7)")
    assert wrong_functions(fine) == wrong_calls(fine) == []
