"""Probes of a broker: the rights of an account, and how messages arrive."""

from __future__ import annotations

import secrets
import time
from statistics import median

from pebble.check_result import CheckResult, failed, ok, skipped, warn
from pebble.extensions.checks.broker import MOSQUITTO, OTHER
from pebble.extensions.checks.broker.peer import BrokerTrial, Peer, Received, RefusedError
from pebble.forwarding.probes import new_probe
from pebble.transports import Message, QoS

_APART_S = 0.005  # between the two messages of a pair
_HELD_S = 0.03  # so much Nagle's algorithm delays a message at least, where the receiver's kernel confirms late
_HELD_ROUND_TRIPS = 0.75  # the same in round trips: a thin link itself needs some of one for the second message
_PAIRS = 5
_PING_TRIES = 3  # an answer that comes too early may by chance come last
_PING_S = 2.0  # after which a robot gives a connection up
_WILL_S = 1.0
REFUSED = 0x80  # the least code of a refusal, in the answers to SUBSCRIBE and of MQTT 5

#: What a name of a robot or of a channel may contain, below a topic of our own.
_ODD_TOPICS = {
    "a blank": "a b",
    "a dot": "a.b",
    "* and >": "*/>",
    "letters beyond ASCII": "ä/機",
    "190 levels": "/".join("l" * 190),
    "900 bytes": 900 * "n",
}


# -- rights


def rights(trial: BrokerTrial) -> CheckResult:
    """Check that the account may publish and read.

    Also notes for the later probes whether the broker supports QoS 1 and retained messages.
    """
    fix = (
        "use a robot's account and its topics: --below pebble/robots/ID; "
        f"or allow these ({MOSQUITTO}an acl_file with topic readwrite {trial.below}/#)"
    )
    reader, writer = trial.peer(), trial.peer()
    granted, began = reader.subscribe("#"), time.monotonic()
    if reader.problem:
        return failed(f"after {trial.base}/# was subscribed to: {reader.problem}", fix)
    if not granted or granted[0] >= REFUSED:
        return failed(f"this account may not subscribe to {trial.base}/#", fix)
    mid = writer.publish("x", qos=1)
    trial.wait(lambda: (mid in writer.acks and reader.received) or writer.closed)
    has_qos_1 = mid in writer.acks and bool(reader.received) and not writer.closed
    if has_qos_1:
        trial.round_trip_s = min(1.0, time.monotonic() - began)  # at most, as later waits last several times as long
    elif why := _why_unread(trial, reader):
        return failed(why, fix)
    trial.qos = int(has_qos_1 and granted == b"\x01")
    retained_message = _retained(trial)
    trial.retains = retained_message is not None
    if retained_message is not None and not retained_message.retain:
        return failed("what it retains comes without the retain flag: a command of yesterday looks new", OTHER)
    lacks = []
    if not trial.qos:
        lacks.append("it has no QoS 1: events and answers may be lost on the way")
    if not trial.retains:
        lacks.append("it retains nothing: who connects later sees no state until it changes")
    if lacks:
        return warn("; ".join(lacks), f"{MOSQUITTO}max_qos 2, retain_available true")
    took = f"a round trip takes {1000 * trial.round_trip_s:.1f} ms"
    return ok(f"this account publishes and reads below {trial.below}/; {took}")


def _why_unread(trial: BrokerTrial, reader: Peer) -> str:
    """Publish once more, with QoS 0; return why even that message is not delivered, or "" if it is."""
    writer = trial.peer()
    writer.publish("x")
    if not trial.wait(lambda: reader.received or writer.closed):
        may = "publish" if _is_forbidden(trial) else "read"
        return f"this account may not {may} {trial.base}/x, and is not told"
    return f"it hangs up on what this account publishes to {trial.base}/x" if writer.closed else ""


def _retained(trial: BrokerTrial) -> Received | None:
    """Publish a message to be retained; return it as a later subscriber gets it, or None if it gets none."""
    writer, late = trial.peer(), trial.peer()
    writer.publish("retained", qos=trial.qos, retain=True)
    writer.ping()  # its answer: the broker has read the message
    late.subscribe("retained", qos=0)
    if not trial.wait(lambda: late.received):
        trial.left.clear()  # this broker retains nothing, so there is nothing to remove
        return None
    return late.received[0]


