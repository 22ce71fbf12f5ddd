"""Kept messages that were there before the robot: commands are stale and stay where they are, flags settle."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.robot.operator import Operator, kept_copies
from tests.robot.rig import BASE, Rig
from tests.support import until

pytestmark = pytest.mark.alone  # deadlines are checked

COMMANDS: dict[str, Any] = {
    "incoming/drive-values": {"x": 0, "z": 1},
    "incoming/lights-solid": {"r": 1},
    "incoming/flags/reboot": True,
    "incoming/flags/git-pull": {"value": True},
    "incoming/flags/service-restart": {"enabled": True},
    "incoming/soundboard-command": {"action": "play", "file": "a.wav"},
    "incoming/autonomy-command": {"action": "start", "file": "x"},
    "incoming/never-heard-of": {"x": 1},
}


def keep(port: int, messages: dict[str, Any]) -> None:
    """Leave kept copies at a broker, and see that they are there."""
    somebody = Operator(port, BASE)
    for topic, body in messages.items():
        somebody.send(topic, body, retain=True)
    assert until(lambda: set(kept_copies(port, BASE, 0.2)) >= set(messages), 5)
    somebody.close()


def clear(port: int, topics: dict[str, Any]) -> None:
    keep_nothing = Operator(port, BASE)
    for topic in topics:
        keep_nothing.send(topic, b"", retain=True)
    assert until(lambda: not set(kept_copies(port, BASE, 0.2)) & set(topics), 5)
    keep_nothing.close()


def assert_untouched(rig: Rig) -> None:
    """No wheel, no light, no action since the robot exists."""
    assert not [entry.line for entry in rig.mcu.entries() if entry.line[:1] in "LF"]
    assert not [wheels for _, wheels in rig.mcu.drives() if wheels != (0.0, 0.0)]
    assert rig.recorded() == []


@pytest.fixture(params=["mqtt", "zenoh", "single", "mirror"])
def unstarted(request: pytest.FixtureRequest) -> Iterator[Rig]:
    kind, mirror = ("zenoh", True) if request.param == "mirror" else (request.param, False)
    with Rig(kind, mirror=mirror, start=False) as rig:
        yield rig


@pytest.fixture(params=["mqtt", "mirror"])
def two_brokers(request: pytest.FixtureRequest) -> Iterator[Rig]:
    mirror = request.param == "mirror"
    with Rig("zenoh" if mirror else "mqtt", mirror=mirror, start=False) as rig:
        yield rig


def test_kept_commands_at_the_remote_broker(unstarted: Rig) -> None:
    """None runs at the start, none after an uplink outage, none crosses."""
    keep(unstarted.remote.port, COMMANDS)
    unstarted.start()
    assert_still_untouched(unstarted)
    unstarted.uplink.drop()
    cut = time.monotonic()
    unstarted.operator.wait_for("outgoing/online", since=cut + 0.3)
    assert_still_untouched(unstarted)


def assert_still_untouched(rig: Rig) -> None:
    """Also after a live command that came behind the kept ones has been through."""
    began = time.monotonic()
    rig.operator.send("incoming/lights-flash", {"g": 0.5})
    assert until(lambda: any(entry.line[:1] == "F" for entry in rig.mcu.entries(began)), 5)
    assert not [entry.line for entry in rig.mcu.entries() if entry.line[:1] == "L"]
    assert not [wheels for _, wheels in rig.mcu.drives() if wheels != (0.0, 0.0)]
    assert rig.recorded() == []


def test_kept_commands_do_not_cross_from_remote_to_local(two_brokers: Rig) -> None:
    assert two_brokers.local is not None
    keep(two_brokers.remote.port, COMMANDS)
    two_brokers.start()
    assert_still_untouched(two_brokers)
    assert not set(kept_copies(two_brokers.local.port, BASE)) & set(COMMANDS)


def test_kept_commands_at_the_local_broker(two_brokers: Rig) -> None:
    """Neither executed nor carried to the remote side, not even with everything mirrored."""
    assert two_brokers.local is not None
    keep(two_brokers.local.port, COMMANDS)
    keep(two_brokers.remote.port, {"incoming/flags/remote-mirror": True})
    two_brokers.start()
    assert_still_untouched(two_brokers)
    assert not set(kept_copies(two_brokers.remote.port, BASE)) & set(COMMANDS)


def test_kept_flags_that_differ_end_as_the_remote_side_says(two_brokers: Rig) -> None:
    flag = "incoming/flags/mqtt-video"
    assert two_brokers.local is not None
    keep(two_brokers.local.port, {flag: {"value": True}})
    keep(two_brokers.remote.port, {flag: {"value": False}})
    watchers = [Operator(broker.port, BASE) for broker in (two_brokers.local, two_brokers.remote)]
    two_brokers.start()
    assert until(lambda: watchers[0].last(flag).json == {"value": False}, 10)
    time.sleep(1)  # long enough for hundreds of rounds, if it flapped
    for watcher in watchers:
        assert watcher.last(flag).json == {"value": False}
        assert len(watcher.on(flag)) <= 3
        watcher.close()


def test_a_flag_set_locally_during_an_outage_wins(two_brokers: Rig) -> None:
    flag = "incoming/flags/mqtt-audio"
    assert two_brokers.local is not None
    two_brokers.start()
    two_brokers.operator.send(flag, {"value": False}, retain=True)
    local = Operator(two_brokers.local.port, BASE)
    assert until(lambda: (seen := local.last(flag)) is not None and seen.json == {"value": False}, 5)
    two_brokers.uplink.hole()
    time.sleep(3)  # noticed after 2 s
    local.send(flag, {"value": True}, retain=True)
    two_brokers.uplink.resume()
    assert until(lambda: two_brokers.operator.last(flag).json == {"value": True}, 10)
    assert until(lambda: kept_copies(two_brokers.remote.port, BASE, 0.2)[flag] == b'{"value": true}', 5)
    assert local.last(flag).json == {"value": True}
    local.close()
