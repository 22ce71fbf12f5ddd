"""Interfaces that are local_only never leave the robot: the rule alone, and with real bridges."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pebble.forwarding.side import Gate
from pebble.services.mqtt_bridge.private_topics import PrivateTopics
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import parse_describe
from pebble.transports import Message, MqttSettings, create
from tests.kit.board import SerialRig, motion
from tests.kit.robot import BASE, Listener, Running
from tests.services.mqtt_bridge.bridge_rig import gate_of
from tests.services.serial_mcu_bridge import mcu_wire as wire
from tests.services.serial_mcu_bridge.mcu_wire import F, I, M
from tests.support import Broker, cases, until

OUT = f"{BASE}/outgoing"
#: One interface of each kind, private and public, and an inertial sensor with channels outside the contract.
SPY = M("spy-1", (
    I(1, "fast", wire.OUT, wire.KIND_SAMPLE, (F("v", wire.U8),), "lab/fast", "", wire.LOCAL_ONLY),
    I(2, "slow", wire.OUT, wire.KIND_STATE, (F("v", wire.U8),), "lab/slow", "", wire.RETAIN),
    I(3, "secret", wire.OUT, wire.KIND_STATE, (F("v", wire.U8),), "lab/secret", "", wire.RETAIN | wire.LOCAL_ONLY),
    I(4, "set", wire.IN, wire.KIND_COMMAND, (F("v", wire.U8),), "lab/set"),
    I(5, "tune", wire.IN, wire.KIND_COMMAND, (F("v", wire.U8),), "lab/tune", "", wire.LOCAL_ONLY),
    *wire.imu_interfaces(6, channels=("lab/imu-fast", "lab/imu")),
))  # fmt: skip
PRIVATE = ("mcu/spy-1/fast", "lab/fast", "mcu/spy-1/secret", "lab/secret", "mcu/spy-1/imu_fast", "lab/imu-fast")


def manifest(which: M = SPY) -> bytes:
    return msgspec.json.encode(parse_describe(which.describe()).payload())


def described(which: M = SPY, uid: str = "spy-1") -> Message:
    return Message(f"{OUT}/mcu/{uid}/describe", manifest(which), retain_requested=True)


def sample(interface: str, uid: str = "spy-1") -> bytes:
    body = {"t": 1, "seq": 1, "mcu_ms": 1, "device_uid": uid, "interface": interface, "profile": "", "value": {"v": 1}}
    return json.dumps(body).encode()


def value(metric: str, interface: str = "", **more: Any) -> Message:
    """A value of the interface that the topic ends with, unless another is named."""
    return Message(f"{OUT}/{metric}", sample(interface or metric.rpartition("/")[2]), **more)


def cleared(metric: str) -> Message:
    return Message(f"{OUT}/{metric}", b"", retain_requested=True)


def but(flags: int, *interfaces: I) -> Message:
    """A manifest of the same MCU with these interfaces, all with these flags."""
    return described(SPY.but(interfaces=tuple(I(**{**vars(one), "flags": flags}) for one in interfaces)))


@pytest.fixture
def topics() -> PrivateTopics:
    return PrivateTopics(BASE)


def passed(topics: PrivateTopics, message: Message) -> list[str]:
    return [admitted.topic.removeprefix(f"{OUT}/") for admitted in topics.admit(message)]


FAST, SLOW = ("mcu/spy-1/fast", "lab/fast"), ("mcu/spy-1/slow", "lab/slow")
DESCRIBE = "mcu/spy-1/describe"
SECRET = value("mcu/spy-1/secret", retain_requested=True)
NONSENSE = (b"", b"{", b'{"device_uid": 5}', b'["device_uid"]', b"\xff\xfe", sample("slow"))
#: What is offered one after the other, and what passes then: the message, nothing, or the topics that are named.
HISTORIES: dict[str, list[tuple[Message, bool | list[str]]]] = {
    "what is private stays, and what is not passes": [
        (described(), True),
        *((value(metric), False) for metric in (*FAST, "mcu/spy-1/secret", "lab/secret")),
        *((value(metric), True) for metric in SLOW),
    ],
    "a private value before its manifest is dropped": [
        *((value(metric, "fast"), False) for metric in (*FAST, "anywhere/else")),
        (described(), True),
        *((value(metric, "fast"), False) for metric in (*FAST, "anywhere/else")),
    ],
    # Retained messages arrive in any order, and later subscribers need the state of a socket.
    **{
        f"a value with {flag} waits for its manifest": [
            *((value(metric, **{flag: True}), False) for metric in (*SLOW, "lab/secret")),
            (described(), [DESCRIBE, *SLOW]),
            (described(), True),
        ]
        for flag in ("retain", "retain_requested")
    },
    "a retained value that was cleared is not forwarded later": [
        *(step for one in SLOW for step in ((value(one, retain=True), False), (cleared(one), True))),
        (described(), True),
    ],
    "published while private, it stays so after new firmware made it public: the manifest first": [
        *((described(), True), (SECRET, False)),
        *((but(wire.RETAIN, *SPY.interfaces), True), (SECRET, True)),
    ],
    "published while private, it stays so after new firmware made it public: the value first": [
        *((SECRET, False), (described(), True)),
        *((but(wire.RETAIN, *SPY.interfaces), True), (SECRET, True)),
    ],
    "new firmware may hide what was public": [
        *((described(), True), (cleared(DESCRIBE), True), (value("lab/slow"), False)),
        *((but(wire.LOCAL_ONLY, *SPY.interfaces[:2]), True), (value("lab/slow"), False)),
    ],
    "retracting always passes unless it is private": [
        *((described(), True), (cleared("mcu/spy-1/slow"), True), (cleared("mcu/spy-1/secret"), False))
    ],
    "nonsense is neither an error nor held back": [
        (described(), True),
        *((Message(f"{OUT}/strange", payload), True) for payload in NONSENSE),
        (value("lab/slow"), True),
    ],
    "a manifest that cannot be read concerns no other MCU": [
        (described(SPY, "spy-2"), ["mcu/spy-2/describe"]),
        (Message(f"{OUT}/{DESCRIBE}", b"nonsense", retain_requested=True), False),
        (Message(f"{OUT}/mcu/spy-2/slow", b"1"), True),
    ],
}


@pytest.mark.parametrize("history", HISTORIES.values(), ids=HISTORIES)
def test_what_passes(topics: PrivateTopics, history: list[tuple[Message, bool | list[str]]]) -> None:
    for message, passes in history:
        expected = [message.topic.removeprefix(f"{OUT}/")] if passes is True else passes or []
        assert passed(topics, message) == expected, message


def test_which_topics_are_known_as_private(topics: PrivateTopics) -> None:
    """Uid queries do not leave the robot; other messages are not concerned."""
    incoming = [f"{BASE}/incoming/{metric}" for metric in ("mcu/spy-1/describe", "mcu/spy-1/tune", "lab/tune")]
    public = [f"{BASE}/incoming/lab/set", f"{BASE}/incoming/mcu/spy-1/set", f"{OUT}/mcu/spy-1/describe"]
    assert [topics.is_known(topic) for topic in (*incoming, *public)] == [True] + [False] * 5
    topics.admit(described())
    assert [topics.is_known(topic) for topic in (*incoming, *public)] == [True] * 3 + [False] * 3
    for topic in (f"{OUT}/charging-level", f"{BASE}/incoming/drive-values", "elsewhere/entirely"):
        assert topics.admit(Message(topic, b'{"value": 1}')) == [Message(topic, b'{"value": 1}')]


def test_memory_is_bounded(topics: PrivateTopics) -> None:
    for number in range(300):
        assert passed(topics, value(f"lab/slow-{number}", "slow", retain=True)) == []
    assert len(topics.admit(described())) == 1 + 256, "waiting values"
    for number in range(300):
        topics.admit(described(SPY, f"spy-{number}"))
    slow = [Message(f"{OUT}/mcu/spy-{number}/slow", b"{}") for number in range(300)]
    assert sum(len(topics.admit(message)) for message in slow) == 256, "MCUs"


# -- manifests that are only partly readable

PLAIN: dict[str, Any] = json.loads(manifest())
#: Replacements for any value of a manifest; ``...`` removes the key.
ODD = (..., None, 5, -0.5, True, "", "nonsense", "a/b", "+", "x" * 5000, [], {}, [None], {"a": 1})
GIVEN = ODD[1:]
#: The generic topic and the alias of each interface.
TOPICS = {
    one["name"]: [f"{way}/mcu/spy-1/{one['name']}", f"{way}/{one['channel']}"]
    for one in PLAIN["interfaces"]
    for way in ["incoming" if one["dir"] == "in" else "outgoing"]
}
BY_NAME: dict[str, dict[str, Any]] = {one["name"]: one for one in PLAIN["interfaces"]}
HIDDEN = {name for name in TOPICS if BY_NAME[name].get("local_only")}
PUBLIC = set(TOPICS) - HIDDEN
#: Replacements that are valid: other names.
MEANT = {"name": ("nonsense",), "channel": ("", "nonsense", "a/b")}


def without_holes(plain: dict[str, Any]) -> dict[str, Any]:
    return {key: given for key, given in plain.items() if given is not ...}


def announced(raw: bytes | dict[str, Any]) -> Message:
    payload = raw if isinstance(raw, bytes) else json.dumps(without_holes(raw)).encode()
    return Message(f"{OUT}/mcu/spy-1/describe", payload, retain_requested=True)


def with_interface(which: str, entry: object) -> dict[str, Any]:
    return {**PLAIN, "interfaces": [entry if one["name"] == which else one for one in PLAIN["interfaces"]]}


def opened() -> Message:
    """Return a manifest of the same MCU with all interfaces public."""
    return announced({**PLAIN, "interfaces": [{**one, "local_only": False} for one in PLAIN["interfaces"]]})


def leaving(topics: PrivateTopics) -> set[str]:
    """Return the interfaces of which any message passes: with a full, a partial or an unrelated body."""
    left = set()
    for name, suffixes in TOPICS.items():
        bodies = [sample(name), b'{"device_uid": "spy-1", "interface": "%s"}' % name.encode(), b'{"speed": 1}']
        for suffix, body in itertools.product(suffixes, bodies):
            left |= {name for _ in topics.admit(Message(f"{BASE}/{suffix}", body))}
    return left


#: Manifests, and the interfaces that leave the robot with each.
PARTLY_READABLE: dict[str, list[tuple[dict[str, Any], set[str]]]] = {
    "whole": [(PLAIN, PUBLIC)],
    "the interfaces alone": [({"interfaces": PLAIN["interfaces"]}, PUBLIC)],
    "the rest of a manifest is missing or odd": [
        ({**PLAIN, key: odd}, PUBLIC) for key in PLAIN.keys() - {"interfaces"} for odd in ODD
    ],
    "the rest of an interface is missing or odd": [
        (with_interface(which, without_holes({**BY_NAME[which], key: odd})), PUBLIC)
        for which in HIDDEN
        for key in {key for one in PLAIN["interfaces"] for key in one} - {"local_only"}
        for odd in ODD
        if odd not in MEANT.get(key, ())
    ],
    "only false makes an interface public": [
        (with_interface(which, {**BY_NAME[which], "local_only": odd}), PUBLIC - {which})
        for which in TOPICS
        for odd in GIVEN
    ],
    "an interface that cannot be read stays, and the others do not": [
        (with_interface(which, odd), PUBLIC - {which}) for which in TOPICS for odd in GIVEN
    ],
}


@pytest.mark.parametrize("manifests", PARTLY_READABLE.values(), ids=PARTLY_READABLE)
def test_of_a_partly_readable_manifest_what_is_public_leaves(manifests: list[tuple[dict[str, Any], set[str]]]) -> None:
    for plain, public in manifests:
        topics = PrivateTopics(BASE)
        topics.admit(opened())
        assert leaving(topics) == set(TOPICS)
        assert passed(topics, announced(plain)) == ["mcu/spy-1/describe"]
        assert leaving(topics) == public, plain
        unread = set(TOPICS) - public
        assert {name for name in TOPICS if topics.is_known(f"{BASE}/{TOPICS[name][1]}")} == unread, plain


@pytest.mark.parametrize(
    "raw",
    [
        *({**PLAIN, "interfaces": odd} for odd in ODD if odd != []),
        *(json.dumps(odd).encode() for odd in GIVEN),
        b"nonsense",
        manifest()[:-1],
        manifest().replace(b"spy-1", b"\xff"),
        b'{"a": ' + b"[" * 50 + b"]" * 50 + b"," + manifest()[1:],
    ],
)
def test_without_interfaces_nothing_of_the_mcu_leaves(topics: PrivateTopics, raw: bytes | dict[str, Any]) -> None:
    assert passed(topics, announced(raw)) == []
    assert [suffix for suffixes in TOPICS.values() for suffix in suffixes[:1]
            if topics.admit(Message(f"{BASE}/{suffix}", b"1"))] == []  # fmt: skip
    topics.admit(opened())
    assert passed(topics, announced(raw)) == []
    assert leaving(topics) == set()
    assert all(topics.is_known(f"{BASE}/{suffix}") for suffixes in TOPICS.values() for suffix in suffixes)
    topics.admit(announced(PLAIN))
    assert leaving(topics) == PUBLIC


_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
_interface = st.fixed_dictionaries(
    {},
    optional={
        "name": st.sampled_from(sorted(TOPICS)) | _json,
        "dir": st.sampled_from(["in", "out"]) | _json,
        "channel": st.sampled_from(sorted(suffixes[1].partition("/")[2] for suffixes in TOPICS.values())) | _json,
        "local_only": st.booleans() | _json,
        "encoding": _json,
    },
)
_manifest = st.fixed_dictionaries(
    {}, optional={"interfaces": st.lists(_interface | _json, max_size=5) | _json, "schema_version": _json, "x": _json}
)


@settings(max_examples=cases(100, 400))
@given(st.lists(_manifest | _json, min_size=1, max_size=3))
def test_all_readable_parts_of_any_manifest_are_retained(manifests: list[Any]) -> None:
    topics = PrivateTopics(BASE)
    topics.admit(opened())
    for plain in manifests:
        topics.admit(announced(json.dumps(plain).encode()))
    entries = [one for one in as_list(as_dict(plain).get("interfaces")) if isinstance(one, dict)]
    private = {
        (way, str(one.get(key)))
        for one in entries
        for key, way in itertools.product(("name", "channel"), ways(one))
        if one.get("local_only", False) is not False
    }
    public = {
        str(one.get("name")) for one in entries if one.get("local_only", False) is False and "outgoing" in ways(one)
    }
    messages = {
        (name, suffix): Message(f"{BASE}/{suffix}", body)
        for name, suffixes in TOPICS.items()
        for suffix, body in zip(suffixes, (b"1", sample(name)), strict=True)
    }
    left = {place for place, message in messages.items() if topics.admit(message)}
    assert {name for name, suffix in left if suffix.startswith("outgoing/")} <= public
    assert {(suffix.partition("/")[0], name) for name, suffix in left} & private == set()
    raw = {suffix for _, suffix in messages if topics.admit(Message(f"{BASE}/{suffix}", b"1"))}
    assert {(suffix.partition("/")[0], suffix.partition("/")[2]) for suffix in raw} & private == set()


def as_dict(plain: object) -> dict[str, Any]:
    return plain if isinstance(plain, dict) else {}


def as_list(plain: object) -> list[Any]:
    return plain if isinstance(plain, list) else []


def ways(one: dict[str, Any]) -> tuple[str, ...]:
    """Return the directions of an interface; both if its direction is not readable."""
    given_ = one.get("dir")
    return ("incoming",) if given_ == "in" else ("outgoing",) if given_ == "out" else ("incoming", "outgoing")


# -- with real bridges


@pytest.fixture(params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[SerialRig]:
    rig = SerialRig(request.param, tmp_path)
    yield rig
    rig.close()


class World:
    """A remote broker, an operator that subscribes to everything there, and a bridge that can be restarted."""

    def __init__(self, rig: SerialRig) -> None:
        self.rig = rig
        self.broker = Broker(rig.folder)
        self.operator = Listener(create("mqtt", "operator", MqttSettings(host="127.0.0.1", port=self.broker.port)))
        self.bridge: Running | None = None

    def start(self) -> None:
        section = {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": self.broker.port}}
        config = self.rig.network.config(self.rig.folder, {}, mqtt_bridge=section)
        service = MqttBridge(config, self.rig.network.robots_transport(config, "local-bridge", as_published=True))
        self.bridge = Running(service)
        assert until(lambda: gate_of(service) is Gate.OPEN)

    def stop(self) -> None:
        if self.bridge is not None:
            self.bridge.stop()
            self.bridge = None

    def close(self) -> None:
        self.stop()
        self.operator.transport.close()
        self.broker.stop()


@pytest.fixture
def world(rig: SerialRig) -> Iterator[World]:
    world = World(rig)
    yield world
    world.close()


def test_nothing_private_leaves_the_robot_in_any_start_order(rig: SerialRig, world: World) -> None:
    world.start()  # the first time before the MCU is known
    mcu = rig.mcu(SPY)
    line = rig.bridge()
    rig.described("spy-1")
    mcu.stream(300, b"\1")
    assert rig.got("lab/fast")
    for round_ in range(cases(2, 4)):  # then while the MCU sends values
        world.stop()
        mcu.send(wire.frame(wire.STATE, bytes([round_]), 2), wire.frame(wire.STATE, bytes([round_]), 3))
        mcu.send(wire.frame(wire.SAMPLE, motion(), 6), wire.frame(wire.STATE, b"\0" * 18, 7))
        world.start()
        assert until(lambda r=round_: {"v": r} in world.operator.values("lab/slow"), 5), "retained, and from before"
        mcu.send(wire.frame(wire.STATE, bytes([round_ + 100]), 2), wire.frame(wire.SAMPLE, motion(), 6))
        assert until(lambda r=round_: {"v": r + 100} in world.operator.values("lab/slow"), 5)
    mcu.unplug()
    assert world.operator.cleared("mcu/spy-1/describe")
    mcu.plug()
    world.operator.described("spy-1")
    time.sleep(0.5)
    line.stop()
    assert world.operator.cleared("lab/slow")
    received = {message.topic.removeprefix(f"{OUT}/") for message in world.operator.received}
    assert {metric for metric in PRIVATE if rig.world.on(metric)} == set(PRIVATE), "they were published locally"
    assert received & set(PRIVATE) == set()
    assert {"mcu/spy-1/slow", "lab/slow", "mcu/spy-1/describe"} <= received


def test_private_commands_are_for_the_robot_only(rig: SerialRig, world: World) -> None:
    mcu = rig.mcu(SPY)
    rig.bridge()
    world.start()
    assert world.operator.got("mcu/spy-1/describe")
    assert rig.claimed()

    def received(value: int) -> list[int]:
        return [command.interface for command in mcu.commands() if command.payload == bytes([value])]

    def samples_under_alias() -> list[int]:
        """Send a command to the alias: its start is not announced, so the test tries until one arrives."""
        world.operator.command("lab/set", {"v": 3})
        return received(3)

    assert until(samples_under_alias, step=0.2)
    for metric in ("mcu/spy-1/tune", "lab/tune", "mcu/spy-1/set", "lab/set"):
        world.operator.command(metric, {"v": 1})
    assert until(lambda: len(received(1)) == 2)
    rig.world.command("lab/tune", {"v": 2})
    assert until(lambda: received(2))
    assert (received(1), received(2)) == ([4, 4], [5])
