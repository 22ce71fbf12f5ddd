"""Frames, values and manifests of pebble_serial_v1: known vectors, every type, and what is refused, with its reason."""

from __future__ import annotations

import math
import struct
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.errors import PayloadError
from pebble.runtime.lines import LineSplitter
from pebble.services.serial_mcu_bridge.pebble_serial_v1 import frame, struct_v1
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import FRAME_LIMIT, Frame, FrameError, Type
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import Hello, parse_describe, parse_hello
from pebble.services.serial_mcu_bridge.pebble_serial_v1.struct_v1 import Field, FieldType, pack, size, unpack
from tests.ext.boards import mcu_wire as wire
from tests.ext.boards.mcu_wire import IMU, STATION, F, I, M


def test_the_known_vectors() -> None:
    request = "03 01 02 01 01 01 01 01 01 01 01 01 01 03 85 6b 00"
    command = "03 01 20 02 03 02 01 01 01 01 01 01 01 04 01 9b 7c 00"
    assert frame.encode(Frame(Type.DESCRIBE_REQ)).hex(" ") == request
    assert frame.encode(Frame(Type.CMD, b"\x01", interface=3, sequence=1)).hex(" ") == command
    assert frame.crc(b"123456789") == 0x29B1
    wrapped = frame.decode(frame.encode(Frame(Type.PING, sequence=2**32 + 5, timestamp=2**40 + 7))[:-1])
    assert (wrapped.sequence, wrapped.timestamp) == (5, 7)


BLOCKS = [b"\xff" * length + tail for length in (253, 254, 255, 508) for tail in (b"", b"\0", b"\0x")]


@given(st.binary(max_size=1200) | st.sampled_from(BLOCKS))
def test_stuffing_there_and_back(data: bytes) -> None:
    stuffed = frame.stuff(data)
    assert 0 not in stuffed
    assert stuffed == wire.stuff(data)
    assert frame.unstuff(stuffed) == data
    assert frame.unstuff(frame.stuff(b"x" * 254) + b"\x01") == b"x" * 254, "an encoder may close a full last block"


@pytest.mark.parametrize("stuffed", [b"\x02", b"\xff" + b"x" * 253, b"\x03a\0"])
def test_what_stuffing_cannot_have_made(stuffed: bytes) -> None:
    with pytest.raises(PayloadError):
        frame.unstuff(stuffed)


@given(
    st.sampled_from(Type),
    st.binary(max_size=600),
    st.integers(0, 2**16 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**32 - 1),
)
def test_frames_there_and_back(kind: Type, payload: bytes, interface: int, sequence: int, ms: int) -> None:
    encoded = frame.encode(Frame(kind, payload, interface, sequence, ms))
    assert encoded == wire.frame(kind, payload, interface, sequence, ms)
    assert frame.decode(encoded[:-1]) == Frame(kind, payload, interface, sequence, ms)


@pytest.mark.parametrize(
    ("stuffed", "subject"),
    [
        (b"\x07abc", "stuffing"),
        (wire.stuff(b""), "short"),
        (wire.sealed(wire.body(wire.PONG)[:-1])[:-1], "short"),
        (wire.stuff(wire.body(wire.PONG) + b"\0\0"), "crc"),
        (wire.sealed(wire.body(wire.PONG, version=2))[:-1], "version"),
        (wire.frame(0x7F)[:-1], "type"),
    ],
)
def test_what_is_no_frame_is_refused_by_name(stuffed: bytes, subject: str) -> None:
    with pytest.raises(FrameError) as caught:
        frame.decode(stuffed)
    assert caught.value.subject == subject
    assert "frame" in str(caught.value)


def test_a_stream_without_end_is_thrown_away_up_to_the_next_zero() -> None:
    splitter = LineSplitter(FRAME_LIMIT, frame.END)
    good = wire.frame(wire.PONG)
    found = []
    for chunk in (good[:5], good[5:], *(b"x" * 1000 for _ in range(50)), good, good):
        found += splitter.feed(chunk)
    assert found == [good[:-1], good[:-1]], "the first frame after the endless one is discarded with it"
    assert splitter.discarded_lines == 1
    splitter = LineSplitter(FRAME_LIMIT, frame.END)
    assert splitter.feed(b"x" * FRAME_LIMIT + b"\0" + b"x" * (FRAME_LIMIT + 1) + b"\0") == [b"x" * FRAME_LIMIT]


INTEGERS = {
    FieldType.U8: ("B", 0, 2**8 - 1),
    FieldType.I8: ("b", -(2**7), 2**7 - 1),
    FieldType.U16: ("H", 0, 2**16 - 1),
    FieldType.I16: ("h", -(2**15), 2**15 - 1),
    FieldType.U32: ("I", 0, 2**32 - 1),
    FieldType.I32: ("i", -(2**31), 2**31 - 1),
}
f32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
scales = st.sampled_from([1.0, 0.001, 0.01, 0.1, 0.5, 2.0, 10.0, -1.0, -0.25, 100.0])
offsets = st.sampled_from([0.0, 1.0, -40.0, 0.5, 273.15])


