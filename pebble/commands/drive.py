"""``pebble drive``: drives a robot with the keys of a terminal."""

import secrets
import socket
import time
from collections import deque
from contextlib import suppress
from typing import Annotated

import typer

from pebble.client.connection import Target, connected, put_names, target_of
from pebble.client.driver_lease import ANSWER_S, DriverLease
from pebble.client.named_topics import NoNameError
from pebble.client.terminal.driver import TerminalDriver
from pebble.client.terminal.key_decoder import END
from pebble.client.terminal.key_gesture import PERIOD_S, KeyGesture
from pebble.commands.estop import me
from pebble.commands.options import RobotArgument, with_target
from pebble.commands.terminal.loop import TerminalLoop
from pebble.media.in_flight import InFlight
from pebble.transports import Message, QoS, State, Transport
from pebble.transports.clock import since_boot as clock

_KEYS = """\
W A S D or arrows drive, Q E grousers, space stops.
! or Esc Esc is the emergency stop, Ctrl-C ends.
T takes control, or asks for it; O takes it over."""
_STOP_S = 3.0  # so long an emergency stop is still sent after the terminal has ended
_ARRIVED = 1000  # messages that wait to be handled
_OVERHEAD = 32  # bytes of a message on the wire besides topic and payload


@with_target(program="drive")
def drive(
    robot: RobotArgument,
    speed: Annotated[float, typer.Option(min=0.05, max=1, help="Throttle of a key, and speed of the grousers.")] = 0.6,
    turn: Annotated[float, typer.Option(min=0.05, max=1, help="Steering of a key.")] = 0.8,
    take_over: Annotated[bool, typer.Option("--take-over", help="Also from another driver.")] = False,
    *,
    target: Target,
) -> int:
    """Drive a robot with the keys of this terminal.

    W A S D or the arrows drive, Q and E move the grousers, space stops. ! or twice Escape is the emergency stop,
    which only `pebble estop reset` ends. Ctrl-C ends.

    A terminal repeats a key that is held and does not report its release, so a key counts as held for 0.4 s: the
    robot moves on for so long after you let go, and halts briefly where the first repetition comes later than that.
    Of several keys only the last one repeats. What interrupts a drive ends it: let go of all keys, then press again.

    Control is taken if nobody has it, and given back after a minute without a drive. T asks another driver for it, O
    takes it over. When another one asks, L lets them drive, K keeps it.

    \b
        pebble drive goob.json
        pebble drive goob --url mqtt://127.0.0.1 --speed 0.3
        pebble drive goob.json --remote --take-over
    """
    from pebble.client.terminal.keys import check_terminal, opened

    check_terminal()
    target = target_of(robot, target)
    with connected(target) as (transport, names):
        by, device = me(names.account), f"terminal on {socket.gethostname()}"
        lease = DriverLease(names.base, f"drive-{secrets.token_hex(4)}", by=by, device=device)
        heartbeat = target.remote or str(target.url).startswith("mqtt")  # within a robot there is none
        driver = TerminalDriver(
            names.base, KeyGesture(speed, turn), lease, by=by, now=clock(), take_over=take_over, heartbeat=heartbeat
        )
        put_names(transport, names, lambda base: base == names.base and driver.robot.named)
        driving = _Driving(transport, driver)
        typer.echo(_KEYS)
        with opened() as terminal:
            return driving.run(TerminalLoop(terminal, clock))


class _Driving:
    """Passes keys and messages to the driver, and what it returns to the transport, every 50 ms."""

    def __init__(self, transport: Transport, driver: TerminalDriver) -> None:
        """Subscribes; on a slow network this takes seconds."""
        self._transport, self._driver = transport, driver
        self._in_flight = InFlight(_OVERHEAD)
        self._arrived: deque[tuple[Message, float, float]] = deque(maxlen=_ARRIVED)
        self._nameless: NoNameError | None = None  # the robot takes no commands from here
        for filter_ in driver.filters:
            transport.subscribe(filter_, self._take, qos=QoS.DELIVERED, direct=True)

    def run(self, loop: TerminalLoop) -> int:
        """Until a signal, Ctrl-D, or the end of the terminal."""
        try:
            while not (loop.ended or self._nameless):
                keys, now = loop.keys(PERIOD_S), clock()
                self._driver.press(keys, now)
                self._tick(now)
                loop.show(self._driver.status, at_once=bool(keys))
                loop.suspend(lambda: self._halt(self._driver.suspend(clock())))
        finally:
            self._halt(self._driver.leave(clock(), time.time()))
            self._finish_stop()
        if self._nameless:
            raise self._nameless
        return 0 if loop.ended in ("SIGINT", END) else 1

    def _take(self, message: Message) -> None:
        self._arrived.append((message, clock(), time.time()))

    def _tick(self, now: float) -> None:
        while self._arrived:
            self._driver.receive(*self._arrived.popleft())
        outgoing = self._transport.outgoing
        self._in_flight.acknowledge(outgoing.waiting)
        late_s = self._in_flight.age_s(now)
        if problem := self._problem():
            self._in_flight.clear()
        elif outgoing.stalled_s > ANSWER_S:
            problem = "it does not answer"
        self._publish(self._driver.tick(now, time.time(), problem=problem, late_s=late_s), now)

    def _publish(self, messages: list[Message], now: float) -> None:
        for message in messages:
            if self._accepts(message):
                self._in_flight.sent(len(message.topic) + len(message.payload) + _OVERHEAD, now)
            else:
                self._driver.refused(now)

    def _accepts(self, message: Message) -> bool:
        try:
            return self._transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)
        except NoNameError as error:
            self._nameless = error
            return False

    def _problem(self) -> str:
        return "" if self._transport.state is State.CONNECTED else self._transport.problem or "it was lost"

    def _halt(self, messages: list[Message]) -> None:
        """Publish the last zero, and twice more, before this process ends or stands still."""
        self._publish(messages, clock())
        for _ in range(3 if messages else 0):
            time.sleep(PERIOD_S)
            self._tick(clock())

    def _finish_stop(self) -> None:
        """An emergency stop is not given up because the terminal has ended."""
        end = clock() + _STOP_S
        while self._driver.unconfirmed and clock() < end:
            time.sleep(PERIOD_S)
            self._tick(clock())
        if self._driver.unconfirmed:
            with suppress(OSError):  # that terminal is gone
                typer.echo(f"pebble: the emergency stop of {self._driver.name} is NOT CONFIRMED", err=True)
