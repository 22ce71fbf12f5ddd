"""Tries what an account may publish and receive at a broker, and whether that broker holds small messages back."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from statistics import median

from pebble.check_result import CheckResult
from pebble.config.security import SecurityLevel
from pebble.contract import BRIDGE_PROBE, DRIVING, ONLINE
from pebble.contract.identity import SERVERS, Identity
from pebble.contract.levels import LEVELS
from pebble.doctor import fail, ok, warn
from pebble.forwarding.probes import new_probe
from pebble.transports import Message, MqttSettings, QoS, State
from pebble.transports.mqtt.transport import MqttTransport

_OPEN_S = 5.0
_POLL_S = 0.05
_APART_S = 0.005  # between the two messages of a pair
_PAIRS = 5
_QUIET_S = 60  # no pings meanwhile: while the answer to one is not acknowledged, both messages of a pair wait
_QUIET = 1.5  # round trips between two pairs: the one before is acknowledged then
_MATTERS_S = 0.02  # a shorter round trip delays nothing that people notice
_HELD = 0.75  # of a round trip: a thin link itself needs some of it for the second message


def publishing(
    what: str,
    settings: MqttSettings,
    base: str,
    answer_s: float = LEVELS["wide"].answer_s,
    level: SecurityLevel = "open",
) -> Iterator[CheckResult]:
    """Publish probes, which no program takes for anything else, below ``base``, and see when they come back.

    After ``answer_s`` one counts as lost. Above the level ``open`` one that poses as another robot has to be.
    """
    client = MqttTransport("doctor", replace(settings, keepalive_s=_QUIET_S, silence_s=_QUIET_S))
    with closing(client):
        client.open(_OPEN_S)
        if client.state is not State.CONNECTED:
            yield warn(what, f"cannot be published to: {client.problem}")
            return
        echo = _Echo(client, BRIDGE_PROBE.topic(base), answer_s)
        came_back = echo.arrival(echo.send(QoS.DELIVERED), giving_up=lambda: bool(echo.refusal)) is not None
        if echo.refusal or not (came_back or settings.protocol == "5"):  # which says what it refuses
            why = echo.refusal or "it does not come back (or may this account not read it?)"
            fix = f"allow it to write and read {echo.topic.rpartition('/')[0]}/# on the broker"
            yield fail(what, f"this account may not publish to {echo.topic}: {why}", fix)
            return
        yield ok(what, "accepts what this account publishes")
        if level != "open":
            yield _bounds(what, client, echo)
        pairs = [pair for _ in range(_PAIRS if came_back else 0) if (pair := echo.pair()) is not None]
        if pairs:
            yield from held_back(what, min(pair[0] for pair in pairs), median(pair[1] for pair in pairs))


def _bounds(what: str, client: MqttTransport, own: _Echo) -> CheckResult:
    """Whether the broker has rules: no robot, and no page, may publish what a robot of another name does."""
    other = _Echo(client, BRIDGE_PROBE.topic(f"pebble/robots/doctor-{secrets.token_hex(4)}"), own.answer_s)
    payload = other.send(QoS.DELIVERED)
    came_back = own.arrival(own.send(QoS.DELIVERED)) is not None  # what was let through has come before it
    if not (came_back or other.has(payload)):
        return warn(what, "does not answer in time: whether it has rules is not known")
    if other.has(payload):
        fix = "start it with the files of `pebble fleet init`, see docs/fleet.md"
        return fail(what, "has no rules: with this account one can pose as any robot, and drive it", fix)
    return ok(what, "keeps this account from posing as another robot")


def of_page(what: str, settings: MqttSettings, level: SecurityLevel = "open") -> Iterator[CheckResult]:
    """Whether a page server with this account is sent what robots publish, and may announce who drives."""
    client = MqttTransport("doctor", settings)
    with closing(client):
        client.open(_OPEN_S)
        why = client.problem
        if client.state is State.CONNECTED:
            client.subscribe(ONLINE.filter("+/+/+"), lambda _: None)
            echo = _Echo(client, DRIVING.topic(Identity("pebble", SERVERS, "doctor").base), LEVELS["wide"].answer_s)
            came_back = echo.arrival(echo.send(QoS.DELIVERED)) is not None
            why = client.not_received or ("" if came_back else f"what it publishes on {echo.topic} does not come back")
        if why:
            fix = "pebble fleet check; its role is page"
            yield fail(what, f"a page with this account does not hear robots: {why}", fix)
            return
        yield ok(what, "delivers what robots send, and takes what a page publishes")
        if level != "open":
            yield _bounds(what, client, echo)


def held_back(what: str, round_trip_s: float, apart_s: float) -> Iterator[CheckResult]:
    """Judge the shortest round trip, and the time by which the second message of a pair usually came after the first.

    By Nagle's algorithm a broker sends the second one when the first is acknowledged, so a round trip later.
    """
    if round_trip_s < _MATTERS_S:
        return
    if apart_s < _HELD * round_trip_s:
        yield ok(what, "passes small messages on at once")
        return
    saved_ms = 1000 * (apart_s - _APART_S)
    yield warn(
        what,
        f"holds small messages back: a command that follows another one comes up to {saved_ms:.0f} ms later, "
        f"a round trip being {1000 * round_trip_s:.0f} ms",
        "in mosquitto.conf: set_tcp_nodelay true",
    )


class _Echo:
    """Probes on one topic, and when each came back."""

    def __init__(self, client: MqttTransport, topic: str, answer_s: float) -> None:
        self._client, self.topic, self.answer_s = client, topic, answer_s
        self._came, self._arrivals = threading.Condition(), dict[bytes, float]()
        client.subscribe(topic, self._note, direct=True)  # in the order in which messages come

    @property
    def refusal(self) -> str:
        """Why the broker does not take them; empty: it has not refused them."""
        if self.topic in self._client.not_taken:
            return self._client.not_taken[self.topic][0]
        hung_up = self._client.state is not State.CONNECTED or self._client.counters["connected"] > 1
        return "the broker hangs up on it" if hung_up else ""

    def send(self, qos: QoS) -> bytes:
        payload = new_probe(time.time_ns() // 1_000_000)
        self._client.publish(self.topic, payload, qos=qos, urgent=True)
        return payload

    def arrival(self, payload: bytes, giving_up: Callable[[], bool] = lambda: False) -> float | None:
        """When it came back; None: it has not in time."""
        deadline = time.monotonic() + self.answer_s
        with self._came:
            while payload not in self._arrivals and time.monotonic() < deadline and not giving_up():
                self._came.wait(_POLL_S)
            return self._arrivals.get(payload)

    def has(self, payload: bytes) -> bool:
        """Whether it has come back."""
        with self._came:
            return payload in self._arrivals

    def pair(self) -> tuple[float, float] | None:
        """The round trip of one message, and by how much a second one, sent a moment later, came after it."""
        began = time.monotonic()
        first = self.send(QoS.LATEST)
        time.sleep(_APART_S)
        second = self.send(QoS.LATEST)
        came = self.arrival(first), self.arrival(second)
        if came[0] is None or came[1] is None:
            return None
        round_trip_s = came[0] - began
        time.sleep(_QUIET * round_trip_s)
        return round_trip_s, came[1] - came[0]

    def _note(self, message: Message) -> None:
        with self._came:
            self._arrivals.setdefault(message.payload, time.monotonic())
            self._came.notify()
