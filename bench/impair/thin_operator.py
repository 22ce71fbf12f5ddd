"""The operator of one robot on a thin link: drives as our clients do, lets go, stops, and is taken over.

As a process: ``python -m pebble.bench.impair.thin_operator``. Its first line is the orders, as JSON: there may be
passwords in them. It reports when the robot is ready, and at the next line does all of it and reports what it recorded.
"""

from __future__ import annotations

import os
import queue
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from pebble.bench.clients import all_ready, axes_of
from pebble.bench.impair.metrics import Command, Heartbeat
from pebble.bench.impair.operator import MediaSubscriber, monotonic_ns
from pebble.bench.impair.wheels import Driven, Gesture, LinkSeen, Login, Orders, Take, WheelRecord, WheelReport, hand
from pebble.client.connection import put_names
from pebble.client.control import ControlClient
from pebble.client.drive_reasons import RESET_S
from pebble.client.driveable import is_held
from pebble.client.estop import StopSender, new_name
from pebble.client.estop_states import Reset
from pebble.client.names import Names
from pebble.client.pace_of_link import WIDE
from pebble.client.robot_topics import FLEET, WATCHED
from pebble.client.robot_view import RobotView
from pebble.contract import DRIVE, LINK, ONLINE, STATUS, channel_of, codec
from pebble.contract.payloads import Drive
from pebble.errors import PebbleError
from pebble.rig.worker_end import answer, serve_on_thread
from pebble.transports import Message, MqttSettings, QoS, State, create
from pebble.transports.clock import since_boot as clock
from pebble.transports.settings import TlsSettings

_READY_S: Final = 90.0
_CONNECT_S, _ANSWER_S, _CONTROL_S, _RESET_S = 30.0, 5.0, 15.0, 15.0
_STEP_S = 0.01
_TICK_S = 0.05  # of the page and of `pebble drive`
_ZEROS_S = (0.0, 0.1, 0.2)  # after a release
_CONFIRM_S = 10.0  # a stop that is not confirmed by then is given up
_RESET_AGAIN_S = 3.0
_TOOK_S, _LET_GO_S = 2.5, 1.0  # so long is driven after control was taken
_HEARTBEATS = 100_000
_BY = "trial"
_CAMERA = "camera_publisher"
_DECIMALS = 4  # of an axis, as a page has them: they hold the three of a wheel


