"""Malformed messages and as many garbage lines: nothing dies, nothing moves, every refusal is counted.

100,000 of each with ``make test THOROUGH=1``.
"""

from __future__ import annotations

import ast
import json
import math
import os
import random
import re
import select
import time
import tty
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.contract import CHANNELS, ESTOP, INCOMING, Channel, Kind
from pebble.contract.payloads import AutonomyCommand, Drive, LightsFlash, LightsSolid, MediaRequest, SoundboardCommand
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.services.serial_mcu_bridge.text.motor_bridge import MotorBridge
from tests.robot.rig import Rig
from tests.support import cases, until

MESSAGES = cases(1_600, 100_000)
CHUNK = 800  # messages before waiting for a sign that the robot has read them: less than any queue on the way holds
LINES = 400  # the same for lines: together fewer bytes than may wait unread


# -- an independent oracle: what the contract accepts, written with nothing but the standard library


def valid(channel: Channel, raw: bytes) -> bool:
    """Could this have an effect? What is doubtful counts as valid and is not sent."""
    if channel.payload is bool and not raw:
        return True  # removes a retained flag
    try:
        body = json.loads(raw.strip(bytes({*range(256)} - {*range(0x21, 0x7F)})).decode())
    except (ValueError, RecursionError):
        return False
    if channel.payload is bool:
        return isinstance(body, bool) or (
            isinstance(body, dict) and any(isinstance(body.get(key), bool) for key in ("value", "enabled"))
        )
    if channel.payload in (SoundboardCommand, AutonomyCommand, MediaRequest) and isinstance(body, bool):
        return True
    if not isinstance(body, dict):
        return False
    inner = body["value"] if isinstance(body.get("value"), dict) else body
    names = {Drive: "xzy", LightsSolid: "bgr", LightsFlash: ["b", "g", "r", "period"]}.get(channel.payload)
    return names is None or all(_may_be_read(inner[name]) for name in names if name in inner)


def _may_be_read(value: Any) -> bool:
    """A value is a number, or something else that counts as the default; NaN and infinity refuse a command."""
    text = str(value).lower()
    if not isinstance(value, (int, float, str)) or isinstance(value, bool):
        return True
    try:
        return math.isfinite(float(value))
    except (ValueError, OverflowError):
        return isinstance(value, str) and "nan" not in text and "inf" not in text


# -- garbage of many kinds


def garbage(channel: Channel, chance: random.Random) -> bytes:
    """One message that the oracle refuses."""
    while True:
        raw = chance.choice(_KINDS)(chance)
        if not valid(channel, raw):
            return raw


def _noise(chance: random.Random) -> bytes:
    return chance.randbytes(chance.randrange(0, 60))


def _wrong_number(chance: random.Random) -> bytes:
    axis = chance.choice(["x", "z", "y", "b", "g", "r", "period", "on", "value", "enabled"])
    value = chance.choice(
        ["NaN", "Infinity", "-Infinity", '"nan"', '"inf"', "1e999", "-1e999", "null", "[]", "{}", '"on"']
    )
    return f'{{"{axis}": {value}, "x": {value}, "z": {value}, "r": {value}}}'.encode()


def _nested(chance: random.Random) -> bytes:
    depth = chance.randrange(33, 3000)
    return chance.choice([b"[" * depth, b'{"value":' * depth, b"[" * depth + b"]" * depth])


def _scalar(chance: random.Random) -> bytes:
    return chance.choice([b"null", b"0", b"1", b'"true"', b"[true]", b'"on"', b"TRUE", b"True", b"1.5e308", b"-0"])


def _broken_utf8(chance: random.Random) -> bytes:
    return b'{"x": 1, "z": 1, "value": true, "n": "' + chance.randbytes(3).replace(b'"', b"\xff") + b'\xff"}'


def _truncated(chance: random.Random) -> bytes:
    whole = b'{"value": {"x": 0.5, "z": 0.5, "action": "play", "on": true}, "enabled": true}'
    return whole[: chance.randrange(len(whole))]


def _oversized(chance: random.Random) -> bytes:
    return b'{"x": "' + b"9" * chance.randrange(400, 900) + b'", "z": "1e400"}'


_KINDS = (_noise, _wrong_number, _nested, _scalar, _broken_utf8, _truncated, _oversized)

STOP = b"M 0.000 0.000\n"
SERVICES = (MqttBridge, MotorBridge)

#: Without emergency stops: there garbage is a stop, too (tests/services/serial_mcu_bridge).
_TARGETS = [
    channel
    for channel in CHANNELS
    if channel.direction == INCOMING and channel.payload is not bytes and channel is not ESTOP
]
_ACTIONS = {channel.metric for channel in _TARGETS if channel.kind is Kind.ACTION}


