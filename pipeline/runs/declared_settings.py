"""The settings that a stage declares, and no others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from duagc.pipeline.config.base import Config


class DeclaredSettings:
    """Settings of a run as one stage may read them: anything else is an error, not a default."""

    def __init__(self, config: Config, stage: str, declared: Sequence[str], path: str = "") -> None:
        """Keep the settings, and the names of those that may be read.

        Args:
            config: settings, or a section of them.
            stage: name of the stage.
            declared: dotted names that it may read, from the top; "" for all.
            path: of the section.
        """
        self._config, self._stage, self._declared, self._path = config, stage, declared, path

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._config, name)
        path = f"{self._path}.{name}" if self._path else name
        if any(path == d or path.startswith(f"{d}.") or not d for d in self._declared):
            return value
        if any(d.startswith(f"{path}.") for d in self._declared):
            return DeclaredSettings(value, self._stage, self._declared, path)
        raise ValueError(f"stage {self._stage} reads the setting {path}, expected one of its `settings`")

    def plain(self) -> dict[str, Any]:
        """Every declared setting by its dotted name, as plain values."""
        out: dict[str, Any] = {}
        for name in type(self._config).model_fields:
            try:
                value = getattr(self, name)
            except ValueError:
                continue
            path = f"{self._path}.{name}" if self._path else name
            if isinstance(value, Config):
                value = DeclaredSettings(value, self._stage, self._declared, path)
            if isinstance(value, DeclaredSettings):
                out |= value.plain()
            else:
                out[path] = self._config.model_dump(mode="json", include={name})[name]
        return out
