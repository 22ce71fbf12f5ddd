"""Builds the command line from the modules it needs, and runs it."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer.core import TyperCommand, TyperGroup

from pebble.version import __version__

if TYPE_CHECKING:
    from typer._click.core import Command, Context
    from typer._click.formatting import HelpFormatter

#: Each command, by what it is for: the module of pebble that has the function of its name, or registers what is
#: below it, and its line of help. One of two words is imported without the others of its group.
COMMANDS: Final = {
    "use": {
        "demo": ("extensions.lab.commands.sim", "run four simulated robots; needs nothing else"),
        "drive": ("extensions.operator.commands.drive", "drive a robot with the keys of this terminal"),
        "estop": ("extensions.operator.commands.estop", "stop robots until they are reset"),
        "watch": ("extensions.operator.commands.watch", "write a picture of a robot's camera into a file"),
        "web": ("extensions.page.commands.group", "drive, stop and watch robots in a browser"),
        "foxglove": ("extensions.foxglove.command", "show robots live in the Foxglove app"),
    },
    "own": {
        "setup": ("extensions.install.commands.setup", "make a robot of this machine, or back it up"),
        "up": ("commands.up", "run a robot"),
        "check": ("commands.check", "validate configs and summarise them"),
        "doctor": ("extensions.checks.commands.doctor", "find what is wrong with a machine, robot or broker"),
        "flash": ("extensions.install.commands.flash", "install a robot's firmware on its board"),
    },
    "write": {
        "script": ("extensions.scripts.commands.group", "write, start and stop programs that move a robot"),
        "topic": ("extensions.operator.commands.topic", "list, print, publish and measure messages"),
        "sim": ("extensions.lab.commands.sim", "simulate boards, robots, rooms and fleets"),
        "conform": ("extensions.checks.commands.conform", "judge a robot of your own by the contract"),
    },
    "share": {
        "fleet": ("extensions.fleet.commands.group", "give robots and people accounts at a broker"),
        "fleet hub": ("extensions.fleet.commands.hub", "Run a Zenoh hub for several robots."),
        "fleet gateway": ("extensions.fleet.commands.gateway", "Carry robots of a hub or a LAN to a broker."),
        "fleet audit": ("extensions.fleet.commands.audit", "Print who did what to a robot."),
        "cert": ("extensions.page.commands.cert", "make certificates, so that phones may connect"),
    },
    "measure": {
        "record": ("extensions.recordings.commands.record", "record robots"),
        "recordings": ("extensions.recordings.commands.group", "list, search, mend and export recordings"),
        "replay": ("extensions.recordings.commands.replay", "play recordings as if their robots were there"),
        "analyse": ("extensions.recordings.commands.analyse", "report bandwidth, outages and latency of recordings"),
        "bench": ("extensions.lab.commands.bench", "compare MQTT and Zenoh on this machine"),
    },
}

#: Commands of the last release, and how they are called now.
FORMER: Final = {
    "topics": "topic contract",
    "topic bw": "topic hz",
    "snapshot": "watch --picture FILE",
    "script status": "script list",
    "selftest": "doctor --running",
    "report": "doctor --report FILE.zip",
    "backup": "setup --backup FILE",
    "hub": "fleet hub",
    "gateway": "fleet gateway",
    "audit": "fleet audit",
    "impair": "bench impair",
}

_ROWS: Final = {words: row for rows in COMMANDS.values() for words, row in rows.items()}


def run(arguments: list[str]) -> int:
    """Run one command line; returns the exit code, 2 for a wrong command line. Raises PebbleError."""
    for former, now in FORMER.items():
        if arguments[: len(former.split())] == former.split():
            command = now.partition(" --")[0]
            sys.stderr.write(f'pebble: "{former}" is now "{now}": pebble {command} --help\n')
            return 2
    with _thread_errors_on_stderr():
        return _run(arguments)


def application() -> Command:
    """Build the command line; what is below a command is imported when it is needed."""
    app = typer.Typer(cls=_Pebble, rich_markup_mode=None)
    app.callback()(_options)
    return typer.main.get_command(app)


class _Pebble(TyperGroup):
    """The command ``pebble``. Its help has one line for each command, and fits on a terminal of 80 x 24."""

    def __init__(self, **attributes: Any) -> None:
        commands = {words: _Listed(words) for words in _ROWS if " " not in words}
        super().__init__(**attributes | {"commands": commands})

    def format_help(self, ctx: Context, formatter: HelpFormatter) -> None:
        formatter.write(
            f"Usage: {ctx.command_path} COMMAND …  (also: --version, COMMAND --help, --install-completion)\n"
        )
        for group, rows in COMMANDS.items():
            names = [name for name in rows if " " not in name]
            for name in names:
                formatter.write(f"{group if name == names[0] else '':<9}{name:<12}{rows[name][1]}\n")


class _Listed(TyperCommand):
    """A command of the table. It is imported when it runs, explains itself or completes what is typed."""

    def __init__(self, words: str) -> None:
        super().__init__(words.split()[-1], help=_ROWS[words][1])
        self._words = words

    def make_context(self, info_name: str | None, args: list[str], parent: Context | None = None, **extra: Any) -> Any:
        command = self._command(args)
        if extra.get("resilient_parsing"):  # for Tab
            from pebble.commands.completion import complete_values

            complete_values(command)
        return command.make_context(info_name, args, parent, **extra)

    def _command(self, arguments: list[str]) -> Command:
        below: dict[str, Command] = {
            words.split()[1]: _Listed(words) for words in _ROWS if words.startswith(f"{self._words} ")
        }
        if arguments and arguments[0] in below:
            return TyperGroup(name=self.name, commands=below, rich_markup_mode=None)
        module, name = import_module(f"pebble.{_ROWS[self._words][0]}"), str(self.name)
        app = typer.Typer(rich_markup_mode=None)
        if hasattr(module, "register"):
            module.register(app)
        else:
            app.command(name)(getattr(module, name))
        command = typer.main.get_group(app).commands[name]
        if isinstance(command, TyperGroup):
            command.commands.update(below)
        return command


def _run(arguments: list[str]) -> int:
    try:
        code = application().main(arguments, prog_name="pebble", standalone_mode=False)
    except typer.TyperException as error:
        context, message = getattr(error, "ctx", None), error.format_message().rstrip(".")
        if context is not None and message == "Missing command":
            typer.echo(context.get_help())
            return 0
        from pebble.config.secret_text import without_secrets  # of use to errors only

        wrong = without_secrets(message).replace("float range", "number").replace("int range", "whole number")
        sys.stderr.write(f"pebble: {wrong}; see {context.command_path if context else 'pebble'} --help\n")
        return 2
    except typer.Abort as error:  # Ctrl-C
        raise KeyboardInterrupt from error
    return code if isinstance(code, int) else 0


class _ErrorHandler(logging.StreamHandler):  # type: ignore[type-arg]  # of the stream of the moment
    """Writes without logins, and imports what that takes with the first error."""

    def format(self, record: logging.LogRecord) -> str:
        from pebble.runtime.parent import MaskingFormatter  # of use to errors only

        return MaskingFormatter("pebble: %(message)s").format(record)


@contextmanager
def _thread_errors_on_stderr() -> Iterator[None]:
    """Log errors to stderr: a command raises its own errors, but not those of threads."""
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
