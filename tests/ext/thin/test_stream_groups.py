"""Streams in groups from a bridge to expanders beside the broker, in virtual time and at real brokers."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.errors import ConfigError, PayloadError
from pebble.extensions.fleet.roles import Account
from pebble.extensions.operator.client.connection import put_account_into_topics
from pebble.extensions.operator.client.names import Names
from pebble.extensions.page.server import expand
from pebble.extensions.thin.expander import ANNOUNCE_S, Expander
from pebble.extensions.thin.packed import MOST_BYTES, joined, packed, unpacked
from pebble.runtime.connections import local_transport
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.transports import Message, MqttSettings, QoS, Transport, create
from tests.ext.fleet.brokers import HOST, FleetBroker
from tests.forwarding.virtual import Connection, World
from tests.robot.operator import Operator
from tests.services.mqtt_bridge.bridge_rig import BASE as ROVER
from tests.services.mqtt_bridge.bridge_rig import Running, make_config
from tests.support import ROOT, SOON_S, WAIT_S, Broker, Child, free_port, until

TOUCH, IMU, ODOMETRY, WIRE, STREAMS = (
    "outgoing/touch-sensors",
    "outgoing/sensors/imu",
    "outgoing/wheel-odometry",
    "outgoing/wire",
    "outgoing/group",
)
VALUE = b'{"value": {"a0": %d, "a1": 2, "a2": 3}}'
Start = Callable[..., World]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Start:
    def started(**link: Any) -> World:
        world = World("bridge", monkeypatch)
        world.start(link={"profile": "thin", "group_hz": 2, **link})
        world.run()
        world.remote.seen.clear()
        return world

    return started


class Beside:
    """An expander at the operators' broker."""

    def __init__(self, world: World, id_: str = "5") -> None:
        self.world = world
        self.connection = Connection(f"expander-{id_}", world.remote_hub, world)
        self.connection.open(WAIT_S)
        self.expander = Expander(self.connection, clock=lambda: world.now, id_=id_)
        self.expander.start()
        world.run(0.1)

    def close(self) -> None:
        self.connection.close()
        self.world.connections.remove(self.connection)


def run(world: World, seconds: float, *expanders: Beside, first: int = 0) -> int:
    """Publish two streams twenty times a second; returns the number after the last one."""
    for step in range(round(20 * seconds)):
        if step % round(20 * ANNOUNCE_S) == 0:
            for beside in expanders:
                beside.expander.announce()
        world.local.publish(TOUCH, VALUE % (first + step))
        world.local.publish(ODOMETRY, VALUE % (first + step), qos=0)
        world.run(0.05)
    return first + round(20 * seconds)


def counted(world: World, suffix: str) -> int:
    return len(world.remote.payloads(suffix))


def test_while_an_expander_is_there_streams_come_in_groups_and_plain_at_the_tools(start: Start) -> None:
    world = start()
    expander = Beside(world)
    run(world, 2, expander)
    world.remote.seen.clear()
    run(world, 6, expander, first=100)
    groups = world.remote.payloads(STREAMS)
    assert 10 <= len(groups) <= 13
    assert groups[-1][0] <= 31, "deflated, once the dictionary is known"
    assert len(groups[-1]) < 40
    plain = world.remote.payloads(TOUCH)
    assert len(plain) == len(groups)
    assert plain[-1] in {VALUE % number for number in range(200, 220)}, "the same bytes"
    assert expander.expander.counts["refused groups"] == 0


def test_without_an_expander_streams_are_plain_again_within_six_seconds(start: Start) -> None:
    world = start()
    expander = Beside(world)
    run(world, 4, expander)
    expander.close()
    number = run(world, 6)
    world.remote.seen.clear()
    run(world, 4, first=number)
    assert counted(world, STREAMS) == 0
    assert 3 <= counted(world, TOUCH) <= 5


