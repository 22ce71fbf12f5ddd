"""Builds the command line from the modules it needs, and runs it."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Annotated

import typer

from pebble.version import __version__

COMMANDS = ("up", "check", "doctor", "topics", "topic", "sim", "demo", "watch", "snapshot", "flash", "bench", "impair")

_HELP = """Runs Pebble robots, and looks at them.

\b
    pebble demo                four simulated robots, nothing else needed
    pebble check goob.json     is this config right, and what does it come to?
    pebble doctor goob.json    is this machine ready for it?
    pebble up goob.json        run the robot
    pebble watch goob.json     see its camera and hear its microphone
    pebble flash lamp.json     put a robot's firmware onto its board
    pebble bench control       compare MQTT and Zenoh on this machine
    pebble impair              a robot behind a bad link
"""


def run(arguments: list[str]) -> int:
    """Run one command line; returns the exit code, 2 for one that makes no sense. Raises PebbleError."""
    with _errors_in_threads_are_said():
        return _run(arguments)


def _run(arguments: list[str]) -> int:
    wanted = [arguments[0]] if arguments and arguments[0] in COMMANDS else []
    app = typer.Typer(rich_markup_mode=None, add_completion=False)
    app.callback(help=_HELP)(_options)
    for name in wanted or COMMANDS:
        import_module(f"pebble.commands.{name}").register(app)
    line = [*arguments, "--help"] if arguments in ([], ["topic"], ["bench"], ["sim"]) else arguments
    try:
        code = typer.main.get_command(app).main(line, prog_name="pebble", standalone_mode=False)
    except typer.TyperException as error:
        help_ = " ".join(["pebble", *wanted, "--help"])
        sys.stderr.write(f"pebble: {error.format_message().rstrip('.')}; see {help_}\n")
        return 2
    except typer.Abort as error:  # Ctrl-C
        raise KeyboardInterrupt from error
    return code if isinstance(code, int) else 0


@contextmanager
def _errors_in_threads_are_said() -> Iterator[None]:
    """Commands say themselves what went wrong; what they cannot know of is an error in a thread."""
    handler = logging.StreamHandler()
    handler.setLevel(logging.ERROR)
    handler.setFormatter(logging.Formatter("pebble: %(message)s"))
    logging.getLogger("pebble").addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger("pebble").removeHandler(handler)


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"pebble {__version__}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Say which Pebble this is.", callback=_say_version, is_eager=True)
    ] = False,
) -> None:
    """What stands before a command."""
    _ = version
