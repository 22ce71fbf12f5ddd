"""The parts of the server together, without a broker."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from pebble.client.page_settings import WebSettings
from pebble.fleet.audit import Audit
from pebble.fleet.people import People
from pebble.transports import Message, MqttSettings
from pebble.web.server import Server

GOOB, TOWER = "pebble/robots/goob", "pebble/robots/tower"


@pytest.fixture
def server() -> Iterator[Server]:
    people, audit = People(None), Audit(None)
    yield Server(WebSettings(broker=MqttSettings(host="127.0.0.1", port=1)), people, audit)
    people.close()
    audit.close()


def test_what_is_drawn_over_a_picture_of_another_component_follows_its_capabilities(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    updated: list[str] = []
    monkeypatch.setattr(server.open_components, "update", updated.append)
    server.robots.sources[GOOB] = TOWER
    payload = json.dumps({"schema": "pebble-capabilities/v1", "t": 1, "value": {}}).encode()
    server.receive(Message(f"{TOWER}/outgoing/capabilities", payload), 1.0)
    assert updated == [TOWER, GOOB]


@pytest.mark.parametrize("topic", ["pebble/robots/goob/incoming/\x01", "x" * 1100, "a" + "/b" * 250, "#", ""])
def test_what_no_topic_may_be_called_is_refused_and_nothing_else(server: Server, topic: str) -> None:
    assert server.broker.publish(topic, b"{}") is False
