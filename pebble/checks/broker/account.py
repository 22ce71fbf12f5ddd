"""Checks what an account may publish and receive at a broker, and whether that broker holds small messages back."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median

from pebble.checks.broker import MOSQUITTO
from pebble.checks.broker.peer import BrokerTrial, Peer, reached
from pebble.checks.check import CheckResult, failed, ok, warn
from pebble.config.security import SecurityLevel
from pebble.contract import BRIDGE_PROBE, ONLINE
from pebble.contract.identity import SERVERS, Identity
from pebble.contract.levels import LEVELS
from pebble.errors import TransportError
from pebble.forwarding.probes import new_probe
from pebble.transports import MqttSettings

_REFUSED = 0x80
_APART_S = 0.005  # between the two messages of a pair
_PAIRS = 5
_QUIET = 1.5  # round trips between two pairs: the one before is acknowledged then
_MATTERS_S = 0.02  # a shorter round trip delays nothing that people notice
_HELD = 0.75  # of a round trip: a thin link itself needs some of it for the second message


def robot_account(
    what: str,
    settings: MqttSettings,
    base: str,
    answer_s: float = LEVELS["wide"].answer_s,
    level: SecurityLevel = "open",
) -> Iterator[CheckResult]:
    """Publish probes, which no program takes for anything else, below ``base``, and see when they come back.

    After ``answer_s`` one counts as lost. Above the level ``open`` one that poses as another robot has to be.
    """
    try:
        with _logged_in(settings, answer_s) as (trial, peer):
            topic = BRIDGE_PROBE.topic(base)
            peer.subscribe(topic)
            is_back, refusal = _echo(trial, peer, topic)
            if refusal or not (is_back or settings.protocol == "5"):  # which says what it refuses
                why = refusal or "it does not come back (or may this account not read it?)"
                fix = f"allow it to write and read {topic.rpartition('/')[0]}/# on the broker"
                yield failed(f"this account may not publish to {topic}: {why}", fix, what)
                return
            yield ok("accepts what this account publishes", what=what)
            if level != "open":
                yield _rules(what, trial, peer, topic)
            pairs = [pair for _ in range(_PAIRS if is_back else 0) if (pair := _pair(trial, peer, topic)) is not None]
            if pairs:
                yield from held_back(what, min(pair[0] for pair in pairs), median(pair[1] for pair in pairs))
    except TransportError as error:
        yield warn(f"cannot be published to: {error}", what=what)


def page_account(what: str, settings: MqttSettings, level: SecurityLevel = "open") -> Iterator[CheckResult]:
    """Check that a page server with this account is sent what robots publish, and may publish itself."""
    why = ""
    try:
        with _logged_in(settings, LEVELS["wide"].answer_s) as (trial, peer):
            topic, states = BRIDGE_PROBE.topic(Identity("pebble", SERVERS, "doctor").base), ONLINE.filter("+/+/+")
            if (peer.subscribe(states) or b"\xff")[0] >= _REFUSED:
                why = f"the broker refuses it {states}"
            else:
                peer.subscribe(topic)
                is_back, refusal = _echo(trial, peer, topic)
                why = "" if is_back else refusal or f"what it publishes on {topic} does not come back"
            if not why:
                yield ok("delivers what robots send, and takes what a page publishes", what=what)
                if level != "open":
                    yield _rules(what, trial, peer, topic)
    except TransportError as error:
        why = str(error)
    if why:
        fix = "pebble fleet check; its role is page"
        yield failed(f"a page with this account does not hear robots: {why}", fix, what)


@contextmanager
def _logged_in(settings: MqttSettings, answer_s: float) -> Iterator[tuple[BrokerTrial, Peer]]:
    """One client with the account, for whole topics. Raises TransportError."""
    with reached(settings, "") as trial:
        trial.begin("account")
        trial.base, trial.patience_s = "", answer_s
        yield trial, trial.peer(protocol=settings.protocol)


def _echo(trial: BrokerTrial, peer: Peer, topic: str) -> tuple[bool, str]:
    """Publish a probe; True if it comes back, and why the broker does not take it, as far as it tells."""
    payload = new_probe(time.time_ns() // 1_000_000)
    mid = peer.publish(topic, payload, qos=1)

    def refusal() -> str:
        if peer.acks.get(mid, 0) >= _REFUSED:
            return f"the broker refuses it (code {peer.acks[mid]})"
        return "the broker hangs up on it" if peer.closed else ""

    trial.wait(lambda: payload in peer.payloads() or refusal())
    return payload in peer.payloads(), refusal()


def _rules(what: str, trial: BrokerTrial, peer: Peer, own: str) -> CheckResult:
    """Check that the broker has rules: no robot, and no page, may publish what a robot of another name does."""
    other = BRIDGE_PROBE.topic(f"pebble/robots/doctor-{secrets.token_hex(4)}")
    peer.subscribe(other)
    payload = new_probe(time.time_ns() // 1_000_000)
    peer.publish(other, payload, qos=1)
    is_back, _ = _echo(trial, peer, own)  # what was let through has come before it
    if payload in peer.payloads():
        fix = "start it with the files of `pebble fleet init`, see docs/fleet.md"
        return failed("has no rules: with this account one can pose as any robot, and drive it", fix, what)
    if not is_back and not peer.closed:
        return warn("does not answer in time: whether it has rules is not known", what=what)
    return ok("keeps this account from posing as another robot", what=what)


def _pair(trial: BrokerTrial, peer: Peer, topic: str) -> tuple[float, float] | None:
    """Return the round trip of one message, and by how much a second one, sent a moment later, came after it."""
    began, probes = time.monotonic(), [new_probe(number) for number in range(2)]
    for probe in probes:
        peer.publish(topic, probe)
        trial.wait(lambda: False, _APART_S)
    trial.wait(lambda: set(probes) <= set(peer.payloads()))
    arrivals = {message.payload: message.at for message in peer.received}
    if not set(probes) <= arrivals.keys():
        return None
    round_trip_s = arrivals[probes[0]] - began
    trial.wait(lambda: False, _QUIET * round_trip_s)
    return round_trip_s, arrivals[probes[1]] - arrivals[probes[0]]


def held_back(what: str, round_trip_s: float, apart_s: float) -> Iterator[CheckResult]:
    """Judge the shortest round trip, and the time by which the second message of a pair usually came after the first.

    By Nagle's algorithm a broker sends the second one when the first is acknowledged, so a round trip later.
    """
    if round_trip_s < _MATTERS_S:
        return
    if apart_s < _HELD * round_trip_s:
        yield ok("passes small messages on at once", what=what)
        return
    saved_ms = 1000 * (apart_s - _APART_S)
    yield warn(
        f"holds small messages back: a command that follows another one comes up to {saved_ms:.0f} ms later, "
        f"a round trip being {1000 * round_trip_s:.0f} ms",
        f"{MOSQUITTO}set_tcp_nodelay true",
        what,
    )
