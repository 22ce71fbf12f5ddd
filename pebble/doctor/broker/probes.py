"""What a robot needs of a broker, as a table: each probe, the promises of docs/transports.md that it tries, their cost."""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, pairwise
from statistics import median

from pebble.doctor import Finding, Level
from pebble.doctor.broker.peer import ANSWER_S, NAME, Bench, Peer, Received, RefusedError, will
from pebble.transports.mqtt import client_ids

_BURST = 1000  # messages of QoS 1
_BEHIND = 500  # messages for a receiver that acknowledges none of them
_STATES = 200  # retained ones; a robot has some twenty
_BY_NAME = 8  # filters in one SUBSCRIBE: AWS IoT closes the connection for more
_KEEPALIVE_S = 2
_KEEPALIVE_LATE_S = 12.0  # mosquitto looks every few seconds
_WILL_S = 1.0
_APART_S = 0.005
_HELD_S = 0.03  # by which Nagle's algorithm delays where the receiver's kernel confirms late
_PAIRS = 5
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
ok, warn, fail, skip = (partial(Finding, level, "") for level in Level)  # the probe's name comes later
_MOSQUITTO = "in mosquitto.conf: "
_PERSISTENT = f"{_MOSQUITTO}persistence true, persistence_location /var/lib/mosquitto/, autosave_on_changes true"


@dataclass(frozen=True)
class Probe:
    """``costs``: what it means for a robot and its operators where a broker lacks it."""

    name: str
    promises: tuple[str, ...]
    costs: str
    run: Callable[[Bench], Finding]

    def finding(self, bench: Bench) -> Finding:
        bench.begin(re.sub(r"\W+", "-", self.name).strip("-"))
        try:
            found = self.run(bench)
        except RefusedError as error:
            found = fail(f"a connection was refused: {error}", "let an account have ten connections at once")
        return replace(found, what=self.name)


# -- what every other probe needs


def rights(bench: Bench) -> Finding:
    allow = f"topic readwrite {bench.root.rpartition('/')[0]}/#"
    reader, writer = bench.peer(), bench.peer()
    granted = reader.subscribe("#", qos=0)
    writer.publish("x")
    fix = f"allow it ({_MOSQUITTO.strip()} an acl_file with {allow}), or name topics that it may use: --below TOPIC"
    if not granted or granted[0] >= _REFUSED:
        return fail(f"this account may not subscribe to {bench.base}/#", fix)
    if bench.wait(lambda: reader.received or writer.closed) and not writer.closed:
        return ok(f"this account publishes and reads below {bench.root.rpartition('/')[0]}/")
    if writer.closed:
        return fail(f"it hangs up on what this account publishes to {bench.base}/x", fix)
    may = "publish" if _is_forbidden(bench) else "read"
    return fail(f"this account may not {may} {bench.base}/x, and is not told", fix)


def _is_forbidden(bench: Bench) -> bool:
    """MQTT 5 tells why a message is not taken."""
    try:
        writer = bench.peer(protocol="5")
    except RefusedError:
        return False
    mid = writer.publish("x", qos=1)
    return bench.wait(lambda: mid in writer.acks or writer.closed) and writer.acks.get(mid, 0) >= _REFUSED


def acknowledged(bench: Bench) -> Finding:
    fix = f"{_MOSQUITTO}max_qos 2"
    reader, writer = bench.peer(), bench.peer()
    granted, began = reader.subscribe("#"), time.monotonic()
    mid = writer.publish("x", qos=1)
    bench.wait(lambda: (mid in writer.acks and reader.received) or writer.closed)
    bench.qos = 0
    if writer.closed:
        return warn(f"it hangs up on messages of QoS 1{_because(writer)}", fix)
    if not granted or granted[0] != 1:
        return warn("it grants a subscription QoS 0 only", fix)
    if mid not in writer.acks:
        return fail("it does not acknowledge a message of QoS 1", fix)
    if not reader.received:
        return fail("it acknowledges a message and does not deliver it", "use another broker")
    bench.qos, bench.round_trip_s = 1, min(1.0, reader.received[0].at - began)
    return ok(f"delivered in {1000 * bench.round_trip_s:.1f} ms, and acknowledged")


