"""What the commands share: the application, options, how they speak. Light at import."""

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from duagc import __version__
from duagc.pipeline.base.errors import DuagError
from duagc.pipeline.base.said_lines import say_line

EXIT_FAILED, EXIT_DIFFERENT = 1, 3
Command = TypeVar("Command", bound=Callable[..., Any])


def of_home(path: str) -> str:
    """A path whose `~` is the home of the user; the shell leaves it in `--out=~/room` and in quotes."""
    return os.path.expanduser(path)


def _checked_path(path: Path) -> Path:
    """A path with the home of the user in the place of `~`, which libraries that take only UTF-8 write, too."""
    try:
        named_alike = os.fsencode(path) == str(path).encode()
    except UnicodeEncodeError:  # bytes that are no letters
        named_alike = False
    if not named_alike:
        raise DuagError(f"{path}: is no name in UTF-8, expected one, and a locale such as C.UTF-8")
    return Path(of_home(str(path)))


class Commands(typer.Typer):
    """Commands that get their paths with the home of the user in the place of `~`."""

    def command(self, *args: Any, **named: Any) -> Callable[[Command], Command]:
        """Like `typer.Typer.command`."""
        register = super().command(*args, **named)

        def registered(command: Command) -> Command:
            @wraps(command)
            def called(**values: Any) -> Any:
                return command(
                    **{n: _checked_path(v) if isinstance(v, Path) else v for n, v in values.items()}
                )

            register(called)
            return command

        return registered


app = Commands(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
config_app = Commands(no_args_is_help=True, help="Settings of a run and their documentation.")
bench_app = Commands(no_args_is_help=True, help="Speed, side by side with something else in the same run.")
golden_app = Commands(
    no_args_is_help=True, help="A few bytes that stand for a run, to compare later ones with."
)
app.add_typer(config_app, name="config")
app.add_typer(golden_app, name="golden")
app.add_typer(bench_app, name="bench")

Out = Annotated[
    Path, typer.Option("--out", "-o", help="Folder to write; must not exist.", show_default=False)
]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there.")]
Workers = Annotated[int, typer.Option(min=1, help="Robots prepared at the same time; changes no result.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="a.b=VALUE", help="Change one setting; repeatable.")
]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="TOML file; see `duagc config show`.")]
StoreFolder = Annotated[
    Path | None,
    typer.Option(
        "--store",
        metavar="DIR",
        help="Results that are not computed again; else $DUAGC_STORE, else .duagc-store next to the run.",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]


def say(line: str) -> None:
    """Progress goes to standard error, results to standard output."""
    say_line(f"duagc: {line}")


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"duagc {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Recordings of a robot team to one uncertainty-weighted Gaussian map, without a central server.

    Start with `duagc demo`, or with your own data: `duagc convert`, then `duagc run`.
    """
