"""The command line: its table of commands, and how a command is run."""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from pebble.errors import ConfigError, PebbleError
from pebble.extension import Command as Offered
from pebble.extension import Extension, ours, packages, part, refuse_claims
from pebble.version import __version__

log = logging.getLogger(__name__)

#: The command of the core.
_CORE: Final = {"up": Offered("pebble.commands.up:up", "run a robot", "own", 20)}
#: The headings of the help, in order; commands of other packages stand last.
_GROUPS: Final = ("use", "own", "write", "share", "measure", "more")


def commands(words: Sequence[str] = ()) -> dict[str, Offered]:
    """Return the commands by their words, in the order of the help.

    Packages of others are looked at only if none of our commands begins with the first of ``words``.
    """
    offered = dict(_CORE)
    for extension in ours():
        offered |= extension.commands
    if not words or words[0] not in offered:
        foreign = list(packages())
        try:
            refuse_claims(Extension(name="core", package="Pebble", commands=_CORE), [*ours(), *foreign])
        except ConfigError as error:
            if words and not words[0].startswith("-"):
                raise
            log.error("%s", error)  # the help still has ours
            foreign = []
        for extension in foreign:
            offered |= extension.commands
    return dict(sorted(offered.items(), key=lambda item: (_GROUPS.index(item[1].group), item[1].rank)))


def run(arguments: list[str]) -> int:
    """Run a command line; return the exit code, 2 if it is wrong. Raises PebbleError."""
    for extension in ours():
        for former, now in extension.former.items():  # a command of earlier versions, and its successor
            if arguments[: len(former.split())] == former.split():
                command = now.partition(" --")[0]  # without options, which its help explains
                sys.stderr.write(f'pebble: "{former}" is now "{now}": pebble {command} --help\n')
                return 2
    with _thread_errors_on_stderr():
        return _run(arguments)


def application(words: Sequence[str] = ()) -> Any:
    """Return the command ``pebble``, which parses a command line; ``words``: its beginning, if known."""
    app = typer.Typer(cls=_Pebble, rich_markup_mode=None)
    app.callback()(_options)
    command = typer.main.get_command(app)
    assert isinstance(command, _Pebble)  # noqa: S101 - by ``cls`` above
    command.offer(commands(words))
    return command


class _Pebble(TyperGroup):
    """The top command ``pebble``. Its help has one line per command, and fits on a terminal of 80 x 24."""

    _offered: Mapping[str, Offered] = {}

    def offer(self, offered: Mapping[str, Offered]) -> None:
        """Set the commands."""
        self._offered = offered
        self.commands = {words: _Listed(words, offered) for words in offered if " " not in words}

    def format_help(self, ctx: Any, formatter: Any) -> None:
        usage = f"Usage: {ctx.command_path} COMMAND …  (also: --version, COMMAND --help, --install-completion)\n"
        formatter.write(usage)
        last_group = ""
        for name, row in self._offered.items():
            if " " not in name:  # subcommands are in the help of their command
                formatter.write(f"{'' if row.group == last_group else row.group:<9}{name:<12}{row.help}\n")
                last_group = row.group


class _Listed(TyperCommand):
    """A command of the table of :func:`commands`. Its module is imported only to run, explain or complete it."""

    def __init__(self, words: str, offered: Mapping[str, Offered]) -> None:
        super().__init__(words.split()[-1], help=offered[words].help)
        self._words, self._offered = words, offered

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        command = self._command(args)
        _refuse_nan(command)
        if extra.get("resilient_parsing"):  # for Tab
            _complete_values(command)
        return command.make_context(info_name, args, parent, **extra)

    def _command(self, arguments: list[str]) -> Any:
        """Return the loaded command, or the group of its subcommands in the table if ``arguments`` begin with one."""
        listed: dict[str, Any] = {
            words.split()[1]: _Listed(words, self._offered)
            for words in self._offered
            if words.startswith(f"{self._words} ")
        }
        if arguments and arguments[0] in listed:  # the module of this command is not needed
            return TyperGroup(name=self.name, commands=listed, rich_markup_mode=None)
        loaded, name = part(self._offered[self._words].place), str(self.name)
        app = typer.Typer(rich_markup_mode=None)
        if hasattr(loaded, "register"):  # a module, whose command has subcommands
            loaded.register(app)
        else:
            app.command(name)(loaded)
        command = typer.main.get_group(app).commands[name]
        if isinstance(command, TyperGroup):
            command.commands.update(listed)
        return command


