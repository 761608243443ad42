"""Every setting is documented: `duagc config show` and the reference page are made of these texts."""

from duagc.pipeline.config.base import Config
from duagc.pipeline.config.run import RunConfig


def undocumented(model: type[Config], prefix: str = "") -> list[str]:
    """Dotted names of settings without documentation; a section may have that of its class."""
    names, documented = [], model.documentation()
    for name, field in model.model_fields.items():
        section = field.annotation
        if isinstance(section, type) and issubclass(section, Config):
            names += undocumented(section, f"{prefix}{name}.")
            names += [] if name in documented or section.__doc__ else [f"{prefix}{name}"]
        elif not documented.get(name):
            names.append(f"{prefix}{name}")
    return names


def test_every_setting_is_documented() -> None:
    assert undocumented(RunConfig) == []


def test_a_setting_without_documentation_is_found() -> None:
    class Bare(Config):
        speed: float = 1.0

    assert undocumented(Bare) == ["speed"]


class Wheel(Config):
    """What others are made of."""

    radius_m: float = 0.1
    """Of the tire,
    when it is inflated."""
    spokes: int = 8


class DrivenWheel(Wheel):
    """One that has a motor."""

    torque_nm: float = 2.0
    """At the axle."""
    spokes: int = 12
    """More than others have."""


def test_documentation_is_inherited() -> None:
    assert Wheel.documentation() == {"radius_m": "Of the tire,\nwhen it is inflated."}
    assert DrivenWheel.documentation() == {
        "radius_m": "Of the tire,\nwhen it is inflated.",
        "torque_nm": "At the axle.",
        "spokes": "More than others have.",
    }
