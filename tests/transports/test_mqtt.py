"""What only the MQTT transport has: bridge mode, TLS, logins, silent links, full sockets, brokers that lack things."""

from __future__ import annotations

import logging
import os
import re
import shutil
import signal
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from pebble.errors import TransportError
from pebble.transports import Message, MqttSettings, QoS, State, TlsSettings, Transport, create
from pebble.transports.credentials import make_context
from pebble.transports.hosts import Address
from pebble.transports.mqtt import refused_topics
from pebble.transports.mqtt.client import Client, Opening
from pebble.transports.mqtt.connection import UNACKED_LIMIT, UNACKED_RESERVE
from pebble.transports.mqtt.ending import unreached
from tests.support import ROOT, WAIT_S, Broker, RefusingBroker, beside, free_port, quickly, until
from tests.tcp_proxy import BridgelessProxy, ForbiddingProxy, Hole, SlowTcpProxy, TcpProxy
from tests.transports.net import Received

DELIVERED = QoS.DELIVERED
CERTS = ROOT / "tests" / "data" / "tls"


def module_broker(*options: str, files: Callable[[Path], list[str]] = lambda _folder: []) -> Any:
    """A fixture: a mosquitto with these options for all tests of this file; ``files`` makes more, in a folder."""

    @pytest.fixture(scope="module")
    def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
        folder = tmp_path_factory.mktemp("broker")
        made = Broker(folder, *options, *files(folder))
        yield made
        made.stop()

    return broker


def passwords(folder: Path) -> list[str]:
    file = folder / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", file, "goob", "s3cret-word"], check=True)
    return ["allow_anonymous false", f"password_file {file}"]


broker = module_broker()
small_broker = module_broker("max_packet_size 20000")  # hangs up on clients that send a larger packet
strict_broker = module_broker(files=passwords)  # wants a user name and password
#: Has a certificate for localhost (and not for 127.0.0.1), and wants one of its clients.
tls_broker = module_broker(
    *(f"cafile {CERTS}/ca.crt", f"certfile {CERTS}/server.crt", f"keyfile {CERTS}/server.key"),
    "require_certificate true",
)


class Clients:
    """Makes clients, and closes them."""

    def __init__(self) -> None:
        self._made: list[Transport] = []

    def __call__(
        self, port: int, name: str = "", *, opened: bool = True, will: Message | None = None, **changes: Any
    ) -> Transport:
        settings = MqttSettings(**{"host": "127.0.0.1", "port": port, **changes})
        client = create("mqtt", name or f"client{len(self._made)}", settings, will=will)
        self._made.append(client)
        if opened:
            client.open(WAIT_S)
            assert client.state is State.CONNECTED, client.problem
        return client

    def close(self) -> None:
        for client in self._made:
            client.close()


@pytest.fixture
def clients() -> Iterator[Clients]:
    clients = Clients()
    yield clients
    clients.close()


@pytest.fixture
def proxy(broker: Broker) -> Iterator[TcpProxy]:
    with TcpProxy(broker.port) as proxy:
        yield proxy


@pytest.fixture
def topic(request: pytest.FixtureRequest) -> str:
    return "mqtt/" + request.node.name.replace("[", "/").rstrip("]")


def reconnected(client: Transport, times: int = 2) -> bool:
    return until(lambda: client.counters["connected"] >= times and client.state is State.CONNECTED)


# -- as published


@pytest.mark.parametrize("protocol", ["3.1.1", "5"])
def test_subscribe_returns_after_the_retained_messages_however_long_after_the_suback(
    broker: Broker, clients: Clients, protocol: str
) -> None:
    """So none of them reaches the next subscription as a live message."""
    topic = f"crumbs/{protocol}"
    clients(broker.port).publish(topic, b"kept", qos=DELIVERED, retain=True)
    with TcpProxy(broker.port, delay_s=0.02, piece=5) as crumbs:
        bridge = clients(crumbs.port, "bridge", as_published=True, protocol=protocol)
        for _ in range(2):
            received = Received()
            subscription = bridge.subscribe(topic, received, echo=False, direct=True)
            assert received.payloads == [b"kept"]
            subscription.close()


