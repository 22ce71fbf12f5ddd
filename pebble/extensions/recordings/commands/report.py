"""Lines that several commands for recordings print: times, unreadable parts, and files left unchanged."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, tzinfo
from pathlib import Path

import typer

from pebble.config.visible import shown
from pebble.errors import PebbleError
from pebble.extensions.recordings.files.recorded import FOREVER_NS


@contextmanager
def errors_of_files(path: Path | None = None) -> Iterator[None]:
    """Raise PebbleError in place of OSError. ``path`` is named if the error names no file."""
    try:
        yield
    except OSError as error:
        raise PebbleError(f"{error.filename or path}: {error.strerror or error}") from None


def report_unread(lines: list[str]) -> int:
    """Print the lines; return the exit code, 1 if there are any."""
    for line in lines:
        typer.echo(f"pebble: {shown(line)}", err=True)
    return 1 if lines else 0


def report_left(error: object) -> None:
    """Print that a file stays as it is, and why."""
    typer.echo(f"pebble: left as it is: {shown(str(error))}", err=True)


def local_time(ns: int, *, fraction: bool = False) -> str:
    moment = datetime.fromtimestamp(ns / 1e9, UTC).astimezone()
    text = moment.strftime("%Y-%m-%d %H:%M:%S")
    return f"{text}.{ns // 10**6 % 1000:03d}" if fraction else text


def period_words(since_ns: int, until_ns: int) -> str:
    """Return a period in words: in local time with its zone, and in UTC."""
    local, utc = _words(since_ns, until_ns, None), _words(since_ns, until_ns, UTC)
    return local if local == utc else f"{local}, that is {utc}"


def _words(since_ns: int, until_ns: int, zone: tzinfo | None) -> str:
    begin = _moment(since_ns, zone) if since_ns > 0 else "the beginning"
    end = _moment(until_ns, zone) if until_ns < FOREVER_NS else "the end"
    return f"from {begin} to {end}"


def _moment(ns: int, zone: tzinfo | None) -> str:
    return f"{datetime.fromtimestamp(ns // 10**9, UTC).astimezone(zone):%Y-%m-%d %H:%M:%S %Z}"


def one_line(text: str) -> str:
    return " ".join(text.split("\n")).replace("\t", " ")
