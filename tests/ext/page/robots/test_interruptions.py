"""What ends a gesture: the wheels come to rest within a deadline, and turn no more before the key was pressed anew."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest
from playwright.sync_api import Browser

from tests.ext.page.console import QUIET_S, Console, console, used
from tests.ext.page.stage import Stage
from tests.support import until
from tests.tcp_proxy import TcpProxy

pytestmark = pytest.mark.page  # deadlines are checked


def nothing(_: Console) -> None:
    """Nothing has to be done for the page to be usable again."""


@dataclass(frozen=True)
class Interruption:
    """``deadline_s`` until the wheels are at rest, with what a busy machine may add. ``lasts_s``: until the cure.

    ``late_s``: so long the wheels may turn once more, by commands that were already on their way, before the zero
    behind them.
    """

    cause: Callable[[Console], object]
    deadline_s: float
    cure: Callable[[Console], object] = nothing
    lasts_s: float = QUIET_S
    late_s: float = 0.0


PAGE_S = 0.6  # the page sends a zero at once
SILENCE_S = 0.9  # the server notices after 0.25 s
VALID_S = 1.3  # a command counts for 0.4 s
CONNECTION_S = 1.3  # at the robot: a connection that is closed


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
    "the system is about to suspend the tab": Interruption(
        lambda robot: robot.page.evaluate("() => { document.dispatchEvent(new Event('freeze')) }"), PAGE_S
    ),
    "the context menu": Interruption(lambda robot: robot.test("stick").click(button="right"), PAGE_S),
    "another robot is opened": Interruption(
        lambda robot: robot.page.evaluate("window.pebble.route.go('')"), PAGE_S, lambda robot: robot.page.go_back()
    ),
    "the page's main thread is busy": Interruption(_busy, SILENCE_S, lasts_s=1.8),
    "the server is suspended": Interruption(
        lambda robot: robot.stage.server.freeze(), VALID_S, lambda robot: robot.stage.server.thaw(), 1.5
    ),
    "the server is killed": Interruption(
        lambda robot: robot.stage.server.kill(), VALID_S, lambda robot: robot.stage.restart_server(), 1.0
    ),
    "the broker is killed": Interruption(
        lambda robot: robot.stage.remote_broker.kill(), CONNECTION_S, lambda robot: robot.stage.restart_broker(), 1.0
    ),
    "the broker is suspended": Interruption(
        lambda robot: robot.stage.remote_broker.freeze(),
        VALID_S,
        lambda robot: robot.stage.remote_broker.thaw(),
        1.5,
        late_s=0.1,
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
    one = INTERRUPTIONS[what]
    assert at_lamp.drive()
    began = time.monotonic_ns()
    one.cause(at_lamp)
    assert until(lambda: at_lamp.wheels == (0, 0), one.deadline_s)
    rested = time.monotonic_ns()
    assert until(lambda: time.monotonic_ns() - began > 1e9 * one.lasts_s)
    one.cure(at_lamp)
    at_lamp.held.clear()  # Chromium repeats no key by itself, so it stays down
    assert at_lamp.because("", "free", "release")
    at_lamp.page.wait_for_timeout(1000 * QUIET_S)
    turned = [max(0, end - max(rested, begin)) for begin, end in at_lamp.stage.motions("minilamp")]
    assert sum(turned) / 1e9 <= one.late_s
    at_lamp.held.append("KeyW")
    at_lamp.take()
    assert at_lamp.press_anew()


def test_a_tab_that_is_closed_stops(browser: Browser, stage: Stage, at_lamp: Console) -> None:
    at_lamp.test("release").click()
    with console(browser, stage, "minilamp") as second:
        second.take()
        assert second.drive()
        second.page.close()
        assert until(lambda: second.wheels == (0, 0), PAGE_S)
    at_lamp.take()
    assert at_lamp.press_anew()


STALLS: dict[str, Callable[[TcpProxy], object]] = {
    "goes silent and delivers late": lambda proxy: proxy.blackhole(),
    "is reset": lambda proxy: proxy.drop(),
}


@pytest.mark.parametrize("how", STALLS)
@pytest.mark.parametrize("seconds", [0.8, 2.5])
def test_a_connection_that_fails_stops(
    browser: Browser, stage: Stage, proxy: TcpProxy, how: str, seconds: float
) -> None:
    with console(browser, stage, "minilamp", "phone", "dark", url=f"http://127.0.0.1:{proxy.port}/") as robot:
        robot.take()
        assert robot.drive()
        began = time.monotonic()
        STALLS[how](proxy)
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
        assert robot.because("free")


@pytest.mark.parametrize("seconds", [0.4, 3.0])
def test_a_page_that_is_loaded_anew_has_control_and_no_gesture(at_lamp: Console, seconds: float) -> None:
    assert at_lamp.drive()
    at_lamp.page.reload()
    assert at_lamp.rests()
    assert at_lamp.because("", "release")
    assert at_lamp.stays_at_rest(seconds)
    assert at_lamp.press_anew()
