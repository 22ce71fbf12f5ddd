"""Fingers on a phone's glass, as Chromium takes them, and what they must reach."""

from __future__ import annotations

from tests.ext.page.browser import Tab

#: Where STOP lies, and what somebody may need at once but cannot press: something else lies over it.
REACHED = """(() => {
  const middle = (one, { x, y, width, height } = one.getBoundingClientRect()) => [x + width / 2, y + height / 2];
  const top = (one) => document.elementFromPoint(...middle(one));
  const urgent = [...document.querySelectorAll(".top .stop, .banner button, [data-test=take]")];
  const shown = urgent.filter((one) => one.checkVisibility());
  const covered = shown.filter((one) => top(one) && !one.contains(top(one))).map((one) => one.innerText);
  return [[...document.querySelectorAll(".top .stop")].map((one) => middle(one).map(Math.round)), covered];
})()"""


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
