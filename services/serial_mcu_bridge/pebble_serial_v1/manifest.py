"""Parses and checks HELLO and DESCRIBE, the two messages in which an MCU describes itself."""

import math
import re
import struct
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any, Final

from pebble.contract import INCOMING, OUTGOING
from pebble.contract.identity import LEVEL, LEVEL_RULE
from pebble.contract.payloads import McuManifest
from pebble.errors import PayloadError
from pebble.services.serial_mcu_bridge.pebble_serial_v1.struct_v1 import Field, FieldType, shortest
from pebble.transports.topics import MAX_BYTES

PROTOCOL: Final = "pebble_serial_v1"
#: The levels below ``mcu/{uid}/`` that are the topic of the manifest itself, and of the list of what is local_only.
RESERVED, LOCAL_ONLY = "describe", "local-only"

MOST_INTERFACES = 64  # with 64 fields each they exceed FRAME_LIMIT: frame.py says what fits
_MOST_FIELDS = 64  # of one interface
_MOST_LEVELS = 8  # of a channel
_ENCODING_NUMBER, _ENCODING_NAME = 1, "struct_v1"  # so far there is one, so no interface stores which it has
_RETAIN, _LOCAL_ONLY = 1, 2  # bits of an interface's flags; the others are reserved

_level = re.compile(LEVEL).search


class Direction(IntEnum):
    """The direction of an interface as seen from the robot, as in its topics."""

    IN = 1
    OUT = 2


class InterfaceKind(IntEnum):
    SAMPLE = 1
    STATE = 2
    COMMAND = 3
    EVENT = 4


@dataclass(frozen=True, slots=True)
class Interface:
    """A value that the MCU reports, or accepts as a command. ``channel`` is its alias, empty if it has none."""

    id: int
    name: str
    direction: Direction
    kind: InterfaceKind
    retain: bool
    local_only: bool
    rate_hz: int
    channel: str
    profile: str
    fields: tuple[Field, ...]


@dataclass(frozen=True, slots=True)
class Hello:
    """The identity of an MCU and of its manifest, by which a manifest is remembered."""

    schema_version: int
    interface_count: int
    schema_hash: str
    device_uid: str
    firmware_version: str
    model: str


@dataclass(frozen=True, slots=True)
class Manifest:
    hello: Hello
    interfaces: tuple[Interface, ...]

    @property
    def uid(self) -> str:
        return self.hello.device_uid

    def payload(self) -> McuManifest:
        """Return the manifest as published on ``outgoing/mcu/{uid}/describe``, with the keys of the original Pebble."""
        interfaces = [_plain_interface(interface) for interface in self.interfaces]
        return McuManifest(protocol=PROTOCOL, **asdict(self.hello), interfaces=interfaces)


def parse_hello(payload: bytes) -> Hello:
    """Return the HELLO in ``payload``. Raises PayloadError if it is anything else, or more."""
    reader = _Reader(payload)
    hello = _hello(reader)
    reader.end()
    return hello


def parse_describe(payload: bytes, base: str = "") -> Manifest:
    """Return the manifest in ``payload``. PayloadError says what is wrong: bytes missing, invalid topic levels, …

    ``base`` is the beginning of the robot's topics: names that are too long below it are refused, too.
    """
    reader = _Reader(payload)
    hello = _hello(reader)
    if hello.interface_count > MOST_INTERFACES:
        raise PayloadError(f"{hello.interface_count} interfaces, more than {MOST_INTERFACES}")
    interfaces = tuple(_interface(reader) for _ in range(hello.interface_count))
    reader.end()
    _all_differ("interface id", [interface.id for interface in interfaces])
    for direction in Direction:
        names = [interface.name for interface in interfaces if interface.direction is direction]
        _all_differ(f"{direction.name.lower()}-going interface name", names)
    _check_topic(base, "the manifest", f"{OUTGOING}/mcu/{hello.device_uid}/{RESERVED}")
    for interface in interfaces:
        way = INCOMING if interface.direction is Direction.IN else OUTGOING
        _check_topic(base, interface.name, f"{way}/mcu/{hello.device_uid}/{interface.name}")
        _check_topic(base, interface.name, f"{way}/{interface.channel}")
    return Manifest(hello, interfaces)


