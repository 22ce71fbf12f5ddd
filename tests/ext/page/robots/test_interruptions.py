"""What ends a gesture of keys or of a finger: the wheels rest in time, and turn again only when it begins anew."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
from playwright.sync_api import Browser

from tests.ext.page.console import FORWARD, QUIET_S, Console, Wire, console, used
from tests.ext.page.fingers import Fingers
from tests.ext.page.stage import Stage
from tests.support import until
from tests.tcp_proxy import TcpProxy

pytestmark = pytest.mark.page  # deadlines are checked


@dataclass(frozen=True)
class Interruption:
    """``deadline_s`` until the wheels are at rest, with what a busy machine may add. ``lasts_s``: until the cure."""

    cause: Callable[[Console], object]
    deadline_s: float
    cure: Callable[[Console], object] = lambda _: None
    lasts_s: float = QUIET_S


PAGE_S = 0.6  # the page sends a zero at once
SILENCE_S = 0.9  # the server notices after 0.25 s
VALID_S = 1.3  # a command counts for 0.4 s


def _busy(robot: Console) -> None:
    robot.page.evaluate("() => { setTimeout(() => { const end = Date.now() + 1500; while (Date.now() < end); }) }")


INTERRUPTIONS = {
    "another window has the focus": Interruption(lambda robot: robot.tab.blur(), PAGE_S),
    "another tab is in front": Interruption(
        lambda robot: robot.tab.hide(), PAGE_S, lambda robot: robot.tab.hide(hidden=False)
    ),
    "the system suspends the tab": Interruption(
        lambda robot: robot.tab.freeze(), SILENCE_S, lambda robot: robot.tab.thaw(), 2.5
    ),
    "another robot is opened": Interruption(
        lambda robot: robot.page.evaluate("window.pebble.route.go('')"), PAGE_S, lambda robot: robot.page.go_back()
    ),
    "the page's main thread is busy": Interruption(_busy, SILENCE_S, lasts_s=1.8),
    "the server is suspended": Interruption(
        lambda robot: robot.stage.server.freeze(), VALID_S, lambda robot: robot.stage.server.thaw(), 1.5
    ),
    "the broker is killed": Interruption(
        lambda robot: robot.stage.remote_broker.kill(), VALID_S, lambda robot: robot.stage.restart_broker(), 1.0
    ),
}


@pytest.fixture(scope="module")
def proxy() -> Iterator[TcpProxy]:
    """Between the browser and the server, for what happens to their connection."""
    running = TcpProxy(1)
    yield running
    running.resume()
    running.cut()


@pytest.fixture(scope="module")
def stage(proxy: TcpProxy) -> Iterator[Stage]:
    with Stage("minilamp", names=["127.0.0.1", f"127.0.0.1:{proxy.port}"]) as running:
        proxy.lead_to(int(running.url.rpartition(":")[2].rstrip("/")))
        yield running


@pytest.fixture
def at_lamp(lamp_page: Console) -> Iterator[Console]:
    with used(lamp_page, complaints=False) as ready:
        yield ready


@pytest.mark.parametrize("what", INTERRUPTIONS)
def test_the_wheels_stop_and_wait_for_a_new_press(at_lamp: Console, what: str) -> None:
    interruption = INTERRUPTIONS[what]
    assert at_lamp.drive()
    began = time.monotonic_ns()
    interruption.cause(at_lamp)
    assert until(lambda: at_lamp.wheels == (0, 0), interruption.deadline_s)
    rested = time.monotonic_ns()
    assert until(lambda: time.monotonic_ns() - began > 1e9 * interruption.lasts_s, 5)
    interruption.cure(at_lamp)
    at_lamp.held.clear()  # Chromium repeats no key by itself, so it stays down
    assert at_lamp.because("", "free", "release")
    at_lamp.page.wait_for_timeout(1000 * QUIET_S)
    assert not at_lamp.stage.wheels_turning("minilamp", since_ns=rested)
    at_lamp.held.append("KeyW")
    at_lamp.take()
    assert at_lamp.press_anew()


@pytest.mark.parametrize(("how", "seconds"), [(TcpProxy.blackhole, 2.5), (TcpProxy.drop, 0.8)])
def test_a_connection_that_goes_silent_or_is_reset_stops(
    browser: Browser, stage: Stage, proxy: TcpProxy, how: Callable[[TcpProxy], object], seconds: float
) -> None:
    with console(browser, stage, "minilamp", "phone", "dark", url=f"http://127.0.0.1:{proxy.port}/") as robot:
        robot.take()
        assert robot.drive()
        began = time.monotonic()
        how(proxy)
        assert robot.rests(SILENCE_S)
        rested = time.monotonic_ns()
        robot.page.wait_for_timeout(max(0.0, 1000 * (began + seconds - time.monotonic())))
        proxy.resume()
        assert robot.because("", "free", "release")
        robot.page.wait_for_timeout(1000 * QUIET_S)
        assert not stage.wheels_turning("minilamp", since_ns=rested)
        robot.take()
        assert robot.press_anew()
        robot.test("release").click()
        assert robot.because("free", within=3)


def test_a_page_that_is_loaded_anew_has_control_and_no_gesture(at_lamp: Console) -> None:
    assert at_lamp.drive()
    at_lamp.page.reload()
    assert at_lamp.rests()
    assert at_lamp.because("", "release")
    assert at_lamp.stays_at_rest()
    assert at_lamp.press_anew()


# -- fingers on a phone


class Phone(Console):
    """A console that is touched."""

    fingers: Fingers

    def stick(self) -> None:
        """Put a finger on the middle of the stick and drag it forward."""
        left, top, size = self.place("stick")
        self.fingers.down(1, left, top)
        self.fingers.move(1, left, top - 0.2 * size)
        self.fingers.move(1, left, top - 0.4 * size)

    def drive_by_stick(self) -> bool:
        return self.persists(self.stick, lambda: self.wheels == FORWARD, self.fingers.lift)


@contextmanager
def phone(browser: Browser, stage: Stage) -> Iterator[Phone]:
    with console(browser, stage, "minilamp", "phone") as opened, used(opened):
        held = Phone(opened.tab, stage, opened.name)
        held.fingers = Fingers(opened.tab)
        yield held
        held.fingers.lift()


def test_a_second_finger_on_stop_latches(browser: Browser, stage: Stage, wire: Wire) -> None:
    with phone(browser, stage) as robot:
        assert robot.drive_by_stick()
        robot.fingers.down(2, *robot.place("stop-one")[:2])
        assert robot.tab.until(lambda: wire.latched("minilamp"), 2)
        assert robot.rests()
        robot.fingers.up(2)
        assert robot.because("stopped", within=3)
        robot.reset()
        assert robot.tab.until(lambda: not wire.latched("minilamp"), 3)
        left, top, size = robot.place("stick")
        robot.fingers.move(1, left, top - 0.3 * size)
        assert robot.stays_at_rest()
        robot.fingers.up(1)
        assert robot.drive_by_stick()


def _rotate(robot: Phone) -> None:
    orientation = {"type": "landscapePrimary", "angle": 90}
    metrics = {"width": 844, "height": 390, "deviceScaleFactor": 1, "mobile": True, "screenOrientation": orientation}
    robot.tab.cdp().send("Emulation.setDeviceMetricsOverride", metrics)


@pytest.mark.parametrize("loss", [lambda robot: robot.fingers.cancel(), _rotate], ids=["the system", "rotation"])
def test_what_takes_the_finger_away_stops(browser: Browser, stage: Stage, loss: Callable[[Phone], None]) -> None:
    with phone(browser, stage) as robot:
        assert robot.drive_by_stick()
        loss(robot)
        assert robot.rests()
        assert robot.stays_at_rest()
        robot.fingers.lift()
        assert robot.test("stop-one").is_visible()
        assert robot.drive_by_stick()
