"""What every transport promises (docs/transports.md, T1 to T21), on every transport."""

# ruff: noqa: N802  (a test is named after its promise)

from __future__ import annotations

import base64
import os
import pickle
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from paho.mqtt.client import topic_matches_sub

from pebble.errors import TransportError
from pebble.transports import Message, QoS, State, Transport, clock
from tests.support import ROOT, THOROUGH, WAIT_S, beside, quickly, until
from tests.transports.net import Net, Received

LATEST, DELIVERED = QoS.LATEST, QoS.DELIVERED


def drained(sender: Transport, receiver: Transport, base: str) -> None:
    """Wait until all that ``sender`` published before has reached ``receiver``: a last message on another topic has."""
    last = Received()
    subscription = receiver.subscribe(f"{base}/last-word", last)
    assert sender.publish(f"{base}/last-word", b"", qos=DELIVERED)
    assert until(lambda: last.messages)
    subscription.close()


@contextmanager
def reconnecting(*clients: Transport) -> Iterator[None]:
    """What happens inside costs ``clients`` their connection; go on when each has a new one."""
    before = {client: client.counters["connected"] for client in clients}
    yield
    for client in clients:
        assert until(lambda: client.counters["connected"] > before[client]), client.problem  # noqa: B023
        assert until(lambda: client.state is State.CONNECTED), client.problem  # noqa: B023


LEVELS = ["a", "b", "", "+", "#", "$x", "*", "a b", "ü", "@", "?", "a.b"]


def sample_pairs(count: int, seed: int) -> list[tuple[str, str]]:
    """Valid (filter, topic) pairs, about half of which match."""
    chosen = random.Random(seed)
    pairs = []
    while len(pairs) < count:
        topic = [chosen.choice([level for level in LEVELS if level not in "+#"]) for _ in range(chosen.randint(1, 4))]
        filter_ = [chosen.choice([level, level, "+", chosen.choice(LEVELS)]) for level in topic]
        cut = chosen.randint(0, len(filter_))
        filter_ = chosen.choice([filter_, [*filter_[:cut], "#"], [*filter_, "#"]])
        if "#" not in filter_[:-1] and any(topic) and any(filter_) and not topic[0].startswith("$"):
            pairs.append(("/".join(filter_), "/".join(topic)))
    return pairs


def test_T01_filters_match_as_in_paho(net: Net, base: str) -> None:
    client = net.client("matcher")
    pairs = sample_pairs(60, seed=7)
    handlers = {filter_: Received() for filter_, _ in pairs}
    for filter_, received in handlers.items():
        client.subscribe(f"{base}/{filter_}", received, limit=10_000)
    topics = sorted({topic for _, topic in pairs})
    for topic in topics:
        assert client.publish(f"{base}/{topic}", topic.encode(), qos=DELIVERED)
    for filter_, received in handlers.items():
        wanted = [t.encode() for t in topics if topic_matches_sub(f"{base}/{filter_}", f"{base}/{t}")]
        assert received.until(*wanted), (filter_, received.payloads, wanted)
    assert sum(len(received.payloads) for received in handlers.values()) > 60


def test_T02_every_allowed_topic_works(net: Net, base: str) -> None:
    client, received, rooted = net.client("odd-topics"), Received(), Received()
    client.subscribe(f"{base}/#", received)
    client.subscribe(f"/{base}", rooted)
    odd = ("", "/", "//x", "*", "a?b", "@x", "%2F", "%", "a b", "ü/語/🤖", "$x", "~", "a/$/b", "**", "{}", "&;'\"\\")
    topics = [f"{base}/{rest}" for rest in odd]
    topics += [f"{base}/" + "x" * (1024 - len(base) - 1), base + "/l" * (199 - base.count("/"))]
    for topic in topics:
        assert client.publish(topic, topic.encode(), qos=DELIVERED, retain=topic.endswith("*"))
    assert until(lambda: len(received.messages) == len(topics))
    assert [message.topic for message in received.messages] == topics
    assert all(message.topic.encode() == message.payload for message in received.messages)
    assert client.publish(f"/{base}", b"root", qos=DELIVERED)
    assert rooted.until(b"root")


BAD_TOPICS = [
    *("", "a/+", "a+b", "a/#", "a\x00b", "a\x1fb", "a\x7fb", "a\x85b"),
    *("a\ufffeb", "a\U0010ffff", "a\ud800b"),  # no characters, and half a one
    *("x" * 1025, "ü" * 513, "/" * 200, "$SYS/x", None),
]
BAD_FILTERS = [
    *("", "a+/b", "a#", "a/#/b", "a\x00b", "a\nb", "\ufdd0", "\udfff", "x" * 1025, "+/" * 200, "$share/group/a")
]