@pytest.fixture(params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with Rig(request.param, mcu="goob") as rig:
        yield rig


@pytest.mark.timeout(180)
def test_malformed_messages(rig: Rig) -> None:
    chance, sent = random.Random(7), Counter[str]()
    processes, memory, began = rig.processes(), _memory(rig), time.monotonic()
    for first in range(0, MESSAGES, CHUNK):
        for _ in range(CHUNK):
            channel = chance.choice(_TARGETS)
            topic = channel.suffix.format(uid="u", name="n", outlet="o1", robot="r")
            sent[channel.metric] += 1
            rig.operator.send(topic, garbage(channel, chance), qos=0)
        assert _still_responds(rig, first / MESSAGES), f"no response after {first + CHUNK} messages"
    assert rig.processes() == processes
    assert not rig.mcu.moving(began)
    assert rig.recorded() == []
    assert _memory(rig) - memory < 30 * 1024, "memory grew by more than 30 MB"
    assert until(lambda: any("refused" in seen.json["message"] for seen in rig.operator.on("outgoing/logs", began)), 10)
    assert rig.stop() == 0
    refused = _totals(rig, "refused in all")
    received = {channel.metric for service in SERVICES for channel in service.handles()}
    expected = {metric: number for metric, number in sent.items() if metric in received}
    assert refused.keys() == expected.keys()
    # QoS 0: a connection that is reset on a busy machine loses what is on its way, and there drive commands are late. A
    # kind of garbage that was accepted would be a seventh of a channel's messages. Of actions few pass in a second.
    lost = {metric: number - refused[metric] for metric, number in expected.items()}
    assert all(lost[metric] >= 0 for metric in expected), lost
    assert all(lost[metric] < 0.05 * number for metric, number in expected.items() if metric not in _ACTIONS), lost


@pytest.mark.thorough
@pytest.mark.timeout(180)
@pytest.mark.parametrize("rig", ["zenoh"], indirect=True)  # what reads the line knows nothing of transports
def test_garbage_lines(rig: Rig) -> None:
    """Written by something at the other end of the line, as fast as the host reads."""
    chance = random.Random(11)
    processes, memory, began = rig.processes(), _memory(rig), time.monotonic()
    rig.mcu.command("unplug")
    master, slave = os.openpty()
    tty.setraw(slave)
    assert until(lambda: not rig.mcu.port.is_symlink(), 5)
    rig.mcu.port.symlink_to(os.ttyname(slave))
    answers, lines = b"", 0
    while _touched(rig) != 0:  # whatever comes before the port is open is thrown away
        assert time.monotonic() < began + 20, "the port was not opened again"
        answers += _write(master, _good_line(0))
        time.sleep(0.05)
    for number in range(1, MESSAGES // LINES + 1):
        rubbish = b"".join(garbage_line(chance) for _ in range(LINES))
        lines += sum(bool(line.strip()) for line in rubbish.split(b"\n"))
        answers += _write(master, rubbish + _good_line(number))
        assert until(lambda: _touched(rig) == number, 10), "a good line behind all the bad ones is not read"  # noqa: B023
    assert answers.startswith(b"\n" + STOP), "the first line ends whatever half a line is at the other end, and stops"
    assert set(answers.splitlines()) == {b"", STOP.strip()}
    rig.mcu.port.unlink()
    os.close(slave)
    os.close(master)
    rig.mcu.command("replug")
    assert until(lambda: _still_responds(rig, 0.5), 10)
    assert rig.processes() == processes
    assert not rig.mcu.moving(began)
    assert _memory(rig) - memory < 30 * 1024
    assert rig.recorded() == []
    assert rig.stop() == 0
    counted = sum(_totals(rig, "log lines of the MCU").values())
    assert lines <= counted < lines + 10  # the simulated MCU has sent a few lines, too


def a_report(line: bytes) -> bool:
    """Could the host parse this as a measurement? Any field that is a short number counts."""
    values = [field.partition(b"=")[2] for field in line.split()]
    return any(value and len(value) < 20 and not value.strip(b"+-.0123456789") for value in values)


def garbage_line(chance: random.Random) -> bytes:
    """A line that a broken or malicious MCU might send."""
    while True:
        line = _random_line(chance)
        if not any(map(a_report, line.split(b"\n"))):
            return line


def _random_line(chance: random.Random) -> bytes:
    junk = chance.randbytes(chance.randrange(0, 40))
    value = chance.choice([b"nan", b"inf", b"1e999", b"-", b"", b"9" * 300, b"0x10", junk])
    return chance.choice(
        [
            junk,
            b"T a0=" + value,
            b"C v=" + value + b" chg=" + value,
            b"M 1.000 1.000",
            b"T" * 300,
            b"\0\0OK",
            b"ERR " + junk,
        ]
    ) + chance.choice([b"\n", b"\r\n", b"\n\n"])


def _write(master: int, data: bytes) -> bytes:
    """Push ``data`` into the line; returns what the host sent meanwhile. Fails if the host stops reading."""
    received, deadline = b"", time.monotonic() + 30
    os.set_blocking(master, False)
    while data:
        assert time.monotonic() < deadline, "the host has stopped reading the line"
        readable, writable, _ = select.select([master], [master], [], 1)
        if readable:
            received += os.read(master, 65536)
        if writable:
            data = data[os.write(master, data[:4096]) :]
    return received


def _still_responds(rig: Rig, shade: float) -> bool:
    """A good message behind all the bad ones still arrives."""
    began = time.monotonic()
    rig.operator.send("incoming/lights-solid", {"g": round(shade, 3)})
    line = f"L 0.000 {shade:.3f} 0.000"
    return until(lambda: any(entry.line == line for entry in rig.mcu.entries(began)), 20)


def _good_line(number: int) -> bytes:
    return b"T a0=%d a1=0 a2=0\n" % number


def _touched(rig: Rig) -> int | None:
    seen = rig.operator.last("outgoing/touch-sensors")
    return None if seen is None else seen.json["value"]["a0"]


def _totals(rig: Rig, text: str) -> dict[str, int]:
    """The sums over all services of the dictionaries that they log after ``text`` when they stop."""
    logged = re.findall(text + r"[^{\n]*(\{.*?\})", rig.log.read_text())
    return dict(sum((Counter[str](ast.literal_eval(totals)) for totals in logged), Counter[str]()))


def _memory(rig: Rig) -> int:
    """Resident memory of all the robot's processes, KB."""
    pages = sum(int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in rig.processes().values())
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024