def test_an_expander_that_hung_publishes_nothing_that_is_old(start: Start) -> None:
    world = start()
    expander, began = Beside(world), world.now
    ages: list[float] = []

    def note(message: Message) -> None:
        ages.append(world.now - began - msgspec.json.decode(message.payload)["value"]["a0"] / 20)

    world.remote.transport.subscribe(f"{world.remote.base}/{TOUCH}", note, direct=True)
    number = run(world, 6, expander)
    expander.connection.hold()
    number = run(world, 30, first=number)
    expander.expander.announce()  # it goes on, before it reads what has waited
    expander.connection.let_go()
    run(world, 10, expander, first=number)
    assert len(ages) > 50
    assert max(ages) < 8
    assert expander.expander.counts["late groups"] > 0


def test_of_two_expanders_the_smaller_id_works_and_no_value_comes_twice(start: Start) -> None:
    world = start()
    second = Beside(world, "7")
    number = run(world, 4, second)
    first = Beside(world, "3")
    number = run(world, 6, second, first, first=number)
    works = second.expander.counts["groups"]
    number = run(world, 4, second, first, first=number)
    assert second.expander.counts["groups"] == works, "one is silent"
    first.close()
    number = run(world, 6, second, first=number)
    world.remote.seen.clear()
    run(world, 4, second, first=number)
    assert counted(world, TOUCH) >= 3, "the other one has taken over"
    assert second.expander.counts["groups"] > works
    values = world.remote.payloads(TOUCH)
    assert len(values) == len(set(values))


def test_heartbeats_states_and_stops_are_never_in_a_group(start: Start) -> None:
    world = start()
    expander = Beside(world)
    run(world, 4, expander)
    state = b'{"latched": true, "boot": "5f0c11aa", "count": 1, "recent": []}'
    for suffix, payload in (("outgoing/estop/serial", state), ("outgoing/status", b"{}")):
        world.local.publish(suffix, payload, retain=True)
        world.run(0.05)
        assert world.retained(suffix)[1] == payload
    run(world, 3, expander)
    assert counted(world, "outgoing/online") >= 2


@pytest.mark.parametrize("payload", [b"[1", b"1" * 3000])
def test_what_is_no_json_or_large_is_sent_by_itself(start: Start, payload: bytes) -> None:
    world = start()
    expander = Beside(world)
    run(world, 2, expander)
    world.local.publish(IMU, payload)
    world.run(0.2)
    assert world.remote.payloads(IMU) == [payload]


@pytest.mark.parametrize(
    "metric", ["estop/serial", "control/serial", "online", "status", "group", "a/+", "front-camera"]
)
def test_an_expander_publishes_nothing_but_streams(start: Start, metric: str) -> None:
    world = start()
    expander = Beside(world)
    run(world, 1, expander)
    world.remote.seen.clear()
    world.remote.publish(STREAMS, joined({metric: b'{"z": 1}'}), qos=0)
    world.run(0.1)
    assert b'{"z": 1}' not in world.remote.payloads(f"outgoing/{metric}")
    assert expander.expander.counts["refused members"] == 1


BOMB = packed(b'{"a": "' + b" " * 50_000_000 + b'"}', 3, b"{}")


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (BOMB, f"more than {MOST_BYTES} bytes"),
        (packed(b'{"a": 1}', 3, b"{}")[:-2], "or not all of them"),
        (packed(b'{"a": 1}', 4, b"{}"), "dictionary 4 is not known"),
        (b"\x03" + bytes(range(200)), "not deflated"),
        (b"[1]", "not a JSON object"),
        (b'{"a": ', "not a JSON object"),
    ],
)
def test_what_cannot_be_read_is_dropped(raw: bytes, why: str) -> None:
    with pytest.raises(PayloadError, match=why):
        unpacked(raw, {3: b"{}"})


def test_what_is_packed_is_unpacked() -> None:
    streams = {"touch-sensors": b'{"a": 1.50}', "sensors/imu": b"[1, 2]"}
    text = joined(streams)
    assert unpacked(packed(text, 5, b""), {}) == streams
    assert unpacked(packed(text, 5, text), {5: text}) == streams
    assert len(packed(text, 5, text)) < len(zlib.compress(text)) < len(text) + 12