def _because(peer: Peer) -> str:
    return f" ({peer.problem})" if peer.problem else ""


# -- messages


def burst(bench: Bench) -> Finding:
    if not bench.qos:
        return skip("it has no QoS 1")
    reader, writer = bench.peer(), bench.peer()
    reader.subscribe("#")
    began = time.monotonic()
    confirmed = writer.publish_all((("x", b"%d" % number) for number in range(_BURST)), qos=1)
    bench.wait(lambda: len(reader.received) >= _BURST or reader.closed, ANSWER_S)
    seconds = time.monotonic() - began
    bench.settle(reader)
    found = [int(one) for one in reader.payloads()]
    first, lost = list(dict.fromkeys(found)), _BURST - len(set(found))
    if not confirmed:
        return fail(f"only {len(writer.acks)} of them were acknowledged{_because(writer)}", "use another broker")
    if lost:
        return fail(f"{lost} of them were acknowledged and lost", f"{_MOSQUITTO}max_queued_messages 1000")
    if first != sorted(first):
        return fail("they came out of order", f"{_MOSQUITTO}max_inflight_messages 1, or use another broker")
    if len(found) > _BURST:
        return warn(f"{len(found) - _BURST} of them came twice", "use another broker")
    return ok(f"complete and in order, in {seconds:.2f} s")


def queue(bench: Bench) -> Finding:
    if not bench.qos:
        return skip("it has no QoS 1")
    reader, writer = bench.peer(), bench.peer()
    reader.subscribe("#")
    reader.holds = True
    writer.publish_all((("x", b"%d" % number) for number in range(_BEHIND)), qos=1)
    reader.holds = False
    bench.wait(lambda: len(set(reader.payloads())) >= _BEHIND or reader.closed, ANSWER_S)
    bench.settle(reader)
    came = len(set(reader.payloads()))
    if came < _BEHIND:
        fix = f"{_MOSQUITTO}max_queued_messages 1000"
        return warn(f"it keeps {came} of {_BEHIND} messages for it, and drops the others", fix)
    return ok(f"it keeps {_BEHIND} messages for it")


def filters(bench: Bench) -> Finding:
    writer = bench.peer()
    expected = {"a/+": {"a/b"}, "a/#": {"a", "a/b", "a/b/c"}, "+/b": {"a/b"}, "+": {"a", "end"}, "#": set(_TOPICS)}
    readers = {filter_: bench.peer() for filter_ in expected}
    for filter_, reader in readers.items():
        reader.subscribe(filter_, qos=0)
    for topic in _TOPICS:
        writer.publish(topic)
    bench.wait(lambda: all(expected[one] <= reader.topics() for one, reader in readers.items()))
    bench.settle(readers["#"])
    wrong = [
        f"{filter_} {'misses' if expected[filter_] - reader.topics() else 'also gets'} "
        f"{', '.join(sorted(expected[filter_] ^ reader.topics()))}"
        for filter_, reader in readers.items()
        if reader.topics() != expected[filter_]
    ]
    return fail("; ".join(wrong), "use another broker") if wrong else ok("+ and # match as MQTT wants it")


_TOPICS = ("a", "a/b", "a/b/c", "end")


def topics(bench: Bench) -> Finding:
    reader = bench.peer()
    reader.subscribe("#", qos=0)
    for name in _ODD_TOPICS.values():
        bench.peer().publish(name)  # each with a connection of its own: some brokers end it
    bench.wait(lambda: len(reader.topics()) >= len(_ODD_TOPICS) or reader.closed)
    lacks = [words for words, name in _ODD_TOPICS.items() if name not in reader.topics()]
    if lacks:
        return warn(f"it does not carry those with {', '.join(lacks)}", "give robots names of A-Z, a-z, 0-9, _ and -")
    return ok(f"also those with {', '.join(_ODD_TOPICS)}")


