"""``pebble bench``: the command of each comparison, which follows from its declaration, and those for all results."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from pebble.bench.comparison import FOLDER, MODULES, Comparison, Option, chosen, find
from pebble.commands.options import Output, Quick, split_names
from pebble.errors import PebbleError

if TYPE_CHECKING:
    from typer._click.core import Command, Context

_GROUP_HELP = """Comparisons, side by side in one run on this machine.

\b
    pebble bench frames
    pebble bench compare before/frames.json after/frames.json
"""
_NAMES = [name for name in MODULES if name != "impair"]  # which is a command of its own


def compare(
    a: Annotated[Path, typer.Argument(help="Results of the older run.", metavar="A.json", show_default=False)],
    b: Annotated[Path, typer.Argument(help="Results of the newer run.", metavar="B.json", show_default=False)],
    everything: Annotated[bool, typer.Option("--all", help="Also list what did not change.")] = False,
) -> int:
    """Did medians, p99 or losses get worse from A to B, beyond noise? Exit code 1 if so.

    Both files come from the same comparison, if possible on the same machine with the same options.
    """
    from pebble.bench.judging.compare import run

    return run(a, b, everything=everything)


def echo(
    url: Annotated[
        str, typer.Argument(help="mqtt://HOST[:PORT] or mqtts://HOST[:PORT]", metavar="URL", show_default=False)
    ],
) -> int:
    """Send back what `pebble bench control --far` sends, until Ctrl-C. Runs on the other machine."""
    from pebble.bench.control.far import serve

    return serve(url)


def report(
    folder: Annotated[Path, typer.Argument(help="Folder for results, pictures and README.md.", metavar="FOLDER")],
    quick: Quick = False,
    only: Annotated[str | None, typer.Option(help="Some of them, separated by commas.", metavar="NAMES")] = None,
    render: Annotated[bool, typer.Option("--render", help="Only write pictures and README.md again.")] = False,
) -> int:
    """Run all comparisons and pebble impair, one after the other, and write a report.

    Takes an hour and a half, with --quick some five minutes. If a comparison fails, the others still run, and
    the exit code is 1. Without root, comparisons that need it are left out.
    """
    from pebble.bench.report import run, write

    if render:
        typer.echo(f"Written: {write(folder)}")
        return 0
    return run(chosen([] if only is None else split_names(only)), folder, quick=quick)


class Comparisons(TyperGroup):
    """Imports the declaration of a comparison when its command is wanted."""

    def list_commands(self, ctx: Context) -> list[str]:
        return [*_NAMES, *super().list_commands(ctx)]

    def get_command(self, ctx: Context, cmd_name: str) -> Command | None:
        if cmd_name not in _NAMES:
            return super().get_command(ctx, cmd_name)
        return command_named(cmd_name)


def command_named(name: str) -> Command:
    app = typer.Typer(rich_markup_mode=None, add_completion=False)
    app.command(name)(command_of(find(name)))
    return typer.main.get_command(app)


def command_of(about: Comparison) -> Callable[..., int]:
    """The function of a command, with the options of its comparison."""
    options = {option.name.replace("-", "_"): option for option in about.options}

    def run(*, quick: bool = False, output: Path = FOLDER, **given: Any) -> int:
        from pebble.bench.engine import run as run_

        wanted = {options[name].key: _parsed(options[name], value) for name, value in given.items()}
        mode = about.mode(wanted)
        return run_(mode.run_of(quick=quick, output=output, **wanted))

    declared: dict[str, tuple[Any, Any]] = {name: (_annotation(about, one), None) for name, one in options.items()}
    declared |= {"quick": (Quick, False), "output": (Output, about.folder)}
    run.__doc__ = about.help
    run.__annotations__ = {name: annotation for name, (annotation, _) in declared.items()}
    run.__signature__ = inspect.Signature([  # type: ignore[attr-defined]
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for name, (annotation, default) in declared.items()
    ])  # fmt: skip
    return run


def _annotation(about: Comparison, option: Option) -> Any:
    """The option for typer, with a default as text: None if it is not given."""
    kind: Any = list[str] if option.many else option.kind
    default = about.full.get(option.key)
    shown = "" if default in (None, False) or option.known else f" [default: {option.as_word(default)}]"
    own = typer.Option(f"--{option.name}", help=option.help + shown, metavar=option.metavar, show_default=False)
    return Annotated[kind | None, own]


def _parsed(option: Option, value: Any) -> Any:
    """Values may be separated by commas, too. Raises PebbleError for text in place of numbers."""
    if not option.many:
        return value
    try:
        return [option.kind(one) for words in value or () for one in split_names(words)] or None
    except ValueError:
        raise PebbleError(f"--{option.name}: {','.join(value)} is not a list of numbers") from None


def register(app: typer.Typer) -> None:
    group = typer.Typer(cls=Comparisons, help=_GROUP_HELP, rich_markup_mode=None)
    for command in (compare, echo, report):
        group.command(command.__name__)(command)
    app.add_typer(group, name="bench")