def test_the_wire_says_how_often_and_has_the_dictionary(start: Start) -> None:
    world = start()
    wire = msgspec.json.decode(world.retained(WIRE)[1] or b"")
    assert wire == {"group_hz": 2.0}
    run(world, 8, Beside(world))
    wire = msgspec.json.decode(world.retained(WIRE)[1] or b"")
    assert msgspec.json.decode(wire["dict"]).keys() == {"touch-sensors", "wheel-odometry"}


@pytest.mark.parametrize("claimed", [False, True], ids=["its own", "another robot's, too"])
def test_a_short_name_is_used_while_an_expander_hears_it(start: Start, claimed: bool) -> None:
    world = start(short="3f")
    shorts: list[bytes] = []
    world.remote.transport.subscribe("~/+", lambda message: shorts.append(message.payload), direct=True)
    expander = Beside(world)
    if claimed:
        other = Connection("another", world.remote_hub, world)
        other.open(WAIT_S)
        wire = b'{"group_hz": 1, "short": "~/3f"}'
        other.publish("pebble/robots/another/outgoing/wire", wire, qos=QoS.DELIVERED, retain=True)
    number = run(world, 6, expander)
    world.remote.seen.clear()
    del shorts[:]
    run(world, 8, expander, first=number)
    here, there = counted(world, STREAMS), len([raw for raw in shorts if raw != b"{}"])
    assert (here == 0, there == 0) == (not claimed, claimed)
    assert 14 <= here + there <= 17
    assert counted(world, TOUCH) == here + there, "plain at the tools, in any case"
    assert expander.expander.counts["refused groups"] == 0


