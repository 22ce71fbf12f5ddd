"""A whole robot at the level named, behind a broker that knows roles: who drives it, and what else has no effect."""

from __future__ import annotations

import itertools
import json
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Literal

import pytest
from msgspec.structs import replace

from pebble.config import load
from pebble.forwarding.retained_window import INITIAL_SYNC_S
from pebble.runtime.connections import local_transport
from pebble.transports import Message
from tests.ext.fleet.broker_client import BrokerClient, Place
from tests.ext.fleet.brokers import HOST
from tests.kit.terminal import Terminal
from tests.robot.named import CONTROL, DRIVE, Hall, Named
from tests.robot.operator import Operator, driving
from tests.robot.rig import BASE, STOP, lines
from tests.support import beside, cases, until

pytestmark = pytest.mark.alone  # lines are counted

ESTOP, FLAG = "outgoing/estop/serial", "flags/mqtt-video"
FLOOD_S = float(cases(2, 60))


@pytest.fixture(scope="module", params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Named]:
    with Hall(tmp_path_factory.mktemp("hall") / "hall") as hall, Named(request.param, hall, {"level": "named"}) as one:
        yield one


def test_only_who_has_control_drives(rig: Named) -> None:
    """Not another with the holder's key, nor without, nor without a name, nor with an old key."""
    with rig.held("otto") as old:
        rig.judged("otto", old, 0.11)
    robot = rig.person("rover")  # whose account may publish everything below its base
    with rig.held("mia") as key:
        rig.send("otto", DRIVE, {"x": 0, "z": 0.12, "key": key})
        rig.send("otto", DRIVE, {"x": 0, "z": 0.12, "key": key, "by": "mia"})
        rig.send("mia", DRIVE, {"x": 0, "z": 0.13})
        rig.send("mia", DRIVE, {"x": 0, "z": 0.14, "key": old})
        rig.person("mia").send(f"incoming/{DRIVE}", {"x": 0, "z": 0.15, "key": key})
        rig.person("otto").send(f"incoming/by/mia/{DRIVE}", {"x": 0, "z": 0.16, "key": key})
        robot.send(f"incoming/{DRIVE}", {"x": 0, "z": 0.17, "key": key, "by": "mia"})
        robot.send(f"incoming/by/otto/by/mia/{DRIVE}", {"x": 0, "z": 0.18, "key": key})
        rig.send("mia", DRIVE, {"x": 0, "z": 0.19, "key": key, "source": "autonomy", "run": 7})
        rig.send("mia", DRIVE, {"x": 0, "z": 0.19, "key": key}, retain=True)
        wanted = [round(0.2 + number / 1000, 3) for number in range(10)]
        for z in wanted:
            rig.judged("mia", key, z)
        for name, suffix, more in (
            ("otto", f"incoming/by/otto/{DRIVE}", {"key": "ffffffff"}),
            ("rover", f"incoming/{DRIVE}", {}),
            ("otto", f"incoming/by/otto/{DRIVE}", {"source": "autonomy", "run": 9}),
        ):
            rig.judged("mia", key, 0.3)
            zeroed = time.monotonic()
            rig.person(name).send(suffix, {"x": 0, "z": 0, **more})
            assert until(lambda since=zeroed: lines(rig, 0.0, since), 5), (name, suffix)
            assert until(lambda: not rig.mcu.moving(), 5)
    assert [z for z in (0.12, 0.13, 0.14, 0.15, 0.16, 0.17, 0.18, 0.19) if lines(rig, z)] == []
    capabilities = rig.operator.last("outgoing/capabilities")
    assert capabilities is not None
    assert capabilities.json["value"]["named"] is True


