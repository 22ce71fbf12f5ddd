"""What an operator may expect of a robot on any transport, from any of its brokers."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from tests.robot.conftest import Station
from tests.robot.operator import retained_messages
from tests.robot.rig import BASE, STOP
from tests.support import SOON_S, until

pytestmark = pytest.mark.alone  # deadlines are checked

DRIVE = "incoming/drive-values"


def stop_and_wait(station: Station) -> None:
    """Send a stop until it reaches the wheels: a serial line and a mirror open late."""
    began = time.monotonic()

    def stands() -> bool:
        return station.rig.mcu.drives(began) and not station.rig.mcu.moving()

    assert until(lambda: station.operator.send(DRIVE, {"x": 0, "z": 0}) and until(stands, 1))


def first_motion(station: Station, since: float) -> tuple[float, tuple[float, float]]:
    """When the wheels first turned after ``since``, and how fast."""
    return next((at, wheels) for at, wheels in station.rig.mcu.drives(since) if wheels != STOP)


@pytest.mark.parametrize(
    ("body", "wheels"),
    [
        ({"x": 0.2, "z": 0.5}, (0.7, 0.3)),
        ({"x": 1, "z": -1e300, "y": 0.5}, (0.0, -1.0)),
    ],
)
def test_drive_forms_reach_the_wheels(station: Station, body: Any, wheels: tuple[float, float]) -> None:
    stop_and_wait(station)
    began = time.monotonic()
    station.operator.send(DRIVE, body)
    assert until(lambda: station.rig.mcu.moving(began))
    assert first_motion(station, began)[1] == pytest.approx(wheels)


def test_silence_stops_the_wheels(station: Station) -> None:
    stop_and_wait(station)
    began = time.monotonic()
    station.operator.send(DRIVE, {"x": 0.1, "z": 0.3})
    assert until(lambda: station.rig.mcu.moving(began))
    assert until(lambda: not station.rig.mcu.moving(began))
    started, _ = first_motion(station, began)
    stopped, _ = next((at, wheels) for at, wheels in station.rig.mcu.drives(started) if wheels == STOP)
    assert 0.70 <= stopped - started < 1.0, "later the MCU stops by itself"


def test_actions_run_once_and_only_for_true(station: Station) -> None:
    before = len(station.rig.recorded())
    for body in (False, {"value": False}, 1, "true", {"value": 1}, None, {"on": True}, b"true\xff"):
        station.operator.send("incoming/flags/reboot", body)
    station.operator.send("incoming/flags/reboot", True, retain=True)
    station.operator.send("incoming/flags/reboot", b"", retain=True)
    station.operator.send("incoming/flags/service-restart", {"enabled": True})
    assert until(lambda: len(station.rig.recorded()) > before)
    assert station.rig.recorded()[before:] == ["service_restart"]


# -- the way to the remote broker


def test_four_heartbeats_a_second(uplinked: Station) -> None:
    began = time.monotonic()
    assert until(lambda: len(uplinked.operator.on("outgoing/online", began)) >= 9)
    heartbeats = uplinked.operator.on("outgoing/online", began)[:9]
    assert 1.5 <= heartbeats[-1].at - heartbeats[0].at < SOON_S
    assert abs(heartbeats[-1].json["t"] / 1000 - time.time()) < 3
    assert "outgoing/online" in retained_messages(uplinked.rig.remote.port, BASE)


def test_the_launcher_forks_its_programs_so_it_has_one_thread_and_only_its_own_sockets(uplinked: Station) -> None:
    launcher = Path(f"/proc/{uplinked.rig.launcher_pid}")
    assert len(list((launcher / "task").iterdir())) == 1
    opened = [path.readlink().name for path in (launcher / "fd").iterdir()]
    sockets = [name for name in opened if name.startswith("socket:")]
    assert len(sockets) == 3, "two for its stop signals, one to the announcer"


def test_stopping_the_robot_stops_the_wheels_and_reports_offline(uplinked: Station) -> None:
    rig = uplinked.rig
    began = time.monotonic()
    uplinked.operator.send(DRIVE, {"x": 0, "z": 0.5})
    assert until(lambda: rig.mcu.moving(began))
    left_behind = rig.processes()
    assert rig.stop() == 0
    assert rig.mcu.drives(began)[-1][1] == STOP
    assert until(lambda: (last := uplinked.operator.last("outgoing/online")) and last.json.get("online") is False)
    assert not [pid for pid in left_behind.values() if rig.alive(pid)]
    rig.start()
