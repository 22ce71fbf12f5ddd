"""A function as a program, with a robot and its options: ``run(main)``."""

import inspect
import logging
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from pebble.config import Config, load
from pebble.contract.payloads import LAST_RUN, LONGEST_SUMMARY, MOST_MAIN
from pebble.errors import ConfigError, PebbleError, TransportError
from pebble.extensions.operator.places import launcher_runs
from pebble.extensions.scripts.runs import CONFIG, RUN, LocalScriptsLock, next_run
from pebble.extensions.scripts.script.guard import END_S, Guard
from pebble.extensions.scripts.script.options import OneLineParser, form, parse
from pebble.extensions.scripts.script.robot import EXIT_ENDED, Robot
from pebble.runtime.connections import local_transport
from pebble.runtime.parent import set_up_logging
from pebble.transports import State, Transport

_CONNECT_S = 2.0

log = logging.getLogger(__name__)


def run(
    main: Callable[..., None],
    *,
    label: str = "",
    summary: str = "",
    main_options: Sequence[str] = (),
    needs: Mapping[str, Mapping[str, Any]] | None = None,
    drives: bool = True,
) -> None:
    """Run ``main(robot)``, or ``main(robot, options)`` with your own msgspec Struct, as this script's whole program.

    ``label`` is the script's name for operators, ``summary`` the sentence that says what the script does (default: the
    first line of main's docstring). ``main_options`` names up to three options that operators see first (default: the
    first three). ``needs`` lists other scripts that must run, with their options. With ``drives=False`` the script only
    measures: an emergency stop does not end the script, and every command raises PebbleError. Returns when main has
    returned; raises SystemExit if main failed or was stopped. The wheels are stopped in any case.
    """
    options = _options_of(main)
    name = _name()
    if sys.argv[1:] == ["--describe"]:
        words = {"label": label or name, "summary": summary or _first_line(main)}
        _describe(words, options, main_options, needs or {}, drives=drives)
        return
    arguments = _arguments(main, label or name, options)
    set_up_logging("INFO")
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    try:
        _Program(name, drives=drives).run(main, *arguments)
    except PebbleError as error:
        for line in str(error).splitlines():
            log.error("%s", line)
        sys.exit(1)
    except Exception:  # the process boundary
        log.exception("%s failed", name)
        sys.exit(1)


def run_for(config: Path, main: Callable[[Robot], None], *, name: str, drives: bool = True) -> None:
    """Run ``main(robot)`` as a script, for a command of ``pebble`` that does nothing else.

    Raises PebbleError if there is no such robot, and what ``main`` raises; Stopped if the script was ended.
    """
    set_up_logging("WARNING")
    _Program(name, drives=drives).run(main, config, ())


def _options_of(main: Callable[..., None]) -> type[msgspec.Struct] | None:
    """Return the type of main's second parameter; None without one. Raises TypeError if main cannot be called."""
    parameters = list(inspect.signature(main, eval_str=True).parameters.values())
    if not 1 <= len(parameters) <= 2:
        raise TypeError(f"{main.__name__}: write main(robot) or main(robot, options)")
    if len(parameters) == 1:
        return None
    struct = parameters[1].annotation
    if not (isinstance(struct, type) and issubclass(struct, msgspec.Struct)):
        raise TypeError(f"{main.__name__}: annotate {parameters[1].name} with a msgspec Struct of yours")
    return struct


def _name() -> str:
    """Return the name of the script's folder; of the file, if that is not the entry point of a folder."""
    path = Path(sys.argv[0]).resolve()
    return path.parent.name if path.stem == "run" else path.stem


def _documentation(main: Callable[..., None]) -> str:
    return inspect.getdoc(main) or inspect.getdoc(inspect.getmodule(main)) or ""


def _first_line(main: Callable[..., None]) -> str:
    line = _documentation(main).partition("\n")[0]
    return line[:LONGEST_SUMMARY] if line.isprintable() else ""


