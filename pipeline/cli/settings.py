"""Commands about the settings of a run, and about the machine that it would run on."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from duagc.pipeline.cli.common import (
    EXIT_DIFFERENT,
    EXIT_FAILED,
    ConfigFile,
    Json,
    Overrides,
    app,
    config_app,
)

if TYPE_CHECKING:
    from duagc.pipeline.config.run import RunConfig


@config_app.command("show")
def config_show(config: ConfigFile = None, overrides: Overrides = None) -> None:
    """Print the resolved configuration as TOML, every setting with its documentation."""
    from duagc.pipeline.config.base import dump_config, load_config
    from duagc.pipeline.config.run import RunConfig

    print(dump_config(load_config(RunConfig, config, overrides or [])), end="")


@config_app.command("check")
def config_check(config: Annotated[Path, typer.Argument(show_default=False)]) -> None:
    """Say whether a configuration file is sound."""
    from duagc.pipeline.config.base import load_config
    from duagc.pipeline.config.run import RunConfig

    load_config(RunConfig, config)
    print(f"{config}: sound")


@config_app.command("diff")
def config_diff(
    first: Annotated[Path, typer.Argument(metavar="A", help="A TOML file, or a run.", show_default=False)],
    second: Annotated[
        Path | None, typer.Argument(metavar="B", help="Another one; else the defaults.", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """Say which settings differ, with both values.

    Exit code 3 if any does.

    Example: `duagc config diff outputs/before outputs/after`
    """
    from duagc.pipeline.config.base import differing_settings
    from duagc.pipeline.config.run import RunConfig

    rows = differing_settings(_settings(first), RunConfig() if second is None else _settings(second))
    if as_json:
        print(json.dumps({name: [_plain(one), _plain(other)] for name, one, other in rows}, indent=2))
    else:
        for name, one, other in rows:
            print(f"{name}: {_plain(one)!r} and {_plain(other)!r}")
    if rows:
        raise typer.Exit(EXIT_DIFFERENT)


def _settings(path: Path) -> "RunConfig":
    """Settings of a file, or of a run."""
    from duagc.pipeline.config.base import load_config
    from duagc.pipeline.config.run import RunConfig

    return load_config(RunConfig, path / "config.toml" if path.is_dir() else path)


def _plain(value: object) -> object:
    """What JSON can hold."""
    from duagc.pipeline.config.base import Config

    if isinstance(value, Config):
        return value.model_dump(mode="json")
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


@app.command()
def doctor(
    path: Annotated[
        Path, typer.Option("--out", "-o", help="Where runs would go: its disk is looked at.")
    ] = Path("outputs"),
    as_json: Json = False,
) -> None:
    """Say whether this machine can do the job: versions, instruction sets, memory, disk, optional libraries.

    Everything that lacks has the line that mends it. Exit code 1 if a run would fail.
    """
    from duagc.pipeline.doctor import examine, text

    findings = examine(path)
    print(json.dumps([vars(f) for f in findings], indent=2) if as_json else text(findings))
    if any(f.state == "missing" for f in findings):
        raise typer.Exit(EXIT_FAILED)
