"""A tab of the page before one robot of a stage: tests use the page's controls, and look at the robot's motors."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

from playwright.sync_api import Browser, Error, Locator

from tests.ext.page.browser import Size, Tab, Theme, tab
from tests.ext.page.stage import Stage
from tests.support import SOON_S, WAIT_S

Wheels = tuple[int, int]

FORWARD, BACK, LEFT, RIGHT, REST = (1, 1), (-1, -1), (-1, 1), (1, -1), (0, 0)
QUIET_S = 0.4  # so long nothing may turn where nothing may turn: eight commands of a gesture
_PRESSES = 6
_MOVES_S = 3.0


@dataclass
class Console:
    """``name`` is the robot's. ``since_ns`` is when the last call of ``rests`` began."""

    tab: Tab
    stage: Stage
    name: str
    held: list[str] = field(default_factory=list)

    # -- the page

    @property
    def page(self) -> Any:
        return self.tab.page

    @property
    def ref(self) -> str:
        return self.stage.ref(self.name)

    def test(self, name: str) -> Locator:
        return self.tab.page.locator(f'[data-test="{name}"]:visible')

    def place(self, name: str) -> tuple[float, float, float]:
        """The middle of a control and its width, in pixels of the window."""
        box = self.test(name).bounding_box()
        assert box is not None
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, box["width"]

    @property
    def reason(self) -> str:
        """The code of why it cannot be driven; "" it can."""
        return str(self.page.evaluate("window.pebble?.driver.reason()?.code ?? (window.pebble ? '' : 'loading')"))

    def state(self, metric: str, ref: str | None = None) -> Any:
        """The newest value of a metric that the page has."""
        return self.page.evaluate(
            "([ref, metric]) => window.pebble?.store.get(ref, metric)?.value",
            [self.ref if ref is None else ref, metric],
        )

    def because(self, *codes: str, within: float = WAIT_S) -> bool:
        """Wait until driving is off for one of these reasons; "" is that it is on."""
        return self.tab.until(lambda: self.reason in codes, within)

    def reset(self, name: str = "") -> None:
        """Without the page's controls: end the stop of this robot, or of another one."""
        ref = self.stage.ref(name or self.name)
        owners = self.state("web/estop", ref)["owners"]
        self.page.evaluate("([ref, owners]) => window.pebble.commands.reset(ref, owners)", [ref, owners])

    def take(self) -> None:
        """Take control; there may be a stop to be reset, or a picture to wait for. Ends with nothing held."""
        self.let_go()
        end = time.monotonic() + 2 * WAIT_S
        while not self.because("", within=0.2):
            assert time.monotonic() < end, self.reason
            with suppress(Error):  # the reason has changed meanwhile, and with it the button
                self._improve(self.reason)

    def _improve(self, reason: str) -> None:
        """Do what the page offers against this reason."""
        match reason:
            case "stopped":
                self.reset()
            case "free" | "idle" | "itself":
                self.test("take").click(timeout=2000)
            case "lease":
                self.test("take-over").hover(timeout=2000)
                self.page.mouse.down()
                self.because("", "free", "idle", "itself", within=SOON_S)
                self.page.mouse.up()

    def hold_button(self, name: str, seconds: float = 1.15) -> None:
        """Press it with the mouse for so long; after a second until the page has counted it."""
        self.test(name).hover()
        self.page.mouse.down()
        self.page.wait_for_timeout(1000 * seconds)
        assert seconds < 1 or self.tab.until(lambda: not self.page.locator(".held").count())
        self.page.mouse.up()

    # -- keys

    def down(self, *codes: str) -> None:
        for code in codes:
            self.page.keyboard.down(code)
            self.held.append(code)

    def let_go(self) -> None:
        """Release all keys."""
        while self.held:
            self.page.keyboard.up(self.held.pop())

    def drive(self, *codes: str, wheels: Wheels = FORWARD) -> bool:
        """Press and hold keys until the wheels turn so."""
        return self.persists(lambda: self.down(*(codes or ("KeyW",))), lambda: self.wheels == wheels, self.let_go)

    def persists(self, begin: Callable[[], None], reached: Callable[[], bool], end: Callable[[], None]) -> bool:
        """Begin a gesture until it has its effect; again, if a busy machine has ended it, as it should."""
        for _ in range(_PRESSES):
            begin()
            if self.tab.until(reached, _MOVES_S):
                return True
            end()
            self.page.wait_for_timeout(60)
        return False

    def press_anew(self) -> bool:
        """Whether releasing and pressing a key drives again; the robot is at rest after it."""
        self.let_go()
        self.page.wait_for_timeout(80)
        turned = self.drive()
        self.let_go()
        return turned and self.rests()

    # -- wheels

    @property
    def wheels(self) -> Wheels:
        motors = self.stage.motors(self.name)
        left, right = motors[-1][1] if motors else (0.0, 0.0)
        return _sign(left), _sign(right)

    @property
    def speeds(self) -> tuple[float, float]:
        return self.stage.motors(self.name)[-1][1]

    def rests(self, within: float = SOON_S) -> bool:
        return self.tab.until(lambda: self.wheels == REST, within)

    def stays_at_rest(self, seconds: float = QUIET_S) -> bool:
        """Whether no motor runs, from now on for so long."""
        began = time.monotonic_ns()
        self.page.wait_for_timeout(1000 * seconds)
        return not self.stage.wheels_turning(self.name, since_ns=began)


@contextmanager
def console(
    browser: Browser,
    stage: Stage,
    name: str,
    size: Size = "desktop",
    theme: Theme = "light",
    *,
    url: str = "",
    script: str = "",
    engineers: bool = True,
) -> Iterator[Console]:
    """Open the page of a robot. ``url`` with a slash at the end: by another way than the server's own address.

    Without ``engineers`` none of its cards for them is open: drawing plots takes most of what a page needs.
    """
    address = f"{url or stage.url}r/{stage.ref(name)}"
    with tab(browser, address, size, theme, script=script, engineers=engineers) as opened:
        yield Console(opened, stage, name)


@contextmanager
def used(opened: Console, *, complaints: bool = True) -> Iterator[Console]:
    """A console for one test: it has control, and at the end nothing moves and the page has not complained.

    ``complaints`` False: the browser may report that connections have failed, and nothing else.
    """
    opened.page.evaluate("document.activeElement.blur()")  # keys in a list choose from it
    opened.take()
    before = len(opened.tab.complaints())
    yield opened
    opened.let_go()
    opened.page.mouse.up()
    assert opened.rests(), opened.speeds
    found = opened.tab.complaints()[before:]
    assert [one for one in found if complaints or not _of_connection(one)] == []


def _of_connection(complaint: str) -> bool:
    return any(words in complaint for words in ("WebSocket", "ERR_CONNECTION", "Failed to load resource"))


def _sign(value: float) -> int:
    return (value > 0) - (value < 0)
