"""Arguments and options that commands for recordings share."""

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from pebble.extensions.recordings.period import SINCE_HELP, UNTIL_HELP, parse_period

RecordingsArgument = Annotated[list[Path], typer.Argument(help="Recordings, or folders of them.", metavar="DIR|FILE…")]
Since = Annotated[str | None, typer.Option(help=SINCE_HELP, metavar="TIME")]
Until = Annotated[str | None, typer.Option(help=UNTIL_HELP, metavar="TIME")]
RobotOption = Annotated[
    str | None, typer.Option("--robot", "-r", help="Only this one.", metavar="[SYSTEM/TYPE/]ID", show_default=False)
]
Topics = Annotated[
    list[str] | None,
    typer.Option(
        "--topic", "-t", help="outgoing/logs, or a whole topic; + and # allowed; repeatable.", metavar="FILTER"
    ),
]


def period(since: str | None, until: str | None) -> tuple[int, int]:
    return parse_period(since, until, now=datetime.now())
