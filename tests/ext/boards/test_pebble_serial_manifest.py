"""HELLO and DESCRIBE: manifests of the original Pebble's devices, and everything that is refused, with its reason."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.config import parse
from pebble.errors import PayloadError
from pebble.services.serial_mcu_bridge.devices.described_bridge import DescribedBridge
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import (
    Hello,
    parse_describe,
    parse_hello,
)
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.boards import mcu_wire as wire
from tests.ext.boards.mcu_wire import IMU, STATION, F, I, M


def test_the_published_manifest_has_exactly_the_keys_of_the_wire() -> None:
    plain = msgspec.json.decode(msgspec.json.encode(parse_describe(IMU.describe()).payload()))
    assert list(plain) == [
        "protocol", "schema_version", "interface_count", "schema_hash",
        "device_uid", "firmware_version", "model", "interfaces",
    ]  # fmt: skip
    assert plain["protocol"] == "pebble_serial_v1"
    fast, slow = plain["interfaces"]
    keys = ["id", "name", "dir", "kind", "channel", "profile", "rate_hz", "encoding"]
    assert list(slow) == keys
    assert list(fast) == [*keys, "local_only"]
    assert fast["local_only"] is True
    assert (fast["dir"], fast["kind"]) == ("out", "sample")
    assert fast["encoding"]["kind"] == "struct_v1"
    assert fast["encoding"]["fields"][0] == {"name": "ax", "type": "i16", "scale": 0.001, "unit": "mps2"}
    assert slow["encoding"]["fields"][4] == {"name": "samples_ok", "type": "u32"}
    command, state = msgspec.to_builtins(parse_describe(STATION.describe()).payload())["interfaces"][:2]
    assert (command["dir"], command["kind"]) == ("in", "command")
    assert list(state) == [*keys, "retain"]


@pytest.mark.parametrize(
    ("manifest", "named"),
    [
        (M("😀" * 30, (I(1, "😀" * 60, wire.OUT, wire.KIND_STATE),)), "😀" * 40),
        (M("u", (I(1, "lamp", wire.IN, wire.KIND_COMMAND, channel="/".join(["😀" * 31] * 2)),)), "lamp"),
    ],
    ids=["name", "channel"],
)
def test_names_that_make_no_topic_of_this_robot_are_refused(manifest: M, named: str) -> None:
    longest = "/".join(["😀" * 64] * 3)
    with pytest.raises(
        PayloadError, match=rf"^{named}: its topic has 1\d\d\d bytes, more than 1024: shorten the names"
    ):
        parse_describe(manifest.describe(), longest)
    assert len(parse_describe(manifest.describe(), "pebble/robots/goob").interfaces) == 1
    assert parse_describe(IMU.describe(), longest).uid == "goob-imu-nano"


def test_a_bridge_of_a_robot_with_long_names_refuses_such_a_manifest_and_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    level = "😀" * 64
    raw = {
        "robot": {"system": level, "type": level, "id": level},
        "services": {"serial_mcu_bridge": {"protocol": "pebble_serial_v1", "serial": {"port": "/dev/none"}}},
    }
    config = parse(raw, folder=Path("/nowhere"), env={})
    with MemoryTransport("mcu", MemoryHub()) as transport:
        bridge = DescribedBridge(config, transport)
        bridge.on_input(wire.frame(wire.DESCRIBE, M("😀" * 60).describe()))
        assert "DESCRIBE refused: the manifest: its topic has 10" in caplog.text
        bridge.on_input(wire.frame(wire.DESCRIBE, IMU.describe()))
    assert bridge.counters["describe"] == 1


def one(**changes: Any) -> bytes:
    interface = {"id": 1, "name": "a", "dir": wire.OUT, "kind": wire.KIND_STATE, "fields": (F("v", wire.U8),)}
    return M("u", (I(**{**interface, **changes}),)).describe()


def field(**changes: Any) -> bytes:
    return one(fields=(F(**{"name": "v", "type": wire.U8, **changes}),))


BAD_NAMES: list[str] = ["", "a/b", "a#", "+", "$SYS", "a\nb", "{uid}", "n" * 65]
BAD_CHANNELS = ["/a", "a//b", "a/", "a/#", "a/+/b", "$share/a", "a/b\0c"]
SCALES: list[dict[str, float]] = [{"scale": 0.0}, {"scale": math.nan}, {"scale": math.inf}, {"offset": -math.inf}]


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "ends after 0 bytes"),
        (one()[:-1], "in the middle"),
        (one() + b"\0", "1 bytes too many"),
        (M("u", ()).describe()[:1] + b"\xff" + M("u", ()).describe()[2:], "255 interfaces, more than 64"),
        (one(name=b"\xff"), "is not UTF-8"),
        (one(channel=b"a/\xc3\x28"), "is not UTF-8"),
        *((one(name=name), "must be a topic level") for name in BAD_NAMES),
        (one(name="describe"), '"describe" is taken'),
        *((one(channel=channel), "in the channel") for channel in BAD_CHANNELS),
        (one(channel="/".join("abcdefghi")), "9 levels, more than 8"),
        (one(id=0), "id 0 is the protocol's own"),
        (one(dir=3), "unknown direction 3"),
        (one(dir=0), "unknown direction 0"),
        (one(kind=9), "unknown kind 9"),
        (one(dir=wire.IN), "a state cannot go in"),
        (one(kind=wire.KIND_COMMAND), "a command cannot go out"),
        (one(encoding=2), "unknown encoding 2"),
        (one(fields=tuple(F(f"f{n}", wire.U8) for n in range(65))), "65 fields, more than 64"),
        (one(fields=(F("v", wire.U8), F("v", wire.U16))), "'v' is there twice"),
        (field(type=0), "unknown type 0"),
        (field(type=9), "unknown type 9"),
        (field(name=""), "is no name of a field"),
        (field(name="\x07"), "is no name of a field"),
        *((field(**changes), "make no number") for changes in SCALES),
        (M("").describe(), "device uid ''"),
        (M("a/b").describe(), "device uid 'a/b'"),
        (M(b"\xff\xfe").describe(), "is not UTF-8"),
        (M("u", (I(1, "a", wire.OUT, wire.KIND_STATE), I(1, "b", wire.OUT, wire.KIND_STATE))).describe(),
         "interface id 1"),
        (M("u", (I(1, "a", wire.OUT, wire.KIND_STATE), I(2, "a", wire.OUT, wire.KIND_STATE))).describe(),
         "out-going interface name 'a'"),
    ],
)  # fmt: skip
def test_refused_with_its_reason(payload: bytes, reason: str) -> None:
    with pytest.raises(PayloadError) as caught:
        parse_describe(payload)
    assert reason in str(caught.value)


def test_what_is_understood_all_the_same() -> None:
    """A command and its report may share a name, a boolean has no scale, and flags of the future are ignored."""
    assert parse_describe(one()).interfaces[0].name == "a", "the template of the cases above is good"
    both = M("u", (I(1, "led", wire.IN, wire.KIND_COMMAND), I(2, "led", wire.OUT, wire.KIND_STATE)))
    assert len(parse_describe(both.describe()).interfaces) == 2
    described = parse_describe(field(type=wire.BOOL, scale=0.0, offset=math.nan)).interfaces[0].fields[0]
    assert (described.scale, described.offset) == (1.0, 0.0)
    interface = parse_describe(one(flags=0xFF)).interfaces[0]
    assert (interface.retain, interface.local_only) == (True, True)


def test_a_hello_is_exact() -> None:
    assert parse_hello(IMU.hello()) == Hello(1, 2, "goob-imu-v2", "goob-imu-nano", "2", "arduino-nano")
    for payload in (b"", b"\1", IMU.hello()[:-1], IMU.hello() + b"\0", M(b"\xc0").hello()):
        with pytest.raises(PayloadError):
            parse_hello(payload)


def test_every_beginning_of_a_manifest_is_refused_and_nothing_else_is_raised() -> None:
    whole = STATION.describe()
    for length in range(len(whole)):
        with pytest.raises(PayloadError):
            parse_describe(whole[:length])