def test_T02_what_no_transport_may_carry_is_refused_before_anything_is_sent(net: Net, base: str) -> None:
    client = net.client("bad-topics")
    before = client.counters["sent"]
    for topic in BAD_TOPICS:
        with pytest.raises(TransportError):
            client.publish(topic, b"x", qos=DELIVERED)  # type: ignore[arg-type]
    for filter_ in BAD_FILTERS:
        with pytest.raises(TransportError):
            client.subscribe(filter_, Received())
    with pytest.raises(TransportError):
        client.publish(base, "text", qos=DELIVERED)  # type: ignore[arg-type]
    assert client.counters["sent"] == before
    drained(client, client, base)


def test_T02_a_will_on_a_bad_topic_is_refused(net: Net) -> None:
    with pytest.raises(TransportError):
        net.client("bad-will", will=Message("a/#", b"x"), opened=False)


def test_T03_a_message_put_right_after_open_and_subscribe_arrives(net: Net, base: str) -> None:
    for turn in range(10):
        received = Received()
        receiver = net.client(f"receiver{turn}")
        receiver.subscribe(f"{base}/{turn}/#", received)
        sender = net.client(f"sender{turn}")
        assert sender.publish(f"{base}/{turn}/x", b"now", qos=DELIVERED)
        assert received.until(b"now")
        sender.close()
        receiver.close()


def test_T03_several_subscriptions_that_are_made_together_are_as_good_as_each(net: Net, base: str) -> None:
    publisher, client = net.client("publisher"), net.client("together")
    topics = [f"{base}/{name}/topic" for name in ("a", "b", "c")]
    for topic in topics:
        assert publisher.publish(topic, b"retained", qos=DELIVERED, retain=True)
    drained(publisher, client, base)
    handlers = {f"{base}/{name}/#": Received() for name in ("a", "b", "c")}
    first, *others = client.subscribe_all(handlers)
    for topic in topics:
        assert publisher.publish(topic, b"live", qos=DELIVERED)
    assert all(received.until(b"retained", b"live") for received in handlers.values())
    first.close()
    for topic in topics:
        assert publisher.publish(topic, b"again", qos=DELIVERED)
    assert [received.until(b"retained", b"live", b"again") for received in [*handlers.values()][1:]] == [True, True]
    assert [one.filter for one in others] == [*handlers][1:]
    assert handlers[first.filter].payloads == [b"retained", b"live"]
    with pytest.raises(TransportError):
        client.subscribe_all({f"{base}/d": Received(), "d#": Received()})


def test_T03_a_short_lived_publisher_is_received(net: Net, base: str) -> None:
    received = Received()
    net.client("receiver").subscribe(f"{base}/#", received)
    for number in range(5):
        sender = net.client(f"short-lived{number}")
        assert sender.publish(f"{base}/x", b"%d" % number, qos=DELIVERED)
        sender.close()
    assert received.until(*(b"%d" % number for number in range(5)))


def test_T03_delivered_messages_arrive_in_order(net: Net, base: str) -> None:
    sender, receiver, received = net.client("sender"), net.client("receiver", **net.patient), Received()
    receiver.subscribe(f"{base}/+", received, limit=5000)
    wanted = []
    for number in range(900):  # mosquitto queues 1000 for a receiver that falls behind
        payload = b"%d" % number
        assert sender.publish(f"{base}/{number % 3}", payload, qos=DELIVERED)
        wanted.append(payload)
    assert until(lambda: len(received.payloads) >= len(wanted))
    for lane in range(3):
        assert [p for p in received.payloads if int(p) % 3 == lane] == wanted[lane::3]


def test_T04_what_was_not_accepted_is_never_delivered(net: Net, base: str) -> None:
    sender, receiver, received = net.client("sender"), net.client("receiver"), Received()
    receiver.subscribe(base, received)
    with reconnecting(sender, receiver):
        net.stop_network()
        assert until(lambda: sender.state is State.CONNECTING)
        accepted, refused_before = [], sender.counters["refused"]
        for number in range(100):
            payload = b"%d" % number
            with quickly():
                if sender.publish(base, payload, qos=QoS(number % 2)):
                    accepted.append(payload)
        assert sender.counters["refused"] - refused_before == 100 - len(accepted)
        net.start_network()
    drained(sender, receiver, base)
    assert received.payloads == accepted