def test_as_published_refuses_to_promise_an_echo(broker: Broker, clients: Clients, topic: str) -> None:
    with pytest.raises(TransportError, match="echo=False"):
        clients(broker.port, as_published=True).subscribe(topic, Received())


@pytest.mark.parametrize("answer", [b"", b"\x20\2\0\1"], ids=["silently", "unacceptable protocol version"])
def test_a_broker_that_hangs_up_on_bridge_mode_gets_a_plain_connection_until_it_is_another_one(
    broker: Broker, clients: Clients, caplog: pytest.LogCaptureFixture, topic: str, answer: bytes
) -> None:
    watcher, wills = clients(broker.port), Received()
    watcher.subscribe(topic, wills)
    with BridgelessProxy(broker.port) as proxy:
        proxy.answer = answer
        bridge = clients(proxy.port, "bridge", as_published=True, will=Message(topic, b"gone"))
        assert not bridge.as_published
        assert "no bridge mode" in caplog.text
        proxy.bridgeless = False
        proxy.drop()
        assert reconnected(bridge)
        assert bridge.as_published
        assert bridge.exact_echo
        watcher.publish(topic, b"last", qos=DELIVERED)
        assert wills.until(b"gone", b"last")  # of the one that was dropped: a probe has none


def test_urgent_messages_expire_on_mqtt_5(
    broker: Broker, clients: Clients, topic: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A command that waits in the broker for a slow robot is stale after a while; a retained flag never is."""
    expiries, publish = list[int | None](), Client.publish

    def note(client: Client, *arguments: Any, expires_s: int | None, **options: Any) -> int:
        expiries.append(expires_s)
        return publish(client, *arguments, expires_s=expires_s, **options)

    monkeypatch.setattr(Client, "publish", note)
    client = clients(broker.port, protocol="5", silence_s=2.5)
    client.publish(topic, b"command", qos=DELIVERED, urgent=True)
    client.publish(f"{topic}/flag", b"true", qos=DELIVERED, retain=True, urgent=True)
    assert until(lambda: expiries == [3, None])


# -- T19: links that go silent


def test_what_was_typed_into_a_silent_link_never_arrives(
    broker: Broker, clients: Clients, proxy: TcpProxy, topic: str
) -> None:
    operator = clients(proxy.port, "operator", silence_s=0.7)
    robot, received = clients(broker.port), Received()
    robot.subscribe(topic, received)
    operator.publish(topic, b"before", qos=DELIVERED)
    assert received.until(b"before")
    proxy.blackhole()
    for _ in range(20):
        operator.publish(topic, b"into the hole", qos=DELIVERED)
        operator.publish(f"{topic}/latest", b"into the hole")
    assert until(lambda: operator.state is State.CONNECTING)
    assert "has not answered" in operator.problem
    assert operator.publish(topic, b"without a connection", qos=DELIVERED) is False
    proxy.resume()
    assert reconnected(operator)
    assert operator.publish(topic, b"after", qos=DELIVERED)
    assert received.until(b"before", b"after")
    assert operator.counters["silences"] == 1


def test_what_waited_at_the_broker_or_on_the_way_is_no_younger(
    broker: Broker, clients: Clients, proxy: TcpProxy, topic: str
) -> None:
    """Pings are sent twice a second: their answers stand in the same queue."""
    robot, operator, waited = clients(proxy.port), clients(broker.port), list[float]()
    robot.subscribe(topic, lambda message: waited.append(message.waited_s))
    operator.publish(topic, b"")
    assert until(lambda: len(waited) == 1)
    assert waited[0] < 0.4
    proxy.blackhole()
    time.sleep(0.1)
    operator.publish(topic, b"")
    time.sleep(1.5)
    proxy.resume()
    assert until(lambda: len(waited) == 2)
    assert 0.9 < waited[1] < 2.5
    assert robot.counters["connected"] == 1


# -- messages that are too large


@pytest.mark.parametrize(("protocol", "qos"), [("3.1.1", DELIVERED), ("5", QoS.LATEST)])
def test_a_retained_message_that_the_broker_refuses_is_set_aside(
    small_broker: Broker, clients: Clients, topic: str, protocol: str, qos: QoS, caplog: pytest.LogCaptureFixture
) -> None:
    """On 3.1.1 it can only be told from how the connection ends; 5 says what is too large."""
    robot = clients(small_broker.port, "robot", protocol=protocol)
    late, received = clients(small_broker.port), Received()
    for number in range(2):
        robot.publish(f"{topic}/map", b"%d" % number + bytes(50_000), qos=qos, retain=True)
        robot.publish(f"{topic}/state", b"%d" % number, qos=DELIVERED, retain=True)
        late.subscribe(f"{topic}/+", received)
        assert until(lambda: received.payloads[-1:] == [b"%d" % number])  # noqa: B023
    assert until(lambda: robot.state is State.CONNECTED)
    assert robot.counters["connected"] == {"3.1.1": 4, "5": 1}[protocol]
    (line,) = [line for line in caplog.messages if f"{topic}/map" in line]
    assert "50001 bytes" in line
    robot.publish(f"{topic}/map", b"smaller", qos=qos, retain=True)
    assert until(lambda: b"smaller" in received.payloads)


# -- what a broker refuses


def test_a_topic_on_which_the_broker_hangs_up_costs_that_topic_until_it_is_allowed(
    broker: Broker, clients: Clients, topic: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refused_topics, "RETRY_S", 1.5)
    monkeypatch.setattr(refused_topics, "QUIET_S", 0.7)
    with ForbiddingProxy(broker.port) as proxy:
        proxy.forbidden = {f"{topic}/forbidden"}
        robot = clients(proxy.port, "robot", vital=(f"{topic}/online",))
        other, commands, received = clients(broker.port), Received(), Received()
        robot.subscribe(f"{topic}/command", commands)
        other.subscribe(f"{topic}/forbidden", received)
        stopping = threading.Event()

        def stream() -> None:
            while not stopping.wait(0.02):
                robot.publish(f"{topic}/forbidden", b"x", retain=True)
                robot.publish(f"{topic}/online", b"1", retain=True)

        with beside(stream, stopping):
            assert until(lambda: robot.counters["withheld"] > 0)
            assert reconnected(robot)
            for number in range(20):
                other.publish(f"{topic}/command", b"%d" % number, qos=DELIVERED)
            assert until(lambda: len(commands.payloads) == 20)
            (error,) = [line for line in caplog.messages if "is not sent" in line]
            assert f"{topic}/forbidden" in error
            assert not received.payloads
            proxy.forbidden = set()
            assert until(lambda: received.payloads)


def test_a_state_that_the_broker_has_refused_arrives_once_it_is_allowed(
    tmp_path: Path, clients: Clients, topic: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refused_topics, "RETRY_S", 0.3)
    rules, received = tmp_path / "rules", Received()
    rules.write_text("topic read #\n")
    broker = Broker(tmp_path, f"acl_file {rules}")
    robot = clients(broker.port, "robot", protocol="5", silence_s=0.4)
    clients(broker.port).subscribe(f"{topic}/#", received)
    robot.publish(f"{topic}/state", b"1", qos=DELIVERED, retain=True)
    robot.publish(f"{topic}/others", b"1", qos=DELIVERED, retain=True, shared=True)
    assert until(lambda: robot.counters["publications_refused"] >= 3)  # it is tried again
    rules.write_text("topic readwrite #\n")
    os.kill(broker.pid, signal.SIGHUP)
    assert until(lambda: received.payloads == [b"1"])
    assert robot.counters["connected"] == 1
    broker.stop()


def test_close_does_not_wait_for_a_silent_broker(clients: Clients, proxy: TcpProxy) -> None:
    proxy.blackhole()
    others = set(threading.enumerate())
    client = clients(proxy.port, opened=False)
    client.open(0.1)
    threads = {thread for thread in set(threading.enumerate()) - others if thread.name.startswith("pebble-mqtt")}
    assert threads
    with quickly(2.5):
        client.close()
    assert until(lambda: not threads & set(threading.enumerate()))


def test_a_client_has_one_id_for_all_its_connections(tmp_path: Path, clients: Clients) -> None:
    """So a broker closes a half-dead one as soon as the client is back. Another client of that name has another id."""
    log = tmp_path / "log"
    broker = Broker(tmp_path, f"log_dest file {log}", "log_type notice")
    client = clients(broker.port, "twin")
    broker.stop()
    broker.start()
    assert reconnected(client)
    clients(broker.port, "twin")
    ids = re.findall(r" as (twin-[0-9a-f]{16}) ", log.read_text())
    assert len(ids) == 3
    assert ids[0] == ids[1] != ids[2]
    broker.stop()


def test_two_clients_with_one_id_do_not_fight_at_full_speed(
    broker: Broker, clients: Clients, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each throws the other out; without a pause that would be thousands of times a second."""
    monkeypatch.setattr("secrets.token_hex", lambda size: "0" * 2 * size)
    first = clients(broker.port, "twin", reconnect_max_s=0.2)
    clients(broker.port, "twin", opened=False, reconnect_max_s=0.2).open(0.0)  # it may be thrown out again at once
    assert until(lambda: first.counters["connected"] >= 3)
    began, before = time.monotonic(), first.counters["connected"]
    assert until(lambda: first.counters["connected"] >= before + 3)
    assert time.monotonic() - began > 0.2


# -- full sockets


def test_unacknowledged_messages_are_bounded(tmp_path: Path, clients: Clients, topic: str) -> None:
    """And there is room left for stops."""
    broker, received = Broker(tmp_path, "max_queued_messages 0"), Received()  # for the receiver, which may be slow
    with TcpProxy(broker.port) as proxy:
        client = clients(proxy.port, "client", silence_s=60, keepalive_s=60)
        clients(broker.port).subscribe(f"{topic}/#", received, limit=100_000)
        proxy.blackhole()
        accepted = [client.publish(topic, b"%d" % number, qos=DELIVERED) for number in range(UNACKED_LIMIT + 100)]
        assert accepted == [True] * UNACKED_LIMIT + [False] * 100
        client.policy.is_stop = lambda one: one.endswith("/stop")
        stops = [client.publish(f"{topic}/stop", b"stop", qos=DELIVERED) for _ in range(UNACKED_RESERVE + 1)]
        assert stops == [True] * UNACKED_RESERVE + [False]
        assert client.publish(f"{topic}/kept", b"parked", qos=DELIVERED, retain=True)
        proxy.resume()
        numbers = [b"%d" % number for number in range(UNACKED_LIMIT)]
        assert received.until(*numbers, *[b"stop"] * UNACKED_RESERVE, b"parked")
    broker.stop()


# -- refused subscriptions (T21)


@pytest.fixture
def refusing(tmp_path: Path) -> Iterator[RefusingBroker]:
    broker = RefusingBroker(tmp_path)
    yield broker
    broker.stop()


@pytest.mark.parametrize("protocol", ["3.1.1", "5"])
def test_a_refused_subscription_is_known_at_once_and_renewed_with_every_connection(
    refusing: RefusingBroker, clients: Clients, topic: str, protocol: str, caplog: pytest.LogCaptureFixture
) -> None:
    refusing.refuse(f"{topic}/secret")
    client, other, received = clients(refusing.port, protocol=protocol), clients(refusing.port), Received()
    secret = client.subscribe(f"{topic}/secret", received)
    public = client.subscribe(f"{topic}/public", received)
    assert (secret.refused, public.refused) == (True, False)
    assert f"refused to subscribe us to {topic}/secret (" in caplog.text
    assert client.counters["subscriptions_refused"] == 1
    for metric in ("secret", "public"):
        other.publish(f"{topic}/{metric}", metric.encode(), qos=DELIVERED)
    assert received.until(b"public")
    seen: list[tuple[State, bool, bool]] = []
    client.on_state(lambda state: seen.append((state, secret.refused, public.refused)))
    refusing.refuse(f"{topic}/public")
    assert reconnected(client)
    refusing.refuse()
    assert reconnected(client, 3)
    assert seen == [
        (State.CONNECTING, True, False),
        (State.CONNECTED, False, True),
        (State.CONNECTING, False, True),
        (State.CONNECTED, False, False),
    ]


def test_a_merged_filter_is_refused_for_all_it_covers(refusing: RefusingBroker, clients: Clients) -> None:
    refusing.refuse("+/+")
    client, received = clients(refusing.port), Received()
    one, apart = client.subscribe("a/+", received), client.subscribe("a/b/c", received)
    assert not one.refused
    other = client.subscribe("+/b", received)
    assert (one.refused, other.refused, apart.refused) == (True, True, False)


# -- logins and TLS


def test_only_the_right_password_opens_and_none_is_shown(
    strict_broker: Broker, clients: Clients, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    clients(strict_broker.port, username="goob", password="s3cret-word")
    wrong: dict[str, Any] = {"username": "goob", "password": "s3cret-wrong"}
    for login, words in ((wrong, "bad user name or password"), ({}, "")):
        client = clients(strict_broker.port, **login, opened=False)
        client.open(0.3)
        refused = f"broker 127.0.0.1:{strict_broker.port} refused us"
        assert until(lambda: refused in client.problem and words in client.problem)  # noqa: B023
        assert "s3cret" not in client.problem + caplog.text + repr(client.settings)  # type: ignore[attr-defined]
        assert client.state is State.CONNECTING


def tls(**changes: Any) -> TlsSettings:
    files = {"ca_cert": "ca.crt", "client_cert": "client.crt", "client_key": "client.key", **changes}
    return TlsSettings(**{name: CERTS / value if name in _FILES and value else value for name, value in files.items()})


_FILES = ("ca_cert", "client_cert", "client_key")


def test_tls_with_client_certificates(tls_broker: Broker, clients: Clients, topic: str) -> None:
    client, received = clients(tls_broker.port, host="localhost", tls=tls()), Received()
    client.subscribe(topic, received)
    payload = bytes(range(256)) * 4000
    client.publish(topic, payload, qos=DELIVERED)
    assert received.until(payload)
    clients(tls_broker.port, "careless", tls=tls(insecure=True))


def test_files_that_were_renewed_count_for_the_next_connection(
    tls_broker: Broker, strict_broker: Broker, clients: Clients, tmp_path: Path
) -> None:
    authority, word = tmp_path / "authority", tmp_path / "word"
    shutil.copy(CERTS / "other-ca.crt", authority)
    word.write_text("yesterday's")
    login = {"username": "goob", "password": "yesterday's", "password_file": word}
    made = [
        clients(tls_broker.port, host="localhost", tls=tls(ca_cert=authority), opened=False),
        clients(strict_broker.port, **login, opened=False),
    ]
    assert all(until(lambda client=client: client.open(0.1).problem) for client in made)  # type: ignore[misc]
    shutil.copy(CERTS / "ca.crt", authority)
    word.write_text("s3cret-word\n")
    assert until(lambda: {client.state for client in made} == {State.CONNECTED})


@pytest.mark.parametrize("goes_on", [True, False])
def test_a_handshake_may_take_long_while_bytes_arrive(tls_broker: Broker, goes_on: bool) -> None:
    patience_s = 0.4
    with SlowTcpProxy(tls_broker.port, 20) as slow:  # a piece of 512 bytes takes 0.2 s
        if not goes_on:
            slow.blackhole()
        address = Address(socket.AF_INET, ("127.0.0.1", slow.port))
        opening = Opening("id", MqttSettings(host="localhost"), make_context(tls()), None, address, patience_s)
        began = time.monotonic()
        with closing(Client(opening, Mock(), bridge=False)) as client:
            with nullcontext() if goes_on else pytest.raises(TimeoutError, match="TLS handshake"):
                client.open()
            assert patience_s < time.monotonic() - began


@pytest.mark.parametrize(
    ("host", "changes", "problem"),
    [
        ("127.0.0.1", {}, "not valid for '127.0.0.1'; name the host as it does"),  # it names localhost
        (
            "localhost",
            {"ca_cert": "other-ca.crt", "insecure": True},
            "; name its authority: --ca-cert FILE, tls.ca_cert",
        ),
        ("localhost", {"client_cert": None, "client_key": None}, "certificate required; give this machine one"),
        ("localhost", None, "if this port is for TLS: mqtts://"),
        ("plain", {}, "it answers no TLS; if this port is not for TLS: mqtt://"),
    ],
)
def test_tls_checks_host_name_and_authority_and_shows_a_certificate(
    tls_broker: Broker, broker: Broker, clients: Clients, host: str, changes: dict[str, Any] | None, problem: str
) -> None:
    port = {"plain": broker.port}.get(host, tls_broker.port)
    changed = None if changes is None else tls(**changes)
    client = clients(port, host=host.replace("plain", "localhost"), tls=changed, opened=False)
    client.open(0.3)
    assert until(lambda: client.problem and problem in client.problem)
    assert client.state is State.CONNECTING


@pytest.mark.parametrize(
    ("code", "fix"),
    [(9, "set the clock of this machine"), (10, "renew it"), (19, "name its authority: --ca-cert FILE")],
)
def test_a_certificate_that_is_refused_is_named_with_its_fix(code: int, fix: str) -> None:
    error = ssl.SSLCertVerificationError()
    error.verify_code, error.verify_message = code, "why."
    assert unreached(error, tls=True).startswith(f"its certificate is refused: why; {fix}")


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"client_key": "nowhere.key"}, "tls.client_key: there is no file .*nowhere.key"),
        ({"client_cert": None}, "tls.client_key is set without tls.client_cert"),
        ({"ca_cert": "make.sh"}, "tls.ca_cert: .*make.sh cannot be used"),
        ({"client_key": "server.key"}, "tls.client_cert: .*client.crt cannot be used"),
    ],
)
def test_tls_mistakes_are_one_clear_error(clients: Clients, wrong: dict[str, Any], words: str) -> None:
    client = clients(free_port(), tls=tls(**wrong), opened=False)
    with pytest.raises(TransportError, match=words):
        client.open(1)
    assert client.state is State.CLOSED
    client.close()


