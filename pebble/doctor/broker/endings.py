"""Probes of a broker: what happens when a connection ends, and when its client comes back."""

from __future__ import annotations

import time
from contextlib import suppress

from pebble.check_result import CheckResult
from pebble.doctor.broker import OTHER, fail, ok, skip, warn
from pebble.doctor.broker.peer import NAME, Bench, RefusedError, will
from pebble.transports.mqtt import client_ids

_KEEPALIVE_S = 2
_KEEPALIVE_LATE_S = 12.0  # mosquitto looks every few seconds
_WILL_S = 1.0


def last_wills(bench: Bench) -> CheckResult:
    reader = bench.peer()
    reader.subscribe("#", qos=bench.qos)
    retain = bench.retains
    try:
        robot = bench.peer(will=will("online", b"gone", qos=bench.qos, retain=retain))
    except RefusedError as error:
        return warn(f"it refuses a client with a will: {error}", "allow wills, also retained ones of QoS 1")
    robot.publish("online", b"here", qos=bench.qos, retain=retain)
    bench.wait(lambda: reader.received)
    began = time.monotonic()
    robot.cut()
    bench.wait(lambda: b"gone" in reader.payloads(), 2 * bench.answer_s)
    seconds = time.monotonic() - began
    bench.wait_quiet(reader)
    wills = reader.payloads().count(b"gone")
    if not wills:
        return warn("none is published when a connection is reset", "allow wills (an access list may forbid them)")
    if wills > 1:
        return warn(f"one is published {wills} times", "")
    if seconds > _WILL_S + bench.round_trip_s:
        return warn(f"one is published {seconds:.1f} s after the connection is reset", "")
    late = bench.peer()
    late.subscribe("online", qos=bench.qos)
    bench.wait(lambda: not retain or late.received)
    if retain and late.payloads()[-1:] != [b"gone"]:
        return warn("one is published, and not retained", "allow retained wills")
    return ok(f"once, {seconds:.2f} s after a reset{', and retained' if retain else ''}")


def goodbye(bench: Bench) -> CheckResult:
    reader = bench.peer()
    reader.subscribe("#", qos=0)
    try:
        robot = bench.peer(will=will("online", b"gone", qos=0, retain=False))
    except RefusedError:
        return skip("it takes no wills")
    robot.leave()
    bench.wait_quiet(reader, most_s=1.0)
    if reader.received:
        return warn("the will of a client that says goodbye is published as well", OTHER)
    return ok("a client that says goodbye has none")


def fall_silent(bench: Bench) -> None:
    """A client that sends no pings from now on: its will is waited for at the end."""
    bench.begin("silent")
    reader, began = bench.peer(lasting=True), time.monotonic()
    reader.subscribe("#", qos=0)
    with suppress(RefusedError):
        bench.peer(lasting=True, keepalive_s=_KEEPALIVE_S, will=will("online", b"gone", qos=0, retain=False))
        bench.silent = reader, began


def will_of_silent(bench: Bench) -> CheckResult:
    if bench.silent is None:
        return skip("it takes no wills")
    reader, began = bench.silent
    if not bench.wait(lambda: reader.received, max(began + _KEEPALIVE_LATE_S - time.monotonic(), 0.0)):
        return warn(f"none within {_KEEPALIVE_LATE_S:.0f} s, with a keep-alive of {_KEEPALIVE_S} s", "")
    return ok(f"{reader.received[0].at - began:.1f} s after its last word, with a keep-alive of {_KEEPALIVE_S} s")


def takeover(bench: Bench) -> CheckResult:
    if bench.settings.client_id is not None:
        return skip("the client id is set")
    name, reader = client_ids.unique(NAME), bench.peer()
    reader.subscribe("#", qos=0)
    before = bench.peer(client_id=name)
    try:
        after = bench.peer(client_id=name)
    except RefusedError as error:
        return fail(f"who comes back is refused while the old connection is there: {error}", OTHER)
    after.publish("x")
    ended = bench.wait(lambda: before.closed)
    if not bench.wait(lambda: reader.received):
        return fail("who comes back cannot publish while the old connection is there", OTHER)
    if not ended:
        return warn("the old connection of a client that is back stays open", "")
    return ok("the old connection is closed at once")


def outage(bench: Bench) -> CheckResult:
    if bench.settings.client_id is not None:
        return skip("the client id is set")
    name, writer = client_ids.unique(NAME), bench.peer()
    robot = bench.peer(client_id=name)
    robot.subscribe("x", qos=bench.qos)
    robot.cut()
    bench.wait(lambda: False, 0.1)
    for number in range(5):
        writer.publish("x", b"%d" % number, qos=bench.qos)
    writer.ping()
    back = bench.peer(client_id=name)
    back.subscribe("x", qos=bench.qos)
    bench.wait_quiet(back)
    if back.received:
        return fail(f"{len(back.received)} commands of meanwhile come to a robot that is back", OTHER)
    return ok("what was sent meanwhile does not come to a client that is back")
