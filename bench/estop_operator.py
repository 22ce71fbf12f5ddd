"""Stops and resets robots with the code that ``pebble estop`` is made of, and records when they confirmed it."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager

from pebble.bench.drivers import ZERO
from pebble.client.connection import Listener, Target, connected
from pebble.client.discovery import ALL_OUTGOING
from pebble.client.estop import StopSender, new_name
from pebble.client.estop_states import Reset, RobotEstop
from pebble.contract import CAPABILITIES, DRIVE, ESTOP, ESTOP_STATE
from pebble.errors import PebbleError
from pebble.rig.stock_client import StockClient
from pebble.transports import Message, Transport

_BY = "bench"
_ANSWER_S = 5.0
_COMMAND_S = 30.0
_POLL_S = 0.005
_LONGEST_WAIT_S = 0.25


class Stop:
    """One emergency stop over a connection that is open, from its construction on.

    Times are CLOCK_MONOTONIC, ns. A robot that has not confirmed it is missing.
    """

    def __init__(self, transport: Transport, robots: Collection[str] | None, *, hold: bool = False) -> None:
        """``robots`` None: all, as ``--all``."""
        self._transport = transport
        self.received: dict[str, int] = {}  # when each robot's first message arrived
        self.latched: dict[str, int] = {}  # when the first state arrived that says so
        self.confirmed: dict[str, int] = {}
        self.began = time.monotonic_ns()
        now = self.began / 1e9
        self._sender = StopSender(new_name(), by=_BY, why="", now=now, robots=robots, hold=hold)
        self._publish()
        channels = (ESTOP_STATE, CAPABILITIES)
        filters = [ALL_OUTGOING] if robots is None else [one.filter(base) for one in channels for base in robots]
        self._listener = Listener(transport, filters)

    def wait_until_confirmed(self, robots: Collection[str], timeout: float) -> None:
        """Send and receive until these robots have confirmed it. Raises PebbleError after ``timeout`` seconds."""
        end = time.monotonic() + timeout
        while not self.confirmed.keys() >= {*robots}:
            if time.monotonic() > end:
                missing = [f"{base}: {robot.why}" for base, robot in self._sender.robots.items() if robot.why]
                raise PebbleError(f"a stop was not confirmed within {timeout:.0f} s: {'; '.join(missing)}")
            self._receive()
            self._publish()

    def _receive(self) -> None:
        """Handle what has arrived; wait for something if nothing has, until something is due."""
        due = self._sender.due
        left = _LONGEST_WAIT_S if due is None else min(_LONGEST_WAIT_S, due - time.monotonic())
        while (message := self._listener.next(left)) is not None:
            now = time.monotonic_ns()
            self._sender.receive(message, now / 1e9)
            self._note(message, now)
            left = 0.0

    def _note(self, message: Message, now: int) -> None:
        base = message.topic.partition("/outgoing/")[0]
        robot = self._sender.robots.get(base)
        if robot is None:
            return
        self.received.setdefault(base, now)
        if robot.estop.latched:
            self.latched.setdefault(base, now)
        if robot.confirmed_s is not None:
            self.confirmed.setdefault(base, now)

    def _publish(self) -> None:
        for message in self._sender.tick(time.monotonic()):
            self._transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)


class StopOperator:
    """Stops and resets robots. Every stop has a connection of its own, which is open before it begins."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._url = f"mqtt://127.0.0.1:{port}"

    @contextmanager
    def stop(self, robots: Collection[str] | None, *, hold: bool = False) -> Iterator[Stop]:
        """Begin a stop of these robots; None: of all, which are found as ``--all`` finds them."""
        with self._connected() as transport:
            yield Stop(transport, robots, hold=hold)

    def zero(self, base: str) -> int:
        """Send a zero as a stock client does; returns when."""
        client = StockClient(at_once=False).open(self._port)
        client.wait()
        began = time.monotonic_ns()
        client.paho.publish(DRIVE.topic(base), ZERO, qos=DRIVE.default_qos).wait_for_publish(_ANSWER_S)
        client.close()
        return began

    def command(self, base: str) -> tuple[int, int, int]:
        """Run ``pebble estop``; returns when it was started, when its first stop was received, and when it ended."""
        received: list[int] = []
        words = [sys.executable, "-m", "pebble.cli", "estop", base, "--url", self._url]
        with self._connected() as transport:
            topic = ESTOP.topic(base)
            transport.subscribe(topic, lambda _message: received.append(time.monotonic_ns()), direct=True)
            began = time.monotonic_ns()
            done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=_COMMAND_S)
            ended = time.monotonic_ns()
        if done.returncode or not received:
            raise PebbleError(f"pebble estop ended with code {done.returncode}: {done.stdout}{done.stderr}")
        return began, received[0], ended

    def reset(self, bases: Sequence[str]) -> None:
        """Let these robots, which are stopped, move again. Raises PebbleError if one does not confirm it."""
        robots = [RobotEstop(base) for base in bases]
        with self._connected() as transport:
            for robot in robots:
                robot.subscribe(transport)
            _wait(lambda: all(robot.has_capabilities and robot.latched for robot in robots), "no stop to reset")
            resets = [Reset(robot, _BY) for robot in robots]
            for message in (message for reset in resets for message in reset.messages()):
                transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)
            _wait(lambda: all(reset.free for reset in resets), "a reset was not obeyed")

    @contextmanager
    def _connected(self) -> Iterator[Transport]:
        with connected(Target(url=self._url)) as (transport, _):
            yield transport


def _wait(condition: Callable[[], bool], problem: str) -> None:
    end = time.monotonic() + _ANSWER_S
    while not condition():
        if time.monotonic() > end:
            raise PebbleError(f"{problem} within {_ANSWER_S:.0f} s")
        time.sleep(_POLL_S)
