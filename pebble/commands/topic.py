"""``pebble topic``: see and send what travels, on either transport."""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from pebble.commands import show
from pebble.commands.connection import PASSWORD, Listener, Target, connected
from pebble.commands.outgoing import draft
from pebble.commands.rates import Rates
from pebble.errors import TransportError
from pebble.transports import QoS

_TICK_S = 0.2
_SAY_EVERY_S = 1.0

Name = Annotated[
    str,
    typer.Argument(
        help="A metric (drive-values, outgoing/online) or a whole topic; all but pub take + and # too.",
        show_default=False,
    ),
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="A robot's config file: use its own transport.", metavar="CONFIG")
]
UrlOption = Annotated[
    str | None, typer.Option(help="mqtt://[USER@]HOST[:PORT], mqtts://… or zenoh:RUN_DIR.", metavar="URL")
]
RobotOption = Annotated[
    str | None, typer.Option("--robot", "-r", help="Whose topics short names mean.", metavar="[SYSTEM/TYPE/]ID")
]
RemoteOption = Annotated[
    bool, typer.Option("--remote", help="With --config: the broker where operators are, not the robot's own side.")
]
PasswordOption = Annotated[
    Path | None, typer.Option(help=f"File with the password for --url; else ${PASSWORD}.", metavar="FILE")
]
CaOption = Annotated[Path | None, typer.Option(help="Authority to trust with mqtts://.", metavar="FILE")]
SecondsOption = Annotated[float | None, typer.Option("--seconds", "-s", min=0.1, help="Stop after this long.")]
WindowOption = Annotated[int, typer.Option("--window", "-w", min=2, help="Messages that the figures are about.")]

_GROUP_HELP = """See and send messages, on either transport.

\b
    pebble topic list -c goob.json
    pebble topic echo online -c goob.json --remote
    pebble topic pub drive-values '{"z": 0.3}' -c goob.json --rate 10 -n 20
    pebble topic hz touch-sensors --url mqtt://127.0.0.1 -r fred
"""


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_GROUP_HELP, rich_markup_mode=None)
    for command in (list_, echo, pub, hz, bw):
        group.command(command.__name__.rstrip("_"))(command)
    app.add_typer(group, name="topic")


def list_(
    filter_: Annotated[str | None, typer.Argument(help="Only topics that match.", metavar="FILTER")] = None,
    seconds: Annotated[float, typer.Option("--seconds", "-s", min=0.1, help="How long to listen.")] = 2.0,
    config: ConfigOption = None,
    url: UrlOption = None,
    robot: RobotOption = None,
    remote: RemoteOption = False,
    password_file: PasswordOption = None,
    ca_cert: CaOption = None,
) -> int:
    """Topics seen within some seconds: kept or not, rate, size and age.

    \b
        pebble topic list -c goob.json
        pebble topic list 'pebble/+/+/outgoing/#' --url mqtt://127.0.0.1 -s 5
    """
    from pebble.commands.listing import Listing, print_listing

    with connected(_target(config, url, robot, remote, password_file, ca_cert)) as (transport, names):
        listing = Listing(names)
        listener = Listener(transport, [filter_ or ("#" if robot is None else f"{names.base}/#")])
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            message = listener.next(left)
            if message is not None:
                listing.add(message, time.monotonic())
        print_listing(listing, time.monotonic(), time.time())
    return 0 if listing.seen else 1


def echo(
    topic: Name,
    count: Annotated[int | None, typer.Option("--count", "-n", min=1, help="Stop after this many.")] = None,
    seconds: SecondsOption = None,
    raw: Annotated[bool, typer.Option("--raw", help="Payloads as they are, one per line.")] = False,
    config: ConfigOption = None,
    url: UrlOption = None,
    robot: RobotOption = None,
    remote: RemoteOption = False,
    password_file: PasswordOption = None,
    ca_cert: CaOption = None,
) -> int:
    """Print messages as they come.

    JSON is printed readably, binary payloads as a hex dump of their beginning.

    \b
        pebble topic echo drive-values -c goob.json
        pebble topic echo '+/+/+/outgoing/online' --url mqtt://127.0.0.1 -n 4
        pebble topic echo capabilities -c goob.json --raw -n 1 | jq .value.drive
    """
    printed = 0
    with connected(_target(config, url, robot, remote, password_file, ca_cert)) as (transport, names):
        listener = Listener(transport, names.filters(topic))
        end = _end(seconds)
        while time.monotonic() < end and printed != count:
            message = listener.next(min(_TICK_S, end - time.monotonic()))
            if message is None:
                continue
            printed += 1
            if raw:
                sys.stdout.buffer.write(message.payload + b"\n")
                sys.stdout.buffer.flush()
            else:
                typer.secho(show.headline(message, time.time()), dim=True)
                typer.echo(show.body(message.payload, shutil.get_terminal_size().columns))
        _tell_dropped(listener)
    return 0 if printed else 1


