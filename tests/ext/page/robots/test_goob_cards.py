"""The cards of a robot at the whole Goob: what its MCUs are told, and what its sensors sent.

On a desktop and on a phone, where the cards are behind tabs. Clips and scripts are tested at a
robot that records what it is asked (test_lights_sounds_scripts).
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser

from pebble.extensions.lab.rig.testbed import LinuxRobot
from pebble.transports import Message, MqttSettings, create
from tests.ext.boards import mcu_wire
from tests.ext.page.console import Console, Wire, console
from tests.ext.page.stage import Stage
from tests.kit.board import ScriptedMcu

pytestmark = [pytest.mark.alone, pytest.mark.page]  # deadlines are checked
_REPORTS = ("charging-level", "sensors/imu", "wheel-odometry")
_SWITCHES_S = 5.0


class Reports:
    """What goob reports at the broker of its operators."""

    def __init__(self, stage: Stage) -> None:
        self.received: dict[str, list[Any]] = {metric: [] for metric in _REPORTS}
        self._prefix = f"{stage.ref('goob')}/outgoing/"
        self._transport = create("mqtt", "reports", MqttSettings(host="127.0.0.1", port=stage.broker_port))
        self._transport.open()
        for metric in _REPORTS:
            self._transport.subscribe(self._prefix + metric, self._receive)

    def values(self, metric: str) -> list[Any]:
        return [payload["value"] for payload in list(self.received[metric])]

    def close(self) -> None:
        self._transport.close()

    def _receive(self, message: Message) -> None:
        self.received[message.topic.removeprefix(self._prefix)].append(json.loads(message.payload))


class GoobWithOutlets(Stage):
    """Goob with a microcontroller besides, which describes itself as a station of outlets."""

    def __init__(self, station: ScriptedMcu) -> None:
        super().__init__("goob", room=False)
        self._station = station

    def start_robots(self) -> None:
        goob = self.robots["goob"]
        assert isinstance(goob, LinuxRobot)
        port = {"port": str(self._station.link)}
        goob.instances["outlets"] = {"protocol": "pebble_serial_v1", "serial": port}
        super().start_robots()


def state_of(number: int, on: bytes = b"\0") -> bytes:
    """Return the report of an outlet; the fourth one has no relay."""
    return mcu_wire.frame(mcu_wire.STATE, b"\1\0\0" if number == 4 else b"\1\1" + on, 2 * number)


def obey(command: mcu_wire.Received) -> bytes:
    """Return what the station answers: it does what it is told, and reports so."""
    done = mcu_wire.frame(mcu_wire.ACK, b"", command.interface, command.sequence)
    return done + state_of((command.interface + 1) // 2, command.payload)


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ScriptedMcu]:
    with ScriptedMcu(tmp_path_factory.mktemp("station") / "port", mcu_wire.STATION, sends_hello=True) as running:
        running.after_describing = b"".join(map(state_of, (1, 2, 3, 4)))
        running.answers = obey
        yield running


@pytest.fixture(scope="module")
def stage(station: ScriptedMcu) -> Iterator[Stage]:
    with GoobWithOutlets(station) as running:
        yield running


@pytest.fixture(scope="module")
def reports(stage: Stage) -> Iterator[Reports]:
    running = Reports(stage)
    yield running
    running.close()


@pytest.fixture(scope="module", params=["desktop", "phone"])
def goob(browser: Browser, stage: Stage, reports: Reports, request: pytest.FixtureRequest) -> Iterator[Console]:
    with console(browser, stage, "goob", request.param) as opened:
        yield opened
        assert opened.tab.complaints() == []


def lines(stage: Stage) -> list[str]:
    """The lines about lights that the MCU has received."""
    return [entry.line for entry in stage.lines("goob") if entry.line[:1] in "LF"]


def test_lights_reach_the_mcu(goob: Console, stage: Stage) -> None:
    before = len(lines(stage))
    goob.uncover("colour-red").click()
    assert goob.tab.until(lambda: lines(stage)[before:] == ["L 0.000 0.000 1.000"], 5), lines(stage)
    goob.test("lights-flash").click()
    assert goob.tab.until(lambda: lines(stage)[before + 1 :] == ["F 0.000 0.000 1.000 2.000"], 5), lines(stage)
    goob.test("lights-off").click()
    assert goob.tab.until(lambda: lines(stage)[before + 2 :] == ["L 0.000 0.000 0.000"], 5), lines(stage)


@pytest.mark.thorough
def test_a_flag_is_retained_at_the_broker(goob: Console, stage: Stage, wire: Wire) -> None:
    topic = "goob/incoming/flags/mqtt-audio"
    flag = lambda: goob.state("web/flags")["mqtt_audio"]
    goob.uncover("flag-mqtt-audio").check()
    assert goob.tab.until(lambda: wire.last(topic) == {"value": True}, 3)
    assert goob.tab.until(lambda: flag() is True, 3), (flag(), wire.all(topic))
    later = Wire(stage)
    assert goob.tab.until(lambda: later.last(topic) == {"value": True}, 3)
    later.close()
    wire.publish(topic, {"value": False}, retain=True)  # another operator
    assert goob.tab.until(lambda: flag() is False, 3), (flag(), wire.all(topic))
    assert goob.tab.until(lambda: not goob.test("flag-mqtt-audio").is_checked(), 3)
    wire.publish(topic, None, retain=True)
    assert goob.tab.until(lambda: flag() is None, 3)


# -- outlets and microcontrollers


def switched(goob: Console, station: ScriptedMcu, *commands: tuple[int, bytes]) -> bool:
    """True if these are the newest commands of the station: interfaces and payloads."""
    return goob.tab.until(
        lambda: [(one.interface, one.payload) for one in station.commands()[-len(commands) :]] == list(commands),
        _SWITCHES_S,
    )


def test_a_relay_is_switched_on_and_off(goob: Console, station: ScriptedMcu) -> None:
    switch = goob.uncover("outlet-o1")
    switch.click()
    assert switched(goob, station, (1, b"\1"))
    assert goob.tab.until(lambda: switch.get_attribute("aria-checked") == "true")
    assert goob.test("outlet-asked-o1").count() == 0
    switch.click()
    assert switched(goob, station, (1, b"\1"), (1, b"\0"))
    assert goob.tab.until(lambda: goob.test("outlet-state-o1").inner_text() == "off")


@pytest.mark.thorough
def test_an_unreachable_outlet_has_its_reason(goob: Console) -> None:
    switch = goob.uncover("outlet-o4")
    assert switch.is_disabled()
    why = goob.page.locator(f'[id="{switch.get_attribute("aria-describedby")}"]')
    assert why.inner_text() == "outlet is unreachable"


def test_a_generated_form_reaches_the_microcontroller(goob: Console, station: ScriptedMcu) -> None:
    field, state = goob.uncover("mcu-in-o2_set").locator('[data-test="field-on"]'), goob.test("outlet-state-o2")
    for switch, payload, word in ((field.check, b"\1", "on"), (field.uncheck, b"\0", "off")):
        switch()
        goob.test("send-o2_set").click()
        assert switched(goob, station, (3, payload))
        assert goob.tab.until(lambda word=word: state.inner_text() == word)  # type: ignore[misc]


def test_what_a_microcontroller_measures_is_shown(goob: Console) -> None:
    values = goob.uncover("mcu-out-imu")
    assert goob.tab.until(lambda: "accel_norm_g" in values.inner_text())
    assert goob.tab.until(lambda: "/s" in values.inner_text())
    assert "stays on the robot" in goob.test("mcu-out-imu_fast").inner_text()


# -- what its sensors sent, and where it is

#: Every row that the page remembers of a metric.
_ROWS = """async ([kind, metric]) => {
  const { recorderOf } = await import(`/static/${pebble.connection.version}/ui/parts/recorder.js`);
  return recorderOf(pebble, pebble.route.ref).all.get(`${kind} ${metric}`)?.rows ?? [];
}"""


def rows(goob: Console, metric: str, kind: str = "numbers") -> list[Any]:
    found: list[Any] = goob.page.evaluate(_ROWS, [kind, metric])
    return found


@pytest.mark.thorough
def test_the_battery_is_plotted_as_the_broker_carried_it(goob: Console, reports: Reports) -> None:
    goob.uncover("plot-battery")
    assert goob.tab.until(lambda: len(rows(goob, "charging-level")) >= 1, 20)
    assert {row["value"] for row in rows(goob, "charging-level")} <= set(reports.values("charging-level"))
    newest = lambda: f"{reports.values('charging-level')[-1]:.2f}"
    assert goob.tab.until(lambda: newest() in goob.test("plot-battery").inner_text())


def test_the_map_follows_goob_while_it_drives(goob: Console, stage: Stage, wire: Wire, reports: Reports) -> None:
    """Its hall sensors are not published: odometry is where its simulated MCU says that it is."""

    def publish() -> float:
        pose = stage.robots["goob"].mcu_reports[-1].board.pose
        value = {"x_mm": pose.x_mm, "y_mm": pose.y_mm, "heading_rad": pose.heading_rad}
        wire.publish("goob/outgoing/wheel-odometry", {"value": value, "unit": "mm", "timestamp": time.time()})
        goob.page.wait_for_timeout(50)
        return math.hypot(pose.x_mm - start[0], pose.y_mm - start[1])

    pose = stage.robots["goob"].mcu_reports[-1].board.pose
    start = pose.x_mm, pose.y_mm
    assert goob.tab.until(lambda: publish() >= 0 and bool(rows(goob, "wheel-odometry", "poses")), 20)
    goob.uncover("map")
    words = goob.test("map-pose").inner_text()
    goob.uncover("stick")
    goob.take()
    assert goob.persists(lambda: goob.down("KeyW"), lambda: publish() > 100, goob.let_go)
    goob.let_go()
    assert goob.rests()
    goob.uncover("map")

    def agree() -> bool:
        publish()
        last, text = reports.values("wheel-odometry")[-1], goob.test("map-pose").inner_text()
        return text != words and text.startswith(f"x {last['x_mm'] / 1000:.2f} m")

    assert goob.tab.until(agree, 5)
    xs = {round(pose["x"], 3) for pose in rows(goob, "wheel-odometry", "poses")}
    assert len(xs) > 1
    assert xs <= {round(one["x_mm"] / 1000, 3) for one in reports.values("wheel-odometry")}