class Person:
    """One operator with a connection: what it knows of the robot, and what it wants."""

    def __init__(self, orders: Orders, login: Login) -> None:
        tls = None if orders.ca_cert is None else TlsSettings(ca_cert=Path(orders.ca_cert))
        self.settings = MqttSettings(
            host=orders.host, port=orders.port, tls=tls, username=login.name or None, password=login.password or None
        )
        self.transport = create("mqtt", f"pebble-trial-{login.name or 'controls'}", self.settings)
        self.name, self.base, self.foreign = login.name or _BY, orders.base, orders.foreign_hz > 0
        self.view = RobotView(orders.base)
        self.control = ControlClient(self.view.control, by=self.name, device=_BY, pace_of=lambda: self.view.pace)
        self.stopping: StopSender | None = None
        self.heartbeats: deque[Heartbeat] = deque(maxlen=_HEARTBEATS)
        self.links: list[LinkSeen] = []
        self.ready = self.held = False  # held: its pictures wait for driving
        self._key = secrets.token_hex(4)
        self._arrived: deque[tuple[Message, float, float, int]] = deque()
        names = Names(orders.base, account=login.name)
        put_names(self.transport, names, lambda base: base == self.base and self.view.named)

    def open(self) -> None:
        self.transport.open(_CONNECT_S)
        if self.transport.state is not State.CONNECTED:
            raise PebbleError(f"{self.name} cannot connect to the broker: {self.transport.problem}")
        for channel in (*FLEET, *WATCHED):
            self.transport.subscribe(channel.filter(self.base), self._take, qos=QoS.DELIVERED, direct=True)

    def _take(self, message: Message) -> None:
        self._arrived.append((message, clock(), time.time(), time.monotonic_ns()))

    def step(self) -> None:
        """Take note of what has arrived, and publish what follows from it."""
        while self._arrived:
            message, now, wall, ns = self._arrived.popleft()
            channel = channel_of(message.topic[len(self.base) + 1 :])
            self.view.receive(channel, message, now, wall)
            self.view.remember(message)
            if self.stopping is not None:
                self.stopping.receive(message, now)
            if channel is ONLINE and not message.retain:
                sent = codec.decode(ONLINE, message.payload)
                self.heartbeats.append(Heartbeat(monotonic_ns(sent.t), ns, sent.online is not False))
            elif channel is LINK and self.view.link is not None:
                self.links.append(LinkSeen(ns, self.view.link.level, self.view.link.queue_ms))
            elif channel is STATUS:
                self.ready = all_ready(codec.decode(STATUS, message.payload).value)
                self.held = is_held(message.payload, _CAMERA)
        now = clock()
        if not self.foreign:
            self.publish(self.control.tick(now))
        if self.stopping is not None:
            self.publish(self.stopping.tick(now))

    def publish(self, messages: list[Message]) -> None:
        for message in messages:
            self.transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)

    def drive(self, left: float, right: float) -> None:
        axes, pace = axes_of(left, right), WIDE if self.foreign else self.view.pace
        command = Drive(x=round(axes["x"], _DECIMALS), z=round(axes["z"], _DECIMALS))
        if not self.foreign:
            key = self.control.key or msgspec.UNSET
            command = msgspec.structs.replace(command, valid_ms=pace.valid_ms, key=key)
            command = pace.dated(command, clock(), self._key)
        topic = self.view.estop.drive_topic
        self.transport.publish(topic, codec.encode(DRIVE, command), qos=pace.qos, urgent=True)

    def zero(self, command: Drive | None = None) -> None:
        payload = codec.encode(DRIVE, command or Drive(valid_ms=0))
        self.transport.publish(self.view.estop.drive_topic, payload, qos=QoS.DELIVERED, urgent=True)

    def stop(self) -> StopSender:
        self.stopping = StopSender(new_name(), by=self.name, why="trial", now=clock(), robots=[self.base])
        for message in self.view.remembered.values():
            self.stopping.receive(message, clock())
        self.publish(self.stopping.tick(clock()))
        return self.stopping


