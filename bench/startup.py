"""Measures a robot's start-up, how fast a late subscriber receives all retained messages, and the first picture.

On MQTT and on Zenoh. Every launch is a fresh robot: launcher, hub or local broker, bridges, a simulated MCU, a remote
broker; for the first pictures another one, with a camera.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager

from pebble.bench import subscribers
from pebble.bench.comparison import Budget, Case, Comparison, rounds, variants
from pebble.bench.drivers import RATE_HZ, driving
from pebble.bench.pictures import dots
from pebble.bench.results import Cell
from pebble.bench.subscribers import UP_S, RobotSubscriber, ready_robot
from pebble.bench.tables import SPREAD, Claims, Grid
from pebble.client.media_receiver import MediaReceiver
from pebble.contract.encodings import ALL_VIDEO
from pebble.errors import PebbleError
from pebble.media.decode import Decoded
from pebble.rig.robot import BASE, KINDS, Robot, one_robot
from pebble.transports import MqttSettings, Transport, create

PICTURES_EVERY = 5  # launches, the first of which is followed by one of a robot with a camera
AT_REST, RUNNING = "at rest", "running"  # the camera
PICTURES = tuple(f"picture, {encoding}, {state}" for state in (AT_REST, RUNNING) for encoding in ALL_VIDEO)
LATE = ("late operator", "late operator, paho", "late service")
MEASURES = ("first heartbeat", "all ready", "first drive obeyed", *LATE, *PICTURES)
_CAMERA = "camera_publisher"  # runs while it is requested
_REST_S, _PICTURE_S = 10.0, 15.0
_ANSWER_S = 60.0
_POLL_S = 0.02  # how often an operator looks whether a key frame is missing


def measure(case: Case) -> Iterator[Cell]:
    """One launch, and in some rounds the first pictures. Raises PebbleError with the robot's log."""
    yield from launch(case)
    if case.number % PICTURES_EVERY == 0:
        yield from first_pictures(case)


def launch(case: Case) -> Iterator[Cell]:
    """Measures one robot from its start to its end. Seconds count from just before its launcher is started."""
    with one_robot(case.variant) as robot, closing(RobotSubscriber(robot.remote_port, BASE)) as subscriber:
        service = robot.running.worker("late service", "pebble.bench.subscribers", robot.config)
        service.answer(_ANSWER_S)  # it is started beforehand, so that its imports do not disturb the launch
        subscriber.wait()
        for measure_, seconds in zip(MEASURES, _start(robot, subscriber), strict=False):
            yield case.cell(measure_, "s", [seconds])
        joins = range(case.run["joins"])
        service.send(str(len(joins)))  # it first counts the retained messages, which gives start-up time to finish
        answer = service.answer(_ANSWER_S)
        port, retained = robot.remote_port, set(subscriber.retained)
        for measure_, join in zip(LATE, (subscribers.operator_ms, subscribers.stock_operator_ms), strict=False):
            yield case.cell(measure_, "ms", [join(port, BASE, retained) for _ in joins], topics=len(retained))
        yield case.cell(LATE[-1], "ms", answer["ms"], topics=len(answer["retained"]))


def _start(robot: Robot, subscriber: RobotSubscriber) -> list[float]:
    """Seconds to the first heartbeat, to all services ready, and to the first command that moves the wheels."""
    with driving(robot.remote_port, BASE):
        began_ns = time.monotonic_ns()
        robot.launch()
        robot.expect(lambda: subscriber.first_heartbeat_ns is not None, "no heartbeat", UP_S)
        robot.expect(lambda: subscriber.ready_ns is not None, "not every service is ready", UP_S)
        robot.expect(lambda: bool(_obeyed(robot, began_ns)), "no drive command was obeyed", UP_S)
    times = (subscriber.first_heartbeat_ns or 0, subscriber.ready_ns or 0, _obeyed(robot, began_ns)[0])
    return [(time_ns - began_ns) / 1e9 for time_ns in times]


def _obeyed(robot: Robot, since_ns: int) -> list[int]:
    """The times at which lines that move the wheels reached the MCU."""
    return [line.ns for line in robot.lines(since_ns) if line.drive is not None and any(line.drive)]


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
    """The wait with the camera at rest, and that of a second operator, of a fresh robot in each encoding."""
    with ready_robot(case.variant) as (robot, _):
        for encoding in ALL_VIDEO:
            robot.expect(lambda: _CAMERA not in robot.processes(), "the camera does not rest", _REST_S)
            with _operator(robot, encoding) as first, _operator(robot, encoding) as second:
                for state, operator in ((AT_REST, first), (RUNNING, second)):
                    yield case.cell(f"picture, {encoding}, {state}", "ms", [operator.wait_ms()])


@contextmanager
def _operator(robot: Robot, encoding: str) -> Iterator[_Operator]:
    """Connected beforehand, as an operator who has the robot's page open."""
    settings = MqttSettings(host="127.0.0.1", port=robot.remote_port)
    with (
        create("mqtt", f"operator-{time.monotonic_ns()}", settings) as transport,
        closing(_Operator(transport, encoding)) as operator,
    ):
        yield operator


def paper(_cells: Sequence[Cell]) -> Iterator[str]:
    yield (
        "The paper (5.1.1) names start-up delay first among what its MQTT video should improve, and gives no figure "
        "for it; its pictures are our json."
    )


STARTUP = Comparison(
    name="startup",
    title="Start-up",
    what="The time from a robot's launch to its first heartbeat, to ready and to the first obeyed command, and the "
    "time until a late subscriber has all retained messages; and the time from an operator's request to the first "
    "decoded picture. Each dot in the figure is one launch or subscriber.",
    help="""How fast a robot starts: first heartbeat, all services ready, first drive command executed.

    And how fast an operator or a service that connects later receives all retained messages, and how long an operator
    waits for the first picture in each encoding. Every launch is a new simulated robot. Needs mosquitto.

    \b
        pebble bench startup
        pebble bench startup --quick
    """,
    options=(rounds("Launches of each variant."), variants(KINDS, "mqtt or zenoh.")),
    full=Budget(156, rounds=10, joins=5),
    quick=Budget(23, rounds=3, joins=3),
    constants={"rate_hz": RATE_HZ},
    variants=KINDS,
    measure=measure,
    measures=MEASURES,
    figures={"topics": max},
    tables=(
        Grid(
            title="median (minimum to maximum) of the launches", rows=("measure", "unit"), heads=("", "unit"),
            columns=(SPREAD,), ratio=True,
        ),
    ),
    assessment=(Claims(judged=lambda cell: cell.measure not in PICTURES), paper),
    pictures=(dots("Start-up"),),
    summary_lines=2,
)  # fmt: skip
