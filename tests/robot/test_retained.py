"""Messages retained before the robot starts: commands are stale and are not forwarded."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.robot.operator import Operator, retained_messages
from tests.robot.rig import BASE, Rig
from tests.support import further, until

pytestmark = pytest.mark.alone  # deadlines are checked

COMMANDS: dict[str, Any] = {
    "incoming/drive-values": {"x": 0, "z": 1},
    "incoming/lights-solid": {"r": 1},
    "incoming/flags/reboot": True,
    "incoming/flags/git-pull": {"value": True},
    "incoming/flags/service-restart": {"enabled": True},
    "incoming/soundboard-command": {"action": "play", "file": "a.wav"},
    "incoming/autonomy-command": {"action": "start", "file": "x"},
    "incoming/not-in-the-contract": {"x": 1},
}
OLD_STOP = {"incoming/estop": {"stop": "00000000000000a0"}}


def retain_messages(port: int, messages: dict[str, Any]) -> None:
    """Publish retained messages to a broker, and wait until it has them."""
    publisher = Operator(port, BASE)
    for topic, body in messages.items():
        publisher.send(topic, body, retain=True)
    assert until(lambda: set(retained_messages(port, BASE, 0.2)) >= set(messages))
    publisher.close()


@pytest.fixture(params=["mqtt", "zenoh", further("single"), further("mirror")])
def unstarted(request: pytest.FixtureRequest) -> Iterator[Rig]:
    kind, mirror = ("zenoh", True) if request.param == "mirror" else (request.param, False)
    with Rig(kind, mirror=mirror, start=False) as rig:
        yield rig


def test_what_is_retained_does_nothing_and_a_live_stop_that_asks_to_be_retained_stops(unstarted: Rig) -> None:
    """Neither at the start, nor when the uplink comes back. Afterwards the broker has the live stop, now old."""
    rig, state = unstarted, "outgoing/estop/serial"
    retain_messages(rig.remote.port, COMMANDS | OLD_STOP)
    if rig.local is not None:
        retain_messages(rig.local.port, OLD_STOP)
    rig.start()
    for _ in range(2):
        assert not rig.operator.wait_for(state).json["latched"]
        assert_untouched(rig)
        rig.uplink.drop()
        rig.operator.wait_for("outgoing/online", since=time.monotonic() + 0.3)
    if rig.local is not None:
        assert not set(retained_messages(rig.local.port, BASE)) & set(COMMANDS)
    began = time.monotonic()
    assert until(lambda: _turns(rig, began))
    assert not any(seen.json["latched"] or seen.json["count"] for seen in rig.operator.on(state))
    assert until(lambda: _is_stopped(rig, state), step=0.2)
    stopped = time.monotonic()
    assert not until(lambda: _turns(rig, stopped), 1)


def assert_untouched(rig: Rig) -> None:
    """Nothing happened, not even after a live command that followed the retained ones has been carried out."""
    began = time.monotonic()

    def flashes() -> bool:
        rig.operator.send("incoming/lights-flash", {"g": 0.5})
        return until(lambda: any(entry.line[:1] == "F" for entry in rig.mcu.entries(began)), 1)

    assert until(flashes), "no live command was carried out"
    assert not [entry.line for entry in rig.mcu.entries() if entry.line[:1] == "L"]
    assert not [wheels for _, wheels in rig.mcu.drives() if wheels != (0.0, 0.0)]
    assert rig.recorded() == []


def _is_stopped(rig: Rig, state: str) -> bool:
    """Whether the robot has latched a stop sent now, or an earlier one of the same name."""
    rig.operator.send("incoming/estop", {"stop": "00000000000000a1", "by": "test"}, retain=True)
    return [seen.json["recent"] for seen in rig.operator.on(state) if seen.json["latched"]][-1:] == [
        ["00000000000000a1"]
    ]


def _turns(rig: Rig, since: float) -> bool:
    """Whether a wheel turns for a command sent now."""
    rig.operator.send("incoming/drive-values", {"x": 0, "z": 0.5})
    time.sleep(0.05)
    return any(wheels != (0.0, 0.0) for _, wheels in rig.mcu.drives(since))
