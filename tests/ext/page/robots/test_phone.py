"""The page on phones, used with fingers; what they do is asserted at the robot's motors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser

from tests.ext.page.attacker import Everything
from tests.ext.page.browser import Size, Tab, Theme
from tests.ext.page.console import BACK, FORWARD, LEFT, RIGHT, Console, Wheels, console, used
from tests.ext.page.stage import Stage

pytestmark = pytest.mark.page  # deadlines are checked


class Fingers:
    """Fingers on the glass of one tab, by number; positions are pixels of the window."""

    def __init__(self, tab: Tab) -> None:
        self._session = tab.cdp()
        self._places: dict[int, tuple[float, float]] = {}

    def down(self, finger: int, x: float, y: float) -> None:
        self._places[finger] = x, y
        self._send("touchStart", *self._places)

    def move(self, finger: int, x: float, y: float) -> None:
        self._places[finger] = x, y
        self._send("touchMove", *self._places)

    def up(self, finger: int) -> None:
        self._send("touchEnd", finger)
        del self._places[finger]

    def cancel(self) -> None:
        """Cancels a touch as a call, a system gesture or too many fingers do."""
        self._places.clear()
        self._send("touchCancel")

    def lift(self) -> None:
        for finger in list(self._places):
            self.up(finger)

    def _send(self, kind: str, *fingers: int) -> None:
        points = [{"id": one, "x": self._places[one][0], "y": self._places[one][1]} for one in fingers]
        self._session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


class Phone(Console):
    """A console that is touched."""

    fingers: Fingers

    def stick(self, x: float = 0.0, y: float = -1.0, finger: int = 1) -> None:
        """Put a finger on the middle of the stick and drag it: to the right and down, of the stick's reach."""
        left, top, size = self.place("stick")
        self.fingers.down(finger, left, top)
        self.fingers.move(finger, left + 0.2 * x * size, top + 0.2 * y * size)
        self.fingers.move(finger, left + 0.4 * x * size, top + 0.4 * y * size)

    def drive_by_stick(self, x: float = 0.0, y: float = -1.0, wheels: Wheels = FORWARD) -> bool:
        return self.persists(lambda: self.stick(x, y), lambda: self.wheels == wheels, self.fingers.lift)

    def touch(self, name: str, finger: int = 2) -> None:
        left, top, _ = self.place(name)
        self.fingers.down(finger, left, top)


@contextmanager
def phone(browser: Browser, stage: Stage, size: Size = "phone", theme: Theme = "light") -> Iterator[Phone]:
    with console(browser, stage, "minilamp", size, theme) as opened, used(opened):
        held = Phone(opened.tab, stage, opened.name)
        held.fingers = Fingers(opened.tab)
        yield held
        held.fingers.lift()


@pytest.fixture
def at_lamp(browser: Browser, stage: Stage) -> Iterator[Phone]:
    with phone(browser, stage) as opened:
        yield opened


@pytest.mark.parametrize(("size", "theme"), [("phone", "light"), ("landscape", "dark")])
def test_the_stick_follows_a_finger_until_it_is_lifted(
    browser: Browser, stage: Stage, size: Size, theme: Theme
) -> None:
    with phone(browser, stage, size, theme) as robot:
        for x, y, wheels in [(0, -1, FORWARD), (0, 1, BACK), (-1, 0, LEFT), (1, 0, RIGHT)]:
            assert robot.drive_by_stick(x, y, wheels)
            robot.fingers.up(1)
            assert robot.rests()
        assert robot.drive_by_stick()
        robot.fingers.move(1, robot.place("stick")[0], 1)  # far above the stick
        assert robot.tab.until(lambda: robot.wheels == FORWARD)
        robot.fingers.up(1)
        assert robot.rests()


# -- a second finger


def test_a_second_finger_on_stop_latches(at_lamp: Phone, wire: Everything) -> None:
    assert at_lamp.drive_by_stick()
    at_lamp.touch("stop-one")
    assert at_lamp.tab.until(lambda: wire.latched("minilamp"))
    assert at_lamp.rests()
    at_lamp.fingers.up(2)
    assert at_lamp.because("stopped")
    at_lamp.reset()
    assert at_lamp.tab.until(lambda: not wire.latched("minilamp"))
    left, top, size = at_lamp.place("stick")
    at_lamp.fingers.move(1, left, top - 0.3 * size)
    assert at_lamp.stays_at_rest()
    at_lamp.fingers.up(1)
    assert at_lamp.drive_by_stick()


# -- what takes the finger away


def _rotate(robot: Phone, width: int, height: int, kind: str, angle: int) -> None:
    robot.tab.cdp().send(
        "Emulation.setDeviceMetricsOverride",
        {
            "width": width,
            "height": height,
            "deviceScaleFactor": 1,
            "mobile": True,
            "screenOrientation": {"type": kind, "angle": angle},
        },
    )


LOSSES: dict[str, Callable[[Phone], None]] = {
    "the system takes the finger": lambda robot: robot.fingers.cancel(),
    "rotation": lambda robot: _rotate(robot, 844, 390, "landscapePrimary", 90),
    "the screen is switched off": lambda robot: robot.tab.hide(),
    "another application": lambda robot: robot.tab.blur(),
}


@pytest.mark.parametrize("what", LOSSES)
def test_what_takes_the_finger_away_stops(at_lamp: Phone, what: str) -> None:
    assert at_lamp.drive_by_stick()
    LOSSES[what](at_lamp)
    assert at_lamp.rests()
    assert at_lamp.stays_at_rest()
    at_lamp.tab.hide(hidden=False)
    assert at_lamp.stays_at_rest()
    at_lamp.fingers.lift()
    assert at_lamp.test("stop-one").is_visible()
    assert at_lamp.drive_by_stick()
