"""The encoding ``struct_v1``: converts an interface's fields between packed little-endian numbers and JSON's."""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Any

from pebble.errors import PayloadError

_DIGITS = 12  # significant ones of a scaled value: more than any field holds, and 0.1 × 3 is 0.3


class FieldType(IntEnum):
    """The type of a field, by its number in a manifest."""

    BOOL = 1
    U8 = 2
    I8 = 3
    U16 = 4
    I16 = 5
    U32 = 6
    I32 = 7
    F32 = 8

    @property
    def word(self) -> str:
        return self.name.lower()


_CODES = {
    FieldType.BOOL: "?",
    FieldType.U8: "B",
    FieldType.I8: "b",
    FieldType.U16: "H",
    FieldType.I16: "h",
    FieldType.U32: "I",
    FieldType.I32: "i",
    FieldType.F32: "f",
}
_RANGES = {
    FieldType.U8: (0, 2**8 - 1),
    FieldType.I8: (-(2**7), 2**7 - 1),
    FieldType.U16: (0, 2**16 - 1),
    FieldType.I16: (-(2**15), 2**15 - 1),
    FieldType.U32: (0, 2**32 - 1),
    FieldType.I32: (-(2**31), 2**31 - 1),
}


@dataclass(frozen=True, slots=True)
class Field:
    """A number whose value is raw · ``scale`` + ``offset``, in ``unit``. A boolean has no scale."""

    name: str
    type: FieldType
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""

    @property
    def plain(self) -> bool:
        return self.scale == 1.0 and self.offset == 0.0


def size(fields: Sequence[Field]) -> int:
    """Return how many bytes a payload with these fields has."""
    return _layout(tuple(field.type for field in fields)).size


def unpack(fields: Sequence[Field], payload: bytes) -> dict[str, Any]:
    """Return the values by field name. Raises PayloadError for a wrong length, and for a value that is not finite."""
    layout = _layout(tuple(field.type for field in fields))
    if len(payload) != layout.size:
        raise PayloadError(f"{len(payload)} bytes, not the {layout.size} of its fields")
    return {field.name: _value(field, raw) for field, raw in zip(fields, layout.unpack(payload), strict=True)}


def pack(fields: Sequence[Field], values: Mapping[str, Any]) -> bytes:
    """Return ``values`` as a payload. Raises PayloadError for a missing value, or one that its field cannot hold."""
    raw = [_raw(field, values) for field in fields]
    try:
        return _layout(tuple(field.type for field in fields)).pack(*raw)
    except OverflowError:  # only of an f32: integers are range-checked
        raise PayloadError("a number is too large for an f32") from None


@lru_cache(maxsize=256)
def _layout(types: tuple[FieldType, ...]) -> struct.Struct:
    return struct.Struct("<" + "".join(_CODES[kind] for kind in types))


def _value(field: Field, raw: Any) -> Any:
    """Return a field's value for JSON: the packed number, scaled and rounded, so that 3 × 0.1 is 0.3."""
    if field.type is FieldType.BOOL:
        return raw
    if field.type is FieldType.F32:
        if not math.isfinite(raw):
            raise PayloadError(f"{field.name} is not a finite number")
        raw = shortest(raw)  # the decimal with the fewest digits
    if field.plain:  # it has neither scale nor offset
        return raw
    return float(f"{raw * field.scale + field.offset:.{_DIGITS}g}")


def _raw(field: Field, values: Mapping[str, Any]) -> Any:
    """Return the number to pack for a field. Raises PayloadError."""
    if field.name not in values:
        raise PayloadError(f"{field.name} is missing")
    value = values[field.name]
    if field.type is FieldType.BOOL:
        if not isinstance(value, bool):  # 0 and 1 are numbers, "false" is a string: none of them switches anything
            raise PayloadError(f"{field.name} is a boolean: true or false")
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
        raise PayloadError(f"{field.name} is not a number")
    if not field.plain:
        value = (value - field.offset) / field.scale
    if field.type is FieldType.F32:
        if not _is_finite(value):
            raise PayloadError(f"{field.name} is too large")
        return value
    return _integer(field, value)


def _integer(field: Field, value: float) -> int:
    low, high = _RANGES[field.type]
    number = round(value) if _is_finite(value) else None
    if number is None or not low <= number <= high:
        ends = (low, high) if field.plain else sorted((_value(field, low), _value(field, high)))
        raise PayloadError(f"{field.name} is out of range: {ends[0]} to {ends[1]} {field.unit}".rstrip())
    return number


def _is_finite(value: float) -> bool:
    """True if the value is finite as a float; False also for an integer that is too large for one."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def shortest(value: float) -> float:
    """Return the shortest decimal that is the same f32: 0.001 for an f32 that is exactly 0.00100000005."""
    wanted = struct.pack("<f", value)
    for digits in range(6, 9):
        short = float(f"{value:.{digits}g}")
        if _f32(short) == wanted:
            return short
    return float(f"{value:.9g}")


def _f32(value: float) -> bytes:
    try:
        return struct.pack("<f", value)
    except OverflowError:  # the largest f32, rounded up
        return b""
