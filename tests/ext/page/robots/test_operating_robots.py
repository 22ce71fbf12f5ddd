"""Whole robots, operated from the page in a browser: their logs, flags, restarts and troubles."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from pebble.extensions.fleet.audit import Audit
from tests.ext.page.console import Console, Wire, console, used
from tests.ext.page.stage import Stage

pytestmark = [pytest.mark.alone, pytest.mark.page]  # deadlines are checked

SERVICE = "soundboard_handler"
_RESTARTED = r"Restart Pebble: asked \d\d:\d\d"


@pytest.fixture(scope="module")
def people(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("page") / "people.sqlite"


@pytest.fixture(scope="module")
def stage(people: Path) -> Iterator[Stage]:
    with Stage("goob", "minilamp", room=False, people=people) as running:
        yield running


@pytest.fixture(scope="module")
def at_goob(browser: Browser, stage: Stage) -> Iterator[Console]:
    with console(browser, stage, "goob") as opened:
        assert opened.tab.until(lambda: opened.test("log-lines").count() == 1)
        assert opened.tab.until(lambda: opened.test("bell").count() == 1)
        yield opened
        assert opened.tab.complaints() == []


def shown(robot: Console) -> str:
    return str(robot.test("log-lines").inner_text())


def test_what_a_service_logs_is_on_the_page_and_can_be_filtered(at_goob: Console, wire: Wire) -> None:
    text = "neither plays nor stops: 'dance'"

    def logged() -> bool:
        wire.publish("goob/incoming/soundboard-command", {"action": "dance"})
        return at_goob.tab.until(lambda: text in shown(at_goob), 0.5)

    assert at_goob.tab.until(logged)
    line = at_goob.page.locator(".log-line", has_text=text).first
    assert re.match(r"\d\d:\d\d:\d\d\.\d\d\d\s*▲ WARNING\s*soundboard_handler\s*ignored a command", line.inner_text())
    at_goob.test("log-level").select_option("3")
    assert at_goob.tab.until(lambda: text not in shown(at_goob), 2)
    at_goob.test("log-level").select_option(index=0)
    at_goob.test("log-search").fill("NOR stops")
    assert at_goob.tab.until(lambda: at_goob.page.locator(".log-line", has_not_text=text).count() == 0, 2)
    assert text in shown(at_goob)
    at_goob.test("log-search").fill("")


def child(stage: Stage, name: str) -> int:
    """The pid of a service of goob; 0 if it does not run."""
    launcher = stage.robots["goob"].launcher
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            head, _, rest = stat.read_text().rpartition(")")
        except OSError:
            continue
        if int(rest.split()[1]) == launcher.pid and head.endswith(f"({name[:15]}"):
            return int(stat.parent.name)
    return 0


def test_the_service_that_keeps_restarting_is_found(at_goob: Console, stage: Stage) -> None:
    row = at_goob.test(f"service-{SERVICE}")
    for count in (1, 2):
        assert at_goob.tab.until(lambda: child(stage, SERVICE) != 0)
        os.kill(child(stage, SERVICE), signal.SIGKILL)
        assert at_goob.tab.until(lambda count=count: f"restarted {count}×" in row.inner_text()), row.inner_text()
    assert "restarted 2×; last exit: signal 9" in row.inner_text()
    at_goob.test(f"logs-of-{SERVICE}").click()
    assert at_goob.tab.until(lambda: at_goob.test("log-service").input_value() == SERVICE, 2)
    at_goob.test("log-service").select_option("")
    at_goob.test("bell").click()
    notice = at_goob.page.locator(".notice-service")
    assert notice.count() == 1
    assert re.search(rf"Goob service {SERVICE} .* \(signal 9\)", notice.inner_text()), notice.inner_text()
    at_goob.page.keyboard.press("Escape")
    assert at_goob.tab.until("document.querySelector('dialog[open]') === null", 2)


def restarted(robot: Console) -> bool:
    outcome = robot.test("outcome")
    return bool(outcome.count() and re.search(_RESTARTED, outcome.inner_text()))


def restarts(robot: Console) -> bool:
    """Ask until it was asked: on a busy machine the hold may have ended early, or the robot was not there."""
    for _ in range(3):
        if not robot.test("ask-hold").count():
            robot.uncover("service-restart").click()
        robot.hold_button("ask-hold")
        if robot.tab.until(lambda: restarted(robot), 15):
            return True
    return False


def test_a_restart_is_asked_and_moves_nothing(browser: Browser, at_goob: Console, stage: Stage, people: Path) -> None:
    """While another page drives: its gesture is over, and it may go on with a new one."""
    with console(browser, stage, "goob") as driver:
        driver.test("video").click()  # its picture would end the gesture, too
        with used(driver, complaints=False):
            at_goob.test("service-restart").click()
            assert driver.drive()
            at_goob.hold_button("ask-hold")
            assert driver.rests(3)
            assert at_goob.tab.until(lambda: restarted(at_goob), 15) or restarts(at_goob)
            assert driver.stays_at_rest()  # its key is still held
            assert driver.state("web/driver")["you"] is True
            assert driver.because("release", "picture", "", within=3)
            assert driver.press_anew()
    audit = Audit(people)
    entries = [one for one in audit.read(100) if one.what == "action"]
    audit.close()
    for one in entries:
        assert (one.ref, one.user, one.detail) == (stage.ref("goob"), "local", "name service-restart")
    assert entries
