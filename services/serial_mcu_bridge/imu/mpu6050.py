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
_HEAD = {b"n": "n", b"ms": "ms"}  # number of the line, and the sensor's clock


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
    kind, *tokens = line.split() or [b""]
    if kind in (b"I", b"S"):
        fields = dict(token.split(b"=", 1) for token in tokens if b"=" in token)
        report = _motion(fields) if kind == b"I" else _summary(fields)
        return report or DeviceLogLine(logging.WARNING, printable(line))
    text = printable(line)
    return DeviceLogLine(logging.INFO, text) if text else None


def _motion(fields: dict[bytes, bytes]) -> Motion | None:
    head, values = _numbers(fields, _HEAD, int), _numbers(fields, _MOTION, float)
    return None if head is None or values is None else Motion(head["n"], head["ms"], values)


def _summary(fields: dict[bytes, bytes]) -> Summary | None:
    head, values = _numbers(fields, _HEAD, int), _numbers(fields, _SUMMARY | _ATTITUDE, float)
    counts = _numbers(fields, _COUNTS, int)
    if head is None or values is None or counts is None:
        return None
    return Summary(head["n"], head["ms"], {**values, **counts})


def _numbers(fields: dict[bytes, bytes], names: dict[bytes, str], kind: type[Any]) -> dict[str, Any] | None:
    """Return the numbers of a line by their names; None if one is missing, or is not written as this kind."""
    form = _INTEGER if kind is int else _DECIMAL
    texts = {name: fields.get(key, b"") for key, name in names.items()}
    return {name: kind(raw) for name, raw in texts.items()} if all(map(form.match, texts.values())) else None
