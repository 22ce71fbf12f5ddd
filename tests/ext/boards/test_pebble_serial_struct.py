"""struct_v1, encoded and decoded: every type, scaled or not, and values that a field cannot hold."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.errors import PayloadError
from pebble.services.serial_mcu_bridge.pebble_serial_v1 import struct_v1
from pebble.services.serial_mcu_bridge.pebble_serial_v1.struct_v1 import Field, FieldType, pack, size, unpack

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


def test_values_have_no_binary_rounding_errors() -> None:
    fields = (Field("a", FieldType.U8, struct_v1.shortest(struct.unpack("<f", struct.pack("<f", 0.1))[0])),)
    assert unpack(fields, b"\x03") == {"a": 0.3}
    assert unpack((Field("a", FieldType.F32),), struct.pack("<f", 0.1)) == {"a": 0.1}
    assert unpack((Field("a", FieldType.U32, 0.1),), b"\xff\xff\xff\xff") == {"a": 429496729.5}


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


def test_any_byte_but_zero_is_true() -> None:
    assert [unpack((Field("on", FieldType.BOOL),), raw)["on"] for raw in (b"\0", b"\1", b"\7")] == [False, True, True]


#: The original Pebble switches on by the text "false". Numbers are refused, too, as on every control.
NO_BOOLEANS = ["false", "true", 0, 1, 0.0, None, [], {}]
NO_NUMBERS = ["1", None, True, [1], {"v": 1}, math.nan, math.inf, -math.inf]


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
