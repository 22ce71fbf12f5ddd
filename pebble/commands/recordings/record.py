"""``pebble record``: records what robots and operators publish."""

import logging
import re
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from pebble.client.connection import Target, password, resolve
from pebble.client.url import settings_of
from pebble.commands.options import with_target
from pebble.commands.terminal import show
from pebble.errors import PebbleError
from pebble.launcher.sd_notify import SystemdNotifier
from pebble.recordings.recorder import metrics
from pebble.recordings.recorder.recorder import Recorder
from pebble.recordings.recorder.settings import EVERYTHING, Connection, Options, Settings, load
from pebble.recordings.recorder.source import Source
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports import MqttSettings
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
    rotate_size: Annotated[str, typer.Option(help="… or at this size.", metavar="SIZE")] = "512M",
    keep: Annotated[str, typer.Option(help="Delete the oldest beyond this; 0: never.", metavar="SIZE")] = "0",
    keep_media: Annotated[str, typer.Option(help="Delete older pictures and sound; 0: never.", metavar="TIME")] = "0",
    keep_state: Annotated[str, typer.Option(help="Delete older state; 0: never.", metavar="TIME")] = "0",
    free: Annotated[str, typer.Option(help="Leave this free on the disk.", metavar="SIZE")] = "2G",
    sync: Annotated[str, typer.Option(help="Make all durable so often: a power cut loses it.", metavar="TIME")] = "5s",
    level: Annotated[int, typer.Option(help="Zstandard's level; 0: no compression.", min=0, max=19)] = 3,
    protocol: Annotated[str, typer.Option(help="MQTT 5 or 3.1.1; only 5 shows who retains.", metavar="5|3.1.1")] = "5",
    length: Annotated[str | None, typer.Option("--for", help="Stop after this long.", metavar="TIME")] = None,
    settings: Annotated[
        Path | None, typer.Option(help="A recorder's own file instead of all other options.", metavar="FILE")
    ] = None,
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
    if settings is not None:
        return _run(*_of_file(settings), length=length)
    options = Options(
        rotate_seconds=seconds(rotate),
        rotate_bytes=size(rotate_size),
        keep_bytes=size(keep),
        keep_media_days=seconds(keep_media) / 86_400,
        keep_state_days=seconds(keep_state) / 86_400,
        free_bytes=size(free),
        sync_seconds=seconds(sync),
        level=level,
        media=media,
    )
    kind, transport, names, where = resolve(target)
    chosen = tuple(filters) if filters else (f"{names.base}/#",) if target.config is not None else EVERYTHING
    for filter_ in chosen:
        check_filter(filter_)
    connection = (kind, _modern(transport, protocol), chosen, "", where)
    return _run(into or Path("recordings"), options, [connection], length=length)


_Connection = tuple[str, Any, tuple[str, ...], str, str]


def _of_file(path: Path) -> tuple[Path, Options, list[_Connection]]:
    found: Settings = load(path)
    connections = []
    for one in found.connections:
        kind, transport = _transport_of(one, path.parent)
        connections.append((kind, _modern(transport, one.protocol), one.filters, one.name, one.url))
    plain = {name: getattr(found, name) for name in Options.__struct_fields__}
    return found.into, Options(**plain), connections


def _transport_of(connection: Connection, folder: Path) -> tuple[str, Any]:
    """The kind of transport and its settings. Raises PebbleError."""
    file, ca_cert = (path and folder / path for path in (connection.password_file, connection.ca_cert))
    secret = None if file is None else password(file)
    return settings_of(connection.url, password=secret, password_file=file, ca_cert=ca_cert)


def _modern(transport: Any, protocol: str) -> Any:
    if not isinstance(transport, MqttSettings):
        return transport
    if protocol not in ("5", "3.1.1"):
        raise PebbleError(f'--protocol "{protocol}": use 5 or 3.1.1')
    return replace(transport, protocol=protocol)


def _each_host(kind: str, transport: Any, filters: tuple[str, ...], name: str, where: str) -> Iterator[_Connection]:
    """A recording tells what each of several brokers has sent."""
    if not isinstance(transport, MqttSettings) or not transport.hosts:
        yield kind, transport, filters, name, where
        return
    for one in transport.each():
        place = f"{one.host}:{one.port}"
        yield kind, one, filters, f"{name} {place}".strip(), place


