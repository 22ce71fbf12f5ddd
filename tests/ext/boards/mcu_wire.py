"""Frames of an MCU by pebble_serial_v1, written from the protocol's description, independently of the host's code."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import Any

#: The numbers in docs/ext/serial-protocol.md.
HELLO, DESCRIBE_REQ, DESCRIBE = 0x01, 0x02, 0x03
SAMPLE, STATE = 0x10, 0x11
CMD, ACK, NACK = 0x20, 0x21, 0x22
LOG, PING, PONG = 0x30, 0x31, 0x32
BOOL, U8, I8, U16, I16, U32, I32, F32 = range(1, 9)
IN, OUT = 1, 2
KIND_SAMPLE, KIND_STATE, KIND_COMMAND, KIND_EVENT = 1, 2, 3, 4
RETAIN, LOCAL_ONLY = 1, 2


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE, bit by bit."""
    value = 0xFFFF
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    return value


def stuff(data: bytes) -> bytes:
    """COBS, byte by byte."""
    out, block = bytearray(), bytearray()
    for number, byte in enumerate(data):
        if byte:
            block.append(byte)
        if not byte or len(block) == 254:
            out += bytes([len(block) + 1]) + block
            full_at_the_end = bool(byte) and number == len(data) - 1
            block.clear()
            if full_at_the_end:
                return bytes(out)
    return bytes(out + bytes([len(block) + 1]) + block)


def body(
    kind: int, payload: bytes = b"", interface: int = 0, sequence: int = 0, ms: int = 0, version: int = 1
) -> bytes:
    return struct.pack("<BBBHII", version, kind, 0, interface, sequence, ms) + payload


def sealed(body: bytes) -> bytes:
    return stuff(body + struct.pack("<H", crc16(body))) + b"\0"


def frame(kind: int, payload: bytes = b"", interface: int = 0, sequence: int = 0, ms: int = 0) -> bytes:
    return sealed(body(kind, payload, interface, sequence, ms))


def text(value: str | bytes) -> bytes:
    raw = value.encode() if isinstance(value, str) else value
    return bytes([len(raw)]) + raw


@dataclass(frozen=True)
class F:
    """A field."""

    name: str | bytes
    type: int
    scale: float = 1.0
    offset: float = 0.0
    unit: str | bytes = ""

    def pack(self) -> bytes:
        return text(self.name) + struct.pack("<Bff", self.type, self.scale, self.offset) + text(self.unit)


@dataclass(frozen=True)
class I:  # noqa: E742 - short, for tables of interfaces
    """An interface."""

    id: int
    name: str | bytes
    dir: int
    kind: int
    fields: tuple[F, ...] = ()
    channel: str | bytes = ""
    profile: str | bytes = ""
    flags: int = 0
    rate_hz: int = 0
    encoding: int = 1

    def pack(self) -> bytes:
        head = struct.pack("<HBBBH", self.id, self.dir, self.kind, self.flags, self.rate_hz)
        names = text(self.name) + text(self.channel) + text(self.profile)
        return head + names + bytes([self.encoding, len(self.fields)]) + b"".join(field.pack() for field in self.fields)


@dataclass(frozen=True)
class M:
    """A manifest."""

    uid: str | bytes
    interfaces: tuple[I, ...] = ()
    hash: str | bytes = "h1"
    firmware: str = "1.0"
    model: str = "board"

    def hello(self) -> bytes:
        strings = (self.hash, self.uid, self.firmware, self.model)
        return bytes([1, len(self.interfaces)]) + b"".join(map(text, strings))

    def describe(self) -> bytes:
        return self.hello() + b"".join(interface.pack() for interface in self.interfaces)

    def but(self, **changes: Any) -> M:
        return replace(self, **changes)


_MOTION = (
    *(F(name, I16, 0.001, 0.0, "mps2") for name in ("ax", "ay", "az")),
    *(F(name, I16, 0.01, 0.0, "dps") for name in ("gx", "gy", "gz")),
    *(F(name, I16, 0.01) for name in ("temp_c", "roll_deg", "pitch_deg")),
)
_SUMMARY = (
    F("accel_norm_g", U16, 0.001),
    *(F(f"gyro_bias_{axis}_dps", I16, 0.01) for axis in "xyz"),
    *(F("samples_ok", U32), F("samples_error", U32), F("calibration_samples", U16)),
)
_SWITCH = (F("on", BOOL),)
_REPORT = (F("bound", BOOL), F("reachable", BOOL), F("on", BOOL))
#: The original Pebble's inertial sensor, and its station of four switched sockets.
IMU = M("goob-imu-nano", (
    I(1, "imu_fast", OUT, KIND_SAMPLE, _MOTION, "sensors/imu-fast", "imu.motion.v1", LOCAL_ONLY, 100),
    I(2, "imu", OUT, KIND_STATE, _SUMMARY, "sensors/imu", "imu.summary.v1", 0, 5),
), "goob-imu-v2", "2", "arduino-nano")  # fmt: skip
STATION = M("hs105-sta", tuple(
    interface for n in range(1, 5) for interface in (
        I(2 * n - 1, f"o{n}_set", IN, KIND_COMMAND, _SWITCH, f"outlets/o{n}/power", "outlet.switch.v1"),
        I(2 * n, f"o{n}_state", OUT, KIND_STATE, _REPORT, f"outlets/o{n}/status", "outlet.switch.v1", RETAIN),
    )
), "hs105-sta-v1", "1", "seeed_xiao_esp32c3_hs105_station_bridge")  # fmt: skip
#: One interface of each kind, the first two with an alias.
LAMP = M("lamp-1", (
    I(1, "lamp", IN, KIND_COMMAND, (F("level", U8, 0.5, 0.0, "%"), F("on", BOOL)), "lights/lamp"),
    I(2, "lamp", OUT, KIND_STATE, (F("level", U8, 0.5, 0.0, "%"),), "lights/lamp", "", RETAIN),
    I(3, "button", OUT, KIND_EVENT, (F("presses", U8),)),
    I(4, "glow", OUT, KIND_SAMPLE, (F("lux", F32),), "", "", RETAIN),
))  # fmt: skip