@pytest.mark.parametrize(
    ("bridge", "why"),
    [
        ({"link": {"profile": "thin", "short": "3f"}}, "without group_hz"),
        ({"link": {"profile": "thin", "group_hz": 2, "short": "a/b"}}, "short"),
        (
            {"link": {"profile": "thin", "group_hz": 2, "short": "3f"}, "remote": {"kind": "zenoh"}},
            "zenoh has no short names",
        ),
    ],
)
def test_groups_that_have_no_effect_are_refused(bridge: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        make_config(**bridge)


# -- at real brokers


BASE = "pebble/robots/goob"
VALUES = {"touch-sensors": b'{"value": {"a0": 1}}', "wheel-odometry": b'{"value": {"x": 1.50}}'}
TEXT = joined(VALUES)


@contextmanager
def command(broker: Broker) -> Iterator[None]:
    words = [sys.executable, "-m", "pebble.cli", "topic", "expand", f"mqtt://127.0.0.1:{broker.port}"]
    process = Child(words, env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        assert process.wait(WAIT_S) == 0


@contextmanager
def page(broker: Broker) -> Iterator[None]:
    loop = asyncio.new_event_loop()
    task = loop.create_task(expand(MqttSettings(host="127.0.0.1", port=broker.port)))
    ended = asyncio.gather(task, return_exceptions=True)
    thread = threading.Thread(target=loop.run_until_complete, args=(ended,))
    thread.start()
    try:
        yield
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(WAIT_S)


@pytest.mark.parametrize("beside", [command, page])
def test_plain_topics_come_of_groups(broker: Broker, beside: Callable[[Broker], Iterator[None]]) -> None:
    seen: dict[str, bytes] = {}
    robot = create("mqtt", "robot", MqttSettings(host="127.0.0.1", port=broker.port)).open(WAIT_S)
    robot.subscribe(f"{BASE}/#", lambda message: seen.update({message.topic: message.payload}), qos=QoS.DELIVERED)
    wire = b'{"group_hz": 2, "dict_id": 3, "dict": "%s"}' % TEXT.replace(b'"', b'\\"')
    robot.publish(f"{BASE}/outgoing/wire", wire, qos=QoS.DELIVERED, retain=True)
    with beside(broker):  # type: ignore[attr-defined]
        assert until(lambda: f"{BASE}/incoming/expander" in seen)

        def comes() -> bool:
            robot.publish(f"{BASE}/outgoing/group", packed(TEXT, 3, TEXT), qos=QoS.LATEST)
            return until(lambda: all(seen.get(f"{BASE}/outgoing/{metric}") for metric in VALUES), 1)

        assert until(comes)
    assert {metric: seen[f"{BASE}/outgoing/{metric}"] for metric in VALUES} == VALUES
    robot.close()


ACCOUNTS = {"goob": Account(roles=("robot",), bases=(BASE,)), "vera": Account(roles=("viewer",))}


@pytest.mark.parametrize(
    ("level", "roles", "comes"),
    [("login", ("expander",), True), ("named", ("page", "expander"), True), ("named", ("page",), False)],
)
def test_at_a_fleets_broker_it_has_an_account_of_its_own(
    tmp_path: Path, level: Any, roles: tuple[str, ...], comes: bool
) -> None:
    """The robot sends by the name of its account, once that is heard; a viewer sees the plain topics."""
    accounts, said, seen = ACCOUNTS | {"exp": Account(roles=roles)}, list[bytes](), dict[str, bytes]()
    with FleetBroker(tmp_path / "hall", accounts, level=level, unencrypted=free_port()) as hall, ExitStack() as opened:

        def client(name: str) -> Transport:
            port = hall.unencrypted or 0
            settings = MqttSettings(host=HOST, port=port, username=name, password=hall.passwords[name])
            return opened.enter_context(create("mqtt", name, settings))

        robot, vera, exp = map(client, ("goob", "vera", "exp"))
        expander = Expander(exp)
        put_account_into_topics(exp, Names("", None, "exp"), expander.is_named)
        robot.subscribe(f"{BASE}/incoming/#", lambda message: said.append(message.payload), qos=QoS.DELIVERED)
        vera.subscribe(f"{BASE}/outgoing/#", lambda message: seen.update({message.topic: message.payload}))
        wire = b'{"group_hz": 2, "short": "~/goob", "named": %s}' % str(level == "named").lower().encode()
        robot.publish(f"{BASE}/outgoing/wire", wire, qos=QoS.DELIVERED, retain=True)
        expander.start()

        def arrives() -> bool:
            expander.announce()
            robot.publish("~/goob", TEXT, qos=QoS.LATEST)
            return until(
                lambda: f"{BASE}/outgoing/wheel-odometry" in seen and b'"short":"~/goob"' in b"".join(said), 0.3
            )

        assert until(arrives, WAIT_S if comes else 1) is comes
        assert bool(said) is comes, "it is not even said that it is there"


SENSOR, STOP, ONLINE, LINK = "outgoing/sensors/imu", "incoming/estop", "outgoing/online", "outgoing/link"
FLOOD = 3_000


def test_a_stop_passes_at_once_while_much_waits(tmp_path: Path, broker: Broker) -> None:
    local, remote = Broker(tmp_path, "max_queued_messages 0"), broker
    config = make_config(
        local_mqtt={"host": "127.0.0.1", "port": local.port},
        remote_mqtt={"host": "127.0.0.1", "port": remote.port},
        link={"profile": "thin", "kbit": 9.6},
    )
    running = Running(MqttBridge(config, local_transport(config, "local-bridge", as_published=True)))
    robot, operator = Operator(local.port, ROVER), Operator(remote.port, ROVER)
    assert until(lambda: operator.last(LINK) and len([one for one in operator.seen if one.topic.endswith(ONLINE)]) >= 2)
    for number in range(FLOOD):
        robot.send(SENSOR, {"n": number})
    began = time.monotonic()
    operator.send(STOP, {"stop": "00000000000000a1", "by": "test"})
    assert until(lambda: robot.last(STOP))
    stopped = robot.last(STOP)
    assert stopped is not None
    assert stopped.at - began < SOON_S
    assert until(lambda: json.loads((operator.last(SENSOR) or stopped).payload).get("n") == FLOOD - 1)
    arrived = [one for one in operator.seen if one.topic.endswith("imu")]
    assert len(arrived) < FLOOD / 50
    heartbeats = [one.at for one in operator.seen if one.topic.endswith(ONLINE)]
    assert len(heartbeats) <= heartbeats[-1] - heartbeats[0] + 2.5, "one a second"
    operator.close()
    robot.close()
    running.stop()
    local.stop()
