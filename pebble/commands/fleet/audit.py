"""``pebble fleet audit``: who did what to this robot, as the robot itself has kept it."""

import time
from collections.abc import Iterable
from typing import Annotated

import msgspec
import typer

from pebble.commands.options import ConfigArgument
from pebble.commands.terminal.show import print_table
from pebble.config import load
from pebble.contract import chain
from pebble.errors import PebbleError
from pebble.services.mqtt_bridge.audit import chain_files

_KNOWN = ("n", "t", "what", "who", "count", "since", "after", "h")


def audit(
    config: ConfigArgument,
    verify: Annotated[bool, typer.Option("--verify", help="Name the first line that was changed.")] = False,
    refused: Annotated[bool, typer.Option("--refused", help="Print what was refused instead.")] = False,
    limit: Annotated[int, typer.Option("--limit", "-n", help="Lines to print.", min=1, max=100_000)] = 50,
) -> int:
    """Print who did what to a robot, on its own computer, the newest last. Names with ? are claims.

    \b
        pebble fleet audit goob.json
        pebble fleet audit goob.json --refused
        pebble fleet audit goob.json --verify
    """
    files = chain_files(load(config))
    try:
        if verify:
            found = [_verify(name, one.lines()) for name, one in files.items()]
            return 1 if any(found) else 0
        lines = files["refused" if refused else "acts"].newest(0, limit)
    except OSError as error:
        raise PebbleError(f"{error.filename}: {error.strerror}; run it as the robot's user") from None
    print_table(("line", "time", "what", "who", ""), [row for raw in lines if (row := _row(raw))])
    if not lines:
        typer.echo("nothing yet: the bridge of this robot writes it")
    return 0


def _verify(name: str, lines: Iterable[bytes]) -> str:
    whole = list(lines)
    problem = chain.verify(whole)
    newest = chain.parse(whole[-1]) if whole else None
    text = f"{len(whole):,} lines follow each other" + (f", the newest is {newest.n} {newest.h}" if newest else "")
    typer.echo(f"{name}: {problem or text}")
    return problem


def _row(raw: bytes) -> tuple[str, ...]:
    line = chain.parse(raw)
    if line is None:
        return ()
    fields = msgspec.json.decode(raw)
    count, since = fields.get("count", 1), fields.get("since", line.t)
    what = line.what
    if count != 1 and isinstance(count, int) and isinstance(since, int | float):  # a file may have been edited
        what = f"{what} × {count:,} since {_time(since, '%H:%M:%S')}"
    more = ", ".join(f"{key} {value}" for key, value in fields.items() if key not in _KNOWN)
    return str(line.n), _time(line.t, "%Y-%m-%d %H:%M:%S"), what, line.who, more


def _time(t: float, form: str) -> str:
    try:
        return time.strftime(form, time.localtime(t))
    except (OverflowError, ValueError, OSError):
        return f"{t:g}"