def payloads(bench: Bench) -> Finding:
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
    bench.wait(lambda: len(reader.topics()) == len(wanted) or reader.closed, 2 * ANSWER_S)
    came = {one.topic: one.payload for one in reader.received}
    if changed := [name for name, payload in came.items() if payload != wanted.get(name)]:
        return fail(f"it changes them ({', '.join(changed)})", "use another broker")
    if lacks := [name for name in ("empty", "bytes") if name not in came]:
        return fail(f"it does not carry {' and '.join(lacks)}", "use another broker")
    fix = f"{_MOSQUITTO}message_size_limit 0, and no max_packet_size; NATS: max_payload: 8MB"
    if "picture" not in came:
        return warn(f"it does not carry {_PICTURE // 1000} kB", fix)
    if "large" not in came:
        return warn(f"it carries {_PICTURE // 1000} kB and not {_LARGE // 1000} kB", fix)
    return ok(f"unchanged, up to {_LARGE // 1000} kB")


def delay(bench: Bench) -> Finding:
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
            return fail("they are lost on an idle connection", "use another broker")
        apart.append(reader.received[-1].at - reader.received[-2].at)
        bench.wait(lambda: False, 2 * _HELD_S + bench.round_trip_s)
    if median(apart) < _HELD_S + _APART_S:
        return ok("are passed on at once")
    text = (
        f"it holds them back: a message that follows another one comes {1000 * (median(apart) - _APART_S):.0f} ms late"
    )
    return warn(text, f"{_MOSQUITTO}set_tcp_nodelay true")


def pings(bench: Bench) -> Finding:
    peer = bench.peer()
    peer.subscribe("#", qos=0)
    began = time.monotonic()
    if not peer.ping():
        return fail("it does not answer a ping", "use another broker: robots would connect anew all the time")
    seconds = time.monotonic() - began
    for number in range(20):
        peer.publish("x", b"%d" % number)
    peer.ping()
    bench.settle(peer)
    late = len(peer.received) - peer.pongs[-1]
    if seconds > _PING_S:
        return fail(f"it takes {seconds:.1f} s for one", "use a broker that is nearer, or less busy")
    if late:
        return warn(f"it answers before it has passed on what came before ({late} of 20 messages)", "")
    return ok(f"after {1000 * seconds:.1f} ms, behind what came before")


def overlaps(bench: Bench) -> Finding:
    reader, writer = bench.peer(), bench.peer()
    reader.subscribe("a/b", "a/+", "#", qos=bench.qos)
    writer.publish("a/b", qos=bench.qos)
    bench.wait(lambda: reader.received)
    bench.settle(reader)
    copies = len(reader.received)
    if copies > 1:
        return warn(f"a client with three of them gets {copies} copies of a message", "subscribe to one filter only")
    return ok("one copy of each message")


def as_published(bench: Bench) -> Finding:
    found = {}
    for words, protocol, bridge in (("bridge mode of 3.1.1", "3.1.1", True), ("MQTT 5", "5", False)):
        bench.begin(f"as-published-{protocol}")
        try:
            found[words] = _keeps_flags(bench, bench.peer(protocol=protocol, bridge=bridge), modern=protocol == "5")
        except RefusedError:
            continue
    kept = [words for words, lacks in found.items() if not lacks]
    if kept:
        return ok(
            f"own messages do not come back, and tell whether they were to be retained, with {' and '.join(kept)}"
        )
    lacks = "; ".join(f"{words}: {why}" for words, why in found.items()) or "it has neither bridge mode nor MQTT 5"
    return warn(lacks, "a robot works without; mqtt_mirror needs a broker with it, as mosquitto")


def _keeps_flags(bench: Bench, peer: Peer, *, modern: bool) -> str:
    """What it lacks of noLocal and retain-as-published."""
    other, granted = bench.peer(), peer.subscribe("#", qos=bench.qos, options=modern)
    peer.publish("own", qos=bench.qos)
    other.publish("other", b"1", qos=bench.qos, retain=bench.retains)
    bench.wait(lambda: peer.payloads("other"))
    bench.settle(peer)
    if not granted or not peer.payloads("other"):
        return "nothing comes"
    if peer.payloads("own"):
        return "own messages come back"
    return "" if peer.received[-1].retain or not bench.retains else "the retain flag is lost"