def test_T04_a_transport_that_is_not_open_refuses(net: Net, base: str) -> None:
    client = net.client("never-opened", opened=False)
    assert client.publish(base, b"x", qos=DELIVERED) is False
    client.open(WAIT_S)
    client.close()
    assert client.publish(base, b"x", qos=DELIVERED, retain=True) is False
    with pytest.raises(TransportError):
        client.subscribe(base, Received())


def test_T05_a_retained_message_reaches_late_subscribers(net: Net, base: str) -> None:
    sender = net.client("sender")
    for value in (b"old", b"new"):
        assert sender.publish(f"{base}/state", value, qos=DELIVERED, retain=True)
    drained(sender, sender, base)
    received = Received()
    late = net.client("late")
    late.subscribe(f"{base}/#", received)
    assert received.until(b"new")
    assert received.messages[0].retain
    drained(late, late, base)
    assert [payload for payload in received.payloads if payload] == [b"new"]


def test_T05_a_retained_message_outlives_its_publisher(net: Net, base: str) -> None:
    for how in ("kill", "close"):
        peer = net.peer(f"publisher-{how}")
        assert peer.publish(f"{base}/{how}", b"value", retain=True)
        drained(peer, net.client(f"watcher-{how}"), base)
        getattr(peer, how)()
    received = Received()
    net.client("late").subscribe(f"{base}/+", received)
    assert until(lambda: len(received.messages) == 2)
    assert {(m.topic, m.payload, m.retain) for m in received.messages} == {
        (f"{base}/kill", b"value", True),
        (f"{base}/close", b"value", True),
    }


def test_T05_retained_messages_come_once_per_subscription_and_connection(net: Net, base: str) -> None:
    sender = net.client("sender")
    sender.publish(f"{base}/a", b"A", qos=DELIVERED, retain=True)
    sender.publish(f"{base}/b", b"B", qos=DELIVERED, retain=True)
    drained(sender, sender, base)
    client = net.client("late")
    first, same, wider, narrower = Received(), Received(), Received(), Received()
    client.subscribe(f"{base}/+", first)
    assert until(lambda: sorted(first.payloads) == [b"A", b"B"])
    client.subscribe(f"{base}/+", same)
    assert until(lambda: sorted(same.payloads) == [b"A", b"B"])
    client.subscribe(f"{base}/#", wider)
    assert until(lambda: sorted(wider.payloads) == [b"A", b"B"])
    client.subscribe(f"{base}/a", narrower)
    assert narrower.until(b"A")
    drained(sender, client, f"{base}/deep/er")
    for received in (first, same):
        assert sorted(received.payloads) == [b"A", b"B"]
    with reconnecting(sender, client):
        net.restart_network()
    for received in (first, same):
        assert until(lambda: sorted(received.payloads) == [b"A", b"A", b"B", b"B"]), received.payloads  # noqa: B023
    drained(sender, client, f"{base}/deep/er")
    for received in (first, same):
        assert sorted(received.payloads) == [b"A", b"A", b"B", b"B"]
    assert narrower.payloads == [b"A", b"A"]


def test_T06_an_empty_retained_payload_removes_the_retained_message(net: Net, base: str) -> None:
    client, live = net.client("sender"), Received()
    client.subscribe(f"{base}/state", live)
    client.publish(f"{base}/state", b"value", qos=DELIVERED, retain=True)
    client.publish(f"{base}/state", b"", qos=DELIVERED, retain=True)
    assert live.until(b"value", b"")
    late, received = net.client("late"), Received()
    late.subscribe(f"{base}/state", received)
    drained(client, late, base)
    assert received.messages == []
    with reconnecting(client, late):
        net.restart_network()
    drained(client, late, base)
    assert received.messages == []


def test_T07_live_messages_are_not_marked_as_retained(net: Net, base: str) -> None:
    sender, receiver, received = net.client("sender"), net.client("receiver"), Received()
    receiver.subscribe(base, received)
    sender.publish(base, b"fleeting", qos=DELIVERED, retain=False)
    sender.publish(base, b"to be kept", qos=DELIVERED, retain=True)
    assert received.until(b"fleeting", b"to be kept")
    assert [message.retain for message in received.messages] == [False, False]
    assert received.messages[0].retain_requested in (False, None)
    assert received.messages[1].retain_requested in (True, None)


MANY = 300 if THOROUGH else 100