class _Reader:
    """A reader that takes little-endian values from the front of a payload."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        if self._at + layout.size > len(self._data):
            raise PayloadError(f"ends after {len(self._data)} bytes, in the middle of a value")
        values = layout.unpack_from(self._data, self._at)
        self._at += layout.size
        return values

    def string(self) -> str:
        """Take a text: a byte with its length, then that many bytes of UTF-8."""
        (length,) = self.take(_LENGTH)
        raw = self._data[self._at : self._at + length]
        if len(raw) != length:
            raise PayloadError(f"ends after {len(self._data)} bytes, in the middle of a text")
        self._at += length
        try:
            return raw.decode()
        except UnicodeDecodeError:
            raise PayloadError(f"{raw[:40]!r} is not UTF-8") from None

    def end(self) -> None:
        unread = len(self._data) - self._at
        if unread:
            raise PayloadError(f"{unread} bytes too many")


_LENGTH = struct.Struct("<B")
_HELLO = struct.Struct("<BB")  # schema version, interfaces
_INTERFACE = struct.Struct("<HBBBH")  # id, direction, kind, flags, rate in Hz
_ENCODING = struct.Struct("<BB")  # encoding, fields
_FIELD = struct.Struct("<Bff")  # type, scale, offset


def _hello(reader: _Reader) -> Hello:
    version, count = reader.take(_HELLO)
    hello = Hello(version, count, reader.string(), reader.string(), reader.string(), reader.string())
    _check_level("device uid", hello.device_uid)
    return hello


def _interface(reader: _Reader) -> Interface:
    number, direction, kind, flags, rate_hz = reader.take(_INTERFACE)
    name, channel, profile = reader.string(), reader.string(), reader.string()
    encoding, count = reader.take(_ENCODING)
    _check_level("interface name", name)
    _check_channel(name, channel)
    if name in (RESERVED, LOCAL_ONLY):
        raise PayloadError(f'interface name "{name}" is taken')
    if number == 0:
        raise PayloadError(f"{name}: id 0 is the protocol's own")
    if encoding != _ENCODING_NUMBER:
        raise PayloadError(f"{name}: unknown encoding {encoding}")
    if count > _MOST_FIELDS:
        raise PayloadError(f"{name}: {count} fields, more than {_MOST_FIELDS}")
    way, form = _enum(Direction, direction, name, "direction"), _enum(InterfaceKind, kind, name, "kind")
    if (way is Direction.IN) != (form is InterfaceKind.COMMAND):
        raise PayloadError(f"{name}: a {form.name.lower()} cannot go {way.name.lower()}")
    fields = tuple(_field(reader, name) for _ in range(count))
    _all_differ(f"field of {name}", [field.name for field in fields])
    retain, local_only = bool(flags & _RETAIN), bool(flags & _LOCAL_ONLY)
    return Interface(number, name, way, form, retain, local_only, rate_hz, channel, profile, fields)


def _field(reader: _Reader, interface: str) -> Field:
    name = reader.string()
    number, scale, offset = reader.take(_FIELD)
    unit = reader.string()
    where = f"{interface}.{name}"
    if not name or not name.isprintable():
        raise PayloadError(f"{interface}: {name!r} is no name of a field")
    kind: FieldType = _enum(FieldType, number, where, "type")
    if kind is FieldType.BOOL:
        return Field(name, kind, unit=unit)
    if not (math.isfinite(scale) and math.isfinite(offset)) or scale == 0:
        raise PayloadError(f"{where}: scale {scale:g} and offset {offset:g} make no number")
    return Field(name, kind, shortest(scale), shortest(offset), unit)


def _enum(kind: Any, number: int, where: str, what: str) -> Any:
    try:
        return kind(number)
    except ValueError:
        raise PayloadError(f"{where}: unknown {what} {number}") from None


def _check_level(what: str, text: str) -> None:
    # braces are how the contract writes a level that varies
    if not _level(text) or "{" in text or "}" in text:
        raise PayloadError(f"{what} {text!r}: must be {LEVEL_RULE}")


def _check_channel(name: str, channel: str) -> None:
    if not channel:
        return
    levels = channel.split("/")
    if len(levels) > _MOST_LEVELS:
        raise PayloadError(f"{name}: a channel of {len(levels)} levels, more than {_MOST_LEVELS}")
    for level in levels:
        _check_level(f"{name}: in the channel {channel!r},", level)


def _check_topic(base: str, name: str, suffix: str) -> None:
    size = len(f"{base}/{suffix}".encode())
    if size > MAX_BYTES:
        raise PayloadError(f"{name[:40]}: its topic has {size} bytes, more than {MAX_BYTES}: shorten the names in it")


def _all_differ(what: str, values: list[Any]) -> None:
    twice = next((value for value in values if values.count(value) > 1), None)
    if twice is not None:
        raise PayloadError(f"{what} {twice!r} is there twice")


def _plain_interface(interface: Interface) -> dict[str, Any]:
    plain: dict[str, Any] = {
        "id": interface.id,
        "name": interface.name,
        "dir": interface.direction.name.lower(),
        "kind": interface.kind.name.lower(),
        "channel": interface.channel,
        "profile": interface.profile,
        "rate_hz": interface.rate_hz,
        "encoding": {"kind": _ENCODING_NAME, "fields": [_plain_field(field) for field in interface.fields]},
    }
    flags = {"retain": interface.retain, "local_only": interface.local_only}
    return plain | {name: True for name, is_set in flags.items() if is_set}


def _plain_field(field: Field) -> dict[str, Any]:
    plain: dict[str, Any] = {"name": field.name, "type": field.type.word}
    if field.scale != 1.0:
        plain["scale"] = field.scale
    if field.offset != 0.0:
        plain["offset"] = field.offset
    if field.unit:
        plain["unit"] = field.unit
    return plain
