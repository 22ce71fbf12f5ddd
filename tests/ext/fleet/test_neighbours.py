"""Two whole robots at a hub that knows accounts: goob's script drives fred, and what must never move fred."""

from __future__ import annotations

import secrets
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.folder import Fleet, Server, refused
from pebble.extensions.fleet.roles import Account, rules
from pebble.transports.topics import matches
from tests.ext.fleet.secured_hub import SecuredHub
from tests.robot.rig import STOP, Rig
from tests.support import Child, until

FRED, GOOB = "pebble/robots/fred", "pebble/robots/goob"
LEAD = """
from pebble import Robot, run

def main(robot: Robot) -> None:
    fred = robot.neighbour("fred")
    while True:
        fred.drive(z=0.4)
        robot.sleep(0.05)

run(main)
"""
BY_GOOB = (0.4, 0.4)
HOLD_S = 2.1  # after a person's command
OLD_S = 1.0  # what was sent before a stop has arrived or is too old


def neighbour(name: str) -> Account:
    return Account(roles=("neighbour",), bases=(f"pebble/robots/{name}",))


#: Topics at the hub, and whether goob's account writes them and reads them.
TOPICS = {
    f"{FRED}/incoming/from/goob/drive-values": (True, False),
    f"{FRED}/incoming/from/goob/lights-solid": (False, False),
    f"{FRED}/incoming/from/carl/drive-values": (False, False),
    f"{FRED}/incoming/drive-values": (False, False),
    f"{FRED}/outgoing/wheel-odometry": (False, True),
    f"{GOOB}/outgoing/wheel-odometry": (True, True),
    f"{GOOB}/incoming/from/carl/drive-values": (False, True),
    f"{GOOB}/incoming/drive-values": (False, False),
    "pebble/lamps/lamp/outgoing/online": (False, False),
}


@pytest.mark.parametrize("level", ["login", "named"])
def test_an_account_of_a_neighbour_speaks_for_its_own_base(level: Any) -> None:
    held = rules("goob-lan", neighbour("goob"), level, at_hub=True)
    found = {
        topic: tuple(
            any(matches(rule.filter, topic) for rule in held if rule.access == one) for one in ("write", "read")
        )
        for topic in TOPICS
    }
    assert found == TOPICS
    assert rules("goob-lan", neighbour("goob"), level) == (), "at a broker it is nothing"


def test_one_neighbour_has_a_base(tmp_path: Path) -> None:
    accounts = {"goob": Account(roles=("robot",), bases=(GOOB,)), "goob-lan": neighbour("goob")}
    fleet = Fleet(level="login", brokers=(Server(host="127.0.0.1"),), accounts=accounts)
    assert refused(fleet, "two", neighbour("goob")) == f"{GOOB} belongs to goob-lan"
    assert refused(fleet, "two", neighbour("fred")) == ""


class Hall(SecuredHub):
    """The hub, fred and goob."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        accounts = {f"{name}-lan": neighbour(name) for name in ("fred", "goob", "carl")}
        super().__init__(folder, "login", accounts, accounts)
        self._stack = stack
        self.hub.start()
        stack.callback(self.hub.end)
        self.fred = self._robot("fred", shares=["wheel-odometry"], commanded={"goob": ["drive-values"]})
        self.goob = self._robot("goob", listens={"fred": ["wheel-odometry"]})

    def _robot(self, name: str, **section: Any) -> Rig:
        place, account = self.folder / certificates.ACCOUNTS, f"{name}-lan"
        files = {"client_cert": str(place / f"{account}.pem"), "client_key": str(place / f"{account}.key")}
        tls = {"enabled": True, "ca_cert": str(self.folder / certificates.CA_CERT), **files}
        lan = {"connect": [self.endpoint], "account": account, "tls": tls}
        rig = Rig("zenoh", name=name, direct=True, neighbours={"enabled": True, "lan": lan, **section})
        self._stack.callback(rig.close)
        return rig

    def script(self, stack: ExitStack) -> None:
        """goob's script drives fred."""
        path = self.folder / "lead.py"
        path.write_text(LEAD)
        began = time.monotonic()
        self.start(self.goob, path, stack)
        assert until(lambda: self.by_goob(began), 20), self.fred.log.read_text()[-3000:]

    def start(self, robot: Rig, path: Path, stack: ExitStack) -> None:
        script = Child([sys.executable, str(path), "--config", str(robot.config)])
        stack.callback(script.wait, 10)
        stack.callback(script.terminate)

    def by_goob(self, since: float) -> list[float]:
        return [at for at, wheels in self.fred.mcu.drives(since) if wheels == BY_GOOB]

    def stop(self) -> float:
        """Stop fred, by its operator; seconds until its wheels have stopped."""
        began = time.monotonic()
        self.fred.operator.send("incoming/estop", {"stop": secrets.token_hex(8), "by": "ann"})
        assert until(self._latched, 10)
        assert until(lambda: not self.fred.mcu.turning(), 10)
        return max([at for at, drive in self.fred.mcu.motors(began) if drive == STOP], default=began) - began

    def reset(self) -> None:
        if self._latched():
            state = self.fred.operator.last("outgoing/estop/serial")
            assert state is not None
            self.fred.operator.send("incoming/estop-reset", {one: state.json[one] for one in ("boot", "count")})
            assert until(lambda: not self._latched(), 10)

    def _latched(self) -> bool:
        state = self.fred.operator.last("outgoing/estop/serial")
        return state is not None and state.json["latched"]

    def rests(self, timeout: float = 5.0) -> None:
        """Wait until fred's wheels rest, it is not stopped, and no person drives it."""
        self.reset()
        assert until(lambda: not self.fred.mcu.turning(), timeout)
        time.sleep(HOLD_S)


@pytest.fixture(scope="module")
def hall() -> Iterator[Hall]:
    with tempfile.TemporaryDirectory(prefix="pbl") as folder, ExitStack() as stack:
        yield Hall(Path(folder), stack)


@pytest.mark.thorough
@pytest.mark.alone
def test_a_script_drives_another_robot_until_a_person_does_or_stops_it(hall: Hall) -> None:
    with ExitStack() as script:
        hall.script(script)
        began = time.monotonic()
        hall.fred.operator.send("incoming/drive-values", {"x": 0, "z": -0.3})
        assert until(lambda: (-0.3, -0.3) in [wheels for _, wheels in hall.fred.mcu.drives(began)])
        taken = next(at for at, wheels in hall.fred.mcu.drives(began) if wheels == (-0.3, -0.3)) - began
        time.sleep(OLD_S)
        assert (hall.by_goob(began + OLD_S / 2), taken < 1.0) == ([], True)
    hall.rests()
    with ExitStack() as script:
        hall.script(script)
        stopped = time.monotonic()
        stop = hall.stop()
        time.sleep(OLD_S)
        moved = [drive for at, drive in hall.fred.mcu.motors(stopped + stop) if drive != STOP]
        assert (moved, stop <= 1.0) == ([], True)
