"""Commands about the settings of a run."""

from pathlib import Path
from typing import Annotated

import typer

from duagc.pipeline.cli.common import ConfigFile, Overrides, config_app


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
