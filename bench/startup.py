"""Measures a robot's start-up, how fast a late subscriber receives all retained messages, and the first picture."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Set
from contextlib import closing
from functools import partial
from typing import Any

from pebble.bench.clients import RATE_HZ, UP_S, RobotSubscriber, StockClient, driving, ready_robot
from pebble.bench.comparison import Budget, Case, Comparison, Measuring, Report, rounds, variants
from pebble.bench.pictures import dots
from pebble.bench.results import Cell
from pebble.bench.tables import SPREAD, Claims, Grid
from pebble.client.media_receiver import MediaReceiver
from pebble.config import load
from pebble.contract.encodings import ALL_VIDEO
from pebble.errors import PebbleError
from pebble.media.decode import Decoded
from pebble.rig.robot import BASE, KINDS, Robot, one_robot
from pebble.runtime.connections import local_transport
from pebble.transports import Message, MqttSettings, Transport, create

PICTURES_EVERY = 5  # launches, the first of which is followed by one of a robot with a camera
PICTURES = tuple(f"picture, {encoding}, {state}" for state in ("at rest", "running") for encoding in ALL_VIDEO)
STARTED = ("first heartbeat", "all ready", "first drive obeyed")
MEASURES = (*STARTED, "late operator", "late operator, paho", "late service", *PICTURES)
_CAMERA = "camera_publisher"  # runs while it is requested
_LATE_S = 10.0  # for one late subscriber
_QUIET_S = 0.3  # without another retained message until all count as received
_REST_S, _PICTURE_S = 10.0, 15.0
_EVERYTHING = f"{BASE}/#"
_POLL_S = 0.02  # how often an operator looks whether a key frame is missing

_Receive = Callable[[Any], None]  # is called with each message


def measure(case: Case) -> Iterator[Cell]:
    """One launch, and in some rounds the first pictures, of fresh robots. Raises PebbleError with the robot's log."""
    yield from launch(case)
    if case.number % PICTURES_EVERY == 0:
        yield from first_pictures(case)


def launch(case: Case) -> Iterator[Cell]:
    """Seconds count from just before the launcher is started."""
    with one_robot(case.variant) as robot, closing(RobotSubscriber(robot.remote_port, BASE)) as subscriber:
        subscriber.wait()
        with driving(robot.remote_port, BASE):
            began_ns = time.monotonic_ns()
            robot.launch()
            robot.expect(lambda: subscriber.first_heartbeat_ns is not None, "no heartbeat", UP_S)
            robot.expect(lambda: subscriber.ready_ns is not None, "not every service is ready", UP_S)
            robot.expect(lambda: bool(_obeyed(robot, began_ns)), "no drive command was obeyed", UP_S)
        times = (subscriber.first_heartbeat_ns or 0, subscriber.ready_ns or 0, _obeyed(robot, began_ns)[0])
        for name, at_ns in zip(STARTED, times, strict=True):
            yield case.cell(name, "s", [(at_ns - began_ns) / 1e9])
        yield from _late(case, robot)


def _obeyed(robot: Robot, since_ns: int) -> list[int]:
    """The times at which lines that move the wheels reached the MCU."""
    return [line.ns for line in robot.lines(since_ns) if line.drive is not None and any(line.drive)]


# -- late subscribers, operators and services, wait for all retained messages of a running robot


def _late(case: Case, robot: Robot) -> Iterator[Cell]:
    port, local = robot.remote_port, partial(local_transport, load(robot.config))
    inside, outside = map(_retained_topics, (local("retained-topics"), _connection(port)))  # start-up work finishes
    late: dict[str, tuple[Set[str], Callable[[_Receive], StockClient | Transport]]] = {
        "late service": (inside, lambda _receive: local("late-service")),
        "late operator": (outside, lambda _receive: _connection(port)),
        "late operator, paho": (outside, lambda receive: StockClient(receive, [(_EVERYTHING, 1)], at_once=False)),
    }
    for name, (topics, make) in late.items():
        samples = [_late_ms(topics, make, port) for _ in range(case.run["joins"])]
        yield case.cell(name, "ms", samples, topics=len(topics))


def _retained_topics(transport: Transport) -> set[str]:
    """The topics with a retained message. Waits for a pause, since no message is marked as the last."""
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
    """Milliseconds from opening a client until messages of all topics have arrived. Raises PebbleError."""
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
    """An operator's, not yet opened."""
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
        """Milliseconds from the request to the first picture. Raises PebbleError if none comes."""
        self.wait_for_capabilities(UP_S)
        began_ns = time.monotonic_ns()
        self.request(self._encoding, sound=False)
        while not self._first_ns:
            time.sleep(_POLL_S)
            self.poll()
            if time.monotonic_ns() - began_ns > 1e9 * _PICTURE_S:
                raise PebbleError(f"no picture as {self._encoding} within {_PICTURE_S:.0f} s")
        return (self._first_ns - began_ns) / 1e6


def first_pictures(case: Case) -> Iterator[Cell]:
    """The wait with the camera at rest, and that of a second operator, of a fresh robot in each encoding.

    Both are connected beforehand, as operators who have the robot's page open.
    """
    with ready_robot(case.variant) as (robot, _):
        for encoding in ALL_VIDEO:
            robot.expect(lambda: _CAMERA not in robot.processes(), "the camera does not rest", _REST_S)
            with (
                _connection(robot.remote_port) as one,
                _connection(robot.remote_port) as other,
                closing(_Operator(one, encoding)) as first,
                closing(_Operator(other, encoding)) as second,
            ):
                yield case.cell(f"picture, {encoding}, at rest", "ms", [first.wait_ms()])
                yield case.cell(f"picture, {encoding}, running", "ms", [second.wait_ms()])


STARTUP = Comparison(
    name="startup",
    title="Start-up",
    what="The time from a robot's launch to its first heartbeat, to ready and to the first obeyed command, and the "
    "time until a late subscriber has all retained messages; and the time from an operator's request to the first "
    "decoded picture. Each dot in the figure is one launch or subscriber.",
    help="""How fast a robot starts: first heartbeat, all services ready, first drive command executed.

    And how fast an operator or a service that connects later receives all retained messages, and how long an operator
    waits for the first picture in each encoding. Every launch is a new simulated robot. Needs mosquitto.
    """,
    options=(rounds("Launches of each variant."), variants(KINDS, "mqtt or zenoh.")),
    full=Budget(100, rounds=10, joins=5),
    quick=Budget(23, rounds=3, joins=3),
    constants={"rate_hz": RATE_HZ},
    variants=KINDS,
    measuring=Measuring(measure=measure, measures=MEASURES, figures={"topics": max}),
    report=Report(
        tables=(
            Grid(
                title="median (minimum to maximum) of the launches", rows=("measure", "unit"), heads=("", "unit"),
                columns=(SPREAD,), ratio=True,
            ),
        ),
        assessment=(Claims(judged=lambda cell: cell.measure not in PICTURES),),
        pictures=(dots("Start-up"),),
    ),
)  # fmt: skip
