"""Probes of a broker: who may publish, and how messages arrive."""

from __future__ import annotations

import secrets
import time
from statistics import median

from pebble.check_result import CheckResult
from pebble.doctor.broker import MOSQUITTO, OTHER, fail, ok, skip, warn
from pebble.doctor.broker.peer import Bench, Peer, RefusedError, number

_BURST = 1000  # messages of QoS 1
_BEHIND = 500  # messages for a receiver that acknowledges none of them
_APART_S = 0.005
_HELD_S = 0.03  # by which Nagle's algorithm delays where the receiver's kernel confirms late
_PAIRS = 5
_PING_TRIES = 3  # an answer that comes too early may by chance come last
_PING_S = 2.0  # after which a robot gives a connection up
_PICTURE, _LARGE = 35_000, 256_000  # bytes
_REFUSED = 0x80

#: What a name of a robot or of a channel may contain (T2), below a topic of our own.
_ODD_TOPICS = {
    "a blank": "a b",
    "a dot": "a.b",
    "* and >": "*/>",
    "letters beyond ASCII": "ä/機",
    "190 levels": "/".join("l" * 190),
    "900 bytes": 900 * "n",
}


def rights(bench: Bench) -> CheckResult:
    allow = f"topic readwrite {bench.root.rpartition('/')[0]}/#"
    reader, writer = bench.peer(), bench.peer()
    granted = reader.subscribe("#", qos=0)
    writer.publish("x")
    fix = (
        "use a robot's account and its topics: --below pebble/robots/ID; "
        f"or allow these ({MOSQUITTO}an acl_file with {allow})"
    )
    if not granted or granted[0] >= _REFUSED:
        return fail(f"this account may not subscribe to {bench.base}/#", fix)
    if bench.wait(lambda: reader.received or writer.closed) and not writer.closed:
        return ok(f"this account publishes and reads below {bench.root.rpartition('/')[0]}/")
    if writer.closed:
        return fail(f"it hangs up on what this account publishes to {bench.base}/x", fix)
    may = "publish" if _is_forbidden(bench) else "read"
    return fail(f"this account may not {may} {bench.base}/x, and is not told", fix)


def _is_forbidden(bench: Bench) -> bool | None:
    """Whether a message is not taken; only MQTT 5 tells."""
    try:
        writer = bench.peer(protocol="5")
    except RefusedError:
        return None
    mid = writer.publish("x", qos=1)
    if not bench.wait(lambda: mid in writer.acks or writer.closed) or writer.closed:
        return None
    return writer.acks[mid] >= _REFUSED


def refusals(bench: Bench) -> CheckResult:
    """Subscribe where no rule mentions the topic: an account with rules is refused that."""
    bench.base = f"{secrets.token_hex(8)}/doctor/one"
    reader, writer = bench.peer(), bench.peer()
    granted = reader.subscribe("#", qos=0)
    if granted and granted[0] >= _REFUSED:
        return ok("it tells which it refuses")
    if not granted:
        return warn("it answers one that is not allowed by nothing, or hangs up", "")
    writer.publish("x")
    if bench.wait(lambda: reader.received, 1.0):
        return skip("this account is refused none")
    if _is_forbidden(bench) is False:
        return warn("it grants them, and then delivers nothing", "")
    return skip("it grants them, and nothing comes: this account may not publish there, or may not read")


def acknowledged(bench: Bench) -> CheckResult:
    fix = f"{MOSQUITTO}max_qos 2"
    reader, writer = bench.peer(), bench.peer()
    granted = reader.subscribe("#")
    mid = writer.publish("x", qos=1)
    bench.wait(lambda: (mid in writer.acks and reader.received) or writer.closed)
    bench.qos = 0
    if writer.closed:
        return warn(f"it hangs up on messages of QoS 1{writer.because}", fix)
    if not granted or granted[0] != 1:
        return warn("it grants a subscription QoS 0 only", fix)
    if mid not in writer.acks:
        return fail("it does not acknowledge a message of QoS 1", fix)
    if not reader.received:
        return fail("it acknowledges a message and does not deliver it", OTHER)
    bench.qos, began = 1, time.monotonic()
    writer.ping()
    bench.round_trip_s = min(1.0, time.monotonic() - began)
    return ok(f"delivered and acknowledged; a round trip takes {1000 * bench.round_trip_s:.1f} ms")


# -- messages