# -- what is retained


def by_name(bench: Bench) -> Finding:
    fix = f"{_MOSQUITTO}retain_available true"
    writer, running = bench.peer(), bench.peer()
    running.subscribe("state", qos=bench.qos)
    for payload in (b"old", b"new"):
        mid = writer.publish("state", payload, qos=bench.qos, retain=True)
        bench.wait(lambda: not bench.qos or mid in writer.acks or writer.closed)  # noqa: B023
    writer.ping()
    bench.retains = False
    if writer.closed:
        return warn(f"it hangs up on them{_because(writer)}", fix)
    bench.wait(lambda: b"new" in running.payloads())
    if b"new" not in running.payloads():
        return fail("who is subscribed already does not get them", "use another broker")
    if any(one.retain for one in running.received):
        return fail("live messages come marked as retained: robots refuse such commands", "use another broker")
    writer.leave()
    late = bench.peer()
    late.subscribe("state", qos=bench.qos)
    bench.wait(lambda: late.received)
    bench.settle(late)
    if not late.received:
        return warn("it retains none", fix)
    if not all(one.retain for one in late.received):
        return fail("they come without the retain flag: a command of yesterday looks new", "use another broker")
    if late.payloads()[-1] != b"new":
        return fail("an older value comes instead of the newest", "use another broker")
    bench.retains = True
    if len(late.received) > 1:
        return warn(f"one comes {len(late.received)} times to a subscription", "")
    return ok("the newest of each topic, also when its publisher is gone")


def _states(bench: Bench, value: bytes) -> list[str]:
    names = [f"s/{number}" for number in range(_STATES)]
    bench.peer().publish_all(((name, value) for name in names), qos=bench.qos, retain=True)
    return names


def by_wildcard(bench: Bench) -> Finding:
    if not bench.retains:
        return skip("it retains nothing")
    names = set(_states(bench, b"1"))
    came = []
    for filter_ in ("s/+", "#"):
        reader = bench.peer()
        reader.subscribe(filter_, qos=0)
        bench.wait(lambda: len(reader.topics()) == len(names) or reader.closed)  # noqa: B023
        came.append(len(reader.topics() & names))
    bench.wildcards = min(came) > 0
    if not min(came):
        return warn("nothing comes: only subscriptions of exact names get retained messages", "")
    if min(came) < len(names):
        return fail(f"{min(came)} of {len(names)} come", f"{_MOSQUITTO}max_queued_messages 1000")
    return ok(f"all {len(names)}")


def before_pong(bench: Bench) -> Finding:
    if not bench.retains:
        return skip("it retains nothing")
    names, reader = _states(bench, b"1"), bench.peer()
    reader.subscribe(*(["#"] if bench.wildcards else names[:_BY_NAME]), qos=0)
    reader.ping()
    expected = len(names) if bench.wildcards else _BY_NAME
    bench.wait(lambda: len(reader.received) >= expected)
    late = len(reader.received) - (reader.pongs or [0])[0]
    if late:
        return warn(f"{late} of {expected} come later", "")
    return ok("all of them")


def removal(bench: Bench) -> Finding:
    if not bench.retains:
        return skip("it retains nothing")
    writer, running = bench.peer(), bench.peer()
    running.subscribe("state", qos=bench.qos)
    for payload in (b"1", b""):
        mid = writer.publish("state", payload, qos=bench.qos, retain=True)
        bench.wait(lambda: not bench.qos or mid in writer.acks or writer.closed)  # noqa: B023
    told = bench.wait(lambda: b"" in running.payloads())
    late = bench.peer()
    late.subscribe("state", qos=bench.qos)
    bench.settle(late)
    if late.received:
        return fail("an empty message does not remove what is retained", "use another broker")
    if not told:
        return warn("who is subscribed is not told of it", "use another broker")
    return ok("an empty message removes what is retained")