@pytest.mark.parametrize(("kind", "code", "low", "high"), [(kind, *rest) for kind, rest in INTEGERS.items()])
def test_integers_stay_integers(kind: FieldType, code: str, low: int, high: int) -> None:
    field = (Field("v", kind),)
    for number in (low, high, 0, 1, high // 2):
        raw = struct.pack("<" + code, number)
        assert unpack(field, raw) == {"v": number}
        assert type(unpack(field, raw)["v"]) is int
        assert pack(field, {"v": number}) == raw
    for number in (low - 1, high + 1, 10**400, -(10**400)):
        with pytest.raises(PayloadError, match="v is"):
            pack(field, {"v": number})


@given(st.sampled_from(sorted(INTEGERS)), scales, offsets, st.data())
def test_scaled_integers_there_and_back(kind: FieldType, scale: float, offset: float, data: st.DataObject) -> None:
    code, low, high = INTEGERS[kind]
    raw = struct.pack("<" + code, data.draw(st.integers(low, high)))
    fields = (Field("v", kind, scale, offset),)
    assert pack(fields, unpack(fields, raw)) == raw


@given(f32, scales, offsets)
def test_f32_there_and_back(value: float, scale: float, offset: float) -> None:
    plain = (Field("v", FieldType.F32),)
    raw = struct.pack("<f", value)
    assert pack(plain, unpack(plain, raw)) == raw
    scaled = (Field("v", FieldType.F32, scale, offset),)
    try:
        back = pack(scaled, unpack(scaled, raw))
    except PayloadError:  # at the edge of what an f32 can hold
        assert abs(value) > 3e38
    else:
        (again,) = struct.unpack("<f", back)
        assert again == pytest.approx(value, rel=1e-5, abs=1e-4)


@given(f32)
def test_the_shortest_decimal_is_the_same_f32(value: float) -> None:
    short = struct_v1.shortest(struct.unpack("<f", struct.pack("<f", value))[0])
    assert struct.pack("<f", short) == struct.pack("<f", value)


#: Fields, a value of theirs, and its bytes. The original applies the scale of an F32 when it decodes, not when it
#: encodes; without a scale both agree.
PACKED: list[tuple[Field, Any, bytes]] = [
    (Field("v", FieldType.F32, 0.5, 1.0), 3.0, struct.pack("<f", 4.0)),
    (Field("v", FieldType.F32), 3.0, struct.pack("<f", 3.0)),
    (Field("v", FieldType.U8, 0.1), 1.26, b"\x0d"),
    (Field("v", FieldType.U8), 2.6, b"\x03"),
    *((Field("v", FieldType.BOOL), value, bytes([value])) for value in (False, True)),
]


@pytest.mark.parametrize(("field", "value", "raw"), PACKED)
def test_values_are_packed(field: Field, value: Any, raw: bytes) -> None:
    assert pack((field,), {"v": value}) == raw


#: Any byte but zero is true, and values have no binary rounding errors.
UNPACKED: list[tuple[Field, bytes, Any]] = [
    *((Field("v", FieldType.BOOL), raw, value) for raw, value in ((b"\0", False), (b"\1", True), (b"\7", True))),
    (Field("v", FieldType.U8, struct_v1.shortest(struct.unpack("<f", struct.pack("<f", 0.1))[0])), b"\x03", 0.3),
    (Field("v", FieldType.F32), struct.pack("<f", 0.1), 0.1),
    (Field("v", FieldType.U32, 0.1), b"\xff\xff\xff\xff", 429496729.5),
]


@pytest.mark.parametrize(("field", "raw", "value"), UNPACKED)
def test_values_are_unpacked(field: Field, raw: bytes, value: Any) -> None:
    assert unpack((field,), raw) == {"v": value}


#: The original Pebble switches on by the text "false". Numbers are refused, too, as on every control.
NO_BOOLEANS = ["false", 1, None]
NO_NUMBERS = ["1", True, math.nan, -math.inf]


@pytest.mark.parametrize(
    ("field", "value", "why"),
    [
        *((Field("v", FieldType.BOOL), value, "v is a boolean: true or false") for value in NO_BOOLEANS),
        *((Field("v", FieldType.U8), value, "v is not a number") for value in NO_NUMBERS),
        *((Field("v", FieldType.F32), value, "v is not a number") for value in NO_NUMBERS),
        (Field("v", FieldType.I8, 0.1, unit="deg"), 13, r"v is out of range: -12\.8 to 12\.7 deg"),
        (Field("v", FieldType.I8, -1.0), 500, r"out of range: -127\.0 to 128\.0"),
        (Field("v", FieldType.F32), 1e39, "too large"),
        (Field("v", FieldType.I8, 1e-30), 1e300, "v is "),
        (Field("v", FieldType.F32, 1e-30), 1e300, "v is "),
    ],
)
def test_what_a_field_cannot_hold_is_refused_in_its_unit(field: Field, value: Any, why: str) -> None:
    with pytest.raises(PayloadError, match=why):
        pack((field,), {"v": value})


def test_missing_fields_are_named_and_others_ignored() -> None:
    fields = (Field("a", FieldType.U8), Field("b", FieldType.U16))
    with pytest.raises(PayloadError, match="b is missing"):
        pack(fields, {"a": 1})
    assert pack(fields, {"b": 2, "a": 1, "t": 17}) == b"\1\2\0"


def test_readings_have_exactly_the_length_of_their_fields_and_are_numbers() -> None:
    fields = (Field("a", FieldType.U8), Field("b", FieldType.U16))
    assert size(fields) == 3
    for length in (0, 1, 2, 4, 300):
        with pytest.raises(PayloadError, match=f"{length} bytes, not the 3"):
            unpack(fields, bytes(length))
    for value in (math.nan, math.inf, -math.inf):
        with pytest.raises(PayloadError, match="v is not a finite number"):
            unpack((Field("v", FieldType.F32),), struct.pack("<f", value))
    assert (unpack((), b""), pack((), {"anything": 1})) == ({}, b""), "an interface without fields"


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
        (M("😀" * 60), "the manifest"),
        (M("😀" * 30, (I(1, "😀" * 60, wire.OUT, wire.KIND_STATE),)), "😀" * 40),
        (M("u", (I(1, "lamp", wire.IN, wire.KIND_COMMAND, channel="/".join(["😀" * 31] * 2)),)), "lamp"),
    ],
    ids=["uid", "name", "channel"],
)
def test_names_that_make_no_topic_of_this_robot_are_refused(manifest: M, named: str) -> None:
    longest = "/".join(["😀" * 64] * 3)
    with pytest.raises(
        PayloadError, match=rf"^{named}: its topic has 1\d\d\d bytes, more than 1024: shorten the names"
    ):
        parse_describe(manifest.describe(), longest)
    assert parse_describe(manifest.describe(), "pebble/robots/goob").uid == manifest.uid
    assert parse_describe(IMU.describe(), longest).uid == "goob-imu-nano"


