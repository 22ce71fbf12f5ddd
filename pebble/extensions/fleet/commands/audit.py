"""``pebble fleet audit``: who did what to this robot, as its bridge has logged it."""

import json
import time
from operator import itemgetter
from typing import Annotated, Any

import typer

from pebble.commands.up import ConfigArgument
from pebble.config import load
from pebble.errors import PebbleError
from pebble.extensions.fleet.robot_audit import files
from pebble.extensions.operator.commands.show import print_table
from pebble.ownership import read_plain
from pebble.runtime.as_owner import as_owner

_COLUMNS = ("t", "what", "who", "from", "count")


def audit(
    config: ConfigArgument,
    limit: Annotated[int, typer.Option("--limit", "-n", help="Rows to print.", min=1, max=100_000)] = 50,
) -> int:
    """Print who did what to a robot, on its own computer, the newest last. Names with ? are claims.

    A row with × 12 stands for 12 more such rows within a minute. The log is a file of JSON lines, for jq and grep.

    \b
        pebble fleet audit goob.json
    """
    newer, older = files(load(config))
    try:
        with as_owner(newer.parent):
            content = b"\n".join(read_plain(file) for file in (older, newer) if file.exists())
    except OSError as error:
        raise PebbleError(f"{error.filename}: {error.strerror}; run it as the robot's user") from None
    lines = [line for line in content.splitlines() if line]
    rows = sorted((row for row in map(_row, lines[-limit:]) if row), key=itemgetter(0))  # by time: × rows come late
    print_table(("time", "what", "who", "from", ""), [columns for _, columns in rows])
    typer.echo(f"{newer}: {len(lines):,} rows" if lines else "nothing yet: the bridge of this robot writes it")
    if unread := min(limit, len(lines)) - len(rows):
        typer.echo(f"{unread:,} lines cannot be read: a power cut leaves such, or somebody has changed them")
    return 0


def _row(line: bytes) -> tuple[float, tuple[str, ...]] | None:
    """Return the time and the columns of a line of the log; None if it cannot be read."""
    try:
        row: dict[str, Any] = json.loads(line)
        at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(row["t"]))
    except (ValueError, LookupError, TypeError, ArithmeticError, OSError, RecursionError):
        return None
    what, who, place, count = (str(row.get(column, "")) for column in _COLUMNS[1:])
    more = ", ".join(f"{key} {value}" for key, value in row.items() if key not in _COLUMNS and value != "")
    return row["t"], (at, f"{what} × {count}" if count else what, who, place, more)
