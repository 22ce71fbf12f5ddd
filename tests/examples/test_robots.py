"""What the samples of a robot owe besides the checks of ``pebble conform``."""

from __future__ import annotations

import runpy
import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.ext.checks.conform.programs import (
    ROBOT_PY,
    Command,
    Sample,
    mutant,
    robot_in_micropython,
    robot_in_python,
    sketch,
)
from tests.robot.operator import Operator
from tests.support import Broker, Child, until

BASE = "pebble/robots/mine"


PUBLISH_QOS_1 = 0x32


@pytest.fixture(scope="module")
def packets() -> SimpleNamespace:
    """The module of the robot in MicroPython, which knows no package."""
    return SimpleNamespace(**runpy.run_path(str(ROBOT_PY.with_name("mqtt_packets.py"))))


def publish(packets: SimpleNamespace, topic: str, payload: bytes, number: int) -> bytes:
    content: bytes = packets.text(topic) + struct.pack("!H", number) + payload
    return bytes(packets.packet(PUBLISH_QOS_1, content))


def messages(packets: SimpleNamespace, pieces: Iterator[bytes]) -> list[Any]:
    """Return topic, number and payload of each message in a stream that arrives in pieces."""
    reader, seen = packets.Reader(), []
    for piece in pieces:
        reader.add(piece)
        seen += [packets.message(first, content) for first, content in reader.packets()]
    return seen


@pytest.mark.parametrize("piece", [1, 1024, 100_000])
@pytest.mark.parametrize("topic", [1019, 1020, 1021, 1022, 1023, 65_535])
@pytest.mark.parametrize("payload", [0, 30_000])
def test_each_number_is_read_however_long_topic_and_payload_are(
    packets: SimpleNamespace, piece: int, topic: int, payload: int
) -> None:
    lengths = ((3, 2), (topic, payload), (3, 2))
    stream = b"".join(publish(packets, "t" * size, b"p" * more, 7) for size, more in lengths)
    pieces = (stream[at : at + piece] for at in range(0, len(stream), piece))
    seen = messages(packets, pieces)
    assert [number for _, number, _ in seen] == 3 * [struct.pack("!H", 7)]
    assert seen[0] == seen[2] == ("ttt", struct.pack("!H", 7), b"pp")
    shown = "t" * topic if topic <= packets.LONGEST - 4 else ""
    assert seen[1] == (shown, struct.pack("!H", 7), (b"p" * payload)[: packets.LONGEST - 4 - len(shown)])


def arduino(folder: Path) -> Command:
    """The sketch, on a board whose clock never becomes right."""
    sample = mutant(ROBOT_PY.with_name("robot.cpp"), folder, "1700000000", "99999999999")
    return sketch(sample, folder / "robot")


def micropython(folder: Path) -> Command:
    """The same in MicroPython, where no time server answers."""
    sample = mutant(ROBOT_PY.with_name("robot-micropython.py"), folder, "gmtime()[0] < 2024", "gmtime()[0] < 9999")
    (sample.parent / "ntptime.py").write_text("def settime():\n    raise OSError('no internet')\n")
    return [*robot_in_micropython(folder)[:-1], sample]


@pytest.mark.parametrize("sample", [robot_in_python, arduino, micropython])
def test_topics_of_any_length_hold_up_nothing_nor_does_a_missing_internet(
    sample: Sample, broker: Broker, tmp_path: Path
) -> None:
    operator = Operator(broker.port, BASE)
    robot = Child(list(map(str, [*sample(tmp_path), "mine", "127.0.0.1", broker.port, tmp_path / "stop"])))
    try:
        for state in ("capabilities", "estop/motors"):  # before the first it has subscribed
            operator.wait_for(f"outgoing/{state}")
        for _ in range(50):  # more than a broker sends unacknowledged
            operator.send("incoming/" + 1500 * "x", {})
        for z in (0, 0.5):  # after its start it waits for a zero
            operator.send("incoming/drive-values", {"z": z})
        moves = {"wheels": [0.5, 0.5]}
        assert until(lambda: moves in [status.json["value"] for status in operator.on("outgoing/status")])
    finally:
        robot.kill()
        robot.wait()
        operator.close()