def one(**changes: Any) -> bytes:
    interface = {"id": 1, "name": "a", "dir": wire.OUT, "kind": wire.KIND_STATE, "fields": (F("v", wire.U8),)}
    return M("u", (I(**{**interface, **changes}),)).describe()


def field(**changes: Any) -> bytes:
    return one(fields=(F(**{"name": "v", "type": wire.U8, **changes}),))


BAD_NAMES: list[str] = ["", "a/b", "+", "$SYS", "{uid}", "n" * 65]
BAD_CHANNELS = ["/a", "a//b", "a/#", "$share/a"]
SCALES: list[dict[str, float]] = [{"scale": 0.0}, {"scale": math.nan}, {"offset": -math.inf}]


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "ends after 0 bytes"),
        (one()[:-1], "in the middle"),
        (one() + b"\0", "1 bytes too many"),
        (M("u", ()).describe()[:1] + b"\xff" + M("u", ()).describe()[2:], "255 interfaces, more than 64"),
        (one(name=b"\xff"), "is not UTF-8"),
        *((one(name=name), "must be a topic level") for name in BAD_NAMES),
        (one(name="describe"), '"describe" is taken'),
        *((one(channel=channel), "in the channel") for channel in BAD_CHANNELS),
        (one(channel="/".join("abcdefghi")), "9 levels, more than 8"),
        (one(id=0), "id 0 is the protocol's own"),
        (one(dir=3), "unknown direction 3"),
        (one(kind=9), "unknown kind 9"),
        (one(dir=wire.IN), "a state cannot go in"),
        (one(kind=wire.KIND_COMMAND), "a command cannot go out"),
        (one(encoding=2), "unknown encoding 2"),
        (one(fields=tuple(F(f"f{n}", wire.U8) for n in range(65))), "65 fields, more than 64"),
        (one(fields=(F("v", wire.U8), F("v", wire.U16))), "'v' is there twice"),
        (field(type=9), "unknown type 9"),
        (field(name=""), "is no name of a field"),
        *((field(**changes), "make no number") for changes in SCALES),
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


def test_every_beginning_of_a_manifest_is_refused_and_nothing_else_is_raised() -> None:
    whole = STATION.describe()
    for length in range(len(whole)):
        with pytest.raises(PayloadError):
            parse_describe(whole[:length])


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
    for payload in (*(IMU.hello()[:length] for length in range(len(IMU.hello()))), IMU.hello() + b"\0"):
        with pytest.raises(PayloadError):
            parse_hello(payload)
