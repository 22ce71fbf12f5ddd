"""The embedded broker serves every client that it accepts."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from pebble.transports import Message, MqttSettings, QoS, Transport, create
from tests.support import AmqttBroker, until

CLIENTS, FILTERS = 40, 30


@pytest.fixture
def amqtt() -> Iterator[AmqttBroker]:
    broker = AmqttBroker()
    yield broker
    broker.stop()


def test_a_client_that_connects_while_others_subscribe_is_received(amqtt: AmqttBroker) -> None:
    settings = MqttSettings(host="127.0.0.1", port=amqtt.port)
    received: set[str] = set()
    enough = threading.Event()
    listener, busy = (create("mqtt", name, settings) for name in ("listener", "busy"))
    clients: list[Transport] = [listener, busy]

    def keep_subscribing() -> None:
        while not enough.is_set():
            for one in [busy.subscribe(f"busy/{number}", lambda _message: None) for number in range(FILTERS)]:
                one.close()

    def note(message: Message) -> None:
        received.add(message.topic)

    thread = threading.Thread(target=keep_subscribing)
    try:
        listener.open()
        busy.open()
        for number in range(FILTERS):  # so that going through all of them takes a while
            listener.subscribe(f"said/{number}/+", note)
            busy.publish(f"said/{number}/before", b"x", qos=QoS.DELIVERED, retain=True)
        thread.start()
        for number in range(CLIENTS):
            clients.append(create("mqtt", f"client-{number}", settings).open())
            clients[-1].publish(f"said/0/{number}", b"x", qos=QoS.DELIVERED)
        missing = {f"said/0/{number}" for number in range(CLIENTS)}
        assert until(lambda: missing <= received, 10.0), missing - received
    finally:
        enough.set()
        thread.join(10)
        for client in clients:
            client.close()
