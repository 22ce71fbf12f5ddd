"""What is retained under a name that a robot had before goes, unless the name is another robot's now."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from pebble.config import load
from pebble.services.mqtt_bridge.requests.earlier_names import EarlierNames
from pebble.transports import Transport
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.services.mqtt_bridge.bridge_rig import Client, MemoryRig
from tests.support import until

OLD = "pebble/robots/rover"
_ARRIVES_S = 0.02  # what a hub of memory distributes
LEFT = ("outgoing/online", "outgoing/capabilities", "outgoing/mcu/x/value", "incoming/flags/mqtt-audio")


class Named:
    """A robot that is started again and again under names, at one broker."""

    def __init__(self, folder: Path, make: Callable[[str], Transport]) -> None:
        self.make, self.config = make, folder / "robot.json"
        self.state = folder / "state"
        self.client = Client(make("operator"), OLD, listen=False)

    def start(self, name: str, meanwhile: Callable[[], None] = lambda: None, *, connected: bool = True) -> None:
        """``meanwhile`` happens after it has begun to watch."""
        transport = {"kind": "zenoh", "state_dir": str(self.state)}
        self.config.write_text(json.dumps({"robot": {"id": name}, "transport": transport}))
        robots_own = MemoryHub()
        if not connected:
            robots_own.stop()
        sides = [self.make(name), MemoryTransport(f"{name}-local", robots_own)]
        for side in sides:
            side.open(5 if connected else 0.5)
        jobs: list[Callable[[], None]] = [meanwhile]
        names = EarlierNames(load(self.config), sides, lambda _seconds, job: jobs.append(job))  # type: ignore[arg-type]
        names.begin()
        while jobs:
            jobs.pop(0)()
            until(lambda: False, _ARRIVES_S)
        for side in sides:
            side.close()

    def leave(self) -> None:
        for suffix in LEFT:
            self.client.publish(suffix, b'{"online": false}', retain=True)

    @property
    def left(self) -> list[str]:
        looker = Client(self.make("looker"), OLD)
        until(lambda: False, _ARRIVES_S)
        found = sorted(message.topic.removeprefix(f"{OLD}/") for message in looker.seen)
        looker.transport.close()
        return found

    @property
    def known(self) -> list[str]:
        (file,) = self.state.iterdir()
        return [name.rpartition("/")[2] for name in json.loads(file.read_text())]


@pytest.fixture
def robot(tmp_path: Path) -> Named:
    hub = MemoryHub()
    return Named(tmp_path, lambda name: MemoryTransport(name, hub))


def test_what_was_retained_under_an_earlier_name_is_removed(robot: Named) -> None:
    robot.start("rover")
    robot.leave()
    robot.start("rover")
    assert robot.left == sorted(LEFT)
    robot.start("rover-two")
    assert robot.left == []
    robot.client.publish("outgoing/online", b'{"online": false}', retain=True)  # a late will
    robot.start("rover-two")
    assert (robot.left, robot.known) == ([], ["rover", "rover-two"])
    robot.start("rover-two")
    assert robot.known == ["rover-two"]


def test_what_another_robot_retains_stays(robot: Named) -> None:
    robot.start("rover")
    robot.leave()
    beats = iter(range(1_000_000))

    def beat() -> None:
        for _ in range(2):
            robot.client.publish("outgoing/online", b'{"t": %d}' % next(beats), retain=True)

    robot.start("rover-two", beat)
    assert (robot.left, robot.known) == (sorted(LEFT), ["rover-two"])


def test_without_a_connection_it_is_tried_at_the_next_start(robot: Named) -> None:
    robot.start("rover")
    robot.leave()
    robot.start("rover-two", connected=False)
    assert (robot.left, robot.known) == (sorted(LEFT), ["rover", "rover-two"])
    robot.start("rover-two")
    assert robot.left == []


@pytest.mark.parametrize("text", ['["pebble/#/x"]', "[7]", '["pebble/robots"]'])
def test_a_damaged_file_removes_nothing(robot: Named, text: str) -> None:
    robot.start("rover")
    robot.leave()
    (file,) = robot.state.iterdir()
    file.write_text(text)
    robot.start("rover-two")
    assert (robot.left, robot.known) == (sorted(LEFT), ["rover-two"])


def test_a_bridge_looks_for_them_once_it_forwards(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    begun: list[EarlierNames] = []
    monkeypatch.setattr(EarlierNames, "begin", lambda names: begun.append(names))
    rig = MemoryRig(monkeypatch)
    rig.bridge()
    assert until(lambda: begun)
    rig.close()
    assert "failed at the bridge" not in caplog.text
