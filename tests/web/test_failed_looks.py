"""What is drawn where colours are people's own, and where a part of the page does not come."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.web.browser import Size, Theme
from tests.web.canned import Show
from tests.web.states import STATES

pytestmark = pytest.mark.page

#: What is drawn, and how: its pixels are not all of one colour.
DRAWN = [".knob", ".stick-arrow.n", ".stick-arrow.e", ".stick-arrow.s", ".stick-arrow.w"]
#: How many texts say that a part loads; how many of them lie over a control, and how many leave their card.
COVERED = """(() => {
  const place = (one) => one.getBoundingClientRect();
  const texts = [...document.querySelectorAll(".loading")].filter((one) => place(one).height > 0);
  const controls = [...document.querySelectorAll("button, a, input, select, .stick")]
    .filter((one) => !one.closest(".tabs, header, .skip")); // the page scrolls below these
  const wide = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left);
  const over = (a, b) => wide(a, b) > 1 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1;
  const covers = (one) => controls.some((two) => over(place(one), place(two)));
  const leaves = (one) => place(one).bottom > place(one.closest(".card") ?? document.documentElement).bottom + 1;
  return [texts.length, texts.filter(covers).length, texts.filter(leaves).length];
})()"""
#: Among them the settings below the stick, and a sheet of theirs.
LATE = ("drive-settings.js", "key-hints.js", "telemetry.js", "map.js", "lights.js", "plots.js", "panels.css")


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_the_stick_is_seen_in_forced_colours(show: Show, size: Size, theme: Theme) -> None:
    with show(STATES["driving"], size, theme=theme, forced_colors="active") as opened:
        opened.uncover("stick")
        sheet = "getComputedStyle(document.querySelector('.knob')).forcedColorAdjust === 'none'"
        assert opened.until(sheet)
        for one in DRAWN:
            data = np.frombuffer(opened.page.locator(one).first.screenshot(), np.uint8)
            picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
            assert picture is not None
            assert int(picture.max()) - int(picture.min()) > 100, one
        left = "document.querySelector('.stick-arrow.n')"
        assert opened.page.evaluate(f"getComputedStyle({left}).borderLeftColor") == "rgba(0, 0, 0, 0)", "a triangle"


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_what_still_loads_lies_over_nothing(show: Show, size: Size) -> None:
    late = {f"**/{name}": lambda _: None for name in LATE}  # they never come
    with show(STATES["driving"], size, routes=late) as opened:
        assert opened.until(f"{COVERED}[0] > 0", 20)
        assert opened.until(f"{COVERED}.slice(1).join() === '0,0'", 5), opened.page.evaluate(COVERED)
