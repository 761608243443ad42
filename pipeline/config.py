"""Configuration: frozen models with defaults and documentation, overridden by TOML or by `a.b=value`."""

from pydantic import BaseModel, ConfigDict


class Config(BaseModel):
    """Base of every section: immutable, unknown names refused, defaults validated."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, use_attribute_docstrings=True)