def _run(into: Path, options: Options, connections: list[_Connection], *, length: str | None) -> int:
    logging.getLogger("pebble.recordings").setLevel(logging.INFO)
    ends_at = None if length is None else time.monotonic() + seconds(length)
    about = {"filters": " ".join(filter_ for one in connections for filter_ in one[2])}
    recorder = Recorder(into, options, about)
    connections = [one for connection in connections for one in _each_host(*connection)]
    sources = [Source(recorder, kind, transport, filters, name) for kind, transport, filters, name, _ in connections]
    with ExitStack() as stack:
        stack.enter_context(interrupted_by_signals())
        try:
            recorder.start()
            stack.callback(recorder.stop)
            for source, connection in zip(sources, connections, strict=True):
                source.start()
                stack.callback(source.close)
                _print_start(source, connection, into)
            _serve(recorder, sources, ends_at)
        except KeyboardInterrupt:
            pass
        if sys.stderr.isatty():
            typer.echo("", err=True)
    _print_end(recorder, into)
    return 0


def _serve(recorder: Recorder, sources: list[Source], ends_at: float | None) -> None:
    systemd = SystemdNotifier()
    systemd.ready()
    began = printed = written = time.monotonic()
    while ends_at is None or time.monotonic() < ends_at:
        time.sleep(_TURN_S)
        for source in sources:
            source.check()
        if recorder.alive:
            systemd.watchdog()
        now = time.monotonic()
        if now - printed >= _LINE_S:
            printed = now
            line = _line(recorder, sources, now - began)
            systemd.status(line)
            if sys.stderr.isatty():
                sys.stderr.write(f"\r\x1b[2K{line}")
                sys.stderr.flush()
        if now - written >= _METRICS_S:
            written = now
            _write_metrics(recorder, sources)


def _write_metrics(recorder: Recorder, sources: list[Source]) -> None:
    try:
        metrics.write(recorder, sources)
    except OSError:  # a full disk: the recorder says so
        return


def _line(recorder: Recorder, sources: list[Source], seconds_: float) -> str:
    counters = recorder.counters
    parts = [
        f"{show.duration(seconds_)}",
        f"{counters['messages']:,} messages",
        show.size(counters["bytes"]),
        f"{len(recorder.robots)} robots",
    ]
    if counters["dropped"]:
        parts.append(f"{counters['dropped']:,} dropped")
    lost = [source.problem for source in sources if not source.connected]
    return "  ".join(
        parts + [f"not connected: {problem}" for problem in lost] + [recorder.blocked] * bool(recorder.blocked)
    )


def _print_start(source: Source, connection: _Connection, into: Path) -> None:
    where = connection[4]
    if source.connected:
        typer.echo(f"Recording {where} into {into} (Ctrl-C ends it)", err=True)
    else:
        typer.echo(f"pebble: cannot connect to {where} yet: {source.problem or 'no answer'}; trying again", err=True)


def _print_end(recorder: Recorder, into: Path) -> None:
    counters = recorder.counters
    lost = f", {counters['dropped']:,} dropped" if counters["dropped"] else ""
    typer.echo(
        f"Recorded {counters['messages']:,} messages ({show.size(counters['bytes'])}) of "
        f"{len(recorder.robots)} robots{lost}; `pebble recordings info {into}` shows them",
        err=True,
    )


def seconds(text: str) -> float:
    """Raises PebbleError."""
    return _value(text, _SECONDS, "a duration: 30s, 10min, 1h or 7d")


def size(text: str) -> int:
    """The size in bytes. Raises PebbleError."""
    return int(_value(text.removesuffix("B"), _BYTES, "a size: 64M, 2G or 1T"))


def _value(text: str, units: dict[str, int], form: str) -> float:
    match = _NUMBER.fullmatch(text.strip())
    unit = units.get(match[2]) if match else None
    if match is None or unit is None:
        raise PebbleError(f'"{text}" is not {form}')
    return float(match[1]) * unit