def _describe(
    words: Mapping[str, str],
    options: type[msgspec.Struct] | None,
    first: Sequence[str],
    needs: Mapping[str, Mapping[str, Any]],
    *,
    drives: bool,
) -> None:
    """Print the form that operators see.

    ``words``: the script's label and summary. ``first``: the options that they see first, main_options of :func:`run`.
    """
    settings = [] if options is None else form(options)
    keys = [setting.key for setting in settings]
    unknown = [key for key in first if key not in keys]
    if unknown:
        raise TypeError(f"main_options: there is no option {unknown[0]}")
    if len(first) > MOST_MAIN:
        raise TypeError(f"main_options: {len(first)} are more than {MOST_MAIN}")
    texts = {key: value for key, value in {**words, "main": list(first)}.items() if value}
    description: dict[str, Any] = {
        **texts,
        "configs": [setting.entry() for setting in settings],
        "dependencies": [{"file": file, "config": dict(config)} for file, config in needs.items()],
    }
    if not drives:
        description["drives"] = False
    sys.stdout.write(msgspec.json.encode(description).decode() + "\n")


def _arguments(
    main: Callable[..., None], label: str, options: type[msgspec.Struct] | None
) -> tuple[Path, tuple[msgspec.Struct, ...]]:
    """Return the robot's config file, and main's further arguments, from the command line."""
    parser = OneLineParser(prog=Path(sys.argv[0]).name, description=_documentation(main) or label)
    parser.add_argument(
        "--config",
        metavar="ROBOT.json",
        default=os.environ.get(CONFIG),
        help=f"the robot's config file (default: ${CONFIG})",
    )
    parser.add_argument(
        "--describe", action="store_true", help="print the form that operators see, as JSON; only alone"
    )
    chosen, values = parse(options or _NoOptions, sys.argv[1:], parser)
    if values.describe:  # not as the only word, which `run` has handled before
        parser.error("--describe goes alone: it prints the form and starts nothing")
    if values.config is None:
        parser.error("which robot? Add its config file, for example: --config goob.json")
    return Path(values.config), () if options is None else (chosen,)


class _NoOptions(msgspec.Struct):
    """The options of a script that has none."""


class _Program:
    """The process of a script."""

    def __init__(self, name: str, *, drives: bool) -> None:
        self._name, self._drives = name, drives
        self._robot: Robot | None = None

    def run(self, main: Callable[..., None], config_path: Path, arguments: tuple[msgspec.Struct, ...]) -> None:
        Guard(self._end_on_signal)  # its own thread ends the run at a signal
        config = load(config_path, lenient=True)  # as the launcher does, which runs the robot
        LocalScriptsLock(config).hold()  # until the process ends
        transport = _connected(config, config_path)
        robot = self._robot = Robot(
            config, transport, _numbered(config), name=self._name, on_ended=self._end_run, drives=self._drives
        )
        try:
            main(robot, *arguments)
        finally:
            robot.close()

    def _end_on_signal(self, number: int) -> None:
        if self._robot is None:
            os._exit(128 + number)
        self._robot.end("a signal", 128 + number)

    def _end_run(self, why: str) -> None:
        log.warning("%s", why)
        assert self._robot is not None  # noqa: S101 - only a robot calls this
        self._robot.end(why, EXIT_ENDED)
        time.sleep(END_S)
        os._exit(EXIT_ENDED)


def _connected(config: Config, path: Path) -> Transport:
    """Return the open local transport. Raises PebbleError that names what is missing, for a script run in a shell.

    A script of the manager, which sets RUN, goes on without a connection: the transport makes one when it can.
    """
    transport = local_transport(config, f"script-{os.getpid()}")
    transport.open(_CONNECT_S)
    if transport.state is not State.CONNECTED and RUN not in os.environ:
        why = transport.problem or f"no answer within {_CONNECT_S:g} s"
        transport.close()
        raise TransportError(f"{config.identity.id} is not up ({why}): start it with `pebble up {path}`")
    if RUN not in os.environ and not launcher_runs(config.run_dir()):
        log.warning("%s is not up, so it does not move: start it with `pebble up %s`", config.identity.id, path)
    return transport


def _numbered(config: Config) -> Callable[[int], int]:
    """Return a function that gives this run its number. Raises ConfigError.

    If a manager started the script, the manager has chosen it; else it is a new one, above the function's argument.
    """
    text = os.environ.get(RUN)
    if text is None:
        return lambda above: next_run(config, above)
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= LAST_RUN):
        raise ConfigError(f"{RUN}: {text!r} is not a number from 1 to {LAST_RUN}")
    return lambda _: int(text)
