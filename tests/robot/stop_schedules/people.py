"""Persons, senders of stops and those who reset: each with a connection of its own."""

from __future__ import annotations

import json
import queue
import secrets
import threading
import time
from contextlib import suppress
from typing import Any

from pebble.contract import CAPABILITIES, DRIVE, ESTOP, ESTOP_STATE, ONLINE, codec
from pebble.contract.payloads import EstopState
from pebble.errors import PayloadError
from pebble.extensions.operator.client.estop import StopSender, new_name
from pebble.extensions.operator.client.estop_states import Reset, RobotEstop
from pebble.transports import Message, MqttSettings, QoS, Transport, create
from tests.robot.stop_schedules.history import History

_PERIOD_S = 1 / 15
_OPEN_S = 3.0


def connect(port: int, name: str) -> Transport:
    """A new connection to a broker; it may be down."""
    settings = MqttSettings(host="127.0.0.1", port=port, reconnect_max_s=0.3)
    return create("mqtt", f"{name}-{secrets.token_hex(4)}", settings).open(_OPEN_S)


def base_of(robot: str) -> str:
    return f"pebble/robots/{robot}"


class Driver:
    """Repeats a drive command on a thread while told to. Unlike other drivers it falls silent without a zero."""

    def __init__(self, port: int, robot: str, history: History) -> None:
        self.robot, self.history = robot, history
        self._transport = connect(port, "driver")
        self._topic = DRIVE.topic(base_of(robot))
        self._command: dict[str, Any] | None = None
        self._changed = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def drive(self) -> None:
        self._set({"x": 0, "z": 0.5, "valid_ms": 600})
        self.history.add("drives", self.robot)

    def lose(self) -> None:
        """Send nothing more, as when a connection is lost."""
        self._set(None)
        self.history.add("ends driving", self.robot)

    def zero(self, *, final: bool = False) -> None:
        """Let go, or stop for good."""
        self._set(None)
        at = time.monotonic()
        sent = self._send({"x": 0, "z": 0, **({"valid_ms": 0} if final else {})})
        self.history.add("zero", self.robot, at=at, final=final, sent=sent)

    def close(self) -> None:
        self._ended = True
        self._set(None)
        self._thread.join()
        self._transport.close()

    def _set(self, command: dict[str, Any] | None) -> None:
        self._command = command
        self._changed.set()

    def _run(self) -> None:
        while not self._ended:
            command = self._command
            if command is not None:
                self._send(command)
            self._changed.wait(None if command is None else _PERIOD_S)
            self._changed.clear()

    def _send(self, command: dict[str, Any]) -> bool:
        return self._transport.publish(self._topic, json.dumps(command).encode(), qos=QoS.DELIVERED, urgent=True)


class Sender:
    """One emergency stop, sent by the real StopSender until it is confirmed or ended."""

    def __init__(self, port: int, robots: list[str], history: History, *, retain: bool = False) -> None:
        """``retain``: its stops ask to be retained, which a sender of ours never does."""
        self.name = new_name()
        self.robots = robots
        self._history, self._retain = history, retain
        self._core = StopSender(
            self.name, by="test", why="", now=time.monotonic(), robots=[base_of(robot) for robot in robots]
        )
        self._confirmed: set[str] = set()
        self._messages: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._ended = threading.Event()
        self._transport = connect(port, "sender")
        for robot in robots:
            history.add("stop given", robot, name=self.name)
        self._publish()
        for robot in robots:
            for channel in (ESTOP_STATE, CAPABILITIES, ONLINE):
                self._transport.subscribe(channel.filter(base_of(robot)), self._messages.put, qos=QoS.DELIVERED)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def confirmed(self) -> bool:
        return self._core.confirmed

    @property
    def why(self) -> str:
        return "; ".join(robot.why for robot in self._core.robots.values() if robot.why)

    def end(self) -> None:
        """A person gives up."""
        self._ended.set()
        self._thread.join()
        self._transport.close()

    def _run(self) -> None:
        while not self._ended.is_set() and not self._core.finished:
            with suppress(queue.Empty):
                self._core.receive(self._messages.get(timeout=0.02), time.monotonic())
            self._note()
            self._publish()

    def _publish(self) -> None:
        for message in self._core.tick(time.monotonic()):
            base = "/".join(message.topic.split("/")[:3])
            retain = self._retain and message.topic == ESTOP.topic(base)
            at, name = time.monotonic(), base.rpartition("/")[2]
            sent = self._transport.publish(message.topic, message.payload, qos=message.qos, retain=retain, urgent=True)
            if message.topic == DRIVE.topic(base):
                self._history.add("zero", name, at=at, final=True, sent=sent, sender=self.name)

    def _note(self) -> None:
        for base, robot in self._core.robots.items():
            name = base.rpartition("/")[2]
            if robot.confirmed_s is not None and name not in self._confirmed:
                self._confirmed.add(name)
                for state in robot.estop.states.values():
                    self._history.add("state", name, state=state, live=True, where="sender")
                self._history.add("confirmed", name, name=self.name, saved=robot.saved, took=robot.confirmed_s)


class Subscriber:
    """Records the states and heartbeats that one broker delivers, and knows the newest, as a page does."""

    def __init__(self, port: int, robots: tuple[str, ...], where: str) -> None:
        self.history = History()
        self._where = where
        self._robots = {base_of(robot): RobotEstop(base_of(robot)) for robot in robots}
        self.heartbeats: dict[str, float] = {}  # when the last live one arrived
        self._transport = connect(port, "subscriber")
        for robot in robots:
            for channel in (ESTOP_STATE, CAPABILITIES, ONLINE):
                self._transport.subscribe(channel.filter(base_of(robot)), self._receive, qos=QoS.DELIVERED)

    def robot(self, name: str) -> RobotEstop:
        return self._robots[base_of(name)]

    def publish(self, message: Message) -> None:
        self._transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)

    def look(self, name: str) -> Reset:
        """What a person sees who is about to reset."""
        return Reset(self.robot(name), "test")

    def close(self) -> None:
        self._transport.close()

    def _receive(self, message: Message) -> None:
        base = "/".join(message.topic.split("/")[:3])
        name, robot = base.rpartition("/")[2], self._robots[base]
        robot.receive(message)
        if message.topic == ONLINE.topic(base):
            if not message.retain and b"false" not in message.payload:
                self.heartbeats[name] = self.history.add("online", name)
        elif message.topic.startswith(ESTOP_STATE.topic(base).removesuffix("{owner}")) and message.payload:
            try:
                state: EstopState = codec.decode(ESTOP_STATE, message.payload)
            except PayloadError:
                self.history.add("malformed state", name, payload=message.payload)
                return
            self.history.add("state", name, state=state, live=not message.retain, where=self._where)