def burst(bench: Bench) -> CheckResult:
    if not bench.qos:
        return skip("it has no QoS 1")
    reader, writer = bench.peer(), bench.peer()
    reader.subscribe("#")
    began = time.monotonic()
    confirmed = writer.publish_all((("x", b"%d" % place) for place in range(_BURST)), qos=1)
    bench.wait(lambda: len(reader.received) >= _BURST or reader.closed, bench.answer_s)
    seconds = time.monotonic() - began
    bench.wait_quiet(reader)
    found = [number(one) for one in reader.payloads()]
    first, lost = list(dict.fromkeys(found)), _BURST - len(set(found))
    if not confirmed:
        return fail(f"only {len(writer.acks)} of them were acknowledged{writer.because}", OTHER)
    if lost:
        return fail(f"{lost} of them were acknowledged and lost", f"{MOSQUITTO}max_queued_messages 1000")
    if first != sorted(first):
        return fail("they came out of order", f"{MOSQUITTO}max_inflight_messages 1, or use another broker")
    if len(found) > _BURST:
        return warn(f"{len(found) - _BURST} of them came twice", OTHER)
    return ok(f"complete and in order, in {seconds:.2f} s")


def queue(bench: Bench) -> CheckResult:
    if not bench.qos:
        return skip("it has no QoS 1")
    reader, writer = bench.peer(), bench.peer()
    reader.subscribe("#")
    reader.holds = True
    writer.publish_all((("x", b"%d" % place) for place in range(_BEHIND)), qos=1)
    reader.holds = False
    bench.wait(lambda: len(set(reader.payloads())) >= _BEHIND or reader.closed, bench.answer_s)
    bench.wait_quiet(reader)
    came = len(set(reader.payloads()))
    if came < _BEHIND:
        fix = f"{MOSQUITTO}max_queued_messages 1000"
        return warn(f"it keeps {came} of {_BEHIND} messages for it, and drops the others", fix)
    return ok(f"it keeps {_BEHIND} messages for it")


def filters(bench: Bench) -> CheckResult:
    writer = bench.peer()
    expected = {"a/+": {"a/b"}, "a/#": {"a", "a/b", "a/b/c"}, "+/b": {"a/b"}, "+": {"a", "end"}, "#": set(_TOPICS)}
    readers = {filter_: bench.peer() for filter_ in expected}
    for filter_, reader in readers.items():
        reader.subscribe(filter_, qos=0)
    for topic in _TOPICS:
        writer.publish(topic)
    bench.wait(lambda: all(expected[one] <= reader.topics() for one, reader in readers.items()))
    bench.wait_quiet(readers["#"])
    wrong = [
        f"{filter_} {'misses' if expected[filter_] - reader.topics() else 'also gets'} "
        f"{', '.join(sorted(expected[filter_] ^ reader.topics()))}"
        for filter_, reader in readers.items()
        if reader.topics() != expected[filter_]
    ]
    return fail("; ".join(wrong), OTHER) if wrong else ok("+ and # match as MQTT wants it")


_TOPICS = ("a", "a/b", "a/b/c", "end")


def topics(bench: Bench) -> CheckResult:
    reader = bench.peer()
    reader.subscribe("#", qos=0)
    for name in _ODD_TOPICS.values():
        bench.peer().publish(name)  # each with a connection of its own: some brokers end it
    bench.wait(lambda: len(reader.topics()) >= len(_ODD_TOPICS) or reader.closed)
    lacks = [words for words, name in _ODD_TOPICS.items() if name not in reader.topics()]
    if lacks:
        return warn(f"it does not carry those with {', '.join(lacks)}", "give robots names of A-Z, a-z, 0-9, _ and -")
    return ok(f"also those with {', '.join(_ODD_TOPICS)}")


def payloads(bench: Bench) -> CheckResult:
    reader = bench.peer()
    reader.subscribe("#", qos=bench.qos)
    every = bytes(range(256))
    wanted = {
        "empty": b"",
        "bytes": every,
        "picture": secrets.token_bytes(_PICTURE),
        "large": secrets.token_bytes(_LARGE),
    }
    for name, payload in wanted.items():
        bench.peer().publish(name, payload, qos=bench.qos)
    bench.wait(lambda: len(reader.topics()) == len(wanted) or reader.closed, 2 * bench.answer_s)
    came = {one.topic: one.payload for one in reader.received}
    if changed := [name for name, payload in came.items() if payload != wanted.get(name)]:
        return fail(f"it changes them ({', '.join(changed)})", OTHER)
    if lacks := [name for name in ("empty", "bytes") if name not in came]:
        return fail(f"it does not carry {' and '.join(lacks)}", OTHER)
    fix = f"{MOSQUITTO}message_size_limit 0, and no max_packet_size; NATS: max_payload: 8MB"
    if "picture" not in came:
        return warn(f"it does not carry {_PICTURE // 1000} kB", fix)
    if "large" not in came:
        return warn(f"it carries {_PICTURE // 1000} kB and not {_LARGE // 1000} kB", fix)
    return ok(f"unchanged, up to {_LARGE // 1000} kB")