def order(bench: Bench) -> Finding:
    if not bench.retains:
        return skip("it retains nothing")
    writer, readers, numbers = bench.peer(), [bench.peer() for _ in range(8)], count(1)
    for reader in readers:
        for _ in range(10):
            writer.publish("state", b"%d" % next(numbers), qos=bench.qos, retain=True)
        reader.subscribe("state", qos=bench.qos)
    writer.ping()
    for reader in readers:
        bench.settle(reader)
    found = [one for reader in readers if (one := _older(reader.received))]
    if any(not one.retain for one in found):
        return fail("an older live message comes after a newer one", "use another broker")
    if found:
        return warn("a retained value comes after a newer live one", "")
    return ok("no older value comes after a newer one")


def _older(received: list[Received]) -> Received | None:
    return next((after for before, after in pairwise(received) if int(after.payload) < int(before.payload)), None)


# -- connections that end


def last_wills(bench: Bench) -> Finding:
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
    bench.wait(lambda: b"gone" in reader.payloads(), 2 * ANSWER_S)
    seconds = time.monotonic() - began
    bench.settle(reader)
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
    return ok(f"once, {1000 * seconds:.0f} ms after a reset{', and retained' if retain else ''}")


def goodbye(bench: Bench) -> Finding:
    reader = bench.peer()
    reader.subscribe("#", qos=0)
    try:
        robot = bench.peer(will=will("online", b"gone", qos=0, retain=False))
    except RefusedError:
        return skip("it takes no wills")
    robot.leave()
    bench.settle(reader, 1.0)
    if reader.received:
        return warn("the will of a client that says goodbye is published as well", "use another broker")
    return ok("a client that says goodbye has none")


class Silent:
    """A client that sends no pings from the start of all probes, and whoever waits for its will."""

    def __init__(self, bench: Bench) -> None:
        bench.begin("silent")
        self._reader, self._began, self.refused = bench.peer(lasting=True), time.monotonic(), False
        self._reader.subscribe("#", qos=0)
        try:
            bench.peer(lasting=True, keepalive_s=_KEEPALIVE_S, will=will("online", b"gone", qos=0, retain=False))
        except RefusedError:
            self.refused = True

    def finding(self, bench: Bench) -> Finding:
        if self.refused:
            return skip("it takes no wills")
        left = self._began + _KEEPALIVE_LATE_S - time.monotonic()
        if not bench.wait(lambda: self._reader.received, max(left, 0.0)):
            return warn(f"none within {_KEEPALIVE_LATE_S:.0f} s, with a keep-alive of {_KEEPALIVE_S} s", "")
        seconds = self._reader.received[0].at - self._began
        return ok(f"{seconds:.1f} s after its last word, with a keep-alive of {_KEEPALIVE_S} s")


def takeover(bench: Bench) -> Finding:
    if bench.settings.client_id is not None:
        return skip("the client id is set")
    name, reader = client_ids.unique(NAME), bench.peer()
    reader.subscribe("#", qos=0)
    before = bench.peer(client_id=name)
    try:
        after = bench.peer(client_id=name)
    except RefusedError as error:
        return fail(f"who comes back is refused while the old connection is there: {error}", "use another broker")
    after.publish("x")
    ended = bench.wait(lambda: before.closed)
    if not bench.wait(lambda: reader.received):
        return fail("who comes back cannot publish while the old connection is there", "use another broker")
    if not ended:
        return warn("the old connection of a client that is back stays open", "")
    return ok("the old connection is closed at once")


def outage(bench: Bench) -> Finding:
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
    bench.settle(back)
    if back.received:
        return fail(f"{len(back.received)} commands of meanwhile come to a robot that is back", "use another broker")
    return ok("what was sent meanwhile does not come to a client that is back")


# -- who else


def strangers(bench: Bench) -> Finding:
    """What clients without a name have of what an account publishes."""
    if bench.settings.username is None:
        return skip("this is one: use an account, as in mqtt://ANN@BROKER")
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
    bench.settle(reader)
    can = [*(["read"] if stranger.payloads("own") else []), *(["publish"] if reader.payloads("strange") else [])]
    if can:
        fix = f"{_MOSQUITTO}allow_anonymous false, or no rule for clients without a name in the acl_file"
        return warn(f"are let in, and {' and '.join(can)} the topics of this account", fix)
    return ok("are let in, and neither read nor publish the topics of this account")


