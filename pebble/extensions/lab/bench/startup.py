"""Measures a robot's start-up, how fast a late subscriber receives all retained messages, and the first picture.

Every launch is a fresh robot at a remote broker that runs already; an operator subscribes there, and sends drive
commands at 20 Hz, before the launcher is started. ``first heartbeat``, ``all ready`` and ``first drive obeyed`` count
from just before that, the last one until a line that moves the wheels has reached the MCU's pty. ``late …``: from the
begin of a connection until the last retained topic has arrived. ``picture …``: from an operator's request until the
first picture is decoded, from a camera that no program uses, or for a second operator while the first one watches.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from rich.console import Console
from rich.table import Table

from pebble.config import load
from pebble.contract.encodings import ALL_VIDEO
from pebble.errors import PebbleError
from pebble.extensions.lab.bench.clients import UP_S, RobotSubscriber, StockClient, driving, ready_robot
from pebble.extensions.lab.bench.results import Cell, Results, begin, round_cell
from pebble.extensions.lab.bench.rounds import Progress, in_turn, measure_rounds
from pebble.extensions.lab.bench.show import RATIOS, Shown, compared, plain_table, spread
from pebble.extensions.lab.rig.robot import BASE, KINDS, Robot, one_robot
from pebble.extensions.media.decode import Decoded
from pebble.extensions.operator.client.media_receiver import MediaReceiver
from pebble.runtime.connections import local_transport
from pebble.transports import Message, MqttSettings, Transport, create

STARTED: Final = ("first heartbeat", "all ready", "first drive obeyed")
LATE: Final = ("late operator", "late operator, paho", "late service")
PICTURES: Final = tuple(f"picture, {encoding}, {state}" for encoding in ALL_VIDEO for state in ("at rest", "running"))
MEASURES: Final = (*STARTED, *LATE, *PICTURES)
_PICTURES_EVERY = 5  # launches, the first of which is followed by one of a robot with a camera
_CAMERA = "camera_publisher"  # runs while it is requested
_LATE_S = 10.0  # for one late subscriber
_QUIET_S = 0.3  # without another retained message until all count as received
_REST_S, _PICTURE_S = 10.0, 15.0
_EVERYTHING = f"{BASE}/#"
_POLL_S = 0.02  # how often an operator looks whether a key frame is missing

_Receive = Callable[[Any], None]  # is called with each message


@dataclass(frozen=True, slots=True)
class Settings:
    """Launches of each variant, one in each round, and late subscribers of each launch."""

    variants: Sequence[str] = KINDS
    rounds: int = 10
    joins: int = 5


FULL: Final = Settings()
QUICK: Final = Settings(rounds=3, joins=3)


def run(settings: Settings, console: Console) -> Shown:
    """Measure all variants. Raises PebbleError."""
    results = begin("startup", settings)

    def measure_round(number: int, progress: Progress) -> Iterator[Cell]:
        for variant in in_turn(settings.variants, number):
            progress(variant)
            yield from launch(variant, settings.joins)
            if number % _PICTURES_EVERY == 0:
                yield from first_pictures(variant)

    measure_rounds(results, settings.rounds, measure_round, console)
    return shown(results)


def shown(results: Results) -> Shown:
    """Return results with their table."""
    results.cells.sort(key=lambda cell: MEASURES.index(cell.measure))
    return Shown(results, [table(results)])


def table(results: Results) -> Table:
    """Return the times of both variants, and their ratio."""
    ours, theirs = "zenoh", "mqtt"
    grid = plain_table("Median (minimum to maximum) of the launches", ["", "unit", theirs, ours, f"{ours} / {theirs}"],
                        left=2, caption=RATIOS)  # fmt: skip
    for measure in dict.fromkeys(cell.measure for cell in results.cells):
        mqtt, zenoh = results.find(theirs, measure), results.find(ours, measure)
        unit = next(cell.unit for cell in results.cells if cell.measure == measure)
        grid.add_row(measure, unit, spread(mqtt), spread(zenoh), compared(zenoh, mqtt))
    return grid


def launch(variant: str, joins: int) -> Iterator[Cell]:
    """Launch a fresh robot. Seconds count from just before the launcher is started. Raises PebbleError with its log."""
    with one_robot(variant) as robot, closing(RobotSubscriber(robot.remote_port, BASE)) as subscriber:
        subscriber.wait()
        with driving(robot.remote_port, BASE):
            began_ns = time.monotonic_ns()
            robot.launch()
            robot.expect(lambda: subscriber.first_heartbeat_ns is not None, "no heartbeat", UP_S)
            robot.expect(lambda: subscriber.ready_ns is not None, "not every service is ready", UP_S)
            robot.expect(lambda: bool(_obeyed(robot, began_ns)), "no drive command was obeyed", UP_S)
        times = (subscriber.first_heartbeat_ns or 0, subscriber.ready_ns or 0, _obeyed(robot, began_ns)[0])
        for name, at_ns in zip(STARTED, times, strict=True):
            yield round_cell(variant, name, "s", [(at_ns - began_ns) / 1e9])
        yield from _late(robot, joins)


def _obeyed(robot: Robot, since_ns: int) -> list[int]:
    """Return the times at which lines that move the wheels reached the MCU."""
    return [line.ns for line in robot.lines(since_ns) if line.drive is not None and any(line.drive)]


# -- late subscribers, operators and services, wait for all retained messages of a running robot


def _late(robot: Robot, joins: int) -> Iterator[Cell]:
    port, local = robot.remote_port, partial(local_transport, load(robot.config))
    inside, outside = map(_retained_topics, (local("retained-topics"), _connection(port)))  # start-up work finishes
    late: dict[str, tuple[Set[str], Callable[[_Receive], StockClient | Transport]]] = {
        "late operator": (outside, lambda _receive: _connection(port)),
        "late operator, paho": (outside, lambda receive: StockClient(receive, [(_EVERYTHING, 1)], at_once=False)),
        "late service": (inside, lambda _receive: local("late-service")),
    }
    for name, (topics, make) in late.items():
        samples = [_late_ms(topics, make, port) for _ in range(joins)]
        yield round_cell(robot.kind, name, "ms", samples, topics=len(topics))


def _retained_topics(transport: Transport) -> set[str]:
    """Return the topics with a retained message. Waits for a pause, since no message is marked as the last."""
    found: list[Message] = []
    with transport:
        transport.subscribe(_EVERYTHING, found.append, direct=True)
        topics, before = set[str](), -1
        while before < len(topics):
            before = len(topics)
            time.sleep(_QUIET_S)
            topics = {message.topic for message in found if message.retain}
    return topics


def _late_ms(topics: Set[str], make: Callable[[_Receive], StockClient | Transport], port: int) -> float:
    """Return the ms from opening a client until messages of all topics have arrived. Raises PebbleError."""
    missing, complete, ended_ns = set(topics), threading.Event(), 0

    def receive(message: Any) -> None:
        nonlocal ended_ns
        missing.discard(message.topic)
        if not missing and not complete.is_set():
            ended_ns = time.monotonic_ns()
            complete.set()

    with closing(make(receive)) as client:
        began_ns = time.monotonic_ns()
        if isinstance(client, StockClient):
            client.open(port)
        else:  # as a service does
            client.open(timeout=0.0)
            client.subscribe(_EVERYTHING, receive, direct=True)
        complete.wait(_LATE_S)
    if missing:
        raise PebbleError(f"a late subscriber did not receive {', '.join(missing)} within {_LATE_S:.0f} s")
    return (ended_ns - began_ns) / 1e6


def _connection(port: int) -> Transport:
    """Return an operator's connection, not yet opened."""
    return create("mqtt", f"operator-{time.monotonic_ns()}", MqttSettings(host="127.0.0.1", port=port))


