"""What a computation depends on, and which part of that changed."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from duagc.pipeline.base.files import digest_of_values

SHOWN = 3  # names in a line; the others are counted


@dataclass(frozen=True)
class StageKey:
    """Everything that a stage computes its results from. Equal keys mean equal results.

    Attributes:
        stage: its name.
        robot: whose, or which component's; None: the team's.
        code: digest of every module of it.
        libraries: versions.
        settings: that it declares, by name.
        inputs: content digests, by what they are of.
    """

    stage: str
    robot: str | None
    code: Mapping[str, str]
    libraries: Mapping[str, str]
    settings: Mapping[str, Any]
    inputs: Mapping[str, str]

    @cached_property
    def digest(self) -> str:
        """64 hex characters."""
        return digest_of_values(self.plain())

    def plain(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)

    def changes(self, earlier: StageKey) -> list[str]:
        """What is other than in an earlier key, in words; the part that explains most comes first.

        Args:
            earlier: the key.
        """
        code = [f"{name} {what}" for name, what in _differences(earlier.code, self.code, values=False)]
        inputs = [f"{name} {what}" for name, what in _differences(earlier.inputs, self.inputs, values=False)]
        settings = [f"{name} {what}" for name, what in _differences(earlier.settings, self.settings)]
        libraries = [f"{name} {what}" for name, what in _differences(earlier.libraries, self.libraries)]
        parts = {"settings": settings, "code": code, "inputs": inputs, "libraries": libraries}
        return [f"{part}: {_shortened(lines)}" for part, lines in parts.items() if lines]

    def distance(self, earlier: StageKey) -> int:
        """How many names of parts differ from those of an earlier key.

        Args:
            earlier: the key.
        """
        parts = ("code", "libraries", "settings", "inputs")
        return sum(
            len(list(_differences(getattr(earlier, part), getattr(self, part), values=False)))
            for part in parts
        )


def _differences(
    before: Mapping[str, Any], after: Mapping[str, Any], values: bool = True
) -> Iterator[tuple[str, str]]:
    """Names whose values differ, and how: both values, or a word."""
    for name in sorted({*before, *after}):
        if name not in before:
            yield name, "is new"
        elif name not in after:
            yield name, "is gone"
        elif before[name] != after[name]:
            yield name, f"{json.dumps(before[name])} -> {json.dumps(after[name])}" if values else "changed"


def _shortened(lines: list[str]) -> str:
    more = f" and {len(lines) - SHOWN} more" if len(lines) > SHOWN else ""
    return ", ".join(lines[:SHOWN]) + more