PROBES = (
    Probe("rights", (), "nothing else can be tried", rights),
    Probe(
        "QoS 1",
        ("T3", "T20"),
        "events and answers may be lost on the way; stops are repeated by their senders",
        acknowledged,
    ),
    Probe("1,000 messages", ("T3",), "states and answers are lost or out of order under load", burst),
    Probe("a receiver that is behind", ("T3",), "a robot behind a slow link misses flags, requests and answers", queue),
    Probe("filters", ("T1",), "pages and tools miss robots, or see those of others", filters),
    Probe("names of topics", ("T2",), "a robot with such a name is not heard, or loses its connection", topics),
    Probe("payloads", ("T15",), "pictures of that size do not arrive", payloads),
    Probe(
        "small messages", (), "boards and programs that confirm late are driven late; our own confirm at once", delay
    ),
    Probe("answers to pings", ("T19",), "a robot cannot tell how old a command is", pings),
    Probe(
        "overlapping filters",
        ("T11",),
        "a program that does not merge its filters gets commands twice; ours do",
        overlaps,
    ),
    Probe(
        "retained messages",
        ("T5", "T7"),
        "who connects later sees no state until it changes; a flag that is switched while the robot is away is lost",
        by_name,
    ),
    Probe(
        "retained, to + and #",
        ("T5",),
        "programs that do not ask by name do not see a robot at rest; ours ask",
        by_wildcard,
    ),
    Probe(
        "retained, before an answer to a ping",
        ("T5",),
        "a robot that comes back may send states once more; a flag may come twice",
        before_pong,
    ),
    Probe("removal", ("T6",), "what a robot took back, such as a sensor that is gone, is shown for ever", removal),
    Probe("newest last", ("T8",), "other programs show an old value; ours drop it", order),
    Probe(
        "bridge mode", ("T7", "T16"), "own messages come back and are filtered by comparison; no mirror", as_published
    ),
    Probe(
        "wills", ("T10",), "a robot that lost its power is shown as online until its heartbeat is overdue", last_wills
    ),
    Probe("no will after a goodbye", ("T10",), "a robot that ends in order goes offline twice", goodbye),
    Probe("same client again", ("T12",), "a robot that is back waits until its old connection is forgotten", takeover),
    Probe("nothing from an outage", ("T4",), "a robot that is back is moved by commands of long ago", outage),
    Probe("clients without a name", (), "strangers see the robots, or drive them", strangers),
)


def restarted(bench: Bench, restart: Callable[[], bool] | None) -> Finding:
    if not bench.retains:
        return skip("it retains nothing")
    if restart is None:
        return skip("that needs a restart: --restart asks for one")
    writer = bench.peer()
    mid = writer.publish("state", b"1", qos=bench.qos, retain=True)
    bench.wait(lambda: mid in writer.acks or not bench.qos)
    writer.leave()
    if not restart():
        return skip("it was not restarted")
    late = bench.peer()
    late.subscribe("state", qos=bench.qos)
    if bench.wait(lambda: late.received):
        return ok("it is there again")
    return warn("it is gone", _PERSISTENT)


SILENT = "a robot out of radio range is shown as online until its heartbeat is overdue"
RESTART = "running robots send their states again within 2 s; those of robots that are off, and flags, are lost"


def run(bench: Bench, restart: Callable[[], bool] | None = None) -> Iterator[tuple[Probe, Finding]]:
    """Make one probe after the other; without rights none but the first. ``restart`` has the broker restarted."""
    first, *others = PROBES
    found = first.finding(bench)
    yield first, found
    if found.level is Level.FAIL:
        return
    silent = Silent(bench)
    after = [
        Probe("will of a silent client", ("T10",), SILENT, silent.finding),
        Probe("retained, after a restart", ("T9",), RESTART, partial(restarted, restart=restart)),
    ]
    for probe in (*others, *after):
        yield probe, probe.finding(bench)
