"""The text protocol ``imu_mpu6050_v1`` of an Arduino with an inertial sensor: parses lines, sends nothing, no I/O.

``I n= ms= ax= ay= az= gx= gy= gz= t= r= p=`` is a sample, ``S n= ms= r= p= t= an= gbx= gby= gbz= ok= err= cal=`` a
summary. A line without all keys is a log line.
"""

import logging
import re
from dataclasses import dataclass
from typing import Any, TypeAlias

from pebble.services.serial_mcu_bridge.text.device_log import DeviceLogLine, printable

_INTEGER = re.compile(rb"[+-]?[0-9]{1,10}\Z")
_DECIMAL = re.compile(rb"[+-]?[0-9]{1,9}(?:\.[0-9]{0,9})?\Z")  # never nan or inf

#: Key of a line to field of the profile (imu.py).
_MOTION = {key.encode(): key for key in ("ax", "ay", "az", "gx", "gy", "gz")}
_MOTION |= {b"t": "temp_c", b"r": "roll_deg", b"p": "pitch_deg"}
_SUMMARY = {b"an": "accel_norm_g", b"gbx": "gyro_bias_x_dps", b"gby": "gyro_bias_y_dps", b"gbz": "gyro_bias_z_dps"}
_ATTITUDE = {b"r": "roll_deg", b"p": "pitch_deg", b"t": "temp_c"}  # a summary repeats them
_COUNTS = {b"ok": "samples_ok", b"err": "samples_error", b"cal": "calibration_samples"}


@dataclass(frozen=True, slots=True)
class Motion:
    number: int
    mcu_ms: int
    values: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Summary:
    number: int
    mcu_ms: int
    values: dict[str, Any]


Report: TypeAlias = Motion | Summary | DeviceLogLine


def parse(line: bytes) -> Report | None:
    """Return the report of one line, None for a blank one. A malformed report is a warning. Never raises."""
    kind, *rest = line.split() or [b""]
    if kind in (b"I", b"S"):
        fields = dict(token.split(b"=", 1) for token in rest if b"=" in token)
        report = _motion(fields) if kind == b"I" else _summary(fields)
        return report or DeviceLogLine(logging.WARNING, printable(line))
    text = printable(line)
    return DeviceLogLine(logging.INFO, text) if text else None


def _motion(fields: dict[bytes, bytes]) -> Motion | None:
    head, values = _integers(fields, {b"n": "n", b"ms": "ms"}), _decimals(fields, _MOTION)
    return None if head is None or values is None else Motion(head["n"], head["ms"], values)


def _summary(fields: dict[bytes, bytes]) -> Summary | None:
    head, values = _integers(fields, {b"n": "n", b"ms": "ms"}), _decimals(fields, _SUMMARY | _ATTITUDE)
    counts = _integers(fields, _COUNTS)
    if head is None or values is None or counts is None:
        return None
    return Summary(head["n"], head["ms"], {**values, **counts})


def _integers(fields: dict[bytes, bytes], names: dict[bytes, str]) -> dict[str, int] | None:
    texts = {name: fields.get(key, b"") for key, name in names.items()}
    return {name: int(raw) for name, raw in texts.items()} if all(map(_INTEGER.match, texts.values())) else None


def _decimals(fields: dict[bytes, bytes], names: dict[bytes, str]) -> dict[str, float] | None:
    texts = {name: fields.get(key, b"") for key, name in names.items()}
    return {name: float(raw) for name, raw in texts.items()} if all(map(_DECIMAL.match, texts.values())) else None
