"""Every address of a broker's name gets its turn, whatever way the one before failed (T12)."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import permutations
from typing import Any

import pytest

from pebble.transports import MqttSettings, QoS, State, Transport, create
from tests.fakes.bad_brokers import BEHAVIOURS, mute, serving
from tests.support import ROOT, Broker

NAME = "fleet.test"
GOOD, BAD, WORSE = "127.0.0.1", "127.0.0.2", "127.0.0.3"
#: Fails without a server: no route, no such address of this machine, no such family.
UNREACHABLE = {"no route": "2001:db8::1", "nobody's": "240.0.0.1", "a network": "0.0.0.0"}
CERTS = ROOT / "tests" / "data" / "tls"
Names = Callable[..., None]


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = Broker(tmp_path_factory.mktemp("broker"))
    yield broker
    broker.stop()


@pytest.fixture(autouse=True)
def _short_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.transports.hosts.CONNECT_TIMEOUT_S", 0.4)
    monkeypatch.setattr("pebble.transports.mqtt.transport._ANSWER_S", 0.8)


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Names:
    """Gives the name these addresses from now on."""
    real = socket.getaddrinfo

    def give(*addresses: str) -> None:
        def resolve(host: Any, *more: Any, **options: Any) -> list[Any]:
            return [info for one in (addresses if host == NAME else [host]) for info in real(one, *more, **options)]

        monkeypatch.setattr(socket, "getaddrinfo", resolve)

    return give


CLIENTS = [(client, protocol) for client in ("ours", "paho") for protocol in ("3.1.1", "5")]


@pytest.fixture(params=CLIENTS, ids="-".join)
def made(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[MqttSettings], Transport]]:
    client, protocol = request.param
    monkeypatch.setenv("PEBBLE_MQTT_CLIENT", client)
    with ExitStack() as closing:

        def make(settings: MqttSettings) -> Transport:
            transport = create("mqtt", "tool", replace(settings, protocol=protocol))
            closing.callback(transport.close)
            return transport

        yield make


def works(transport: Transport) -> bool:
    return transport.publish("addresses/works", b"1", qos=QoS.DELIVERED)


@pytest.mark.parametrize("order", permutations((GOOD, BAD, WORSE)), ids=" ".join)
def test_a_living_address_is_found_among_dead_ones_in_any_order(
    broker: Broker, names: Names, made: Callable[[MqttSettings], Transport], order: tuple[str, ...]
) -> None:
    names(*order)
    with serving(BAD, broker.port, mute), serving(WORSE, broker.port, BEHAVIOURS["closing"]):
        transport = made(MqttSettings(host=NAME, port=broker.port, reconnect_max_s=20)).open(0.01)
    assert transport.state is State.CONNECTED, transport.problem
    assert works(transport)


@pytest.mark.parametrize("as_published", [False, True], ids=["plain", "bridge"])
@pytest.mark.parametrize("failing", [*BEHAVIOURS, *UNREACHABLE])
def test_whatever_way_the_first_one_fails(
    broker: Broker, names: Names, monkeypatch: pytest.MonkeyPatch, failing: str, as_published: bool
) -> None:
    names(UNREACHABLE.get(failing, BAD), GOOD)
    settings = MqttSettings(host=NAME, port=broker.port, as_published=as_published)
    with serving(BAD, broker.port, BEHAVIOURS.get(failing)), create("mqtt", "tool", settings) as transport:
        assert transport.state is State.CONNECTED, transport.problem
        assert transport.as_published is as_published
        assert works(transport)
