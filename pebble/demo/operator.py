"""A scripted operator: knows a broker and the contract, finds robots, and drives all of them through the same steps."""

from __future__ import annotations

import threading
import time
from collections import deque

from pebble import codec
from pebble.contract import DRIVE, LIGHTS_FLASH, LIGHTS_SOLID
from pebble.demo.discovery import EVERYBODY, Discovery, Sighting
from pebble.demo.script import COMMAND_PERIOD_S, SCRIPT, Done, Step
from pebble.payloads import Drive, LightsFlash
from pebble.transports import Message, MqttSettings, QoS, create

STOP = Drive()
_SCRIPT_LIMIT = 1000  # finished steps waiting for somebody to look at them


class Operator:
    """Drives on a thread of its own, over its own connection. ``doing`` says in words what; ``done`` collects steps."""

    def __init__(self, port: int, name: str = "pebble-demo-operator") -> None:
        self.discovery = Discovery()
        self.doing = "looking for robots"
        self.rounds = 0
        self.commands: dict[str, tuple[Drive, float]] = {}  # by base topic: the last one sent, and when (monotonic)
        self.done: deque[Done] = deque(maxlen=_SCRIPT_LIMIT)
        self._transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port))
        self._enough = threading.Event()
        self._thread = threading.Thread(target=self._drive, name=name, daemon=True)

    def connect(self) -> None:
        """Start listening; returns at once."""
        self._transport.open(timeout=0.0)
        self._transport.subscribe(EVERYBODY, self._hear)

    def ready(self, wanted: int) -> bool:
        """Are that many robots alive and willing to be driven?"""
        now = time.monotonic()
        return sum(sighting.ready(now) for sighting in self.discovery.everybody()) >= wanted

    def begin(self) -> None:
        """Drive everybody found so far, round after round."""
        self._thread.start()

    def end(self) -> None:
        """Leave the step, stop everybody, go."""
        self._enough.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
        self._transport.close()

    def _hear(self, message: Message) -> None:
        self.discovery.hear(message, time.monotonic(), time.time())

    # -- the operator's thread

    def _drive(self) -> None:
        robots = self.discovery.everybody()
        while not self._enough.is_set():
            for step in SCRIPT:
                self._do(step, robots)
                if self._enough.is_set():
                    break
            else:
                self.rounds += 1
        self._send(STOP, robots)
        self.doing = "leaving"

    def _do(self, step: Step, robots: list[Sighting]) -> None:
        self.doing = step.name
        began = due = released = time.monotonic()
        self._shine(step, robots)
        while due < began + step.drive_s:
            self._send(step.drive, robots)
            released = time.monotonic()
            due += COMMAND_PERIOD_S
            if self._enough.wait(max(0.0, due - released)):
                return
        if step.says_stop:
            self._send(STOP, robots)
            released = time.monotonic()
        self.doing = f"{step.name}: watching"
        if self._enough.wait(step.rest_s):
            return
        self.done.extend(Done(robot.name, step, began, released, time.monotonic()) for robot in robots)

    def _send(self, drive: Drive, robots: list[Sighting]) -> None:
        payload = codec.encode(DRIVE, drive)
        for robot in robots:
            self.commands[robot.base] = drive, time.monotonic()
            self._publish(robot.drive_topic, payload)

    def _shine(self, step: Step, robots: list[Sighting]) -> None:
        flash = isinstance(step.lights, LightsFlash)
        payload = codec.encode(LIGHTS_FLASH if flash else LIGHTS_SOLID, step.lights)
        for robot in robots:
            self._publish(robot.lights_topic(flash=flash), payload)

    def _publish(self, topic: str | None, payload: bytes) -> None:
        if topic is not None:
            self._transport.publish(topic, payload, qos=QoS.DELIVERED, urgent=True)
