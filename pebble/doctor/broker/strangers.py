"""Probes of a broker: what clients have of it that should not, and at which other doors it answers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import msgspec

from pebble import doctor
from pebble.check_result import CheckResult
from pebble.config.web import is_loopback
from pebble.doctor.broker import MOSQUITTO, ok, skip, warn
from pebble.doctor.broker.peer import Bench, RefusedError
from pebble.doctor.broker_probe import probe
from pebble.doctor.reachable import beyond_loopback, own_addresses
from pebble.fleet.roles import CONTROL_TOPIC
from pebble.transports.settings import MqttSettings

_UNENCRYPTED = 1883
_WAIT_S = 1.0
_DEFAULTS = msgspec.json.encode({"commands": [{"command": "getDefaultACLAccess"}]})


def unnamed(bench: Bench) -> CheckResult:
    """What clients without a name have of what an account publishes."""
    if bench.settings.username is None:
        return skip("this is one: log in with an account")
    try:
        stranger = bench.peer(login=False)
    except RefusedError:
        return ok("are refused")
    reader, writer = bench.peer(), bench.peer()
    stranger.subscribe("#", qos=0)
    reader.subscribe("#", qos=0)
    writer.publish("own")
    stranger.publish("strange")
    bench.wait(lambda: reader.payloads("own"))
    bench.wait_quiet(reader)
    can = [*(["read"] if stranger.payloads("own") else []), *(["publish"] if reader.payloads("strange") else [])]
    if can:
        fix = f"{MOSQUITTO}allow_anonymous false, or no rule for clients without a name in the acl_file"
        return warn(f"are let in, and {' and '.join(can)} what this account does", fix)
    return ok("are let in, and neither read nor publish what this account does")


def administers(bench: Bench) -> CheckResult:
    """Ask mosquitto's plugin what an account may do by default: it answers administrators only, and changes nothing."""
    bench.base, _, version = CONTROL_TOPIC.rpartition("/")
    peer = bench.peer()
    peer.subscribe(f"{version}/response", qos=0)
    peer.publish(version, _DEFAULTS)
    if not bench.wait(lambda: peer.received or peer.closed, _WAIT_S) or peer.closed:
        return ok("this account does not change them over MQTT")
    opens = b'"publishClientSend","allow":true' in peer.received[0].payload.replace(b" ", b"").replace(b"\t", b"")
    more = ", and every account may publish everything by default" if opens else ""
    return warn(f"this account changes them{more}", "give robots and people accounts of their own: pebble fleet add")


def other_doors(name: str, settings: MqttSettings) -> Iterator[CheckResult]:
    """Whether a broker answers where it should not: on the network, or without encryption."""
    if is_loopback(settings.host):
        yield from beyond_loopback(name, settings, own_addresses())
    if settings.tls is None:
        return
    what, plain = f"{name} {settings.host}:{_UNENCRYPTED}", replace(settings, port=_UNENCRYPTED, tls=None)
    answer = probe(plain, login=False).code  # without the password: it could be read
    if answer is None:
        yield doctor.ok(what, "does not answer without encryption")
        return
    more = ", and accepts clients without a name" if answer == 0 else ""
    yield doctor.warn(
        what, f"also answers without encryption{more}", f"{MOSQUITTO}listener 1883 127.0.0.1, or none there"
    )
