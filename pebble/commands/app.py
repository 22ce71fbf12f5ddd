"""Builds the command line from the modules it needs, and runs it."""

import logging
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Annotated

import typer

from pebble.config.secret_text import without_secrets
from pebble.runtime.parent import MaskingFormatter
from pebble.version import __version__

#: Each command, and the module of this package that has the function of its name, or registers what is below it.
COMMANDS = {
    "setup": "setup",
    "up": "up",
    "check": "check",
    "doctor": "doctor",
    "selftest": "selftest",
    "report": "report",
    "backup": "backup",
    "topics": "topics",
    "topic": "topic",
    "estop": "estop",
    "drive": "drive",
    "script": "script.group",
    "sim": "sim",
    "demo": "sim",
    "watch": "watch",
    "snapshot": "watch",
    "web": "web.group",
    "foxglove": "foxglove",
    "record": "recordings.record",
    "recordings": "recordings.group",
    "replay": "recordings.replay",
    "analyse": "recordings.analyse",
    "cert": "cert",
    "fleet": "fleet.group",
    "hub": "fleet.hub",
    "gateway": "fleet.gateway",
    "audit": "fleet.audit",
    "conform": "conform",
    "flash": "flash",
    "bench": "bench",
}

_REGISTERED = ("topic", "script", "sim", "web", "recordings", "cert", "fleet", "bench")
#: What prints its help when nothing follows.
_GROUPS = [
    words.split() for words in ("", "topic", "bench", "sim", "script", "cert", "fleet", "recordings", "web user")
]

_HELP = """Runs and inspects Pebble robots.

\b
    pebble demo                run four simulated robots; needs nothing else
    sudo pebble setup          make a robot of this machine
    pebble check goob.json     validate a config and summarise it
    pebble doctor goob.json    check that this machine is ready for the robot
    pebble up goob.json        run the robot
    pebble selftest goob.json  test the running robot, end to end
    pebble report goob.zip     pack what helps to find a fault, no secrets
    pebble backup goob.tar     pack what a new machine needs to be this robot
    pebble drive goob.json     drive it with the keys of this terminal
    pebble estop goob.json     stop the robot until it is reset
    pebble script new follow   write a first program that moves a robot
    pebble watch goob.json     show its camera and play its microphone
    pebble web goob.json       drive, stop and watch robots in a browser
    pebble foxglove goob.json  show robots live in the Foxglove app
    pebble record --url URL    record robots; for recordings, replay, analyse
    pebble cert init NAME      make certificates, so that phones can, too
    pebble fleet init hall     give robots and people accounts at a broker
    pebble audit goob.json     show who did what to the robot
    pebble conform rover       judge a robot of your own by the contract
    pebble flash lamp.json     install a robot's firmware on its board
    pebble bench control       compare MQTT and Zenoh on this machine
    pebble bench impair        measure robots behind an impaired network
"""


def run(arguments: list[str]) -> int:
    """Run one command line; returns the exit code, 2 for a wrong command line. Raises PebbleError."""
    with _thread_errors_on_stderr():
        return _run(arguments)


def application(names: Iterable[str] = COMMANDS) -> typer.Typer:
    """The command line with these commands."""
    app = typer.Typer(rich_markup_mode=None, add_completion=False)
    app.callback(help=_HELP)(_options)
    for name in names:
        module = import_module(f"pebble.commands.{COMMANDS[name]}")
        if name in _REGISTERED:
            module.register(app)
        else:
            app.command(name)(getattr(module, name))
    return app


def _run(arguments: list[str]) -> int:
    wanted = [arguments[0]] if arguments and arguments[0] in COMMANDS else []
    app = application(wanted or COMMANDS)
    line = [*arguments, "--help"] if arguments in _GROUPS else arguments
    try:
        code = typer.main.get_command(app).main(line, prog_name="pebble", standalone_mode=False)
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        wrong = (
            without_secrets(error.format_message().rstrip("."))
            .replace("float range", "number")
            .replace("int range", "whole number")
        )
        sys.stderr.write(f"pebble: {wrong}; see {context.command_path if context else 'pebble'} --help\n")
        return 2
    except typer.Abort as error:  # Ctrl-C
        raise KeyboardInterrupt from error
    return code if isinstance(code, int) else 0


@contextmanager
def _thread_errors_on_stderr() -> Iterator[None]:
    """Log errors to stderr: a command raises its own errors, but not those of threads."""
    handler = logging.StreamHandler()
    handler.setLevel(logging.ERROR)
    handler.setFormatter(MaskingFormatter("pebble: %(message)s"))
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
