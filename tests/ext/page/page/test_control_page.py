"""Two people at two servers of the page, and a robot that keeps control itself: take, ask, let, keep, take over."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser

from pebble.transports import MqttSettings
from tests.ext.page.browser import Size, Tab, tab
from tests.ext.page.served import Served
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

GOOB = "pebble/robots/goob"
SLOT = "document.querySelector('[data-test=why]').textContent"
PLACES = """[...document.querySelectorAll('.slot, .stick, input[type=range]')].filter((one) => one.checkVisibility())
  .map((one) => one.getBoundingClientRect()).map(({ x, y, width, height }) => [x, y, width, height].map(Math.round))
  .join(' ')"""

#: Behind which button of the fleet the notices are.
NOTICES = {"desktop": "bell", "phone": "settings"}

pytestmark = [pytest.mark.page, pytest.mark.timeout(180)]


@contextmanager
def person(browser: Browser, served: Served, name: str, size: Size = "desktop") -> Iterator[Tab]:
    script = f"localStorage.setItem('pebble name', JSON.stringify('{name}'))"
    with tab(browser, f"{served.origin}/r/{GOOB}", size, script=script) as opened:
        assert opened.until("window.pebble?.connection.isOpen && pebble.driver.reason()?.code === 'free'", 30)
        yield opened


def moves(opened: Tab, robot: RecordingRobot) -> bool:
    """Whether a key, pressed anew, moves the robot."""
    opened.page.bring_to_front()
    before = len([one for one in robot.drives() if one["z"]])
    opened.page.keyboard.down("KeyW")
    moved = opened.until(lambda: len([one for one in robot.drives() if one["z"]]) > before + 1, 2)
    opened.page.keyboard.up("KeyW")
    return moved


def server(broker: Broker, name: str, account: str) -> Served:
    """A page server with its own login."""
    return Served(broker.port, server=name, broker=MqttSettings(host="127.0.0.1", port=broker.port, username=account))


@pytest.mark.parametrize(
    ("size", "named", "by", "vouched"),
    [
        ("phone", False, "ann", "name not checked"),
        ("desktop", True, "page-1/ann", "name checked"),
    ],
)
def test_two_people_take_ask_let_keep_and_take_over(
    browser: Browser, broker: Broker, size: Size, named: bool, by: str, vouched: str
) -> None:
    """The robot's clock is slow: who has not driven for five seconds is not asked, and a busy machine may need them."""
    with (
        RecordingRobot(broker.port, GOOB, keeps=True, named=named, pace=0.1) as robot,
        server(broker, "hall", "page-1") as hall,
        server(broker, "attic", "page-2") as attic,
        person(browser, hall, "ann", size) as ann,
        person(browser, attic, "otto", size) as otto,
    ):
        assert robot.keeping is not None
        owner = robot.keeping.owners[0]
        places = ann.page.evaluate(PLACES)
        ann.test("take").click()
        assert ann.until(f"{SLOT}.includes('You drive')")
        assert moves(ann, robot)
        assert otto.until(f"{SLOT}.includes('ann drives') && {SLOT}.includes('{vouched}')")
        assert not moves(otto, robot)

        otto.test("ask").click()
        assert ann.until(f"{SLOT}.includes('otto asks to drive')")
        assert otto.until(f"{SLOT}.includes('ann is asked')")
        assert ann.page.evaluate(PLACES) == places
        ann.test("keep").click()
        assert ann.until(f"{SLOT}.includes('You drive')")
        otto.test("give-up").click()
        assert otto.until(f"{SLOT}.includes('ann drives')")

        assert moves(ann, robot)
        otto.test("ask").click()
        ann.test("let").click()
        assert otto.until(f"{SLOT}.includes('You drive')")
        assert ann.until(f"{SLOT}.includes('otto drives')")
        assert moves(otto, robot)
        assert robot.drives()[-1].get("key") == owner.lease.key
        assert not moves(ann, robot)

        otto.page.bring_to_front()
        otto.page.keyboard.down("KeyW")
        assert otto.until("pebble.driver.gestureActive")
        ann.test("take-over").hover()
        ann.page.mouse.down()
        assert ann.until(f"{SLOT}.includes('You drive')")
        ann.page.mouse.up()
        assert otto.until(f"{SLOT}.includes('ann drives')")
        assert until(lambda: owner.by == by)
        assert not otto.page.evaluate("pebble.driver.gestureActive"), "what is held moves nothing any more"
        otto.page.keyboard.up("KeyW")
        assert moves(ann, robot)
        robot.stranger(z=0.3)
        assert ann.until(f"{SLOT}.includes('Someone else drives, too')")
        assert ann.page.evaluate(PLACES) == places

        assert moves(ann, robot)
        ann.page.evaluate("history.pushState(null, '', '/'); dispatchEvent(new PopStateEvent('popstate'))")
        assert ann.until("window.pebble.driver.ref !== 'pebble/robots/goob'")
        otto.test("ask").click()
        ann.test(NOTICES[size]).click()
        assert ann.until("document.querySelector('.notice')?.textContent.includes('otto asks to drive')")
        assert ann.complaints() + otto.complaints() == []
