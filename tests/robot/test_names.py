"""A whole robot at the level named, behind a broker that knows roles: who drives it, and what else has no effect."""

from __future__ import annotations

import itertools
import statistics
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.ext.fleet.brokers import HOST, BrokerClient, Place
from tests.robot.named import DRIVE, Hall, Named
from tests.robot.operator import driving
from tests.robot.rig import BASE, STOP, lines
from tests.support import beside, cases, until

pytestmark = pytest.mark.alone  # lines are counted

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
        rig.send("mia", DRIVE, {"x": 0, "z": 0.13})
        rig.send("mia", DRIVE, {"x": 0, "z": 0.14, "key": old})
        rig.person("mia").send(f"incoming/{DRIVE}", {"x": 0, "z": 0.15, "key": key})
        rig.person("otto").send(f"incoming/by/mia/{DRIVE}", {"x": 0, "z": 0.16, "key": key})
        robot.send(f"incoming/{DRIVE}", {"x": 0, "z": 0.17, "key": key, "by": "mia"})
        rig.send("mia", DRIVE, {"x": 0, "z": 0.19, "key": key, "source": "autonomy", "run": 7})
        rig.send("mia", DRIVE, {"x": 0, "z": 0.19, "key": key}, retain=True)
        for z in (0.2, 0.21):
            rig.judged("mia", key, z)
        for name, suffix, more in (
            ("otto", f"incoming/by/otto/{DRIVE}", {"key": "ffffffff"}),
            ("rover", f"incoming/{DRIVE}", {}),
        ):
            rig.judged("mia", key, 0.3)
            zeroed = time.monotonic()
            rig.person(name).send(suffix, {"x": 0, "z": 0, **more})
            assert until(lambda since=zeroed: lines(rig, 0.0, since)), (name, suffix)
            assert until(lambda: not rig.mcu.moving())
    assert [z for z in (0.12, 0.13, 0.14, 0.15, 0.16, 0.17, 0.19) if lines(rig, z)] == []
    assert rig.operator.newest("capabilities")["value"]["named"] is True


def test_everybody_stops_it_and_only_a_safety_officer_resets_it(rig: Named) -> None:
    with rig.held("otto") as key, driving(_By(rig, "otto"), 0.7, key=key):
        for suffix, by in (("incoming/by/vera/estop", "vera"), ("incoming/estop", "somebody?")):
            assert until(lambda: rig.mcu.moving())
            rig.person("vera").send(suffix, {"stop": f"{len(suffix):016x}", "by": by})
            assert until(lambda: not rig.mcu.moving())
            assert until(lambda: state_of(rig)["latched"])
            stopped = state_of(rig)
            assert stopped["by"].split("/")[0] == by  # with a mark where it was not checked
            reset = {one: stopped[one] for one in ("boot", "count")}
            rig.send("otto", "estop-reset", reset)
            rig.person("rover").send("incoming/estop-reset", reset)
            assert state_of(rig)["latched"]
            assert rig.sends("boss", "estop-reset", reset | {"by": "ann"}, lambda: not state_of(rig)["latched"])
            rig.send("otto", DRIVE, {"x": 0, "z": 0, "key": key})  # lets go


def state_of(rig: Named) -> dict[str, Any]:
    return rig.operator.newest("estop/serial")


def test_who_is_removed_while_driving_stands(rig: Named) -> None:
    with ExitStack() as ends:
        key = ends.enter_context(rig.held("zoe", for_ms=2000))
        ends.enter_context(driving(_By(rig, "zoe"), 0.8, key=key))
        assert until(lambda: lines(rig, 0.8))
        removed = time.monotonic()
        rig.hall.remove("zoe")
        assert until(lambda: not rig.mcu.moving())
        stood = next(at for at, wheels in rig.mcu.drives(removed) if wheels == STOP)
        assert stood - removed < 4, "a second, on a machine that has nothing else to do"
    assert until(lambda: rig.state()["key"] == "")


class _By:
    """An operator who publishes under a name."""

    def __init__(self, rig: Named, name: str) -> None:
        self._rig, self._name = rig, name

    def send(self, suffix: str, body: Any, **options: Any) -> None:
        self._rig.send(self._name, suffix.removeprefix("incoming/"), body, **options)


def test_what_another_account_sends_holds_up_no_stop(tmp_path: Path) -> None:
    """A viewer floods what it may write, requests for pictures of 60 KB: faster than the robot reads.

    The robot is one of its own: what is left of a flood takes its time.
    """
    with Hall(tmp_path / "hall") as hall, Named("zenoh", hall, {"level": "named"}) as rig:
        assert until(lambda: "have a connection of their own" in rig.log.read_text())
        ending, sent, took = threading.Event(), itertools.count(), list[float]()

        def flood() -> None:
            place = Place(HOST, rig.remote.port, None)
            with BrokerClient(place, "vera", rig.hall.passwords["vera"]) as vera:
                while not ending.is_set():
                    vera.publish(f"{BASE}/incoming/by/vera/front-camera", b"[" * 60_000)
                    next(sent)

        with beside(flood, ending):
            began = time.monotonic()
            while len(took) < 3 or time.monotonic() < began + FLOOD_S:
                assert until(lambda: next(sent) > 100)
                name, pressed = f"f{len(took):015x}", time.monotonic()
                rig.person("mia").send("incoming/estop", {"stop": name})  # once
                assert until(lambda n=name: n in state_of(rig).get("recent", [])), took
                took.append(time.monotonic() - pressed)
        assert statistics.median(took) < 3, took
        order = {one: state_of(rig)[one] for one in ("boot", "count")}
        assert rig.sends("boss", "estop-reset", order, lambda: not state_of(rig)["latched"]), state_of(rig)