#: Who sends what is large, whether it is retained, whether by TLS, and the bytes of a packet that gets through.
LARGE = {
    "a picture": ("robot", False, False, 1400),
    "what the broker retains": ("operator", True, False, 1400),
    "a certificate": ("robot", True, True, 600),
}


@pytest.mark.parametrize("case", LARGE)
def test_where_large_packets_are_lost_segments_become_small(
    broker: Broker,
    tls_broker: Broker,
    clients: Clients,
    topic: str,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    case: str,
) -> None:
    for timeout in ("CONNECT_TIMEOUT_S", "HANDSHAKE_S"):
        monkeypatch.setattr(f"pebble.transports.hosts.{timeout}", 0.4)
    sender, retain, by_tls, limit = LARGE[case]
    to, way = (tls_broker.port, {"host": "localhost", "tls": tls()}) if by_tls else (broker.port, {})
    with Hole(to) as hole:
        hole.limit, received = limit, Received()
        robot = clients(hole.port, "robot", silence_s=0.2, opened=False, **way).open(0)
        operator = clients(to, **way)
        sends, hears = (robot, operator) if sender == "robot" else (operator, robot)
        hears.subscribe(topic, received)
        large = partial(sends.publish, topic, bytes(3000), qos=QoS(retain), retain=retain)
        large()
        assert until(lambda: (retain or large()) and bytes(3000) in received.payloads)
        assert len([line for line in caplog.messages if "lose large packets" in line]) == 1
