"""Who drives a whole robot: control given, taken and lost, seen from outside on both transports."""

from __future__ import annotations

import itertools
import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.robot.operator import Operator, driving
from tests.robot.rig import BASE, STOP, Rig, lines
from tests.support import beside, cases, until

pytestmark = pytest.mark.alone  # lines are counted

CONTROL, TAKE, DRIVE, STATE = (
    "incoming/control",
    "incoming/control/take",
    "incoming/drive-values",
    "outgoing/control/serial",
)
OTTO, MIA = {"id": "aaaaaaaa", "by": "otto", "for_ms": 10_000}, {"id": "bbbbbbbb", "by": "mia", "for_ms": 10_000}
#: The short row runs beside other tests. The least share of commands that become lines, and the longest gap, seconds.
FLOOD_S, LEAST, GAP_S = float(cases(3, 60)), cases(80, 95) / 100, cases(200, 25) / 100


@pytest.fixture(params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with Rig(request.param) as one:
        yield one


def state(rig: Rig) -> dict[str, Any]:
    last = rig.operator.last(STATE)
    return last.json if last is not None else {}


def held(rig: Rig, topic: str, client: dict[str, Any]) -> str:
    """Its key, once this client has control."""
    rig.operator.send(topic, client)
    assert until(lambda: state(rig).get("id") == client["id"], 5), state(rig)
    key: str = state(rig)["key"]
    return key


def test_take_over_stop_and_a_restart_of_the_motor_owner(rig: Rig) -> None:
    key = held(rig, CONTROL, OTTO)
    with driving(rig.operator, 0.5, key=key), driving(rig.operator, 0.9, key="ffffffff"):
        assert until(lambda: lines(rig, 0.5), 5)
        taken = time.monotonic()
        other = held(rig, TAKE, MIA)
        with driving(rig.operator, 0.7, key=other):
            assert until(lambda: len(lines(rig, 0.7)) > 9, 5)
            last_old = max(lines(rig, 0.5)) - taken
            assert last_old < 0.5, last_old
            assert next(wheels for _, wheels in rig.mcu.drives(taken) if wheels in (STOP, (0.7, 0.7))) == STOP
            rig.operator.send("incoming/estop", {"by": "vera"})
            assert until(lambda: not rig.mcu.moving(), 5)
            stopped = rig.operator.wait_for("outgoing/estop/serial", since=taken)
            assert stopped.json["latched"]
            assert state(rig)["by"] == "mia"
            reset = time.monotonic()
            rig.operator.send("incoming/estop-reset", {name: stopped.json[name] for name in ("boot", "count")})
            assert until(lambda: not rig.operator.last("outgoing/estop/serial").json["latched"], 5)  # type: ignore[union-attr]
            for _ in range(20):
                rig.operator.send(DRIVE, {"x": 0, "z": 0})  # a stranger's, while mia's stick is held
                time.sleep(0.05)
            assert lines(rig, 0.7, reset) == []
        assert until(lambda: not rig.mcu.moving(), 5)
        boot = state(rig)["boot"]
        killed = rig.kill("serial_mcu_bridge")
        assert until(lambda: state(rig)["boot"] != boot, 10)
        assert state(rig)["key"] == ""
        rig.operator.send(DRIVE, {"x": 0, "z": 0.3, "key": other})
        rig.operator.send(DRIVE, {"x": 0, "z": 0.4})
        assert until(lambda: lines(rig, 0.4, killed), 5)
        assert lines(rig, 0.3) == lines(rig, 0.9) == []


def test_a_flood_of_strangers_takes_nothing_from_who_has_control(rig: Rig) -> None:
    key = held(rig, CONTROL, OTTO)
    numbers, ending = itertools.count(), threading.Event()
    stranger = Operator(rig.remote.port, BASE, STATE)

    def flood() -> None:
        """A thousand messages a second: commands with wrong keys, requests under new ids, releases."""
        while not ending.wait(0.02):
            for number in itertools.islice(numbers, 20):
                name = {"id": f"{number:08x}", "by": "mia"}
                body = ({"x": 0, "z": -0.9, "key": f"{number:08x}"}, name, name | {"want": "release"})[number % 3]
                stranger.send(DRIVE if number % 3 == 0 else CONTROL, body)

    try:
        with driving(rig.operator, 0.5, key=key) as driver:
            assert until(lambda: lines(rig, 0.5), 5)
            with beside(flood, ending):
                began, before = time.monotonic(), len(driver.sent_at)
                assert until(lambda: time.monotonic() > began + FLOOD_S, FLOOD_S + 5)
                asked = len(driver.sent_at) - before
            assert until(lambda: len(lines(rig, 0.5, began)) >= LEAST * asked, 2), (len(lines(rig, 0.5, began)), asked)
        assert max(after - line for line, after in itertools.pairwise(lines(rig, 0.5, began))) <= GAP_S
        assert next(numbers) > 300 * FLOOD_S
        assert lines(rig, -0.9) == []
        assert state(rig)["id"] == OTTO["id"]
    finally:
        stranger.close()


def test_a_client_that_knows_nothing_of_control_drives_while_nobody_has_it(rig: Rig) -> None:
    """Each of its commands reaches the line, and its bytes are not changed."""
    began = time.monotonic()
    wanted = [round(0.1 + number / 1000, 3) for number in range(20)]
    for z in wanted:
        rig.operator.send(DRIVE, json.dumps({"x": 0, "z": z, "source": "web", "t": 1}).encode())
        assert until(lambda z=z: lines(rig, z, began), 5), z
    assert until(lambda: state(rig)["others"], 5)
    key = held(rig, CONTROL, OTTO)
    rig.operator.send(DRIVE, {"x": 0, "z": 0.6})
    rig.operator.send(DRIVE, {"x": 0, "z": 0.5, "key": key})
    assert until(lambda: lines(rig, 0.5), 5)
    assert lines(rig, 0.6) == []
    rig.operator.send(DRIVE, {"x": 0, "z": 0})
    assert until(lambda: rig.mcu.drives()[-1][1] == (0.0, 0.0), 5)


def test_where_strangers_are_refused_only_a_key_moves() -> None:
    with Rig("zenoh", start=False) as rig:
        raw = json.loads(rig.config.read_text()) | {"security": {"strangers": "refuse"}}
        rig.config.write_text(json.dumps(raw))
        rig.start()
        rig.operator.send(DRIVE, {"x": 0, "z": 0.3})
        key = held(rig, CONTROL, OTTO)
        rig.operator.send(DRIVE, {"x": 0, "z": 0.4})
        rig.operator.send(DRIVE, {"x": 0, "z": 0.5, "key": key})
        assert until(lambda: lines(rig, 0.5), 5)
        assert lines(rig, 0.3) == lines(rig, 0.4) == []
