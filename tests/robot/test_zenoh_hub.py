"""A whole robot whose operators have accounts at a Zenoh hub: that of the operators, or its own."""

from __future__ import annotations

import json
import statistics
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.config import load
from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.folder import ZENOH
from pebble.runtime.connections import local_transport
from pebble.transports import Message, QoS, ZenohSettings, create
from tests.ext.fleet.test_attempts import GOOB
from tests.ext.fleet.test_zenoh import Hall
from tests.robot.operator import ReceivedMessage
from tests.robot.rig import Rig
from tests.support import WAIT_S, beside, cases, further, until

pytestmark = pytest.mark.alone  # stops are timed

STATE = "outgoing/estop/serial"


class Watcher:
    """What a rig needs of its operator, by Zenoh."""

    def __init__(self, settings: ZenohSettings) -> None:
        self.newest: dict[str, ReceivedMessage] = {}
        self._client = create("zenoh", "watcher", settings).open(WAIT_S)
        self._client.subscribe(f"{GOOB}/outgoing/#", self._receive, direct=True)
        self.close = self._client.close

    def last(self, suffix: str) -> ReceivedMessage | None:
        return self.newest.get(suffix)

    def _receive(self, message: Message) -> None:
        suffix = message.topic.removeprefix(f"{GOOB}/")
        self.newest[suffix] = ReceivedMessage(time.monotonic(), message.topic, message.payload, message.retain)


@contextmanager
def at_the_operators_hub(hall: Hall) -> Iterator[Rig]:
    goob = hall.settings("goob")
    assert goob.tls is not None
    tls = {"enabled": True, **{name: str(getattr(goob.tls, name)) for name in ("ca_cert", "client_cert", "client_key")}}
    remote = {"kind": "zenoh", "connect": list(goob.connect), "account": "goob", "tls": tls}
    with hall.running():
        operator: Any = Watcher(hall.local)
        with Rig("zenoh", name="goob", operator=operator, start=False) as rig:
            raw = json.loads(rig.config.read_text()) | {"security": {"level": "named", "strangers": "free"}}
            raw["services"]["mqtt_bridge"] = {"enabled": True, "remote": remote, "link": {"groups": True}}
            started(rig, raw)
            assert until(lambda: "have a connection of their own" in rig.log.read_text())
            yield rig


@contextmanager
def at_its_own_hub(hall: Hall) -> Iterator[Rig]:
    files = {
        "ca_cert": certificates.CA_CERT,
        "client_cert": certificates.SERVER_CERT,
        "client_key": certificates.SERVER_KEY,
    }
    tls = {"enabled": True, **{name: str(hall.folder / file) for name, file in files.items()}}
    with Rig("zenoh", name="goob", start=False) as rig:
        raw = json.loads(rig.config.read_text())
        raw["transport"] |= {"listen": [hall.endpoint], "access": str(hall.folder / ZENOH), "tls": tls}
        started(rig, raw)
        yield rig


def started(rig: Rig, raw: dict[str, Any]) -> None:
    rig.config.write_text(json.dumps(raw))
    rig.config.chmod(0o600)
    rig.start()


def test_a_group_of_commands_passes_over_zenoh(tmp_path: Path) -> None:
    hall, group = Hall(tmp_path / "hall", "named"), {"drive-values": {"z": 0.3}, "lights-solid": {"g": 1}}
    with (
        at_the_operators_hub(hall) as rig,
        closing(create("zenoh", "otto", hall.settings("otto")).open(WAIT_S)) as otto,
    ):

        def turns() -> bool:
            otto.publish(f"{GOOB}/incoming/by/otto/group", json.dumps(group).encode(), qos=QoS.DELIVERED)
            return until(rig.mcu.turning, 0.3)

        assert until(turns)
        lines = [entry.line for entry in rig.mcu.entries() if entry.event == "line"]
        assert "M 0.300 0.300, L 0.000 1.000 0.000" in ", ".join(lines), "one write"


class Program:
    """A program of the robot drives it, ten times as often as it must; ``opened`` ends it."""

    def __init__(self, rig: Rig, opened: ExitStack) -> None:
        self._rig, self._z, self._state = rig, 0.0, dict[str, Any]()
        self._commands = 0  # that were sent
        self._here = opened.enter_context(local_transport(load(rig.config), "program"))
        self._here.subscribe(
            f"{GOOB}/{STATE}", lambda message: self._state.update(json.loads(message.payload)), direct=True
        )
        self._ended = threading.Event()
        opened.enter_context(beside(self._run, self._ended))

    def drive(self, stop: str) -> None:
        """Reset the stop of before, if there was one, and turn the wheels."""
        self._z = 0.0
        assert until(lambda: stop in ("", *self._state.get("recent", []))), self._state
        assert until(self._is_reset, step=0.05)
        enough = self._commands + 2
        assert until(lambda: self._commands >= enough)  # after a reset nothing drives before a zero
        self._z = 0.3
        assert until(self._rig.mcu.turning)

    def _is_reset(self) -> bool:
        if self._state["latched"]:
            self._send("estop-reset", {one: self._state[one] for one in ("boot", "count")})
        return not self._state["latched"]

    def _run(self) -> None:
        while not self._ended.wait(0.05):
            self._send("drive-values", {"x": 0, "z": self._z})
            self._commands += 1

    def _send(self, metric: str, body: dict[str, Any]) -> None:
        self._here.publish(f"{GOOB}/incoming/{metric}", json.dumps(body).encode(), qos=QoS.DELIVERED, urgent=True)


@pytest.mark.parametrize(
    ("where", "level", "floods", "metric"),
    [
        (at_the_operators_hub, "named", "vera", "by/vera/front-camera"),
        (at_its_own_hub, "login", "otto", "drive-values"),
        further(at_the_operators_hub, "named", "lan", "from/fred/drive-values"),
        further(at_the_operators_hub, "named", "gate", "by/vera/front-camera"),
    ],
)
def test_small_messages_of_another_account_hold_up_no_stop(
    where: Any, level: Any, floods: str, metric: str, tmp_path: Path
) -> None:
    """A viewer, a neighbour, a gateway, or at the robot's own hub a driver, sends more than the robot reads; a stop
    that is sent once stops it.

    It came seconds later or not at all: behind what waits for the robot, as too old, or with the connection that a hub
    closes where there is no room.
    """
    hall, took = Hall(tmp_path / "hall", level), list[float]()
    by = "by/sam/" if level == "named" else ""
    with ExitStack() as opened:
        rig = opened.enter_context(where(hall))
        sam = opened.enter_context(closing(create("zenoh", "sam", hall.settings("sam")).open(WAIT_S)))
        program = Program(rig, opened)
        opened.enter_context(hall.account(floods, topics=[f"{GOOB}/incoming/{metric}"], flood="messages"))
        assert until(lambda: "front-camera" in rig.log.read_text() or not metric.endswith("camera"))
        name = ""
        for number in range(cases(3, 20)):
            program.drive(name)
            name, pressed = f"f{number:015x}", time.monotonic()
            sam.publish(
                f"{GOOB}/incoming/{by}estop", json.dumps({"stop": name}).encode(), qos=QoS.DELIVERED, urgent=True
            )
            assert until(lambda: not rig.mcu.turning()), took
            took.append(time.monotonic() - pressed)
    assert statistics.median(took) < 3, took
