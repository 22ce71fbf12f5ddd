"""A robot that cannot be driven does not look as if it could: in its status, by ``pebble estop`` and by doctor."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.config import LAUNCHER_LOCK
from tests.commands.command_line import program
from tests.robot.rig import Rig
from tests.support import further, until


@pytest.fixture(params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with Rig(request.param) as one:
        yield one


def driveable(rig: Rig) -> dict[str, str]:
    found: dict[str, str] = rig.operator.newest("status").get("value", {}).get("driveable", {})
    return found


def shows(rig: Rig, state: str, why: str = "", seconds: float = 20.0) -> bool:
    return until(lambda: driveable(rig).get("state") == state and why in driveable(rig).get("why", ""), seconds)


def pebble(*words: object) -> str:
    return "".join(program(*map(str, words)).communicate(timeout=60))


@pytest.mark.parametrize("rig", [further("mqtt"), "zenoh"], indirect=True)
def test_an_unplugged_board_is_named_everywhere_until_it_is_back(rig: Rig) -> None:
    assert shows(rig, "yes")
    rig.mcu.command("unplug")
    assert shows(rig, "no", f"serial: cannot open {rig.mcu.port}")
    assert _mcu(rig)["state"] == "absent"
    assert f"CANNOT BE DRIVEN OR STOPPED: serial: cannot open {rig.mcu.port}" in pebble("estop", rig.config, "--remote")
    assert f"serial: cannot open {rig.mcu.port}" in " ".join(pebble("estop", "status", rig.config, "--remote").split())
    rig.mcu.command("replug")
    assert shows(rig, "yes")
    again = {"starts_per_minute": 1, "why": "its board has started again once within a minute"}
    assert _mcu(rig) == {"state": "ready", "heard_ms": 0, **again}


def test_siblings_that_do_not_reach_each_other_are_noticed_until_they_do() -> None:
    with Rig("zenoh") as rig:
        assert shows(rig, "yes")
        _socket_of(rig.processes()["serial_mcu_bridge"], rig.folder / "run").unlink()
        before, began = len(_reasons(rig)), time.monotonic()
        rig.kill("mqtt_bridge")  # its successor finds no way to the motor owner

        def drives() -> bool:
            rig.operator.send("incoming/drive-values", {"x": 0, "z": 0.2})
            return rig.mcu.moving(began)

        assert until(lambda: any("nothing from serial" in why for why in _reasons(rig)[before:]), 40), _reasons(rig)
        (rig.folder / "run" / LAUNCHER_LOCK).unlink()
        assert until(drives, 40), "all programs start again"
        assert shows(rig, "yes")


def _socket_of(pid: int, folder: Path) -> Path:
    """That on which its siblings connect to it."""
    links = {str(link.readlink()) for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink()}
    sockets = (line.split() for line in Path("/proc/net/unix").read_text().splitlines() if str(folder) in line)
    own = {Path(columns[7]) for columns in sockets if f"socket:[{columns[6]}]" in links}
    (found,) = {path for path in own if not path.name.startswith("hub")}
    return found


def _mcu(rig: Rig) -> dict[str, Any]:
    found: dict[str, Any] = rig.operator.newest("status")["value"]["mcu"]["serial"]
    return found


def _reasons(rig: Rig) -> list[str]:
    return [one.json["value"].get("driveable", {}).get("why", "") for one in rig.operator.on("outgoing/status")]
