"""Every setting is documented: `duagc config show` and the reference page are made of these texts."""

from duagc.pipeline.config.base import Config
from duagc.pipeline.config.run import RunConfig


def undocumented(model: type[Config], prefix: str = "") -> list[str]:
    """Dotted names of settings without documentation; a section may have that of its class."""
    names = []
    for name, field in model.model_fields.items():
        section = field.annotation
        if isinstance(section, type) and issubclass(section, Config):
            names += undocumented(section, f"{prefix}{name}.")
            names += [] if field.description or section.__doc__ else [f"{prefix}{name}"]
        elif not field.description:
            names.append(f"{prefix}{name}")
    return names


def test_every_setting_is_documented() -> None:
    assert undocumented(RunConfig) == []


def test_a_setting_without_documentation_is_found() -> None:
    class Bare(Config):
        speed: float = 1.0

    assert undocumented(Bare) == ["speed"]
