"""The backlog is bounded and keeps the newest; a retained message counts as lost until the broker confirms it."""

from __future__ import annotations

from pebble.transports import Message, QoS
from pebble.transports.mqtt.outgoing import BACKLOG_BYTES, BACKLOG_MESSAGES, Backlog, InFlightTable, PendingAck


def drain(backlog: Backlog) -> list[bytes]:
    taken = []
    while backlog:
        taken.append(backlog.take().payload)
    return taken


def test_bytes_are_bounded_but_one_message_may_always_wait() -> None:
    backlog = Backlog()
    assert backlog.put(Message("a", b"1" * BACKLOG_BYTES * 3)) == 0
    assert backlog.put(Message("a", b"2" * (BACKLOG_BYTES - 1))) == 1
    assert backlog.put(Message("a", b"3")) == 0
    assert [payload[:1] for payload in drain(backlog)] == [b"2", b"3"]


def test_a_retained_message_is_replaced_only_by_a_newer_one_of_its_topic() -> None:
    backlog = Backlog()
    backlog.put(Message("state", b"old", retain=True))
    backlog.put(Message("other", b"other", retain=True))
    for _ in range(BACKLOG_MESSAGES * 2):
        backlog.put(Message("a", b"x"))
    assert backlog.put(Message("state", b"new", retain=True)) == 1
    taken = drain(backlog)
    assert taken[0] == b"other"
    assert taken[-1] == b"new"
    assert len(taken) == BACKLOG_MESSAGES + 2


def test_a_delivered_message_makes_what_waits_on_its_topic_stale() -> None:
    backlog = Backlog()
    for message in (Message("a", b"1"), Message("b", b"2"), Message("a", b"3", retain=True)):
        backlog.put(message)
    assert backlog.supersede(Message("a", b"4")) == 1
    assert backlog.supersede(Message("a", b"5", retain=True)) == 1
    assert drain(backlog) == [b"2"]
    assert not backlog


def retained(topic: str, payload: bytes = b"1", qos: QoS = QoS.DELIVERED) -> Message:
    return Message(topic, payload, qos, retain=True)


def send(in_flight: InFlightTable, message: Message, mid: int, now: float = 0.0) -> Message:
    in_flight.accept(message)
    in_flight.sent(message, mid, now)
    return message


def test_an_acknowledgement_proves_the_message_it_names() -> None:
    in_flight = InFlightTable()
    send(in_flight, Message("event", b"", QoS.DELIVERED), 1)
    send(in_flight, retained("a"), 2)
    newer = send(in_flight, retained("a", b"2"), 3)
    assert in_flight.unacked == 3
    assert in_flight.acknowledge(2, 0.0) is not None
    assert in_flight.unconfirmed_retained() == [newer]
    assert in_flight.acknowledge(3, 0.0) is not None
    assert in_flight.unconfirmed_retained() == []
    assert in_flight.acknowledge(3, 0.0) is None
    assert in_flight.unacked == 1


def test_messages_wait_since_the_newest_acknowledgement() -> None:
    in_flight = InFlightTable()
    assert in_flight.waiting_since is None
    send(in_flight, Message("stream", b"", QoS.LATEST), 1, 1.0)
    assert in_flight.waiting_since is None
    for mid, at in ((2, 2.0), (3, 2.1), (4, 2.2)):
        send(in_flight, Message("event", b"", QoS.DELIVERED), mid, at)
    assert in_flight.waiting_since == 2.0
    in_flight.acknowledge(3, 2.5)
    assert in_flight.waiting_since == 2.5, "the other one is lost; nothing stands still"
    in_flight.acknowledge(2, 2.6)
    in_flight.acknowledge(4, 2.7)
    assert in_flight.waiting_since is None
    send(in_flight, Message("event", b"", QoS.DELIVERED), 5, 9.0)
    assert in_flight.waiting_since == 9.0


def test_an_answered_ping_proves_what_was_sent_before_it() -> None:
    in_flight = InFlightTable()
    send(in_flight, retained("before", qos=QoS.LATEST), 1)
    in_flight.ping(0.0, None)
    after = send(in_flight, retained("after", qos=QoS.LATEST), 2)
    in_flight.accept(waiting := retained("waiting", qos=QoS.LATEST))
    in_flight.pong(0.1)
    assert in_flight.unconfirmed_retained() == [after, waiting]
    in_flight.ping(0.2, None)
    in_flight.pong(0.3)
    assert in_flight.unconfirmed_retained() == [waiting]


def test_the_end_ends_every_wait() -> None:
    in_flight, request, ping = InFlightTable(), PendingAck(), PendingAck()
    in_flight.ask(1, request)
    in_flight.ping(0.0, ping)
    assert not request.done
    in_flight.end()
    assert request.done
    assert ping.done


def test_answers_complete_their_request_only() -> None:
    in_flight, first, second, ping = InFlightTable(), PendingAck(), PendingAck(), PendingAck()
    in_flight.ask(1, first)
    in_flight.ask(2, second)
    in_flight.ping(0.0, ping)
    in_flight.answer(2)
    in_flight.answer(7)
    assert not second.done, "not before what came before the answer has been delivered"
    in_flight.complete()
    assert (first.done, second.done, ping.done) == (False, True, False)
    in_flight.pong(1.0)
    in_flight.complete()
    assert ping.done
    in_flight.pong(1.0)  # one more than there were pings


def test_a_topic_counts_as_accepted_once_the_ping_after_its_first_message_is_answered() -> None:
    """Also if others of its messages follow all the time; until then the loss of the connection may be its fault."""
    in_flight = InFlightTable()
    for number in range(4):
        send(in_flight, Message("stream", b""), 0, now := 5.0 + number / 10)
        in_flight.ping(now, None)
    send(in_flight, Message("rare", bytes(9)), 0, 5.4)
    assert in_flight.first_written(5.5) == {"stream": 0, "rare": 9}
    in_flight.pong(5.5)
    send(in_flight, Message("stream", bytes(200)), 0, 5.6)
    send(in_flight, Message("stream", bytes(9000)), 0, 5.7)
    assert in_flight.first_written(5.8)["stream"] == 9000, "the broker may accept no more than it has"
    for _ in range(3):
        in_flight.pong(5.8)
    in_flight.ping(5.8, None)
    in_flight.pong(5.9)
    assert in_flight.first_written(5.9) == {}
