"""``pebble recordings``: lists, searches, mends, exports and deletes recordings."""

import typer

from pebble.extensions.recordings.commands.export import export, import_
from pebble.extensions.recordings.commands.files import mend, rm
from pebble.extensions.recordings.commands.look import info, list_, search

_HELP = """List, search, mend, export and delete recordings.

\b
    pebble recordings list DIR
    pebble recordings info DIR --since 10:00
    pebble recordings search DIR --robot goob -t outgoing/logs --text WARN
    pebble recordings export DIR walk.mkv -r goob --since 10:00 --until +5m
    pebble recordings mend DIR       after a power cut, without a recorder
"""


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_HELP, rich_markup_mode=None)
    for command in (list_, info, search, mend, export, import_, rm):
        group.command(command.__name__.rstrip("_"))(command)
    app.add_typer(group, name="recordings")
