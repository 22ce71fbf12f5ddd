"""``pebble topic``: list, print, publish and measure messages, on either transport."""

from __future__ import annotations

import math
import shutil
import sys
import time
from contextlib import nullcontext
from functools import cache
from typing import Annotated

import typer

from pebble.config.visible import shown
from pebble.contract import DRIVE
from pebble.contract.identity import parse_topic
from pebble.errors import PebbleError, TransportError
from pebble.extensions.media.rate_meter import RateMeter
from pebble.extensions.operator.client.connection import (
    Listener,
    Target,
    connected,
    put_account_into_topics,
    subscribed_stop,
)
from pebble.extensions.operator.client.named_topics import moves
from pebble.extensions.operator.client.names import Names, id_of
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.operator.commands import show
from pebble.extensions.operator.commands.draft import draft
from pebble.extensions.operator.commands.options import CaCert, PasswordFile
from pebble.extensions.operator.commands.target import with_target
from pebble.extensions.operator.commands.topic_contract import contract
from pebble.extensions.operator.signals import interrupted_by_signals, until_ended
from pebble.transports import QoS, Transport
from pebble.transports.topics import is_pattern

_TICK_S = 0.2
_REPORT_PERIOD_S = 1.0

Name = Annotated[
    str,
    typer.Argument(
        help="A metric (drive-values, outgoing/online) or a whole topic; + and # except with pub.",
        metavar="TOPIC",
        show_default=False,
    ),
]
SecondsOption = Annotated[float | None, typer.Option("--seconds", "-s", min=0.1, help="Stop after this long.")]
WindowOption = Annotated[int, typer.Option("--window", "-w", min=2, help="Number of newest messages to measure.")]

_GROUP_HELP = """List, print, publish and measure messages, on either transport.

\b
    pebble topic list -c goob.json
    pebble topic echo online -c goob.json --remote
    pebble topic pub drive-values '{"z": 0.3}' -c goob.json --rate 10 -n 20
    pebble topic hz touch-sensors --url mqtt://127.0.0.1 -r fred
    pebble topic contract
"""


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_GROUP_HELP, rich_markup_mode=None)
    for command in (list_, echo, pub, hz, contract, expand):
        group.command(command.__name__.rstrip("_"))(command)
    app.add_typer(group, name="topic")


@with_target(robot=True)
def list_(
    filter_: Annotated[str | None, typer.Argument(help="Only topics that match.", metavar="FILTER")] = None,
    seconds: Annotated[float, typer.Option("--seconds", "-s", min=0.1, help="How long to receive.")] = 2.0,
    *,
    target: Target,
) -> int:
    """List topics: whether retained, rate, size and age.

    \b
        pebble topic list -c goob.json
        pebble topic list 'pebble/+/+/outgoing/#' --url mqtt://127.0.0.1 -s 5
    """
    with connected(target) as (transport, names):
        listing = show.Listing(names)
        listener = Listener(transport, [filter_ or ("#" if target.robot is None else f"{names.base}/#")])
        end = time.monotonic() + seconds
        while (remaining_s := end - time.monotonic()) > 0:
            message = listener.next(remaining_s)
            if message is not None:
                listing.add(message, time.monotonic())
        show.print_listing(listing, time.monotonic(), time.time())
        for line in show.remarks(listing, time.time()):
            typer.echo(line)
    return 0 if listing.records else 1


@with_target(robot=True)
def echo(
    topic: Name,
    count: Annotated[int | None, typer.Option("--count", "-n", min=1, help="Stop after this many.")] = None,
    seconds: SecondsOption = None,
    raw: Annotated[bool, typer.Option("--raw", help="Only unchanged payloads, one per line.")] = False,
    *,
    target: Target,
) -> int:
    """Print messages as they arrive.

    JSON is formatted; of a binary payload the first bytes are printed as a hex dump. If the robot is stopped by an
    emergency stop, the first line shows it.

    \b
        pebble topic echo drive-values -c goob.json
        pebble topic echo '+/+/+/outgoing/online' --url mqtt://127.0.0.1 -n 4
        pebble topic echo capabilities -c goob.json --raw -n 1 | jq .value.drive
    """
    printed = 0
    with until_ended(), connected(target) as (transport, names):
        robot = _estop(transport, names, topic)
        if robot is not None and robot.stopped_by is not None:
            typer.echo(f"pebble: {show.stopped_line(robot, time.time())}", err=True)
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
        _warn_of_dropped(listener)
    return 0 if printed else 1