def test_who_takes_control_over_drives_and_only_they_start_scripts(rig: Named) -> None:
    start = {"action": "start", "file": "no-such-script"}
    with rig.held("otto") as old, driving(_By(rig, "otto"), 0.5, key=old):
        assert until(lambda: lines(rig, 0.5), 5)
        rig.send("mia", "control/take", {"id": "bbbbbbbb", "for_ms": 10_000})  # a driver has no right to
        with rig.held("boss", "control/take") as key:
            taken = time.monotonic()
            rig.judged("boss", key, 0.6)
            assert not [at for at in lines(rig, 0.5) if at > taken + 0.5]
            for name, error in (("otto", "boss has control"), ("boss", "Unknown autonomy file")):
                found = lambda e=error: e in str(rig.operator.last("outgoing/autonomy-status").json["error"])  # type: ignore[union-attr]  # noqa: E731
                assert rig.sends(name, "autonomy-command", start, found), error


def test_a_terminal_takes_control_by_its_account_is_asked_and_is_taken_over(rig: Named, tmp_path: Path) -> None:
    password = tmp_path / "otto-password"
    password.write_text(rig.hall.passwords["otto"])
    password.chmod(0o600)
    url = f"mqtt://otto@127.0.0.1:{rig.hall.plain_port}"
    drive = [sys.executable, "-m", "pebble.cli", "drive", "rover", "--url", url, "--password-file", str(password)]
    with closing(Terminal(*drive)) as console:
        assert console.sees("ready"), console.shown
        assert (rig.state()["by"].partition("/")[0], rig.state()["named"]) == ("otto", True)
        began = time.monotonic()
        console.hold(b"w")
        assert until(lambda: rig.mcu.moving(began), 5)
        asks = {"id": "cccccccc", "for_ms": 10_000}
        assert rig.sends("mia", CONTROL, asks, lambda: rig.state()["asks_id"] == "cccccccc")
        assert console.sees("mia asks for control: l lets mia drive"), console.shown
        with rig.held("boss", "control/take") as key:
            rig.judged("boss", key, 0.33)
            taken = time.monotonic()
            rig.judged("boss", key, 0.34)
            assert {wheels for _, wheels in rig.mcu.drives(taken)} <= {STOP, (0.33, 0.33), (0.34, 0.34)}, (
                "the key is held"
            )
            assert console.sees("boss (name checked) is driving"), console.shown
        rig.send("mia", CONTROL, {"id": "cccccccc", "want": "release"})


def test_everybody_stops_it_and_only_a_safety_officer_resets_it(rig: Named) -> None:
    with rig.held("otto") as key, driving(_By(rig, "otto"), 0.7, key=key):
        for suffix, by in (("incoming/by/vera/estop", "vera"), ("incoming/estop", "somebody?")):
            assert until(lambda: rig.mcu.moving(), 5)
            rig.person("vera").send(suffix, {"stop": f"{len(suffix):016x}", "by": by})
            assert until(lambda: not rig.mcu.moving(), 5)
            assert until(lambda: state_of(rig)["latched"], 5)
            stopped = state_of(rig)
            assert stopped["by"].split("/")[0] == by  # with a mark where it was not checked
            reset = {one: stopped[one] for one in ("boot", "count")}
            rig.send("otto", "estop-reset", reset)
            rig.person("rover").send("incoming/estop-reset", reset)
            assert state_of(rig)["latched"]
            assert rig.sends("boss", "estop-reset", reset | {"by": "ann"}, lambda: not state_of(rig)["latched"])
            rig.send("otto", DRIVE, {"x": 0, "z": 0, "key": key})  # lets go


def state_of(rig: Named) -> dict[str, Any]:
    last = rig.operator.last(ESTOP)
    return {} if last is None else last.json


def test_wills_move_nothing(rig: Named) -> None:
    with rig.held("zoe") as old:
        rig.judged("zoe", old, 0.31)
    waiting = [
        rig.hall.client(name, will=(f"incoming/{by}{DRIVE}", {"x": 0, "z": 0.41, "key": old}))
        for name, by in (("zoe", ""), ("zoe", "by/zoe/"), ("otto", "by/zoe/"), ("rover", ""))
    ]
    with rig.held("zoe") as key:
        for client in waiting:
            client.drop()
        rig.judged("zoe", key, 0.42)
    assert lines(rig, 0.41) == []