def _is_forbidden(trial: BrokerTrial) -> bool | None:
    """True if the broker says that it refuses a message; None if it cannot say so, as only MQTT 5 can."""
    try:
        writer = trial.peer(protocol="5")
    except RefusedError:
        return None
    mid = writer.publish("x", qos=1)
    if not trial.wait(lambda: mid in writer.acks or writer.closed) or writer.closed:
        return None
    return writer.acks[mid] >= REFUSED


def refusals(trial: BrokerTrial) -> CheckResult:
    """Check that the broker tells a client which subscriptions it refuses.

    Subscribes to a topic that no access rule mentions, which a broker with rules must refuse.
    """
    trial.base = f"{secrets.token_hex(8)}/doctor/one"
    reader, writer = trial.peer(), trial.peer()
    granted = reader.subscribe("#", qos=0)
    if granted and granted[0] >= REFUSED:
        return ok("it tells which it refuses")
    if not granted:
        return warn("it does not answer one that is not allowed, or hangs up")
    writer.publish("x")
    if trial.wait(lambda: reader.received, 1.0):
        return skipped("this account is refused none")
    is_forbidden = _is_forbidden(trial)  # None: not known
    if is_forbidden is False:  # the broker has accepted a message there
        return warn("it grants them, and then delivers nothing")
    return skipped("it grants them, and nothing comes: this account may not publish there, or may not read")


# -- messages


def topics(trial: BrokerTrial) -> CheckResult:
    """Check that the broker carries topics of unusual characters or length."""
    reader = trial.peer()
    reader.subscribe("#", qos=0)
    for name in _ODD_TOPICS.values():
        trial.peer().publish(name)  # each with a connection of its own: some brokers end it
    trial.wait(lambda: len(reader.topics()) >= len(_ODD_TOPICS) or reader.closed)
    lacks = [words for words, name in _ODD_TOPICS.items() if name not in reader.topics()]
    if lacks:
        return warn(f"it does not carry those with {', '.join(lacks)}", "give robots names of A-Z, a-z, 0-9, _ and -")
    return ok(f"also those with {', '.join(_ODD_TOPICS)}")


def delay(trial: BrokerTrial) -> CheckResult:
    reader, writer = trial.peer(), trial.peer()
    reader.subscribe("#", qos=0)
    return held_back(trial, reader, writer, "x")


def held_back(trial: BrokerTrial, reader: Peer, writer: Peer, topic: str) -> CheckResult:
    """Check whether Nagle's algorithm delays a message until the receiver has acknowledged the previous one."""
    round_trips_s, gaps_s = [], []
    for _ in range(_PAIRS):
        pair = _pair(trial, reader, writer, topic)
        if pair is None:
            return failed("they are lost on an idle connection", OTHER)
        round_trip_s, gap_s = pair
        round_trips_s.append(round_trip_s)
        gaps_s.append(gap_s)
    late_s = median(gaps_s)
    if late_s < max(_HELD_S, _HELD_ROUND_TRIPS * min(round_trips_s)):
        return ok("are passed on at once")
    trial.late = True
    text = f"it holds them back: a message that follows another one comes {1000 * late_s:.0f} ms late"
    return warn(text, f"{MOSQUITTO}set_tcp_nodelay true")


def _pair(trial: BrokerTrial, reader: Peer, writer: Peer, topic: str) -> tuple[float, float] | None:
    """Return a message's round trip, and how much longer the next message takes; None if either is lost.

    The next one takes longer if the broker holds it back until the first one is acknowledged.
    """
    reader.acknowledge_late()  # after a quick acknowledgement nothing would be held back
    sent, probes = list[float](), [new_probe(number) for number in range(2)]
    for probe in probes:
        sent.append(time.monotonic())
        writer.publish(topic, probe)
        trial.wait(lambda: False, _APART_S)  # serves the peers meanwhile
    if not trial.wait(lambda: set(probes) <= set(reader.payloads())):
        return None
    trial.wait(lambda: False, 2 * _HELD_S + trial.round_trip_s)  # then both are acknowledged: the next pair starts anew
    first, second = (message.at for message in reader.received if message.payload in probes)
    return first - sent[0], (second - sent[1]) - (first - sent[0])


