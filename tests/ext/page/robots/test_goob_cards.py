"""The cards of a robot at the whole Goob: what its MCUs are told, and what its sensors sent.

On a desktop and on a phone, where the cards are behind tabs. Clips and scripts are tested at a
robot that records what it is asked (test_lights_sounds_scripts).
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from pebble.extensions.lab.rig.testbed import LinuxRobot
from tests.ext.boards import mcu_wire
from tests.ext.page.console import Console, console
from tests.ext.page.stage import Stage
from tests.kit.board import ScriptedMcu

pytestmark = [pytest.mark.alone, pytest.mark.page]  # deadlines are checked
_SWITCHES_S = 5.0


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
def goob(browser: Browser, stage: Stage) -> Iterator[Console]:
    with console(browser, stage, "goob") as opened:
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
