"""An operator who drives at a steady rate over MQTT, records when each command was sent, and receives the reports."""

from __future__ import annotations

import json
import time
from collections import deque
from typing import Any

from paho.mqtt.client import Client, MQTTMessage

from pebble.bench.null import spin
from pebble.contract import (
    AUDIO_CONTROL,
    DRIVE,
    MQTT_AUDIO,
    MQTT_VIDEO,
    ONLINE,
    STATUS,
    TOUCH_SENSORS,
    VIDEO_CONTROL,
)
from pebble.errors import PebbleError
from pebble.rig.stock_client import StockClient, steadily
from pebble.services.serial_mcu_bridge.text.goob_base import Touch

Wheels = tuple[float, float]

_DIGITS = 3  # of a wheel's speed on the serial line
_STEPS = 800  # wheel values 0.100 … 0.899
_UP_S = 30.0
_POLL_S = 0.02
_REPORTS_LIMIT = 50_000  # reports; a robot sends 50 a second


class Operator(StockClient):
    """One MQTT connection to the remote broker. Each command is identified by the wheel speeds it causes.

    It uses the same TCP options as our own clients. TCP_NODELAY: see :class:`StockClient`. TCP_QUICKACK: otherwise a
    stock broker delays a report by up to 40 ms while its answer to a command is not acknowledged. Without them the
    comparison would measure that.
    """

    def __init__(self, port: int, base: str) -> None:
        self._base, self._number = base, 0
        self._services: dict[str, Any] = {}
        self._heartbeats = 0
        self._received: deque[tuple[int, bytes | bytearray]] = deque(maxlen=_REPORTS_LIMIT)
        super().__init__(self._on_message, [(channel.topic(base), 1) for channel in (STATUS, ONLINE, TOUCH_SENSORS)])
        self.paho.on_publish = lambda *_: self.acknowledge()
        self.paho.message_callback_add(TOUCH_SENSORS.topic(base), self._on_report)
        self.open(port)

    def wait_until_ready(self) -> None:
        """Waits until every service is ready and heartbeats arrive. Raises PebbleError after a timeout."""
        end = time.monotonic() + _UP_S
        while time.monotonic() < end:
            states = {name: service.get("state") for name, service in self._services.items()}
            waiting = [name for name, state in states.items() if state not in ("ready", "stopped")]
            if states and not waiting and self._heartbeats > 1:
                return
            time.sleep(_POLL_S)
        raise PebbleError(f"the robot is not ready after {_UP_S:.0f} s: {states}")

    def media(self, wanted: bool) -> None:
        """Allows and requests video and audio, or stops both."""
        for flag in (MQTT_VIDEO, MQTT_AUDIO):
            self.send(flag, self._base, wanted)
        for request in (VIDEO_CONTROL, AUDIO_CONTROL):
            self.send(request, self._base, {"enabled": wanted})

    def drive(self, seconds: float, rate_hz: float, *, work_us: float = 0.0, slowed: bool = False) -> dict[Wheels, int]:
        """Returns the time (CLOCK_MONOTONIC, ns) at which the command for each pair of wheel speeds was published.

        It works for ``work_us`` before each: before it reads the clock, or, if ``slowed``, after that.
        """
        sent: dict[Wheels, int] = {}
        for _ in steadily(seconds, rate_hz):
            self._number += 1
            left, right = wheels(self._number)
            spin(0.0 if slowed else work_us)
            sent[left, right] = time.monotonic_ns()
            spin(work_us if slowed else 0.0)
            self.send(DRIVE, self._base, {"x": (left - right) / 2, "z": (left + right) / 2})
        return sent

    def received(self, since_ns: int) -> list[tuple[int, Touch]]:
        """The MCU's reports after ``since_ns``, each with its time of arrival."""
        return [(ns, Touch(**json.loads(payload)["value"])) for ns, payload in self._received.copy() if ns >= since_ns]

    def _on_message(self, message: MQTTMessage) -> None:
        self.acknowledge()
        if message.topic == STATUS.topic(self._base):
            self._services = json.loads(message.payload).get("value", {}).get("services", {})
        elif not message.retain:
            self._heartbeats += 1

    def _on_report(self, _client: Client, _data: Any, message: MQTTMessage) -> None:
        self._received.append((time.monotonic_ns(), message.payload))
        self.acknowledge()


def wheels(number: int) -> Wheels:
    """The wheel speeds of command ``number`` (0 … 639,999): each pair is unique."""
    return round(0.1 + (number % _STEPS) / 1000, 3), round(0.1 + (number // _STEPS % _STEPS) / 1000, 3)


def wheels_of(payload: bytes) -> Wheels:
    """The wheel speeds of a drive command, mixed as the serial bridge does."""
    wanted = json.loads(payload)
    return round(wanted["z"] + wanted["x"], _DIGITS), round(wanted["z"] - wanted["x"], _DIGITS)