def test_T08_the_newest_value_is_seen_last(net: Net, base: str) -> None:
    sender = net.client("sender")
    for number in range(MANY):
        assert sender.publish(f"{base}/{number}", b"0", qos=DELIVERED, retain=True)
    drained(sender, sender, f"{base}-x")
    stop = threading.Event()
    rounds = [0]

    def keep_changing() -> None:
        while not stop.is_set():
            rounds[0] += 1
            for number in range(0, MANY, 10):
                sender.publish(f"{base}/{number}", b"%d" % rounds[0], qos=DELIVERED, retain=True)
            stop.wait(0.002)

    with beside(keep_changing, stop):
        for turn in range(3):
            late, received = net.client(f"late{turn}"), Received()
            late.subscribe(f"{base}/+", received, limit=100_000)
            assert until(lambda: len({m.topic for m in received.messages}) == MANY)  # noqa: B023
            late.close()
            newest: dict[str, int] = {}
            for message in received.messages:
                assert newest.get(message.topic, -1) <= int(message.payload), "an older value came after a newer one"
                newest[message.topic] = int(message.payload)


def test_T09_retained_messages_survive_the_network_and_dead_clients(net: Net, base: str) -> None:
    peer = net.peer("gone")
    assert peer.publish(f"{base}/gone", b"still here", retain=True)
    drained(peer, net.client("watcher"), base)
    peer.kill()
    net.restart_network()
    received = Received()
    net.client("late").subscribe(f"{base}/gone", received)
    assert received.until(b"still here")


def test_T09_running_clients_restore_their_retained_state(net: Net, base: str) -> None:
    retainer = net.client("keeper")
    for name, qos in (("a", DELIVERED), ("b", LATEST)):
        assert retainer.publish(f"{base}/{name}", b"value", qos=qos, retain=True)
    drained(retainer, retainer, base)
    with reconnecting(retainer):
        net.restart_network(forget=True)
    received = Received()
    with quickly():
        net.client("late").subscribe(f"{base}/+", received)
        assert until(lambda: len(received.messages) == 2)


def test_T09_what_is_not_to_be_remembered_is_sent_once(net: Net, base: str) -> None:
    setter, received = net.client("setter"), Received()
    assert setter.publish(f"{base}/flag", b"by setter", qos=DELIVERED, retain=True, remember=False)
    assert setter.publish(f"{base}/own", b"kept", qos=DELIVERED, retain=True)
    drained(setter, setter, base)
    net.client("early").subscribe(f"{base}/flag", received)
    assert received.until(b"by setter")
    with reconnecting(setter):
        net.stop_network(forget=True)
        assert until(lambda: setter.state is State.CONNECTING)
        net.start_network()
    later = Received()
    net.client("late").subscribe(f"{base}/+", later)
    assert later.until(b"kept")
    assert {message.topic for message in later.messages} == {f"{base}/own"}


def test_T09_only_what_changed_during_the_outage_is_sent(net: Net, base: str) -> None:
    retainer, received = net.client("keeper"), Received()
    retainer.publish(f"{base}/same", b"1", qos=DELIVERED, retain=True)
    retainer.publish(f"{base}/changed", b"1", qos=DELIVERED, retain=True)
    retainer.publish(f"{base}/removed", b"1", qos=DELIVERED, retain=True)
    retainer.publish(f"{base}/flag", b"by keeper", qos=DELIVERED, retain=True, shared=True)
    drained(retainer, retainer, base)
    other = net.client("other")
    other.publish(f"{base}/flag", b"by other", qos=DELIVERED, retain=True)
    drained(other, other, base)
    with reconnecting(retainer):
        net.stop_network()
        assert until(lambda: retainer.state is State.CONNECTING)
        assert retainer.publish(f"{base}/changed", b"2", qos=DELIVERED, retain=True)
        assert retainer.publish(f"{base}/removed", b"", qos=DELIVERED, retain=True)
        other.close()
        net.start_network()
    wanted = {f"{base}/same": b"1", f"{base}/changed": b"2", f"{base}/flag": b"by other"}
    with quickly():
        net.client("late").subscribe(f"{base}/+", received)
        assert until(lambda: {m.topic: m.payload for m in received.messages} == wanted)


def test_T10_the_will_is_spoken_once_when_a_client_is_killed(net: Net, base: str) -> None:
    received = Received()
    net.client("watcher").subscribe(f"{base}/will", received)
    peer = net.peer("mortal", will=Message(f"{base}/will", b"gone", DELIVERED, True))
    peer.kill()
    with quickly(10.0):
        assert received.until(b"gone")
    late, retained = net.client("late"), Received()
    late.subscribe(f"{base}/will", retained)
    assert retained.until(b"gone")
    drained(late, late, base)
    assert received.payloads == [b"gone"]