class ThinOperator:
    """Does the orders, step by step."""

    def __init__(self, orders: Orders) -> None:
        self._orders = orders
        self._people = [Person(orders, login) for login in orders.people]
        self._first = self._people[0]
        self._media = create("mqtt", "pebble-trial-media", self._first.settings)
        self._viewer: MediaSubscriber | None = None
        self._polled_at = 0.0
        self._number = 0
        self._commands: list[Command] = []
        self._gestures: list[Driven] = []
        self._takes: list[Take] = []

    def open(self) -> float:
        """Connects; returns how long the robot took to be ready, or the most that is waited for it."""
        began = clock()
        for person in self._people:
            person.open()
        self._wait(lambda: self._first.ready and len(self._first.heartbeats) > 1, _READY_S)
        return clock() - began

    def run(self) -> WheelRecord:
        orders, first = self._orders, self._first
        began_ns, until = time.monotonic_ns(), clock() + self._orders.limit_s
        first.heartbeats.clear()
        first.links[:] = first.links[-1:]
        if orders.video:
            self._watch()
        for gesture in orders.gestures:
            if clock() < until:
                self._own_control(first)
                self._do(first, gesture)
        for number in range(orders.takes):
            self._take_over(self._people[number % 2], self._people[1 - number % 2])
        return WheelRecord(
            began_ns=began_ns, ended_ns=time.monotonic_ns(), commands=self._commands, gestures=self._gestures,
            heartbeats=list(first.heartbeats), links=first.links, takes=self._takes,
            pictures=len(self._viewer.seen) if self._viewer else 0,
            controlled=any(one.control.held for one in self._people),
        )  # fmt: skip

    # -- parts of it

    def _watch(self) -> None:
        self._media.open(_CONNECT_S)
        viewer = MediaSubscriber(self._media, self._orders.base)
        viewer.wait_for_capabilities(_ANSWER_S)
        viewer.viewer.request("video", "h264")
        self._viewer = viewer

    def _own_control(self, person: Person) -> None:
        """Where the robot gives control. Without an answer it is driven without, as by who knows nothing of it."""
        if person.foreign or not person.view.controlled or person.control.held:
            return
        if not person.control.wanted:
            person.control.ask(clock(), over=True)
        self._wait(lambda: person.control.held or not person.control.wanted, _CONTROL_S)

    def _do(self, person: Person, gesture: Gesture) -> None:
        began_ns = time.monotonic_ns()
        self._drive(person, gesture.drive_s)
        ended_ns, ended, confirmed_ns = time.monotonic_ns(), clock(), 0
        if gesture.kind == "release":
            for at in _ZEROS_S:
                self._pause(ended + at - clock())
                person.zero()
        else:
            stop = person.stop()
            if person.foreign:  # it drives on
                self._drive(person, _CONFIRM_S, lambda: stop.confirmed)
            if self._wait(lambda: stop.confirmed, 0 if person.foreign else _CONFIRM_S):
                confirmed_ns = time.monotonic_ns()
        self._pause(ended + gesture.rest_s - clock())
        self._gestures.append(Driven(gesture.kind, began_ns, ended_ns, time.monotonic_ns(), confirmed_ns))
        if gesture.kind == "stop":
            self._reset(person)

    def _drive(self, person: Person, seconds: float, enough: Callable[[], bool] = lambda: False) -> None:
        began, sent_at = clock(), float("-inf")
        period = 1 / self._orders.foreign_hz if person.foreign else _TICK_S
        due = began
        while (now := clock()) < began + seconds and not enough():
            if now >= due:
                due += period
                if person.foreign or now - sent_at >= person.view.pace.step_s:
                    self._number, sent_at = self._number + 1, now
                    left, right = hand(self._number, now - began)
                    self._commands.append(Command(left, right, time.monotonic_ns()))
                    person.drive(left, right)
            self._step()

    def _reset(self, person: Person) -> None:
        if person.stopping is not None:
            person.stopping.end()
        person.stopping = None
        until = clock() + _RESET_S
        while person.view.latched and clock() < until:
            reset = Reset(person.view.estop, person.name)
            person.publish(reset.messages())
            self._wait(lambda: not person.view.latched, _RESET_AGAIN_S)
        self._pause(RESET_S)
        person.zero(Drive(key=person.control.key or msgspec.UNSET))  # lets go, which ends the wait after a reset

    def _take_over(self, taker: Person, other: Person) -> None:
        had, began_ns = other.control.held, time.monotonic_ns()
        taker.control.ask(clock(), over=True)
        held_ns = lost_ns = 0
        until = clock() + _CONTROL_S
        while not (held_ns and (lost_ns or not had)) and clock() < until:
            self._step()
            held_ns = held_ns or (time.monotonic_ns() if taker.control.held else 0)
            lost_ns = lost_ns or (time.monotonic_ns() if had and not other.control.held else 0)
        self._takes.append(Take(began_ns, held_ns, lost_ns))
        self._do(taker, Gesture("release", _TOOK_S, _LET_GO_S))

    # -- time

    def _step(self) -> None:
        for person in self._people:
            person.step()
        if self._viewer is not None and not self._first.held and clock() - self._polled_at > _TICK_S:
            self._polled_at = clock()
            self._viewer.poll()
        time.sleep(_STEP_S)

    def _wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        until = clock() + seconds
        while not (met := condition()) and clock() < until:
            self._step()
        return met

    def _pause(self, seconds: float) -> None:
        self._wait(lambda: False, seconds)


def main() -> None:
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    serve_on_thread(lines.put, lambda: os._exit(0))  # also while driving
    try:
        operator = ThinOperator(msgspec.json.decode(lines.get(), type=Orders))
        answer(msgspec.json.encode(WheelReport(ready_s=operator.open())))
        lines.get()
        answer(msgspec.json.encode(WheelReport(record=operator.run())))
    except PebbleError as error:
        answer(msgspec.json.encode(WheelReport(problem=str(error))))


if __name__ == "__main__":
    main()
    threading.Event().wait()  # until the end of its input
