"""``pebble record``: records what robots and operators publish."""

import logging
import re
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated, Final

import typer

from pebble.errors import PebbleError
from pebble.extensions.operator.client.connection import Target, connecting, resolve
from pebble.extensions.operator.commands import show
from pebble.extensions.operator.commands.target import with_target
from pebble.extensions.operator.notices import printing_thread
from pebble.extensions.operator.signals import interrupted_by_signals
from pebble.extensions.recordings.recorder import metrics
from pebble.extensions.recordings.recorder.recorder import Recorder
from pebble.extensions.recordings.recorder.settings import EVERYTHING, Options
from pebble.extensions.recordings.recorder.source import Source
from pebble.launcher.sd_notify import SystemdNotifier
from pebble.runtime.as_owner import as_owner
from pebble.runtime.output import has_room
from pebble.transports.topics import check_filter

_TURN_S = 0.25
_LINE_S = 1.0
_METRICS_S = 10.0
_SECONDS: Final = {"": 1, "s": 1, "min": 60, "m": 60, "h": 3600, "d": 86_400}
_BYTES: Final = {"": 1, "k": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
_NUMBER: Final = re.compile(r"(\d+(?:\.\d+)?)\s*([A-Za-z]*)")


@with_target(program="record")
def record(
    *,
    target: Target,
    filters: Annotated[
        list[str] | None,
        typer.Option("--filter", "-f", help="Record these topics only, + and # allowed; repeatable.", metavar="FILTER"),
    ] = None,
    into: Annotated[Path | None, typer.Option(help="Folder. [default: recordings]", metavar="DIR")] = None,
    media: Annotated[bool, typer.Option("--media/--no-media", help="Record pictures and sound.")] = True,
    rotate: Annotated[str, typer.Option(help="Begin new files after this long.", metavar="TIME")] = "1h",
    keep: Annotated[str, typer.Option(help="Delete the oldest beyond this; 0: never.", metavar="SIZE")] = "0",
    keep_media: Annotated[str, typer.Option(help="Delete older pictures and sound; 0: never.", metavar="TIME")] = "0",
    length: Annotated[str | None, typer.Option("--for", help="Stop after this long.", metavar="TIME")] = None,
) -> int:
    """Record robots into MCAP files, until Ctrl-C.

    Everything of a broker with --url; one robot's inside with --config, or its remote side with --config and --remote.
    Nothing is lost when the recorder is killed, but what came in the last second.

    \b
        pebble record --url mqtt://127.0.0.1
        pebble record -c goob.json --into walk --for 10min
        pebble record --url mqtts://me@broker --keep 50G --keep-media 7d
        pebble recordings list recordings
    """
    into = into or Path("recordings")
    options = Options(
        rotate_seconds=seconds(rotate),
        keep_bytes=size(keep),
        keep_media_days=seconds(keep_media) / 86_400,
        media=media,
    )
    kind, transport, names, where = resolve(target)
    default = EVERYTHING if target.config is None else (f"{names.base}/#",)
    chosen = tuple(filters) if filters else default
    for filter_ in chosen:
        check_filter(filter_)
    recorder = Recorder(into, options, {"filters": " ".join(chosen)})
    with as_owner(into), suppress(OSError):  # the recorder reports it
        into.mkdir(mode=0o750, parents=True, exist_ok=True)
    # as_owner: now that the folder exists, as another user may have made it. A log line waits for no terminal.
    with as_owner(into), printing_thread():
        _run(recorder, Source(recorder, kind, transport, chosen), where, length)
    if sys.stderr.isatty():
        typer.echo("", err=True)  # ends the line that _serve rewrites
    _print_end(recorder, into)
    return 0


def _run(recorder: Recorder, source: Source, where: str, length: str | None) -> None:
    """Record for ``length``, such as ``10min``; None: until a signal."""
    logging.getLogger("pebble.extensions.recordings").setLevel(logging.INFO)
    ends_at = None if length is None else time.monotonic() + seconds(length)
    with ExitStack() as stack:
        stack.enter_context(interrupted_by_signals())
        try:
            recorder.start()
            stack.callback(recorder.stop)
            with connecting(where, lambda: ""):
                source.start()
            stack.callback(source.close)
            _print_start(source, where, recorder.folder.root)
            _serve(recorder, source, ends_at)
        except KeyboardInterrupt:
            pass


def _serve(recorder: Recorder, source: Source, ends_at: float | None) -> None:
    """Wait until ``ends_at``; report the recorder's state to systemd, to the terminal and as metrics."""
    systemd = SystemdNotifier()
    systemd.ready()
    began = printed = written = time.monotonic()
    while ends_at is None or time.monotonic() < ends_at:
        time.sleep(_TURN_S)
        source.check()
        if recorder.alive:
            systemd.watchdog()
        now = time.monotonic()
        if now - printed >= _LINE_S:
            printed = now
            line = _line(recorder, source, now - began)
            systemd.status(line)
            if sys.stderr.isatty() and has_room(sys.stderr.fileno()):
                sys.stderr.write(f"\r\x1b[2K{line}")
                sys.stderr.flush()
        if now - written >= _METRICS_S:
            written = now
            with suppress(OSError):  # a full disk: the recorder says so
                metrics.write(recorder, [source])


def _line(recorder: Recorder, source: Source, seconds_: float) -> str:
    counters = recorder.counters
    parts = [show.duration(seconds_), show.counted(counters["messages"], "message"), show.size(counters["bytes"])]
    if counters["dropped"]:
        parts.append(f"{counters['dropped']:,} dropped")
    if not source.connected:
        parts.append(f"not connected: {source.problem}")
    if recorder.blocked:
        parts.append(recorder.blocked)
    return "  ".join(parts)


def _print_start(source: Source, where: str, into: Path) -> None:
    if source.connected:
        typer.echo(f"Recording {where} into {into} (Ctrl-C ends it)", err=True)
    else:
        typer.echo(f"pebble: cannot connect to {where} yet: {source.problem or 'no answer'}; trying again", err=True)


def _print_end(recorder: Recorder, into: Path) -> None:
    counters = recorder.counters
    lost = f", {counters['dropped']:,} dropped" if counters["dropped"] else ""
    typer.echo(
        f"Recorded {show.counted(counters['messages'], 'message')} ({show.size(counters['bytes'])} of payload){lost}; "
        f"`pebble recordings info {into}` shows them",
        err=True,
    )


def seconds(text: str) -> float:
    """Parse a duration; return seconds. Raises PebbleError."""
    return _value(text, _SECONDS, "a duration: 30s, 10min, 1h or 7d")


def size(text: str) -> int:
    """Parse a size; return bytes. Raises PebbleError."""
    return int(_value(text.removesuffix("B"), _BYTES, "a size: 64M, 2G or 1T"))


def _value(text: str, units: dict[str, int], form: str) -> float:
    match = _NUMBER.fullmatch(text.strip())
    unit = units.get(match[2]) if match else None
    if match is None or unit is None:
        raise PebbleError(f'"{text}" is not {form}')
    return float(match[1]) * unit