def test_who_is_removed_while_driving_stands(rig: Named) -> None:
    with ExitStack() as ends:
        key = ends.enter_context(rig.held("zoe", for_ms=2000))
        ends.enter_context(driving(_By(rig, "zoe"), 0.8, key=key))
        assert until(lambda: lines(rig, 0.8), 5)
        removed = time.monotonic()
        rig.hall.remove("zoe")
        assert until(lambda: not rig.mcu.moving(), 5)
        stood = next(at for at, wheels in rig.mcu.drives(removed) if wheels == STOP)
        assert stood - removed < 4, "a second, on a machine that has nothing else to do"
    assert until(lambda: rig.state()["key"] == "", 15)


class _By:
    """An operator who publishes under a name."""

    def __init__(self, rig: Named, name: str) -> None:
        self._rig, self._name = rig, name

    def send(self, suffix: str, body: Any, **options: Any) -> None:
        self._rig.send(self._name, suffix.removeprefix("incoming/"), body, **options)


# -- flags


def retained(rig: Named) -> list[bytes]:
    """What both sides retain of the flag: the robot's own, then its remote broker."""
    topic = f"{BASE}/incoming/{FLAG}"
    with ExitStack() as ends:
        here = ends.enter_context(local_transport(load(rig.config), "flags"))
        there = ends.enter_context(rig.hall.login("rover"))
        values: list[Message] = []
        here.subscribe(topic, values.append, direct=True)
        there.subscribe([topic])
        until(lambda: values, 1)
        until(lambda: there.listen(0.01) or there.received, 1)
        return [one.payload for one in values[-1:]] + [payload for _, payload in there.received[-1:]]


@pytest.mark.parametrize("order", ["bridge, broker", "broker, bridge", "robot, broker", "older"])
def test_a_flag_by_name_stays_on_both_sides(rig: Named, order: str) -> None:
    """After restarts in each order; and where the broker retains an older value, as it was killed before it saved."""
    for value in (b"true", b"false", b"true"):
        rig.send("mia", FLAG, value)
        assert until(lambda v=value: retained(rig) == [v, v], 10), retained(rig)
    rig.person("mia").send(f"incoming/{FLAG}", b"false", retain=True)  # the broker refuses it
    steps: dict[str, Callable[[], object]] = {
        "bridge": lambda: rig.kill("mqtt_bridge"),
        "broker": lambda: (rig.hall.stop(), rig.hall.start()),
        "robot": lambda: (rig.stop(), rig.start(ready=False)),
        "older": lambda: (
            rig.stop(),
            rig.person("rover").send(f"incoming/{FLAG}", b"false", retain=True),
            rig.start(ready=False),
        ),
    }
    for step in order.split(", "):
        began = time.monotonic()
        steps[step]()
        rig.wait_until_up(began, 30)
    assert until(lambda: retained(rig) == [b"true", b"true"], 15), retained(rig)


@pytest.fixture
def flooded(tmp_path: Path) -> Iterator[Named]:
    """A robot of its own: what is left of a flood takes its time."""
    with Hall(tmp_path / "hall") as hall, Named("zenoh", hall, {"level": "named"}) as one:
        yield one


def test_what_another_account_sends_holds_up_no_stop(flooded: Named) -> None:
    """A viewer floods what it may write, requests for pictures of 60 KB: faster than the robot reads."""
    rig = flooded
    assert until(lambda: "have a connection of their own" in rig.log.read_text(), 10)
    ending, sent, took = threading.Event(), itertools.count(), list[float]()

    def flood() -> None:
        place = Place(HOST, rig.remote.port, None)
        with BrokerClient(place, "vera", rig.hall.passwords["vera"], timeout_s=30) as vera:
            while not ending.is_set():
                vera.publish(f"{BASE}/incoming/by/vera/front-camera", b"[" * 60_000)
                next(sent)

    with beside(flood, ending):
        began = time.monotonic()
        while len(took) < 3 or time.monotonic() < began + FLOOD_S:
            assert until(lambda: next(sent) > 100, 10)
            name, pressed = f"f{len(took):015x}", time.monotonic()
            rig.person("mia").send("incoming/estop", {"stop": name})  # once
            assert until(lambda n=name: n in state_of(rig).get("recent", []), 10), took
            took.append(time.monotonic() - pressed)
    assert statistics.median(took) < 1, took
    order = {one: state_of(rig)[one] for one in ("boot", "count")}
    assert rig.sends("boss", "estop-reset", order, lambda: not state_of(rig)["latched"], 30), state_of(rig)