def test_T10_the_will_is_spoken_once_on_a_polite_close(net: Net, base: str) -> None:
    watcher, received = net.client("watcher"), Received()
    watcher.subscribe(f"{base}/will", received)
    net.client("polite", will=Message(f"{base}/will", b"bye", DELIVERED)).close()
    with quickly():
        assert received.until(b"bye")
    peer = net.peer("polite-too", will=Message(f"{base}/will", b"bye too", DELIVERED))
    peer.close()
    assert received.until(b"bye", b"bye too")
    drained(watcher, watcher, base)
    assert received.payloads == [b"bye", b"bye too"]


def test_T10_a_client_that_comes_back_replaces_its_retained_will(net: Net, base: str) -> None:
    """The network may have published the will of a client that only lost its connection."""
    client = net.client("alive", will=Message(f"{base}/status", b"offline", DELIVERED, True))
    assert client.publish(f"{base}/status", b"online", qos=DELIVERED, retain=True)
    drained(client, client, base)
    with reconnecting(client):
        net.freeze_network()
        assert until(lambda: client.state is State.CONNECTING)
        net.thaw_network()
    received = Received()
    net.client("late").subscribe(f"{base}/status", received)
    assert until(lambda: received.payloads and received.payloads[-1] == b"online")


def test_T10_a_client_that_is_started_again_at_once_is_believed(net: Net, base: str) -> None:
    """Its former will comes before its new messages, or not at all."""
    will = Message(f"{base}/will", b"gone", DELIVERED, True)
    received, retained = Received(), Received()
    net.client("watcher").subscribe(f"{base}/will", received)
    net.peer("mortal", will=will).kill()
    again = net.client("mortal", will=will)
    again.publish(f"{base}/will", b"back", qos=DELIVERED, retain=True)
    time.sleep(0.5)  # several times as long as a network may wait before it publishes a will
    assert received.payloads[-1] == b"back"
    net.client("late").subscribe(f"{base}/will", retained)
    assert retained.until(b"back")


def test_T11_every_handler_receives_a_message_once(net: Net, base: str) -> None:
    client, sender = net.client("many-filters"), net.client("sender")
    filters = ["a/b", "a/b", "a/+", "a/#", "#", "+/b", "a/b/#", "+/+"]
    handlers = [Received() for _ in filters]
    for filter_, received in zip(filters, handlers, strict=True):
        client.subscribe(f"{base}/{filter_}", received)
    wanted = []
    for number in range(20):
        payload = b"%d" % number
        sender.publish(f"{base}/a/b", payload, qos=QoS.DELIVERED, retain=number % 2 == 1)
        wanted.append(payload)
    for received in handlers:
        assert received.until(*wanted), received.payloads
    drained(sender, client, f"{base}-else/where")
    assert all(received.payloads == wanted for received in handlers)


def test_T11_closing_one_of_two_overlapping_subscriptions_leaves_the_other(net: Net, base: str) -> None:
    client, wide, narrow = net.client("two"), Received(), Received()
    client.subscribe(f"{base}/a/b", narrow)
    subscription = client.subscribe(f"{base}/a/#", wide)
    subscription.close()
    client.publish(f"{base}/a/b", b"x", qos=DELIVERED)
    assert narrow.until(b"x")
    assert wide.payloads == []


def test_T12_reconnects_resubscribes_and_notifies_watchers(net: Net, base: str) -> None:
    client, sender, received, states = net.client("client"), net.client("sender"), Received(), []
    client.on_state(states.append)
    client.subscribe(base, received)
    for turn in range(2):
        with reconnecting(client, sender):
            net.restart_network()
        assert client.was_ended
        assert sender.publish(base, b"%d" % turn, qos=DELIVERED)
        assert until(lambda: len(received.payloads) == turn + 1)  # noqa: B023
    assert states == [State.CONNECTING, State.CONNECTED] * 2
    client.close()
    assert until(lambda: states[-1] is State.CLOSED)


def test_T12_a_client_may_start_before_its_network(net: Net, base: str) -> None:
    net.stop_network()
    early, received = net.client("early", opened=False), Received()
    early.open(0.1)
    assert early.state is State.CONNECTING
    assert until(lambda: early.problem)
    early.subscribe(base, received)
    assert early.publish(f"{base}/kept", b"parked", qos=DELIVERED, retain=True)
    with reconnecting(early):
        net.start_network()
    assert early.problem == ""
    late, retained = net.client("late"), Received()
    late.subscribe(f"{base}/kept", retained)
    assert retained.until(b"parked")
    late.publish(base, b"hello", qos=DELIVERED)
    assert received.until(b"hello")


