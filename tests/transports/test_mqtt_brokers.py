"""Every address of a broker's name gets its turn (T12); brokers that hang up on a message, or lack something."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest

from pebble.transports import Message, MqttSettings, QoS, State, Transport, create
from pebble.transports.hosts import HANDSHAKE_S, STEADY_S, Address, AddressRound, HostPort
from pebble.transports.mqtt.bridge_mode import BridgeMode, Result
from pebble.transports.mqtt.broker_limits import EVERYTHING, BrokerLimits, Limits
from pebble.transports.mqtt.client import Client
from pebble.transports.mqtt.dialler import Dialler
from pebble.transports.mqtt.ending import Absent, Lost, Silent
from pebble.transports.mqtt.outgoing import InFlightTable
from pebble.transports.mqtt.refused_topics import RefusedTopics
from pebble.transports.mqtt.transport import MqttTransport
from tests.fakes.bad_brokers import BEHAVIOURS, mute, serving
from tests.support import WAIT_S, Broker, free_port, quickly, some, until
from tests.transports.net import Received

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


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Names:
    """Gives the name these addresses from now on, which have less time than usual."""
    monkeypatch.setattr("pebble.transports.hosts.CONNECT_TIMEOUT_S", 0.4)
    monkeypatch.setattr("pebble.transports.mqtt.transport._ANSWER_S", 0.8)
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
    with quickly(2.5):
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
        f"{WORSE} refused us: server unavailable; 127.0.1.1 cannot be reached: nothing listens there, is it up?; "
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


# -- topics on which a broker hangs up

VITAL = ("r/online", "r/estop/+")


def sizes(text: str) -> dict[str, int]:
    return {topic: int(size) for topic, _, size in (word.partition(":") for word in text.split())}


@pytest.mark.parametrize(
    ("losses", "withheld", "refused"),  # after which messages the connection was lost; from which size topics wait
    [
        (["a:9"] * 2, "", ""),
        (["a:9"] * 3, "a:0", "a"),
        (["a:9", "a:9", "b:9", "a:9"], "", ""),  # not in a row
        (["a:9", "a:9", None, "a:9"], "", ""),  # it was silent: no message is the reason
        (["a:9 b:9"] * 3, "a:0 b:0", ""),  # each waits until it is tried
        (["a:9 r/online:9"] * 3, "a:0", "a"),
        (["a:9 b:2600"] * 3, "b:1300", "b"),
        (["r/online:9 r/estop/w:2600"] * 3, "r/estop/w:1300", "r/estop/w"),
        (["r/online:1500 r/estop/w:2600"] * 3, "r/online:1024 r/estop/w:1024", ""),
        (["r/online:9 r/estop/w:9"] * 3, "", "r/online r/estop/w"),
    ],
)
def test_what_is_withheld_after_losses(
    losses: list[str | None], withheld: str, refused: str, caplog: pytest.LogCaptureFixture
) -> None:
    topics = RefusedTopics("robot", VITAL)
    for written in losses:
        topics.note_loss("broker", None if written is None else sizes(written), 0.0)
    assert {topic: entry.size for topic, entry in topics.withheld.items()} == sizes(withheld)
    assert set(topics.not_taken) == set(refused.split())
    cannot_run = [line for line in caplog.messages if "this account cannot run a robot" in line]
    assert len(cannot_run) == len(set(refused.split()) - topics.withheld.keys())
    for topic, entry in topics.withheld.items():
        taken = [topics.admits(Message(topic, bytes(size)), 0.0) for size in (entry.size, max(0, entry.size - 1))]
        assert taken == [False, entry.size > 0]


def test_withheld_topics_are_tried_one_at_a_time_and_the_one_at_fault_each_minute(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    topics, own = RefusedTopics("robot", VITAL), {topic: Message(topic, b"x") for topic in "ab"}

    def due(now: float) -> str:
        return "".join(message.topic for message in topics.due(own, "broker", now))

    for _ in range(3):
        topics.note_loss("broker", {"a": 9, "b": 9}, 0.0)
    assert (due(1.9), due(2.0)) == ("", "a")
    assert [topics.admits(own[topic], 2.1) for topic in "ab"] == [True, False]
    topics.note_loss("broker", {"a": 9, "r/online": 9}, 2.5)
    assert [topics.admits(own["b"], now) for now in (4.4, 4.5)] == [False, True], "a live message begins its trial, too"
    assert (due(5.4), due(5.5)) == ("", "")
    assert set(topics.withheld) == set(topics.not_taken) == {"a"}
    assert (due(62.4), due(62.5), due(63.5)) == ("", "a", "")
    assert not topics.withheld
    assert not topics.not_taken
    assert caplog.messages[-1] == "robot: broker accepts messages on a again"


def test_what_is_remembered_is_bounded() -> None:
    topics, in_flight = RefusedTopics("robot", ()), InFlightTable()
    for number in range(5000):
        in_flight.sent(Message(f"t/{number}", b""), 0, 1.0)
    for _ in range(3):
        topics.note_loss("broker", in_flight.first_written(1.1), 1.1)
    assert len(topics.withheld) == 1000


# -- brokers without retained messages, QoS 1, wills or bridge mode


NONE = Limits(retain=False, qos=0)
NO_RETAIN, NO_QOS, NO_WILL = Limits(retain=False), Limits(qos=0), Limits(will=False)
RESULTS = {"accepts": Result.ACCEPTED, "hangs up": Result.HUNG_UP, "no retain": Result.RETAIN_REFUSED}
RESULTS |= {"no QoS": Result.QOS_REFUSED, "refuses": Result.FAILED}


@pytest.mark.parametrize(
    ("events", "limits"),
    [
        (["hangs up"] * 20, EVERYTHING),  # a proxy whose broker is away: no probe is accepted
        (["hangs up", "probed", "hangs up"], NO_QOS),
        (["hangs up", "probed", *["hangs up"] * 2], NO_RETAIN),
        (["hangs up", "probed", *["hangs up"] * 3], NONE),
        (["hangs up", "probed", *["hangs up"] * 4], NO_WILL),
        (["hangs up", "probed", *["hangs up"] * 5], EVERYTHING),  # the will was not the reason
        (["hangs up", "probed", *["hangs up"] * 2, "refuses"], EVERYTHING),  # the broker has gone
        (["hangs up", "probed", "hangs up", "accepts", *["hangs up"] * 9], NO_QOS),  # it is away
        (["no retain"], NO_RETAIN),
        (["no QoS", "no retain", "accepts"], NONE),
        (["no retain", "accepts", "later"], EVERYTHING),  # it may have another config
    ],
)
def test_what_is_tried_next(events: list[str], limits: Limits) -> None:
    learning, now = BrokerLimits(), 0.0
    for event in events:
        learning.begin(now)
        if event in RESULTS:
            if learning.wants_probe:
                learning.note_probe(Result.FAILED)
            learning.note_connect(RESULTS[event], now)
        elif event == "probed":
            assert learning.wants_probe
            learning.note_probe(Result.ACCEPTED)
        else:
            now += 1000.0
    learning.begin(now)
    assert learning.limits == limits


@pytest.mark.parametrize(
    ("lacking", "protocol", "lost"),
    [("retain_available false", "3.1.1", "keeps no retained messages"), ("max_qos 0", "5", "has no QoS 1")],
)
def test_messages_pass_both_ways_and_one_warning_names_what_is_lost(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, lacking: str, protocol: str, lost: str
) -> None:
    broker = Broker(tmp_path, lacking)
    settings = MqttSettings(host="127.0.0.1", port=broker.port, protocol=protocol, as_published=True)
    will = Message("robot/online", b"gone", QoS.DELIVERED, retain=True)
    robot = MqttTransport("robot", settings, will=will)
    operator = MqttTransport("operator", MqttSettings(host="127.0.0.1", port=broker.port)).open()
    try:
        seen, commands = Received(), Received()
        stop = partial(operator.publish, "commands/stop", b"", urgent=True)
        operator.subscribe("robot/#", seen)
        robot.open().subscribe("commands/#", commands, echo=False)
        robot.publish("robot/state", b"state", qos=QoS.DELIVERED, retain=True)
        assert until(lambda: b"state" in seen.payloads)
        assert until(lambda: robot.publish("robot/event", b"event", qos=QoS.DELIVERED) and b"event" in seen.payloads)
        assert until(lambda: stop(qos=QoS.DELIVERED) and commands.payloads)
        assert until(lambda: any(lost in line for line in caplog.messages))
        warned = [line for line in caplog.messages if "that is changed" in line]
        assert len(warned) == ("retain" in lost)
        broker.stop()
        assert until(lambda: robot.state is not State.CONNECTED)
        broker.start()
        assert until(lambda: robot.state is State.CONNECTED)
        robot.close()
        assert until(lambda: b"gone" in seen.payloads)
    finally:
        robot.close()
        operator.close()
        broker.stop()


ACCEPTED, PROTOCOL, HUNG_UP, OTHER = Result.ACCEPTED, Result.PROTOCOL_REFUSED, Result.HUNG_UP, Result.FAILED


@pytest.mark.parametrize(
    ("results", "attempts"),
    [
        ([PROTOCOL, OTHER], "bridge plain bridge"),
        ([OTHER] * 4, "bridge bridge bridge bridge bridge"),  # a wrong password, say
        ([HUNG_UP] * 6, "bridge probe bridge probe bridge probe bridge"),  # a proxy whose broker is away
        ([HUNG_UP, ACCEPTED, ACCEPTED], "bridge probe bridge bridge"),  # the broker was just starting
        ([HUNG_UP, ACCEPTED, OTHER, HUNG_UP], "bridge probe bridge bridge probe"),
        ([HUNG_UP, ACCEPTED, HUNG_UP, ACCEPTED, HUNG_UP], "bridge probe bridge plain bridge plain"),  # remembered
        ([PROTOCOL, ACCEPTED, HUNG_UP], "bridge plain bridge plain"),  # it is tried again with each connection
        ([PROTOCOL, ACCEPTED, ACCEPTED, HUNG_UP], "bridge plain bridge bridge probe"),  # another broker
    ],
)
def test_attempts_with_bridge_mode(results: list[Result], attempts: str) -> None:
    """Those that end with ``results``, and the one after them."""
    mode = BridgeMode()
    made = []
    for result in results:
        made.append(mode.next_attempt.value)
        mode.note(result)
    assert [*made, mode.next_attempt.value] == attempts.split()