class _Completion(NamedTuple):
    """A value as it is given to a shell that completes a word."""

    value: str
    type: str = "plain"
    help: str | None = None


def _complete_values(command: Any) -> None:
    """Let Tab complete arguments of a command and its subcommands, by their names in help (Extension.completions)."""
    places = {name: place for extension in ours() for name, place in extension.completions.items()}
    for parameter in command.params:
        if place := places.get(parameter.metavar or ""):
            parameter.shell_complete = partial(_values, part(place))
    if isinstance(command, TyperGroup):
        for subcommand in command.commands.values():
            _complete_values(subcommand)


def _refuse_nan(command: Any) -> None:
    """Let a command and its subcommands refuse NaN and infinity, which ranges of options let pass."""
    for parameter in command.params:
        if parameter.type.name.startswith("float"):
            parameter.callback = parameter.callback or _finite
    for subcommand in getattr(command, "commands", {}).values():
        _refuse_nan(subcommand)


def _finite(_context: Any, _parameter: Any, value: float | None) -> float | None:
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number")
    return value


def _values(values: Callable[[Any], list[str]], context: Any, incomplete: str) -> list[_Completion]:
    return [_Completion(value) for value in values(context) if value.startswith(incomplete)]


def _run(arguments: list[str]) -> int:
    try:
        code = application(arguments).main(arguments, prog_name="pebble", standalone_mode=False)
    except typer.TyperException as error:  # of a wrong command line
        context, message = getattr(error, "ctx", None), error.format_message().rstrip(".")
        if context is not None and message == "Missing command":  # of a group, as `pebble fleet`: show what it has
            typer.echo(context.get_help())
            return 0
        from pebble.config.secret_text import without_secrets  # of use to errors only

        # A mistyped option's name is no secret, but is hidden if it looks like one before its suggestions.
        wrong = message if message.startswith("No such option") else without_secrets(message)
        wrong = wrong.replace("float range", "number").replace("int range", "whole number")
        file = message.rpartition("(")[2].rstrip(")")  # of an argument too many
        options = () if context is None else context.command.params
        if file.endswith(".json") and Path(file).is_file() and any("-c" in option.opts for option in options):
            wrong += f": use -c {file}"
        sys.stderr.write(f"pebble: {wrong}; see {context.command_path if context else 'pebble'} --help\n")
        return 2
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "pebble"):  # a mistake of ours, with its traceback
            raise
        install = 'pip install "pebble-robot[all]"'
        raise PebbleError(f"{arguments[0]} needs the package {package}, which is not installed: {install}") from None
    except typer.Abort as error:  # Ctrl-C
        raise KeyboardInterrupt from error
    return code if isinstance(code, int) else 0


class _ErrorHandler(logging.StreamHandler):  # type: ignore[type-arg]  # of the stream of the moment
    """A handler for errors that hides the logins in them. Its formatter is imported with the first error."""

    def format(self, record: logging.LogRecord) -> str:
        from pebble.runtime.parent import MaskingFormatter  # of use to errors only

        return MaskingFormatter("pebble: %(message)s").format(record)


@contextmanager
def _thread_errors_on_stderr() -> Iterator[None]:
    """Log exceptions of threads to stderr. Those of the command itself are raised."""
    handler = _ErrorHandler()
    handler.setLevel(logging.ERROR)
    logging.getLogger("pebble").addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger("pebble").removeHandler(handler)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"pebble {__version__}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version of Pebble.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    _ = version