def pings(trial: BrokerTrial) -> CheckResult:
    """Check that a ping is answered soon, and behind the messages that were sent before it."""
    peer = trial.peer()
    peer.subscribe("#", qos=0)
    began = time.monotonic()
    if not peer.ping():
        return failed("it does not answer a ping", "use another broker: robots would connect anew all the time")
    seconds = time.monotonic() - began
    overtaken = max(_overtaken(trial, peer) for _ in range(_PING_TRIES))  # of 20 messages in each try
    if seconds > _PING_S:
        trial.late = True
        return failed(f"it takes {seconds:.1f} s for one", "use a broker that is nearer, or less busy")
    if overtaken:
        return warn(f"it answers before it has passed on what came before ({overtaken} of 20 messages)")
    return ok(f"after {1000 * seconds:.1f} ms, behind what came before")


def _overtaken(trial: BrokerTrial, peer: Peer) -> int:
    """Send twenty messages and then a ping; return how many of the messages arrive after the ping's answer."""
    for place in range(20):
        peer.publish("x", b"%d" % place)
    peer.ping()
    trial.wait_quiet(peer)
    return len(peer.received) - peer.pongs[-1]


def overlaps(trial: BrokerTrial) -> CheckResult:
    reader, writer = trial.peer(), trial.peer()
    reader.subscribe("a/b", "a/+", "#", qos=trial.qos)
    writer.publish("a/b", qos=trial.qos)
    trial.wait(lambda: reader.received)
    trial.wait_quiet(reader)
    copies = len(reader.received)
    if copies > 1:
        return warn(f"a client with three of them gets {copies} copies of a message", "subscribe to one filter only")
    return ok("one copy of each message")


def as_published(trial: BrokerTrial) -> CheckResult:
    """Check that a client can get messages as a bridge needs them: not its own ones, and with the retain flag."""
    lacks = {}
    for mode, protocol, bridge in (("bridge mode of 3.1.1", "3.1.1", True), ("MQTT 5", "5", False)):
        trial.begin()
        try:
            peer = trial.peer(protocol=protocol, bridge=bridge)
            lacks[mode] = _lacks_of_flags(trial, peer, modern=protocol == "5")
        except RefusedError:
            continue
    working = [mode for mode, lack in lacks.items() if not lack]
    if working:
        what_works = "own messages do not come back, and tell whether they were to be retained"
        return ok(f"{what_works}, with {' and '.join(working)}")
    text = "; ".join(f"{mode}: {lack}" for mode, lack in lacks.items()) or "it has neither bridge mode nor MQTT 5"
    return warn(text, "a robot works without; mqtt_mirror needs a broker with it, as mosquitto")


def _lacks_of_flags(trial: BrokerTrial, peer: Peer, *, modern: bool) -> str:
    """Return which of noLocal and retain-as-published does not work; "" if both do."""
    other, granted = trial.peer(), peer.subscribe("#", qos=trial.qos, options=modern)
    peer.publish("own", qos=trial.qos)
    other.publish("other", b"1", qos=trial.qos, retain=trial.retains)
    trial.wait(lambda: peer.payloads("other"))
    trial.wait_quiet(peer)
    if not granted or not peer.payloads("other"):
        return "nothing comes"
    if peer.payloads("own"):
        return "own messages come back"
    return "the retain flag is lost" if trial.retains and not peer.received[-1].retain else ""


# -- the end of a connection


def last_will(trial: BrokerTrial) -> CheckResult:
    """Check that the will of a client whose connection is reset is published soon, and retained."""
    reader, retain = trial.peer(), trial.retains
    reader.subscribe("#", qos=trial.qos)
    try:
        robot = trial.peer(will=Message("online", b"gone", QoS(trial.qos), retain=retain))
    except RefusedError as error:
        return warn(f"it refuses a client with a will: {error}", "allow wills, also retained ones of QoS 1")
    robot.publish("online", b"here", qos=trial.qos, retain=retain)
    trial.wait(lambda: reader.received)
    began = time.monotonic()
    robot.cut()
    if not trial.wait(lambda: b"gone" in reader.payloads(), 3 * trial.answer_s):
        trial.late = True  # so that `judge` tests a second time
        return warn("none is published when a connection is reset", "allow wills (an access list may forbid them)")
    seconds = time.monotonic() - began
    if seconds > _WILL_S + trial.round_trip_s:
        trial.late = True  # as above
        return warn(f"one is published {seconds:.1f} s after the connection is reset")
    latecomer = trial.peer()
    latecomer.subscribe("online", qos=trial.qos)
    trial.wait(lambda: not retain or latecomer.received)
    if retain and latecomer.payloads()[-1:] != [b"gone"]:
        return warn("one is published, and not retained", "allow retained wills")
    return ok(f"once, {seconds:.2f} s after a reset{', and retained' if retain else ''}")
