"""What a broker still owes: kept messages count as lost until it is proven that they are not."""

from __future__ import annotations

from pebble.transports import Message, QoS
from pebble.transports.mqtt_ledger import Ledger, Ticket


def kept(topic: str, payload: bytes = b"1", qos: QoS = QoS.DELIVERED) -> Message:
    return Message(topic, payload, qos, retain=True)


def send(ledger: Ledger, message: Message, mid: int) -> Message:
    ledger.accept(message)
    ledger.sent(message, mid)
    return message


def test_an_acknowledgement_proves_the_message_it_names() -> None:
    ledger = Ledger()
    send(ledger, Message("event", b"", QoS.DELIVERED), 1)
    send(ledger, kept("a"), 2)
    newer = send(ledger, kept("a", b"2"), 3)
    assert ledger.unacked == 3
    assert ledger.acknowledge(2)
    assert ledger.unproven() == [newer]
    assert ledger.acknowledge(3)
    assert ledger.unproven() == []
    assert not ledger.acknowledge(3)
    assert ledger.unacked == 1


def test_an_answered_ping_proves_what_was_sent_before_it() -> None:
    ledger = Ledger()
    send(ledger, kept("before", qos=QoS.LATEST), 1)
    ledger.ping(0.0, None)
    after = send(ledger, kept("after", qos=QoS.LATEST), 2)
    ledger.accept(waiting := kept("waiting", qos=QoS.LATEST))
    ledger.pong(0.1)
    assert ledger.unproven() == [after, waiting]
    ledger.ping(0.2, None)
    ledger.pong(0.3)
    assert ledger.unproven() == [waiting]


def test_unproven_messages_come_oldest_first() -> None:
    ledger = Ledger()
    for number, topic in enumerate(["a", "b", "a"]):
        send(ledger, kept(topic), number)
    assert [message.topic for message in ledger.unproven()] == ["b", "a"]


def test_the_shortest_round_trip_of_late_counts() -> None:
    ledger = Ledger()
    assert ledger.round_trip_s == 0.0
    for round_trip in (0.5, 2.0, 0.5):
        ledger.ping(10.0, None)
        ledger.pong(10.0 + round_trip)
    assert ledger.round_trip_s == 0.5
    for _ in range(8):
        ledger.measured(1.0)
    assert ledger.round_trip_s == 1.0


def test_the_end_ends_every_wait() -> None:
    ledger, request, ping = Ledger(), Ticket(), Ticket()
    ledger.ask(1, request)
    ledger.ping(0.0, ping)
    assert not request.done
    ledger.end()
    assert request.done
    assert ping.done


def test_answers_settle_their_request_only() -> None:
    ledger, first, second, ping = Ledger(), Ticket(), Ticket(), Ticket()
    ledger.ask(1, first)
    ledger.ask(2, second)
    ledger.ping(0.0, ping)
    ledger.answer(2)
    ledger.answer(7)
    assert not second.done, "not before what came before the answer has been delivered"
    ledger.settle()
    assert (first.done, second.done, ping.done) == (False, True, False)
    ledger.pong(1.0)
    ledger.settle()
    assert ping.done
    ledger.pong(1.0)  # one too many: nobody asked