# -- the first picture


class _Operator(MediaReceiver):
    """An operator who waits for the first picture in one encoding."""

    def __init__(self, transport: Transport, encoding: str) -> None:
        self._encoding, self._first_ns = encoding, 0  # not yet
        super().__init__(transport, BASE)

    def on_picture(self, picture: Decoded) -> None:
        if picture.encoding == self._encoding and not self._first_ns:
            self._first_ns = time.monotonic_ns()

    def wait_ms(self) -> float:
        """Return the ms from the request to the first picture. Raises PebbleError if none comes."""
        self.wait_for_capabilities(UP_S)
        began_ns = time.monotonic_ns()
        self.request("video", self._encoding)
        while not self._first_ns:
            time.sleep(_POLL_S)
            self.poll()
            if time.monotonic_ns() - began_ns > 1e9 * _PICTURE_S:
                raise PebbleError(f"no picture as {self._encoding} within {_PICTURE_S:.0f} s")
        return (self._first_ns - began_ns) / 1e6


def first_pictures(variant: str) -> Iterator[Cell]:
    """Measure the wait with the camera at rest, and that of a second operator, of a fresh robot in each encoding.

    Both are connected beforehand, as operators who have the robot's page open.
    """
    with ready_robot(variant) as (robot, _):
        for encoding in ALL_VIDEO:
            robot.expect(lambda: _CAMERA not in robot.processes(), "the camera does not rest", _REST_S)
            with (
                _connection(robot.remote_port) as one,
                _connection(robot.remote_port) as other,
                closing(_Operator(one, encoding)) as first,
                closing(_Operator(other, encoding)) as second,
            ):
                yield round_cell(variant, f"picture, {encoding}, at rest", "ms", [first.wait_ms()])
                yield round_cell(variant, f"picture, {encoding}, running", "ms", [second.wait_ms()])
