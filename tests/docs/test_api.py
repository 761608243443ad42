"""Every public name of `duagc` is documented in the form that the site reads: one line under `Args:` per parameter."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_args

import pytest

import duagc


def functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Public functions, methods of public classes, and functions of public modules, by their names."""
    for name in sorted(duagc.__all__):
        value = getattr(duagc, name)
        if inspect.isfunction(value):
            yield name, value
        elif inspect.isclass(value) or inspect.ismodule(value):
            module = value.__name__ if inspect.ismodule(value) else value.__module__
            for inner, found in vars(value).items():
                function = getattr(found, "__func__", found)
                if inspect.isfunction(function) and function.__module__ == module and inner[0] != "_":
                    yield f"{name}.{inner}", function


FUNCTIONS = dict(functions())


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_parameter_has_a_line(name: str) -> None:
    function = FUNCTIONS[name]
    expected = [p for p in inspect.signature(function).parameters if p not in ("self", "cls")]
    text = inspect.cleandoc(function.__doc__ or "")
    assert text
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", text, re.DOTALL | re.MULTILINE)
    assert (re.findall(r"^    (\w+):", section[1], re.MULTILINE) if section else []) == expected


@pytest.mark.parametrize("name", duagc.__all__)
def test_a_path_may_be_a_text(name: str) -> None:
    """So that nobody has to know which of the public functions wants which."""
    value = getattr(duagc, name)
    methods = [f for of, f in FUNCTIONS.items() if of.partition(".")[0] == name]
    if inspect.isclass(value) and "__init__" in vars(value) and not is_dataclass(value):
        methods.append(value.__init__)
    for function in methods:
        for parameter in inspect.signature(function, eval_str=True).parameters.values():
            kinds = get_args(parameter.annotation) or (parameter.annotation,)
            assert Path not in kinds or str in kinds, parameter


def test_there_are_about_forty_public_names_each_with_a_docstring() -> None:
    assert 30 <= len(duagc.__all__) <= 80
    assert [name for name in duagc.__all__ if not inspect.getdoc(getattr(duagc, name))] == []
