"""The cards Lights, Sounds and Autonomy at a whole robot: what its MCU, its loudspeaker and its scripts do."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser

from pebble.simulation.loudspeaker import playbacks
from pebble.transports import Message, MqttSettings, create
from tests.web.console import Console, console
from tests.web.stage import Stage

pytestmark = pytest.mark.alone  # deadlines are checked


class Reports:
    """What goob reports at the broker of its operators."""

    def __init__(self, stage: Stage) -> None:
        self.last: dict[str, Any] = {}
        self._transport = create("mqtt", "reports", MqttSettings(host="127.0.0.1", port=stage.broker_port))
        self._transport.open()
        for metric in ("autonomy-status", "soundboard-status"):
            self._transport.subscribe(f"{stage.ref('goob')}/outgoing/{metric}", self._receive)

    def close(self) -> None:
        self._transport.close()

    def _receive(self, message: Message) -> None:
        self.last[message.topic.rpartition("/")[2]] = json.loads(message.payload)


@pytest.fixture(scope="module")
def goob() -> Iterator[Stage]:
    with Stage("goob") as running:
        yield running


@pytest.fixture(scope="module")
def reports(goob: Stage) -> Iterator[Reports]:
    running = Reports(goob)
    yield running
    running.close()


@pytest.fixture(scope="module")
def at_goob(browser: Browser, goob: Stage) -> Iterator[Console]:
    with console(browser, goob, "goob") as opened:
        assert opened.tab.until(lambda: opened.test("clip").count() and opened.test("start-script").count(), 20)
        yield opened
        assert opened.tab.complaints() == []


def lines(stage: Stage) -> list[str]:
    """The lines about lights that the MCU has received."""
    return [entry.line for entry in stage.lines("goob") if entry.line[:1] in "LF"]


def test_lights_reach_the_mcu(at_goob: Console, goob: Stage) -> None:
    before = len(lines(goob))
    at_goob.test("colour-red").click()
    assert at_goob.tab.until(lambda: lines(goob)[before:] == ["L 0.000 0.000 1.000"], 5), lines(goob)
    at_goob.test("lights-flash").click()
    assert at_goob.tab.until(lambda: lines(goob)[before + 1 :] == ["F 0.000 0.000 1.000 2.000"], 5), lines(goob)
    at_goob.test("lights-off").click()
    assert at_goob.tab.until(lambda: lines(goob)[before + 2 :] == ["L 0.000 0.000 0.000"], 5), lines(goob)


def test_a_clip_is_played_and_stopped(at_goob: Console, goob: Stage, reports: Reports) -> None:
    record = Path(goob.folder_of_logs) / "goob" / "played"
    at_goob.test("repeat").check()
    at_goob.test("sound-filter").fill("two-tone")
    at_goob.test("clip").click()
    name = "signals/two-tone.wav"
    assert at_goob.tab.until(lambda: (reports.last.get("soundboard-status") or {}).get("file") == name, 5)
    assert at_goob.tab.until(lambda: name in at_goob.test("playing").inner_text(), 3)
    at_goob.test("stop-sound").click()
    assert at_goob.tab.until(lambda: reports.last["soundboard-status"]["playing"] is False, 5)
    played = [one for one in playbacks(record) if one.file.endswith(name)]
    assert played
    assert played[-1].stopped
    at_goob.test("repeat").uncheck()


def test_a_script_is_started_with_a_setting_and_stopped(at_goob: Console, reports: Reports) -> None:
    def status() -> dict[str, Any]:
        return reports.last.get("autonomy-status") or {}

    at_goob.test("script").select_option("wheel-odometry")
    start = at_goob.test("start-script")
    at_goob.test("set-magnets").fill("0")
    assert at_goob.tab.until(start.is_disabled, 2)
    assert at_goob.page.locator("#why-start").inner_text() == "The form has 1 mistake"
    at_goob.test("set-magnets").fill("12")
    at_goob.test("set-second_channel").select_option("none")
    assert at_goob.tab.until(start.is_enabled, 2)
    start.click()
    assert at_goob.tab.until(lambda: status().get("running") is True, 10), status()
    config = status()["config"]
    assert (config["magnets"], config["second_channel"], config["wheel_diameter_mm"]) == (12, "none", 61.0)
    assert at_goob.tab.until(lambda: "wheel-odometry runs, since " in at_goob.test("script-state").inner_text(), 3)
    at_goob.test("end-script").click()
    assert at_goob.tab.until(lambda: status()["running"] is False, 10), status()
    assert status()["error"] is None
