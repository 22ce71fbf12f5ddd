"""Checks of what an account may publish and receive at a broker, and of whether the broker delays small messages."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from dataclasses import replace

from pebble.check_result import CheckResult, State, failed, ok, warn
from pebble.config.security import SecurityLevel
from pebble.contract import BRIDGE_PROBE, ONLINE
from pebble.contract.identity import SERVERS, Identity
from pebble.contract.levels import LEVELS
from pebble.errors import TransportError
from pebble.extensions.checks.broker import MOSQUITTO
from pebble.extensions.checks.broker.login_attempt import reached
from pebble.extensions.checks.broker.messages import REFUSED, held_back
from pebble.extensions.checks.broker.peer import BrokerTrial, Peer
from pebble.forwarding.probes import new_probe
from pebble.transports import MqttSettings
from pebble.transports.mqtt import reasons

_MATTERS_S = 0.02  # a shorter round trip delays nothing that people notice: our own programs acknowledge at once


def robot_account(
    what: str,
    settings: MqttSettings,
    base: str,
    answer_s: float = LEVELS["wide"].answer_s,
    level: SecurityLevel = "open",
    reads: str = "",
) -> Iterator[CheckResult]:
    """Publish probe messages below ``base`` and check that the broker accepts them.

    No program takes a probe for anything else. ``reads``: a further filter that the broker must grant. The probe
    must come back within ``answer_s`` with MQTT 3.1.1, which tells no refusal, or if ``reads`` is given. Otherwise a
    second probe must, among the commands, unless it is refused. Above the level ``open``, a probe in the name of
    another robot must not come back.
    """
    try:
        with reached(settings, "") as trial:  # "": no topic here is below it, as all are complete
            trial.patience_s = answer_s
            peer, topic = trial.peer(protocol=settings.protocol), BRIDGE_PROBE.topic(base)
            must_come_back = bool(reads) or settings.protocol != "5"  # before MQTT 5 no refusal is told
            result = trial.judge(lambda trial: _rights(trial, peer, topic, reads, must_come_back=must_come_back))
            yield replace(result, what=what)
            if result.state is not State.OK:
                return
            if level != "open":
                yield _rules(what, trial, peer, topic)
            if trial.round_trip_s >= _MATTERS_S:
                result = trial.judge(lambda trial: held_back(trial, peer, peer, topic))  # it reads what it writes
                yield replace(result, what=f"small messages at {what}")
    except TransportError as error:
        yield warn(f"cannot be published to: {error}", what=what)


def page_account(what: str, settings: MqttSettings, level: SecurityLevel = "open") -> Iterator[CheckResult]:
    """Check that a page server with this account receives what robots publish, and may publish itself."""
    base, states = Identity("pebble", SERVERS, "doctor").base, ONLINE.filter("+/+/+")
    return robot_account(what, settings, base, level=level, reads=states)


def _rights(trial: BrokerTrial, peer: Peer, topic: str, reads: str, *, must_come_back: bool) -> CheckResult:
    """Check that this account may read ``reads``, if that is given, and publish to ``topic``."""
    if reads and (why := _why_not_granted(peer, reads)):
        text = f"a page with this account does not hear robots: {why} {reads}"
        return failed(text, "pebble fleet check; its role is page")
    peer.subscribe(topic)
    is_back, refusal = _echo(trial, peer, topic)
    if peer.closed and _takes_qos_0(trial, topic):  # it hung up on QoS 1 alone
        return warn("takes no QoS 1: what is lost on the way is not sent again", f"{MOSQUITTO}max_qos 2")
    if refusal or (must_come_back and not is_back):
        why = refusal or "it does not come back (or may this account not read it?)"
        fix = f"allow it to write and read {topic.rpartition('/')[0]}/# on the broker"
        return failed(f"this account may not publish to {topic}: {why}", fix)
    # Where the probe need not come back, one among the commands shows whether the robot receives anything.
    if not must_come_back and (why := _why_deaf(trial, topic.replace("/outgoing/", "/incoming/"))):
        return failed(why, "allow it to read what it subscribes to on the broker")
    return ok("accepts what this account publishes")


def _why_deaf(trial: BrokerTrial, topic: str) -> str:
    """Publish a probe among a robot's commands; return why it is not delivered, empty if it is or is refused."""
    peer = trial.peer(protocol=trial.settings.protocol)  # which the broker may close
    peer.subscribe(topic)
    is_back, refusal = _echo(trial, peer, topic)
    return "" if is_back or refusal else f"this account may not read {topic}: commands and stops do not reach the robot"


def _why_not_granted(peer: Peer, filter_: str) -> str:
    """Subscribe; return why the broker does not grant it, empty if it does."""
    granted = peer.subscribe(filter_)  # its code; empty without an answer
    if not granted:
        return "the broker does not answer its subscription to"
    return "the broker refuses it" if granted[0] >= REFUSED else ""


def _takes_qos_0(trial: BrokerTrial, topic: str) -> bool:
    """True if a probe with QoS 0 comes back."""
    peer = trial.peer(protocol=trial.settings.protocol)
    peer.subscribe(topic)
    return _echo(trial, peer, topic, qos=0)[0]


def _echo(trial: BrokerTrial, peer: Peer, topic: str, qos: int = 1) -> tuple[bool, str]:
    """Publish a probe; return whether it came back, and the broker's reason if it refused the probe."""
    payload, began = new_probe(time.time_ns() // 1_000_000), time.monotonic()
    mid = peer.publish(topic, payload, qos=qos)

    def refusal() -> str:
        if peer.acks.get(mid, 0) >= REFUSED:
            return f"the broker refuses it ({reasons.words(peer.acks[mid])})"
        return "the broker hangs up on it" if peer.closed else ""

    trial.wait(lambda: payload in peer.payloads() or refusal())
    is_back = payload in peer.payloads()
    trial.round_trip_s = time.monotonic() - began if is_back else 0.0
    return is_back, refusal()


def _rules(what: str, trial: BrokerTrial, peer: Peer, topic: str) -> CheckResult:
    """Check that the broker has access rules: this account must not be able to publish in the name of another robot."""
    other = BRIDGE_PROBE.topic(f"pebble/robots/doctor-{secrets.token_hex(4)}")
    peer.subscribe(other)
    payload = new_probe(time.time_ns() // 1_000_000)
    mid = peer.publish(other, payload, qos=1)
    is_back, _ = _echo(trial, peer, topic)  # a later probe: once it is back, the earlier one came or never comes
    if payload in peer.payloads():
        fix = "start it with the files of `pebble fleet init FOLDER --host NAME`, see docs/ext/fleet.md"
        return failed("has no rules: with this account one can pose as any robot, and drive it", fix, what)
    code = peer.acks.get(mid, 0)
    if code >= REFUSED and not reasons.concerns_login(code):  # rules answer "not authorized", a code of logins
        return warn(f"refuses a message to another robot, but not for that: {reasons.words(code)}", what=what)
    if not is_back and not peer.closed:
        return warn("does not answer in time: whether it has rules is not known", what=what)
    return ok("keeps this account from posing as another robot", what=what)
