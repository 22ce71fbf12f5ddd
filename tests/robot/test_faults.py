"""Faults while an operator drives: the wheels stop in time, no stale command moves them, and driving resumes."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import pytest

from tests.commands.command_line import program
from tests.robot.faults import FAULTS, Drive, silent
from tests.robot.operator import Operator, retained_messages
from tests.robot.rig import BASE, Rig
from tests.support import further, until

pytestmark = pytest.mark.alone  # deadlines are checked

KINDS, FURTHER = ("mqtt", "zenoh"), ("for long", "again and again", "whole robot")
USUAL = [name for name in FAULTS if not any(word in name for word in FURTHER)]


@pytest.fixture(autouse=True)
def retained_state_is_current_afterwards(driven: Rig) -> Iterator[None]:
    """Check that a late subscriber finds all retained state after every fault, and that all of it is current."""
    charging = (
        driven.operator.last("outgoing/charging-status") or driven.operator.wait_for("outgoing/charging-status")
    ).json
    change = not charging["value"]
    driven.charge_later = "charge" if change else "discharge"
    yield
    assert until(lambda: _retained_is_current(driven, change)), retained_messages(driven.remote.port, BASE)


def _retained_is_current(rig: Rig, charging: bool) -> bool:
    retained = {topic: json.loads(raw) for topic, raw in retained_messages(rig.remote.port, BASE, 0.3).items()}
    services = retained.get("outgoing/status", {}).get("value", {}).get("services", {})
    return (
        retained.get("outgoing/charging-status") == {"value": charging}
        and "outgoing/capabilities" in retained
        and bool(services)
        and {service["state"] for service in services.values()} == {"ready"}
        and abs(retained["outgoing/online"]["t"] / 1000 - time.time()) < 2
        and retained["outgoing/online"].get("online") is not False
    )


def changed_state(rig: Rig) -> None:
    """Change what the MCU reports, in the middle of the fault."""
    rig.mcu.command(rig.charge_later)


@pytest.mark.parametrize(
    ("driven", "name"),
    [
        (kind, name) if name in USUAL and (USUAL.index(name) + at) % 2 else further(kind, name)
        for at, kind in enumerate(KINDS)
        for name in FAULTS
    ],
    indirect=["driven"],
)
def test_a_fault_while_an_operator_drives(driven: Rig, name: str) -> None:
    drive = Drive(driven, turns_s=FAULTS[name].turns_s)
    FAULTS[name].perform(driven, drive, lambda: changed_state(driven))


@pytest.mark.parametrize("driven", ["zenoh"], indirect=True)
def test_an_unplugged_board_is_named_everywhere_until_it_is_back(driven: Rig) -> None:
    changed_state(driven)
    assert driven.shows_driveable("yes")
    driven.mcu.command("unplug")
    why = f"serial: cannot open {driven.mcu.port}"
    assert driven.shows_driveable("no", why)
    assert driven.operator.newest("status")["value"]["mcu"]["serial"]["state"] == "absent"
    assert f"; nothing confirms that its motors stand: {why}" in pebble("estop", driven.config, "--remote")
    driven.mcu.command("replug")
    assert driven.shows_driveable("yes")
    pebble("estop", "reset", driven.config, "--remote")
    assert until(lambda: not driven.operator.newest("estop/serial")["latched"])
    driven.operator.send("incoming/drive-values", {"x": 0, "z": 0})  # after a reset nothing drives before a zero


def pebble(*words: object) -> str:
    return "".join(program(*map(str, words)).communicate(timeout=60))


def test_an_operator_dies_while_the_link_is_silent(driven: Rig) -> None:
    operator = Operator(driven.remote.port, BASE)
    drive = Drive(driven, operator)
    with silent(driven):
        changed_state(driven)
        time.sleep(1)
        drive.driver.stop()
        operator.drop()
        time.sleep(2)
    heartbeat = driven.operator.wait_for("outgoing/online", since=time.monotonic() + 0.5)
    assert not driven.mcu.moving(heartbeat.at)
    drive.finish()