# -- from a broker with logins to names, as docs/ext/fleet.md has it


class Old(Operator):
    """A client of the original's shape: it logs in, and knows neither names nor control.

    Its account has all rights of people; the broker has passed on what it sent before the next message is sent.
    """

    def __init__(self, hall: Hall) -> None:
        super().__init__(hall.plain_port, BASE, "outgoing/#", login=("boss", hall.passwords["boss"]))

    def send(self, suffix: str, body: Any, *, qos: int = 1, retain: bool = False) -> None:
        self._client.publish(f"{self.base}/{suffix}", json.dumps(body), qos=qos, retain=retain).wait_for_publish(5)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
def test_an_original_client_lives_through_the_migration(kind: str, tmp_path: Path) -> None:
    """Lights, scripts, flags, pictures and wheels: until the robot insists on names, and again when it does not."""
    with Hall(tmp_path / "hall", "login") as hall, Named(kind, hall, {"level": "login"}) as rig:
        old, numbers = Old(hall), itertools.count(110)

        def stage(plain: bool, level: Literal["login", "named"], **security: str) -> None:
            hall.change(replace(hall.fleet, level=level, plain=plain))
            rig.stop()
            rig.configure(level=level, **security)
            rig.start()
            time.sleep(2 * INITIAL_SYNC_S)  # a flag that comes earlier may be an old one: the robot's value counts

        def has_effect(*expected: str) -> bool:
            """Whether just this of what an old client sends has an effect on the robot."""
            number, got = next(numbers), list[Message]()
            z = number / 1000
            sent: dict[str, Any] = {
                "lights-solid": {"r": z}, "flags/mqtt-video": {"value": True, "n": z},
                "flags/reboot": {"value": True, "n": z},
                "autonomy-command": {"action": "start", "file": f"s{z}"}, "front-camera": {"enabled": True, "n": z},
                "control/take": {"id": f"{number:08x}", "n": z}, "estop-reset": {"boot": "", "count": number, "n": z},
            }  # fmt: skip
            with local_transport(load(rig.config), "watcher") as here:
                here.subscribe(f"{BASE}/incoming/#", got.append, direct=True)
                old.send(f"incoming/{DRIVE}", {"x": 0, "z": z})
                assert until(lambda: DRIVE not in expected or lines(rig, z), 5)
                for metric, body in sent.items():  # while it has control, it drives no more: it knows no key
                    old.send(f"incoming/{metric}", body, retain=metric == "flags/mqtt-video")
                zeroed = time.monotonic()
                rig.person("rover").send(f"incoming/{DRIVE}", {"x": 0, "z": 0, "n": number})  # passes always
                assert until(lambda: any(b'"n":%d' % number in one.payload.replace(b" ", b"") for one in got), 5)
                assert until(lambda: lines(rig, 0.0, zeroed), 5)
            found = {one.topic.removeprefix(f"{BASE}/incoming/") for one in got if str(z).encode() in one.payload}
            found = (found - {DRIVE}) | ({DRIVE} if lines(rig, z) else set())
            assert found == set(expected)
            return True

        known = ("lights-solid", "flags/mqtt-video", "autonomy-command", "front-camera")
        try:
            assert has_effect(DRIVE, *known, "flags/reboot", "control/take", "estop-reset")
            stage(True, "named", strangers="free")
            assert has_effect(DRIVE, *known)
            with rig.held("mia") as key:
                rig.judged("mia", key, 0.9)
                assert has_effect(*known)
            stage(False, "named")
            assert has_effect()
            stage(True, "named", strangers="free")
            assert has_effect(DRIVE, *known)
            stage(False, "login")
            assert has_effect(DRIVE, *known, "flags/reboot", "control/take", "estop-reset")
        finally:
            old.close()