def delay(bench: Bench) -> CheckResult:
    """By Nagle's algorithm a small message waits until the one before it is confirmed by the receiver's kernel."""
    reader, writer = bench.peer(), bench.peer()
    reader.subscribe("#", qos=0)
    apart = []
    for pair in range(_PAIRS):
        reader.acknowledge_late()
        writer.publish("x", b"%d" % (2 * pair))
        bench.wait(lambda: False, _APART_S)
        writer.publish("x", b"%d" % (2 * pair + 1))
        if not bench.wait(lambda: len(reader.received) >= 2 * (pair + 1)):  # noqa: B023
            return fail("they are lost on an idle connection", OTHER)
        apart.append(reader.received[-1].at - reader.received[-2].at)
        bench.wait(lambda: False, 2 * _HELD_S + bench.round_trip_s)
    if median(apart) < _HELD_S + _APART_S:
        return ok("are passed on at once")
    text = (
        f"it holds them back: a message that follows another one comes {1000 * (median(apart) - _APART_S):.0f} ms late"
    )
    return warn(text, f"{MOSQUITTO}set_tcp_nodelay true")


def pings(bench: Bench) -> CheckResult:
    peer = bench.peer()
    peer.subscribe("#", qos=0)
    began = time.monotonic()
    if not peer.ping():
        return fail("it does not answer a ping", "use another broker: robots would connect anew all the time")
    seconds = time.monotonic() - began
    late = max(_late(bench, peer) for _ in range(_PING_TRIES))
    if seconds > _PING_S:
        return fail(f"it takes {seconds:.1f} s for one", "use a broker that is nearer, or less busy")
    if late:
        return warn(f"it answers before it has passed on what came before ({late} of 20 messages)", "")
    return ok(f"after {1000 * seconds:.1f} ms, behind what came before")


def _late(bench: Bench, peer: Peer) -> int:
    """How many of twenty messages come after the answer to a ping that was sent after them."""
    for place in range(20):
        peer.publish("x", b"%d" % place)
    peer.ping()
    bench.wait_quiet(peer)
    return len(peer.received) - peer.pongs[-1]


def overlaps(bench: Bench) -> CheckResult:
    reader, writer = bench.peer(), bench.peer()
    reader.subscribe("a/b", "a/+", "#", qos=bench.qos)
    writer.publish("a/b", qos=bench.qos)
    bench.wait(lambda: reader.received)
    bench.wait_quiet(reader)
    copies = len(reader.received)
    if copies > 1:
        return warn(f"a client with three of them gets {copies} copies of a message", "subscribe to one filter only")
    return ok("one copy of each message")


def as_published(bench: Bench) -> CheckResult:
    found = {}
    for words, protocol, bridge in (("bridge mode of 3.1.1", "3.1.1", True), ("MQTT 5", "5", False)):
        bench.begin(f"as-published-{protocol}")
        try:
            found[words] = _keeps_flags(bench, bench.peer(protocol=protocol, bridge=bridge), modern=protocol == "5")
        except RefusedError:
            continue
    working = [words for words, lacks in found.items() if not lacks]
    if working:
        return ok(
            f"own messages do not come back, and tell whether they were to be retained, with {' and '.join(working)}"
        )
    lacks = "; ".join(f"{words}: {why}" for words, why in found.items()) or "it has neither bridge mode nor MQTT 5"
    return warn(lacks, "a robot works without; mqtt_mirror needs a broker with it, as mosquitto")


def _keeps_flags(bench: Bench, peer: Peer, *, modern: bool) -> str:
    """What it lacks of noLocal and retain-as-published."""
    other, granted = bench.peer(), peer.subscribe("#", qos=bench.qos, options=modern)
    peer.publish("own", qos=bench.qos)
    other.publish("other", b"1", qos=bench.qos, retain=bench.retains)
    bench.wait(lambda: peer.payloads("other"))
    bench.wait_quiet(peer)
    if not granted or not peer.payloads("other"):
        return "nothing comes"
    if peer.payloads("own"):
        return "own messages come back"
    return "" if peer.received[-1].retain or not bench.retains else "the retain flag is lost"