@with_target(robot=True)
def pub(
    topic: Name,
    payload: Annotated[str, typer.Argument(help="JSON, any text, or @FILE.", metavar="PAYLOAD", show_default=False)],
    retain: Annotated[
        bool | None,
        typer.Option("--retain/--no-retain", help="Retain it for later subscribers. [default: the contract's rule]"),
    ] = None,
    qos: Annotated[int | None, typer.Option(min=0, max=1, help="[default: the contract's rule]")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Publish even a retained command, and to a stopped robot.")
    ] = False,
    rate: Annotated[float | None, typer.Option("--rate", min=0.01, help="Repeat this many times a second.")] = None,
    count: Annotated[
        int | None, typer.Option("--count", "-n", min=1, help="Stop after this many, with --rate.")
    ] = None,
    *,
    target: Target,
) -> int:
    """Publish a message once, or repeatedly.

    A robot stops 0.75 s after the last drive command: repeat it with --rate. A robot that is stopped by an emergency
    stop is not driven. An empty payload with --retain removes the retained message.

    \b
        pebble topic pub drive-values '{"z": 0.5}' -c goob.json --rate 10 -n 20
        pebble topic pub flags/mqtt-video true -c fred.json
        pebble topic pub lights-flash @party.json --url mqtt://127.0.0.1 -r goob
    """
    repeats = rate is not None and count is None
    with until_ended() if repeats else nullcontext(), connected(target) as (transport, names):
        message = draft(names, topic, payload, retain=retain, qos=qos, force=force)
        for warning in message.warnings:
            typer.echo(f"pebble: warning: {warning}", err=True)
        robot_of_message = cache(lambda: _estop(transport, names, message.topic))  # read once, and only if needed

        def is_named(_base: str) -> bool:
            """True if the robot takes only commands whose topics have the account of the sender."""
            robot = robot_of_message()
            return robot is not None and robot.named

        moves_robot = names.channel(message.topic) is DRIVE and moves(message.payload)
        stoppable = robot_of_message() if moves_robot and not force else None
        if not force:  # with it, the topic stays as it was typed
            put_account_into_topics(transport, names, is_named)
        repetitions = 1 if rate is None else count or sys.maxsize
        for number in range(repetitions):
            if number:
                time.sleep(1 / (rate or 1))
            _refuse_stopped(stoppable)
            if not transport.publish(
                message.topic, message.payload, qos=QoS(message.qos), retain=message.retain, shared=True
            ):
                raise TransportError(
                    f"{message.topic} was not published: {transport.problem or 'the connection was lost'}"
                )
    return 0


@with_target(robot=True)
def hz(topic: Name, window: WindowOption = 100, seconds: SecondsOption = None, *, target: Target) -> int:
    """Print once a second how often messages arrive, and how many payload bytes. Retained messages do not count.

    \b
        pebble topic hz online -c goob.json --remote
        pebble topic hz front-camera --url mqtt://127.0.0.1 -r goob
    """
    meter = RateMeter(window_s=math.inf, limit=window + 1)
    with until_ended(), connected(target) as (transport, names):
        listener = Listener(transport, names.filters(topic))
        end, report_at, reported = _end(seconds), time.monotonic() + _REPORT_PERIOD_S, 0
        while time.monotonic() < end:
            message = listener.next(min(end, report_at) - time.monotonic())
            if message is not None and not message.retain:
                meter.add(time.monotonic(), len(message.payload))
            if time.monotonic() >= min(end, report_at):
                report_at += _REPORT_PERIOD_S
                _print_rate(meter, silent=meter.count == reported)
                reported = meter.count
        _warn_of_dropped(listener)
    return 0 if meter.count else 1


def expand(
    url: Annotated[str, typer.Argument(help="The broker, as mqtt://ops@host.", metavar="URL", show_default=False)],
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Take groups of streams apart beside a broker, until it is interrupted.

    A robot on a thin link with `group_hz` in its config sends its streams together, while this runs; every program at
    the broker sees the plain topics.

    \b
        pebble topic expand mqtt://127.0.0.1
    """
    from pebble.extensions.thin.expander import ANNOUNCE_S, Expander

    target = Target(url=url, password_file=password_file, ca_cert=ca_cert, program="expand")
    with interrupted_by_signals(), until_ended(), connected(target) as (transport, names):
        expander = Expander(transport)
        put_account_into_topics(transport, names, expander.is_named)
        expander.start()
        while True:
            expander.announce()
            time.sleep(ANNOUNCE_S)
    return 0


def _print_rate(meter: RateMeter, *, silent: bool) -> None:
    line = show.rate_line(meter, time.monotonic())
    if silent or line is None:
        line = "no new messages" if meter.count != 1 else "one message so far"
    typer.echo(line)
    sys.stdout.flush()


def _refuse_stopped(robot: RobotEstop | None) -> None:
    """Raise PebbleError if the robot is stopped now."""
    if robot is not None and robot.stopped_by is not None:
        raise PebbleError(
            f"{show.stopped_line(robot, time.time())}; it is not driven (--force publishes anyway). "
            f"To end the stop: pebble estop reset {shown(id_of(robot.base))}, with the same --url or --config"
        )


def _estop(transport: Transport, names: Names, topic: str) -> RobotEstop | None:
    """Return the emergency stop of the robot to which ``topic`` belongs; None if it matches several."""
    address = parse_topic(topic)
    base = names.base if address is None else address.identity.base
    if is_pattern(base):
        return None
    return subscribed_stop(transport, base)


def _warn_of_dropped(listener: Listener) -> None:
    if listener.dropped:
        typer.echo(
            f"pebble: warning: {show.counted(listener.dropped, 'message')} arrived faster than they were printed",
            err=True,
        )


def _end(seconds: float | None) -> float:
    """Return the monotonic time at which to end; infinity without a limit."""
    return float("inf") if seconds is None else time.monotonic() + seconds
