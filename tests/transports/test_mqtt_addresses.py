"""Every address of a broker's name gets its turn, whatever way the one before failed (T12)."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest

from pebble.transports import MqttSettings, QoS, State, Transport, create
from pebble.transports.hosts import HANDSHAKE_S, STEADY_S, Address, AddressRound, HostPort
from pebble.transports.mqtt.client import Client
from pebble.transports.mqtt.dialler import Dialler
from pebble.transports.mqtt.ending import Absent, Lost, Silent
from tests.fakes.bad_brokers import BEHAVIOURS, mute, serving
from tests.support import WAIT_S, Broker, free_port, quickly, some

NAME = "fleet.test"
GOOD, BAD, WORSE = "127.0.0.1", "127.0.0.2", "127.0.0.3"
#: Fails without a server: no route, no such address of this machine, no such family.
UNREACHABLE = {"no route": "2001:db8::1", "nobody's": "240.0.0.1", "a network": "0.0.0.0"}
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

    def give(*addresses: str, name: str = NAME) -> None:
        def resolve(host: Any, *more: Any, **options: Any) -> list[Any]:
            return [
                info
                for one in (addresses if os.fsdecode(host) == name else [host])
                for info in real(one, *more, **options)
            ]

        monkeypatch.setattr(socket, "getaddrinfo", resolve)

    return give


def test_close_does_not_wait_for_a_resolver(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, go_on = Event(), Event()

    def hang(*_: Any, **__: Any) -> None:
        asked.set()
        go_on.wait(WAIT_S)
        raise OSError("no answer")

    monkeypatch.setattr(socket, "getaddrinfo", hang)
    transport = create("mqtt", "tool", MqttSettings(host=NAME)).open(0.0)
    assert asked.wait(WAIT_S)
    with quickly():
        transport.close()
    go_on.set()


def works(transport: Transport) -> bool:
    return transport.publish("addresses/works", b"1", qos=QoS.DELIVERED)


#: Each way to fail, for plain connections and those of a bridge in turns; then the other one.
WAYS = [(way, (turn + more) % 2 == 0) for turn, way in enumerate((*BEHAVIOURS, *UNREACHABLE)) for more in (0, 1)]


@pytest.mark.parametrize(("failing", "as_published"), some(WAYS, 2))
def test_whatever_way_the_first_one_fails(
    broker: Broker, names: Names, monkeypatch: pytest.MonkeyPatch, failing: str, as_published: bool
) -> None:
    names(UNREACHABLE.get(failing, BAD), GOOD)
    settings = MqttSettings(host=NAME, port=broker.port, as_published=as_published)
    with serving(BAD, broker.port, BEHAVIOURS.get(failing)), create("mqtt", "tool", settings) as transport:
        assert transport.state is State.CONNECTED, transport.problem
        assert transport.as_published is as_published
        assert works(transport)


def test_when_all_fail_one_line_names_each_address_and_its_reason(
    names: Names, caplog: pytest.LogCaptureFixture
) -> None:
    port, many = free_port(), [f"127.0.1.{number}" for number in range(1, 13)]
    names(BAD, WORSE, BAD, *many)
    with serving(BAD, port, mute), serving(WORSE, port, BEHAVIOURS["server unavailable"]):
        transport = create("mqtt", "tool", MqttSettings(host=NAME, port=port, reconnect_max_s=20)).open(0.01)
        transport.close()
    assert transport.problem.startswith(
        f"broker {NAME}:{port}: {BAD} accepts connections but does not speak MQTT in time; "
        f"{WORSE} refused us: server unavailable; 127.0.1.1 cannot be reached: [Errno 111] Connection refused; "
    )
    assert transport.problem.endswith("; and 6 more")
    assert [record.getMessage() for record in caplog.records] == [f"tool: {transport.problem}"]


A, B, C = (Address(socket.AF_INET, (f"10.0.0.{number}", 1883)) for number in (1, 2, 3))


@pytest.mark.parametrize(
    ("answers", "held", "tried"),
    [
        ([[A, B, C]], [0, 0, 0, 0], [A, B, C, A]),
        ([[A, B], [B, C]], [0, 0, 0, 0], [A, B, B, C]),  # resolved anew with each round
        ([[A, B, C]], [0, STEADY_S, 0, 0, 0], [A, B, B, A, C]),  # it held: once more, then the others
        ([[A, B, C]], [STEADY_S - 1, 0, 0], [A, B, C]),  # not for long: the next one
        ([[A, B, C], [A, C]], [0, STEADY_S, 0, 0], [A, B, A, C]),  # the name has lost it
    ],
)
def test_whose_turn_it_is(answers: list[list[Address]], held: list[float], tried: list[Address]) -> None:
    rounds = iter([*answers, *answers[-1:] * 9])
    turns, seen = AddressRound(HostPort("b", 1883), lambda _host, _port: next(rounds)), []
    for seconds in held:
        seen.append(turns.address())
        assert turns.several is (len(answers[0]) > 1)
        turns.failed("x", seconds)
    assert seen == tried


#: How an attempt went: TLS was silent for too long, nothing listens, or TCP and TLS took so long.
WENT: dict[str, Callable[[AddressRound], object]] = {
    "late": AddressRound.was_slow,
    "lost": lambda _turns: None,
    "3": lambda turns: turns.opened(3.0),
    "0.1": lambda turns: turns.opened(0.1),
}


@pytest.mark.parametrize(
    ("attempts", "patient"),  # at two addresses in turns, and which attempts may be silent for longer
    [
        ("late late 3 late late 3", "--+-++"),
        ("late 0.1 late", "---"),  # one that answers at once shows that the other is not slow
        ("3 0.1 3 lost 3 lost 0.1 lost lost", "----+-+--"),
    ],
)
def test_where_tls_took_long_it_may_be_silent_for_longer(attempts: str, patient: str) -> None:
    turns, seen = AddressRound(HostPort("b", 1883), lambda _host, _port: [A, B]), ""
    for word in attempts.split():
        turns.address()
        seen += "-+"[turns.patience_s == HANDSHAKE_S]
        WENT[word](turns)
        turns.failed("x")
    assert seen == patient


LOSSES = {"lost": Lost, "silent": Silent, "absent": Absent}


@pytest.mark.parametrize(
    ("events", "ended"),  # what ended a connection (in capitals) or an attempt to connect, and when
    [
        ("LOST@0", True),
        ("SILENT@0", False),  # it may be we who stood still
        ("LOST@0 lost@0.9", True),  # as it ends, it accepts connections and hangs up
        ("LOST@0 lost@1.1", False),
        ("LOST@0 absent@5 lost@5.9", True),
    ],
)
def test_whether_the_broker_has_ended(events: str, ended: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    now, verdict, dialler = 0.0, True, Dialler("tool", MqttSettings(host="b"), None, Client)
    monkeypatch.setattr("pebble.transports.mqtt.dialler.time", SimpleNamespace(monotonic=lambda: now))
    for event in events.split():
        word, now = event.partition("@")[0], float(event.partition("@")[2])
        verdict = dialler.is_gone(LOSSES[word.lower()]("x"), connected=word.isupper(), was_ended=verdict)
    assert verdict is ended
