"""The text protocol ``goob_base_v1`` of the motor MCUs of Goob and Fred: bytes in and out, no I/O.

Host to MCU: ``M <left> <right>``, ``L <b> <g> <r>``, ``F <b> <g> <r> <period>``. MCU to host: ``T`` (sensors), ``C``
(battery), ``OK``/``WARN``/``ERR`` (answers), ``Done!`` (it has started), anything else is a log line.
A line ends with LF, a CR before it is ignored.
"""

import logging
import re
from dataclasses import dataclass, field
from math import isfinite
from typing import TypeAlias

from pebble.errors import PayloadError
from pebble.services.serial_mcu_bridge.text.device_log import DeviceLogLine, printable

SHORTEST_FLASH_S, LONGEST_FLASH_S = 0.05, 3600.0  # one full fade in and out

STARTED = "Done!"  # the first word of what a board logs when it has started
_HALL_NAMES = (b"a0", b"a1", b"a2")  # Goob's
_TOUCH_NAMES = (_HALL_NAMES, (b"t0", b"t1", b"t2"))  # Fred's
_INTEGER = re.compile(rb"[+-]?[0-9]{1,6}\Z")  # an ADC has at most 16 bits
_DECIMAL = re.compile(rb"[+-]?[0-9]{1,6}(?:\.[0-9]{0,9})?\Z")  # what printf("%.3f") makes; never nan or inf
_LEVELS = {b"OK": logging.DEBUG, b"WARN": logging.WARNING, b"ERR": logging.ERROR, STARTED.encode(): logging.INFO}


@dataclass(frozen=True, slots=True)
class Touch:
    """Three sensors as the ADC reads them (10 or 12 bits). On Goob they are the hall sensors of the wheels."""

    a0: int
    a1: int
    a2: int
    of_wheels: bool = field(default=False, compare=False, kw_only=True)


@dataclass(frozen=True, slots=True)
class Charging:
    """The state of the charger: connected or not; None where the board cannot tell (``chg=-1``)."""

    value: bool | None


@dataclass(frozen=True, slots=True)
class Level:
    """Battery voltage."""

    volts: float


Report: TypeAlias = Touch | Charging | Level | DeviceLogLine


def parse(line: bytes) -> list[Report]:
    """Return the reports of one line, none for a blank line: ``T t0=1 t1=2 t2=3 chg=1`` is a Touch and a Charging.

    Never raises. A ``T`` or ``C`` line without a valid field is reported as a warning.
    """
    kind, *tokens = line.split() or [b""]
    if kind in (b"T", b"C"):
        fields = dict([token.split(b"=", 1) for token in tokens if b"=" in token])
        reports = _touch(fields) if kind == b"T" else []
        reports += _charging(fields) + _level(fields)
        return reports or [DeviceLogLine(logging.WARNING, f"not understood: {printable(line)}")]
    text = printable(line)
    return [DeviceLogLine(_LEVELS.get(kind, logging.INFO), text, known=kind in _LEVELS)] if text else []


def mix(x: float, z: float) -> tuple[float, float]:
    """Return the wheel speeds (left, right), each −1..1, for steering ``x`` (> 0 turns right) and throttle ``z``.

    Raises PayloadError for NaN and infinities: with them min() and max() would return full speed.
    """
    if not (isfinite(x) and isfinite(z)):
        raise _not_finite(x, z)
    return max(-1.0, min(1.0, z + x)), max(-1.0, min(1.0, z - x))


def drive_line(left: float, right: float) -> bytes:
    """Return ``M <left> <right>``, each −1..1. Raises PayloadError for NaN and infinities."""
    if not (isfinite(left) and isfinite(right)):
        raise _not_finite(left, right)
    # adding 0.0 turns a rounded −0.0 into 0.0: a stop is always the same bytes
    speeds = round(max(-1.0, min(1.0, left)), 3) + 0.0, round(max(-1.0, min(1.0, right)), 3) + 0.0
    return b"M %.3f %.3f\n" % speeds


def lights_line(blue: float, green: float, red: float) -> bytes:
    """Return ``L <b> <g> <r>``, each 0..1. Raises PayloadError for NaN and infinities."""
    return b"L %.3f %.3f %.3f\n" % _shares(blue, green, red)


def flash_line(blue: float, green: float, red: float, period_s: float) -> bytes:
    """Return ``F <b> <g> <r> <period_s>``: fade from dark to the colour and back once per period, for ever."""
    if not isfinite(period_s):
        raise _not_finite(period_s)
    period = max(SHORTEST_FLASH_S, min(LONGEST_FLASH_S, period_s))
    return b"F %.3f %.3f %.3f %.3f\n" % (*_shares(blue, green, red), period)


def _touch(fields: dict[bytes, bytes]) -> list[Report]:
    for names in _TOUCH_NAMES:
        values = [fields.get(name, b"") for name in names]
        if all(map(_INTEGER.match, values)):
            return [Touch(*map(int, values), of_wheels=names is _HALL_NAMES)]
    return []


def _charging(fields: dict[bytes, bytes]) -> list[Report]:
    raw = fields.get(b"chg", b"")
    if not _INTEGER.match(raw):
        return []
    value = int(raw)
    return [Charging(None if value < 0 else value > 0)]


def _level(fields: dict[bytes, bytes]) -> list[Report]:
    raw = fields.get(b"v", b"")
    return [Level(float(raw))] if _DECIMAL.match(raw) else []


def _shares(*parts: float) -> tuple[float, ...]:
    """Return the values, each limited to 0..1. Raises PayloadError for NaN and infinities."""
    if not all(map(isfinite, parts)):
        raise _not_finite(*parts)
    return tuple([max(0.0, min(1.0, part)) for part in parts])


def _not_finite(*values: float) -> PayloadError:
    return PayloadError(f"not a finite number among {values}")


STOP = drive_line(0.0, 0.0)
