"""Programs that know only plain MQTT take part on a Zenoh robot: mosquitto's clients in C."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.robot.operator import Operator, retained_messages
from tests.robot.rig import BASE, Rig
from tests.support import until

DRIVE = f"{BASE}/incoming/drive-values"


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    """A Zenoh robot with a mirror on its local broker, up and linked."""
    with Rig("zenoh", mirror=True) as rig:
        assert rig.local is not None
        program = Operator(rig.local.port, BASE)
        program.wait_for("outgoing/charging-level")
        program.close()
        yield rig


def local_port(rig: Rig) -> str:
    assert rig.local is not None
    return str(rig.local.port)


def pub(rig: Rig, topic: str, body: Any, *options: str) -> None:
    command = ["mosquitto_pub", "-p", local_port(rig), "-t", topic, "-q", "1", "-m", json.dumps(body), *options]
    subprocess.run(command, check=True, timeout=10)


def sub(rig: Rig, filter_: str, *options: str) -> subprocess.Popen[str]:
    """``mosquitto_sub``, printing "retained topic payload" for each message."""
    command = ["mosquitto_sub", "-p", local_port(rig), "-t", filter_, "-q", "1", "-F", "%r %t %p", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def test_a_c_client_receives_retained_state_and_streams(rig: Rig) -> None:
    out, _ = sub(rig, f"{BASE}/outgoing/#", "-W", "2").communicate(timeout=10)
    received = [line.split(" ", 2)[:2] for line in out.splitlines()]
    retained = {topic.removeprefix(f"{BASE}/outgoing/") for retained, topic in received if retained == "1"}
    live = {topic.removeprefix(f"{BASE}/outgoing/") for retained, topic in received if retained == "0"}
    assert retained >= {"capabilities", "status", "charging-level", "charging-status"}
    assert "touch-sensors" in live - retained


def test_a_c_client_drives(rig: Rig) -> None:
    began = time.monotonic()
    pub(rig, DRIVE, {"x": 0.1, "z": 0.4})
    assert until(lambda: (0.5, 0.3) in [wheels for _, wheels in rig.mcu.drives(began)], 3)


def test_a_c_client_receives_each_command_once(rig: Rig) -> None:
    """Its own command and the operator's: neither arrives twice, neither is retained."""
    listener = sub(rig, DRIVE, "-C", "3", "-W", "5")
    time.sleep(0.5)  # nothing announces that mosquitto_sub has subscribed
    pub(rig, DRIVE, {"z": 0.11})
    rig.operator.send("incoming/drive-values", {"z": 0.22})
    out, _ = listener.communicate(timeout=10)
    assert sorted(out.splitlines()) == [f'0 {DRIVE} {{"z": 0.11}}', f'0 {DRIVE} {{"z": 0.22}}']


def test_a_c_client_sets_a_flag_for_every_client(rig: Rig) -> None:
    pub(rig, f"{BASE}/incoming/flags/mqtt-video", {"value": True}, "-r")
    assert until(lambda: rig.operator.last("incoming/flags/mqtt-video") is not None, 5)
    assert until(
        lambda: retained_messages(rig.remote.port, BASE, 0.2).get("incoming/flags/mqtt-video") == b'{"value": true}', 5
    )
    rig.operator.send("incoming/flags/mqtt-video", {"value": False}, retain=True)
    assert until(
        lambda: (
            retained_messages(int(local_port(rig)), BASE, 0.2).get("incoming/flags/mqtt-video") == b'{"value": false}'
        ),
        5,
    )
