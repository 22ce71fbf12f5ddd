"""A scripted operator: discovers robots on a broker, drives them through the same steps, and overrules a script."""

from __future__ import annotations

import threading
import time
from collections import deque
from functools import partial

from pebble.client.discovery import ALL_OUTGOING, DiscoveredRobot, Discovery
from pebble.contract import DRIVE, LIGHTS_FLASH, LIGHTS_SOLID, codec
from pebble.contract.payloads import Drive, LightsFlash
from pebble.demo.emergency import NAME as EMERGENCY_STOP
from pebble.demo.emergency import CompletedStop, EmergencyStop
from pebble.demo.following import CompletedFollow
from pebble.demo.steps import COMMAND_PERIOD_S, SCRIPT, CompletedStep, Step
from pebble.demo.takeover import TakeOver
from pebble.transports import Message, MqttSettings, QoS, create

STOP = Drive()
_COMPLETED = 1000  # finished steps that wait to be assessed
_EVENTS = 100  # that wait to be shown


class Operator:
    """Drives on its own thread and connection.

    ``activity`` and ``events`` (monotonic seconds and a line) are for display; ``completed`` collects finished steps.
    """

    def __init__(self, port: int, name: str = "pebble-demo-operator") -> None:
        self.discovery = Discovery()
        self.activity = "discovering robots"
        self.rounds = 0
        self.commands: dict[str, tuple[Drive, float]] = {}  # by base topic: the last one sent, and when (monotonic)
        self.events: deque[tuple[float, str]] = deque(maxlen=_EVENTS)
        self.completed: deque[CompletedStep | CompletedStop | CompletedFollow] = deque(maxlen=_COMPLETED)
        self._transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port))
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._drive, name=name, daemon=True)

    def connect(self) -> None:
        """Connect and subscribe; returns at once."""
        self._transport.open(timeout=0.0)
        self._transport.subscribe(ALL_OUTGOING, self._receive)

    def ready(self, wanted: int) -> bool:
        """Are that many robots online, with a drive topic?"""
        now = time.monotonic()
        return sum(robot.ready(now) for robot in self.discovery.all_robots()) >= wanted

    def begin(self) -> None:
        """Start driving all robots discovered so far, round after round."""
        self._thread.start()

    def end(self) -> None:
        """Interrupt the step, stop all robots and disconnect."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
        self._transport.close()

    def _receive(self, message: Message) -> None:
        self.discovery.receive(message, time.monotonic(), time.time())

    # -- the operator's thread

    def _drive(self) -> None:
        robots = self.discovery.all_robots()
        while not self._stopping.is_set():
            for step in SCRIPT:
                self._perform(step, robots)
                if self._stopping.is_set():
                    break
            else:
                if not self.rounds:
                    self._stop_once(robots)
                    self._take_over_once(robots)
                self.rounds += 1
        self._send(STOP, robots)
        self.activity = "disconnecting"

    def _perform(self, step: Step, robots: list[DiscoveredRobot]) -> None:
        self.activity = step.name
        began = due = released = time.monotonic()
        self._switch_lights(step, robots)
        while due < began + step.drive_s:
            self._send(step.drive, robots)
            released = time.monotonic()
            due += COMMAND_PERIOD_S
            if self._stopping.wait(max(0.0, due - released)):
                return
        if step.sends_stop:
            self._send(STOP, robots)
            released = time.monotonic()
        self.activity = f"{step.name}: observing"
        if self._stopping.wait(step.rest_s):
            return
        self.completed.extend(CompletedStep(robot.name, step, began, released, time.monotonic()) for robot in robots)

    def _stop_once(self, robots: list[DiscoveredRobot]) -> None:
        """Stop all robots, try to drive them, and reset them."""
        self.activity = EMERGENCY_STOP
        emergency = EmergencyStop(
            self._transport, lambda drive: self._send(drive, robots), self._stopping.wait, by="the demo's operator"
        )
        subscription = self._transport.subscribe(ALL_OUTGOING, emergency.receive)  # brings retained capabilities again
        self.completed.extend(emergency.perform(robots))
        subscription.close()

    def _take_over_once(self, robots: list[DiscoveredRobot]) -> None:
        """Let each robot with scripts follow a tag, and overrule the script for a moment."""
        for robot in robots:
            if robot.offers("autonomy") and not self._stopping.is_set():
                drive = partial(self._send, robots=[robot])
                completed = TakeOver(self._transport, robot, drive, self._stopping.wait, self._note).perform()
                self.completed.extend([completed] if completed else [])

    def _note(self, what: str, text: str) -> None:
        self.activity = f"{what}: {text}"
        self.events.append((time.monotonic(), f"operator {what}: {text}"))

    def _send(self, drive: Drive, robots: list[DiscoveredRobot]) -> None:
        payload = codec.encode(DRIVE, drive)
        for robot in robots:
            self.commands[robot.base] = drive, time.monotonic()
            self._publish(robot.drive_topic, payload)

    def _switch_lights(self, step: Step, robots: list[DiscoveredRobot]) -> None:
        flash = isinstance(step.lights, LightsFlash)
        payload = codec.encode(LIGHTS_FLASH if flash else LIGHTS_SOLID, step.lights)
        for robot in robots:
            self._publish(robot.lights_topic(flash=flash), payload)

    def _publish(self, topic: str | None, payload: bytes) -> None:
        if topic is not None:
            self._transport.publish(topic, payload, qos=QoS.DELIVERED, urgent=True)
