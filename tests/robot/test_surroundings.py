"""Robots that start and stop in odd surroundings, several at once, and among malformed messages."""

from __future__ import annotations

import itertools
import os
import resource
import signal
import subprocess
import time
from collections.abc import Iterator
from typing import Any

import pytest

from pebble.contract import CHANNELS, ESTOP, INCOMING
from tests.own_memory import own_mb
from tests.robot.faults import HARSH, Drive, HarshRig
from tests.robot.rig import STOP, Rig, descendants
from tests.support import ROOT, cases, further, gone, needs_root, some, until

pytestmark = pytest.mark.alone

SURROUNDINGS: dict[str, dict[str, Any]] = {
    "no environment, and folders that do not exist": {
        "env": {"PYTHONPATH": str(ROOT)} | dict.fromkeys(("HOME", "TMPDIR", "XDG_STATE_HOME"), "/nowhere/at/all")
    },
    "no standard streams": {"preexec_fn": lambda: [os.close(number) for number in range(3)]},
}


def drives_and_stops(rig: Rig, since: int = 0) -> None:
    """``since``: from where on the log has no traceback."""
    rig.operator.send("incoming/drive-values", {"x": 0.5, "z": 0})
    assert until(rig.mcu.moving), rig.log.read_text()[-4000:]
    children = descendants(rig.launcher_pid)
    assert rig.stop() == 0
    assert rig.mcu.drives()[-1][1] == STOP
    assert until(lambda: all(map(gone, children)))
    assert "Traceback" not in rig.log.read_text()[since:]


@pytest.mark.parametrize("surroundings", SURROUNDINGS.values(), ids=SURROUNDINGS)
def test_a_robot_runs(surroundings: dict[str, Any]) -> None:
    with Rig("zenoh", start=False) as rig:
        began = rig.start(ready=False, **surroundings)
        rig.wait_until_up(began)
        drives_and_stops(rig)


@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
@pytest.mark.parametrize("files", [20, further(40)])
def test_too_few_descriptors_are_an_error_or_enough(kind: str, files: int) -> None:
    with Rig(kind, start=False) as rig:
        rig.start(ready=False, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (files, files)))
        ended = until(lambda: gone(rig.launcher_pid), 3.0)
        if not ended:  # it goes on, and can be stopped
            assert rig.stop() == 0
        else:
            assert rig.stop() != 0


def test_a_stop_at_any_moment_of_the_start_leaves_nothing() -> None:
    with Rig("zenoh", start=False) as rig:
        for index in some(range(20), 4):
            rig.start(ready=False)
            time.sleep(0.04 * index)
            children = descendants(rig.launcher_pid)
            rig.stop((signal.SIGTERM, signal.SIGINT, signal.SIGHUP)[index % 3])
            assert until(lambda pids=children: all(map(gone, pids)))  # type: ignore[misc]
        assert not until(lambda: remains(rig), 0.5)
        before = len(rig.log.read_text())  # the interpreter prints a signal that comes before any of our code
        rig.start()
        drives_and_stops(rig, since=before)


def remains(rig: Rig) -> list[str]:
    """Programs of this robot that run."""
    found = subprocess.run(["pgrep", "-f", str(rig.config)], capture_output=True, text=True, check=False)
    return found.stdout.split()


@pytest.mark.parametrize(
    ("kind", "options", "signals"),
    [("mqtt", {"shutdown_timeout_seconds": 0}, 1), ("zenoh", {}, 2)],
)
def test_a_hurried_stop_stops_the_wheels(kind: str, options: dict[str, Any], signals: int) -> None:
    with Rig(kind, launcher=options) as rig:
        rig.operator.send("incoming/drive-values", {"x": 0.5, "z": 0})
        assert until(rig.mcu.moving)
        children = descendants(rig.launcher_pid)
        rig.stop(*[signal.SIGTERM] * signals)
        assert until(lambda: all(map(gone, children)))
        assert until(lambda: not rig.mcu.turning())


MESSAGES = cases(1_600, 20_000)
CHUNK = 800  # messages before waiting for a sign that the robot has read them: less than any queue on the way holds

#: No channel accepts one of these.
GARBAGE = (
    *(b"\xff\xfe\0", b"not json", b"[1, 1]", b"1", b"-0", b'"true"', b'"on"', b"null", b"[true]", b"TRUE", b"1.5e308"),
    *(b"[" * 3000, b'{"value":' * 2000, b"[" * 3000 + b"]" * 3000, b'{"x": 1, "value": true, "n": "\xff\xfe"}'),
    *(b'{"value": {"x": 0.5, "z": 0.5, "action": "pl', b'{"x": 1', b'{"x": "' + b"9" * 900),
)

#: Without emergency stops: there garbage is a stop, too (tests/services/serial_mcu_bridge).
_TARGETS = [
    channel
    for channel in CHANNELS
    if channel.direction == INCOMING and channel.payload is not bytes and channel is not ESTOP
]


@pytest.mark.timeout(180)
@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
def test_malformed_messages(kind: str) -> None:
    with Rig(kind) as rig:
        kinds = itertools.cycle(itertools.product(GARBAGE, _TARGETS))
        processes, memory, began = rig.processes(), _memory(rig), time.monotonic()
        for first in range(0, MESSAGES, CHUNK):
            for raw, channel in itertools.islice(kinds, CHUNK):
                topic = channel.suffix.format(uid="u", name="n", outlet="o1", robot="r")
                rig.operator.send(topic, raw, qos=0)
            assert _still_responds(rig, first / MESSAGES), f"no response after {first + CHUNK} messages"
        assert rig.processes() == processes
        assert not rig.mcu.moving(began)
        assert rig.recorded() == []
        assert _memory(rig) - memory < 30
        assert until(
            lambda: any("refused" in seen.json["message"] for seen in rig.operator.on("outgoing/logs", began)), 10
        )
        assert rig.stop() == 0
        assert "refused in all: {" in rig.log.read_text()


def _still_responds(rig: Rig, shade: float) -> bool:
    """A good message behind all the bad ones still arrives."""
    began = time.monotonic()
    rig.operator.send("incoming/lights-solid", {"g": round(shade, 3)})
    line = f"L 0.000 {shade:.3f} 0.000"
    return until(lambda: any(entry.line == line for entry in rig.mcu.entries(began)))


def _memory(rig: Rig) -> float:
    """Return the memory of all the robot's processes, MB."""
    return sum(map(own_mb, rig.processes().values()))


@pytest.fixture(scope="module", params=["mqtt", "zenoh"])
def harsh(request: pytest.FixtureRequest) -> Iterator[tuple[HarshRig, float]]:
    """Yield a robot on a machine that fails, and the memory that it takes at first."""
    with HarshRig(request.param) as rig:
        rig.start()
        yield rig, _memory(rig)


@needs_root
@pytest.mark.thorough
@pytest.mark.timeout(180)
@pytest.mark.parametrize("name", HARSH)
def test_a_flood_or_a_fault_of_the_machine_while_an_operator_drives(harsh: tuple[HarshRig, float], name: str) -> None:
    rig, before = harsh
    rig.wait_until_up(0.0)
    drive = Drive(rig, turns_s=HARSH[name].turns_s)
    HARSH[name].perform(rig, drive)
    time.sleep(1.5)  # without commands
    assert _memory(rig) - before < 30, "also after many floods"