def pub(
    topic: Name,
    payload: Annotated[str, typer.Argument(help="JSON, any text, or @FILE.", show_default=False)],
    retain: Annotated[
        bool | None,
        typer.Option("--retain/--no-retain", help="Keep it for later subscribers. [default: the contract's rule]"),
    ] = None,
    qos: Annotated[int | None, typer.Option(min=0, max=1, help="[default: the contract's rule]")] = None,
    force: Annotated[bool, typer.Option("--force", help="Send even a kept command.")] = False,
    rate: Annotated[float | None, typer.Option("--rate", min=0.01, help="Repeat this many times a second.")] = None,
    count: Annotated[
        int | None, typer.Option("--count", "-n", min=1, help="Stop after this many, with --rate.")
    ] = None,
    config: ConfigOption = None,
    url: UrlOption = None,
    robot: RobotOption = None,
    remote: RemoteOption = False,
    password_file: PasswordOption = None,
    ca_cert: CaOption = None,
) -> int:
    """Send one message, or the same one again and again.

    A robot stops 0.75 s after the last drive command: repeat it with --rate. An empty payload with --retain removes
    a kept copy.

    \b
        pebble topic pub drive-values '{"z": 0.5}' -c goob.json --rate 10 -n 20
        pebble topic pub flags/mqtt-video true -c fred.json
        pebble topic pub lights-flash @party.json --url mqtt://127.0.0.1 -r goob
    """
    with connected(_target(config, url, robot, remote, password_file, ca_cert)) as (transport, names):
        message = draft(names, topic, payload, retain=retain, qos=qos, force=force)
        for doubt in message.doubts:
            typer.echo(f"pebble: warning: {doubt}", err=True)
        for number in range(1 if rate is None else count or sys.maxsize):
            if number:
                time.sleep(1 / (rate or 1))
            if not transport.publish(message.topic, message.payload, qos=QoS(message.qos), retain=message.retain):
                raise TransportError(f"{message.topic} was not sent: {transport.problem or 'the connection was lost'}")
    return 0


def hz(
    topic: Name,
    window: WindowOption = 100,
    seconds: SecondsOption = None,
    config: ConfigOption = None,
    url: UrlOption = None,
    robot: RobotOption = None,
    remote: RemoteOption = False,
    password_file: PasswordOption = None,
    ca_cert: CaOption = None,
) -> int:
    """How often messages come, once a second. Kept copies do not count.

    \b
        pebble topic hz online -c goob.json --remote
    """
    return _measure("hz", topic, window, seconds, _target(config, url, robot, remote, password_file, ca_cert))


def bw(
    topic: Name,
    window: WindowOption = 100,
    seconds: SecondsOption = None,
    config: ConfigOption = None,
    url: UrlOption = None,
    robot: RobotOption = None,
    remote: RemoteOption = False,
    password_file: PasswordOption = None,
    ca_cert: CaOption = None,
) -> int:
    """How many payload bytes come per second, once a second. Kept copies do not count.

    \b
        pebble topic bw front-camera --url mqtt://127.0.0.1 -r goob
    """
    return _measure("bw", topic, window, seconds, _target(config, url, robot, remote, password_file, ca_cert))


def _measure(what: str, topic: str, window: int, seconds: float | None, target: Target) -> int:
    rates = Rates(window)
    with connected(target) as (transport, names):
        listener = Listener(transport, names.filters(topic))
        end, say_at, said = _end(seconds), time.monotonic() + _SAY_EVERY_S, 0
        while time.monotonic() < end:
            message = listener.next(min(end, say_at) - time.monotonic())
            if message is not None and not message.retain:
                rates.add(time.monotonic(), len(message.payload))
            if time.monotonic() >= min(end, say_at):
                say_at += _SAY_EVERY_S
                _say(rates, what, silent=rates.count == said)
                said = rates.count
        _tell_dropped(listener)
    return 0 if rates.count else 1


def _say(rates: Rates, what: str, *, silent: bool) -> None:
    line = rates.frequency_line() if what == "hz" else rates.bandwidth_line()
    if silent or line is None:
        line = "no new messages" if rates.count != 1 else "one message so far"
    typer.echo(line)
    sys.stdout.flush()


def _tell_dropped(listener: Listener) -> None:
    if listener.dropped:
        typer.echo(f"pebble: warning: {listener.dropped} messages came faster than they could be shown", err=True)


def _end(seconds: float | None) -> float:
    return float("inf") if seconds is None else time.monotonic() + seconds


def _target(
    config: Path | None,
    url: str | None,
    robot: str | None,
    remote: bool,
    password_file: Path | None,
    ca_cert: Path | None,
) -> Target:
    return Target(config=config, url=url, robot=robot, remote=remote, password_file=password_file, ca_cert=ca_cert)