def test_T19_a_network_that_stopped_answering_is_not_connected(net: Net, base: str) -> None:
    client, states = net.client("client"), []
    client.on_state(states.append)
    with reconnecting(client):
        net.freeze_network()
        assert until(lambda: client.state is State.CONNECTING)
        net.thaw_network()
    drained(client, client, base)


@pytest.mark.parametrize("direct", [False, True], ids=["queued", "direct"])
def test_T19_a_message_knows_how_long_it_has_waited_for_a_process_that_stood_still(
    net: Net, base: str, direct: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped, suspended or stuck: the second message is there while the first one is being handled."""
    client, sender, stopped, go_on = net.client("client"), net.client("sender"), threading.Event(), threading.Event()
    waited: list[float] = []

    def handle(message: Message) -> None:
        waited.append(message.waited_s)
        stopped.set()
        go_on.wait(WAIT_S)

    client.subscribe(base, handle, direct=direct)
    assert sender.publish(base, b"first", qos=DELIVERED)
    assert stopped.wait(WAIT_S)
    assert sender.publish(base, b"second", qos=DELIVERED)
    drained(sender, net.client("bystander"), base)  # by then it is on its way to every subscriber
    now = clock.since_boot
    monkeypatch.setattr(clock, "since_boot", lambda: now() + 0.6)
    go_on.set()
    assert until(lambda: len(waited) == 2)
    assert waited[0] < 0.6 <= waited[1]


def test_T13_one_call_at_a_time_and_never_on_the_publishers_thread(net: Net, base: str) -> None:
    client, busy, overlaps, threads = net.client("client"), threading.Lock(), [], set()

    def handler(_message: Message) -> None:
        overlaps.append(not busy.acquire(blocking=False))
        threads.add(threading.current_thread())
        time.sleep(0.001)
        busy.release()

    client.subscribe(base, handler)
    writers = [
        threading.Thread(target=lambda: [client.publish(base, b"x", qos=DELIVERED) for _ in range(20)])
        for _ in range(4)
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert until(lambda: len(overlaps) == 80)
    assert not any(overlaps)
    assert len(threads) == 1
    assert threading.main_thread() not in threads


@pytest.mark.parametrize("direct", [False, True], ids=["queued", "direct"])
def test_T13_a_handler_that_raises_does_not_end_delivery(
    net: Net, base: str, direct: bool, caplog: pytest.LogCaptureFixture
) -> None:
    client, received = net.client("client"), Received()

    def fragile(message: Message) -> None:
        received(message)
        raise ValueError("a bug in a handler")

    client.subscribe(base, fragile, direct=direct)
    client.publish(base, b"1", qos=DELIVERED)
    client.publish(base, b"2", qos=DELIVERED)
    assert received.until(b"1", b"2")
    assert until(lambda: client.counters["handler_errors"] == 2)
    assert "a bug in a handler" in caplog.text


def test_T13_publish_subscribe_and_close_work_inside_a_handler(net: Net, base: str) -> None:
    client, inner, closed = net.client("client"), Received(), threading.Event()

    def ask(message: Message) -> None:
        client.subscribe(f"{base}/answer", inner)
        client.publish(f"{base}/answer", message.payload, qos=DELIVERED)
        subscription.close()

    def end(_message: Message) -> None:
        client.close()
        closed.set()

    subscription = client.subscribe(f"{base}/ask", ask)
    client.subscribe(f"{base}/end", end)
    client.publish(f"{base}/ask", b"1", qos=DELIVERED)
    assert inner.until(b"1")
    client.publish(f"{base}/ask", b"2", qos=DELIVERED)
    client.publish(f"{base}/end", b"", qos=DELIVERED)
    assert closed.wait(WAIT_S)
    assert client.state is State.CLOSED
    assert inner.payloads == [b"1"]


def test_T13_a_direct_handler_may_publish_and_close_the_transport(net: Net, base: str) -> None:
    client, received = net.client("client"), Received()

    def relay(message: Message) -> None:
        client.publish(f"{base}/out", message.payload, qos=DELIVERED)

    client.subscribe(f"{base}/in", relay, direct=True)
    client.subscribe(f"{base}/out", received)
    client.subscribe(f"{base}/end", lambda _message: client.close(), direct=True)
    client.publish(f"{base}/in", b"1", qos=DELIVERED)
    assert received.until(b"1")
    client.publish(f"{base}/end", b"", qos=DELIVERED)
    assert until(lambda: client.state is State.CLOSED)


@pytest.mark.parametrize("direct", [False, True], ids=["queued", "direct"])
def test_T13_nothing_is_delivered_once_close_returned(net: Net, base: str, direct: bool) -> None:
    client, sender = net.client("client"), net.client("sender")
    stop = threading.Event()

    def steady() -> None:
        while not stop.is_set():
            sender.publish(base, b"x", qos=LATEST)
            stop.wait(0.0005)

    with beside(steady, stop):
        for _ in range(20):
            closed, late, received = threading.Event(), [], Received()

            def handler(message: Message) -> None:
                late.append(closed.is_set())  # noqa: B023
                received(message)  # noqa: B023

            subscription = client.subscribe(base, handler, direct=direct)
            assert until(lambda: received.messages)  # noqa: B023
            subscription.close()
            closed.set()
            assert not any(late)
    assert not any(late)


@pytest.mark.parametrize("direct", [False, True], ids=["queued", "direct"])
def test_T13_close_waits_for_a_quick_handler_that_is_running(net: Net, base: str, direct: bool) -> None:
    client, started, ended = net.client("client"), threading.Event(), threading.Event()

    def handler(_message: Message) -> None:
        started.set()
        time.sleep(0.05)
        ended.set()

    subscription = client.subscribe(base, handler, direct=direct)
    client.publish(base, b"x", qos=DELIVERED)
    assert started.wait(WAIT_S)
    subscription.close()
    assert ended.is_set()


def test_T13_two_transports_that_feed_each_other_do_not_lock_up(net: Net, base: str) -> None:
    left, right, ended = net.client("left"), net.client("right"), Received()

    def bounce(to: Transport, topic: str) -> Callable[[Message], None]:
        def handler(message: Message) -> None:
            if len(message.payload) < 50:
                to.publish(topic, message.payload + b".", qos=DELIVERED)
            else:
                ended(message)

        return handler

    left.subscribe(f"{base}/left", bounce(right, f"{base}/right"), direct=True)
    right.subscribe(f"{base}/right", bounce(left, f"{base}/left"), direct=True)
    for _ in range(10):
        left.publish(f"{base}/right", b"", qos=DELIVERED)
        right.publish(f"{base}/left", b"", qos=DELIVERED)
    assert until(lambda: len(ended.messages) == 20), len(ended.messages)


def test_T14_a_slow_handler_delays_only_itself(net: Net, base: str, caplog: pytest.LogCaptureFixture) -> None:
    client, sender = net.client("client"), net.client("sender")
    release, slow, fast = threading.Event(), Received(), Received()

    def stuck(message: Message) -> None:
        slow(message)
        release.wait(WAIT_S)

    subscription = client.subscribe(base, stuck, limit=10)
    client.subscribe(f"{base}/#", fast)
    assert sender.publish(base, b"0", qos=DELIVERED)
    assert slow.until(b"0")
    wanted = [b"%d" % number for number in range(1, 100)]
    for payload in wanted:
        assert sender.publish(base, payload, qos=DELIVERED)
    assert fast.until(b"0", *wanted)
    assert until(lambda: subscription.dropped == 89)
    assert slow.payloads == [b"0"]
    release.set()
    assert slow.until(b"0", *wanted[-10:])
    assert client.counters["dropped"] == 89
    assert 0 < caplog.text.count("too slow") < 10


@pytest.mark.parametrize("qos", [LATEST, DELIVERED])
def test_T15_payloads_arrive_untouched(net: Net, base: str, qos: QoS) -> None:
    sender, receiver, received = net.client("sender"), net.client("receiver"), Received()
    receiver.subscribe(base, received)
    payloads = [b"", bytes(range(256)), b"\x00", b"\xff\xfe", random.Random(1).randbytes(1_000_000), b"null", b"{}"]
    for payload in payloads:
        assert sender.publish(base, payload, qos=qos)
        assert until(lambda: received.payloads[-1:] == [payload]), len(payload)  # noqa: B023
    assert received.payloads == payloads
    assert all(type(message.payload) is bytes for message in received.messages)


def test_T16_own_publishes_do_not_come_back_where_that_is_promised(net: Net, base: str) -> None:
    bridge, other = net.client("bridge", **net.echoless), net.client("other")
    assert bridge.exact_echo
    received, elsewhere = Received(), Received()
    bridge.publish(f"{base}/kept-before", b"own", qos=DELIVERED, retain=True)
    bridge.subscribe(f"{base}/#", received, echo=False)
    other.subscribe(f"{base}/#", elsewhere)
    for number in range(20):
        bridge.publish(f"{base}/x", b"own", qos=DELIVERED, retain=number % 2 == 1)
        other.publish(f"{base}/y", b"%d" % number, qos=DELIVERED)
    drained(bridge, other, f"{base}/z")
    assert received.until(*(b"%d" % number for number in range(20)))
    assert until(lambda: elsewhere.payloads.count(b"own") >= 20)
    with reconnecting(bridge, other):
        net.restart_network()
    other.publish(f"{base}/y", b"after", qos=DELIVERED)
    assert until(lambda: received.payloads[-1:] == [b"after"])
    assert b"own" not in received.payloads


def test_T17_close_is_idempotent_and_leaves_nothing_behind(net: Net, base: str) -> None:
    def use_and_close() -> None:
        client = net.client("client")
        client.subscribe(base, Received())
        client.publish(base, b"x", qos=DELIVERED)
        client.close()
        client.close()
        assert client.state is State.CLOSED

    def started() -> set[threading.Thread]:  # without the threads of Zenoh's pool, which Python only meets
        return {thread for thread in threading.enumerate() if not isinstance(thread, threading._DummyThread)}

    use_and_close()  # the first use starts what the process keeps
    threads, files = started(), open_files()
    for _ in range(3):
        use_and_close()
    assert until(lambda: started() <= threads), started()
    assert until(lambda: open_files() <= files), (open_files(), files)


def test_T17_a_closed_transport_can_be_opened_again(net: Net, base: str) -> None:
    client, received = net.client("client"), Received()
    client.close()
    client.open(WAIT_S)
    client.subscribe(base, received)
    client.publish(base, b"again", qos=DELIVERED)
    assert received.until(b"again")


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


FORGETFUL = """
import base64, pickle, sys
from pebble.transports import QoS, State, create
kind, settings, base, raises = pickle.loads(base64.b64decode(sys.argv[1]))
client = create(kind, "forgetful", settings).open(10)
assert client.state is State.CONNECTED
client.subscribe(base, lambda message: None)
client.publish(base, b"x", qos=QoS.DELIVERED)
if raises:
    raise SystemExit(3)
"""


@pytest.mark.parametrize("raises", [False, True])
def test_T17_a_process_that_forgets_to_close_still_exits(net: Net, base: str, raises: bool) -> None:
    recipe = base64.b64encode(pickle.dumps((net.kind, net.settings(), base, raises))).decode()
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    ended = subprocess.run([sys.executable, "-c", FORGETFUL, recipe], cwd=ROOT, env=env, timeout=30, check=False)
    assert ended.returncode == (3 if raises else 0)


def test_T18_everything_is_counted(net: Net, base: str) -> None:
    client, received = net.client("client"), Received()
    assert client.publish(f"{base}/elsewhere", b"early", qos=DELIVERED)
    client.subscribe(base, received)
    for _ in range(5):
        client.publish(base, b"x", qos=DELIVERED)
    assert until(lambda: len(received.messages) == 5)
    counts = client.counters.snapshot()
    assert counts["sent"] == 6
    assert counts["received"] >= 5
    assert counts["delivered"] == 5
    assert counts["connected"] == 1
    with reconnecting(client):
        net.restart_network()
    assert client.counters["connected"] == 2
    client.close()
    client.publish(base, b"x")
    assert client.counters["refused"] >= 1


def test_T20_nothing_is_on_its_way_once_everything_has_arrived(net: Net, base: str) -> None:
    client, received = net.client("client"), Received()
    client.subscribe(base, received)
    for _ in range(50):
        client.publish(base, bytes(10_000), qos=DELIVERED)
        assert client.outgoing.waiting >= 0
    assert until(lambda: len(received.messages) == 50)
    assert until(lambda: client.outgoing.waiting == 0)
    assert until(lambda: client.outgoing.stalled_s == 0)
    assert 0 <= client.outgoing.round_trip_s < 5
    client.close()
    assert client.outgoing.waiting == 0


def test_T21_a_granted_subscription_is_not_refused_on_any_connection(net: Net, base: str) -> None:
    client, received = net.client("client"), Received()
    seen: list[bool] = []
    subscription = client.subscribe(base, received)
    assert not subscription.refused
    client.on_state(lambda _state: seen.append(subscription.refused))
    with reconnecting(client):
        net.restart_network()
    assert seen
    assert not any(seen)
