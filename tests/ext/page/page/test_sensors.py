"""What is drawn over pictures, full screen, and a robot's own stream; in Chromium."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.ext.page.browser import Size
from tests.ext.page.canned import CannedServer, Show
from tests.ext.page.states import STATES

pytestmark = pytest.mark.page
HERE = "!!window.pebble?.connection.you"


def seen(place: Any) -> Any:
    """Return the pixels of a page, or of an element."""
    return np.asarray(Image.open(io.BytesIO(place.screenshot())).convert("RGB")).astype(int)


def like(pixels: Any, colour: tuple[int, ...]) -> Any:
    """Return which pixels have this colour."""
    return np.abs(pixels - np.array(colour)).sum(axis=2) < 60


# -- over the picture

#: Instead of pictures: one colour, so that a test sees where the picture is.
_PLAIN = """() => {
  pebble.video.draw = function (bitmap, info) {
    const { canvas, context } = this;
    if (canvas.width !== 640) Object.assign(canvas, { width: 640, height: 360 });
    context.fillStyle = "#ff00ff";
    context.fillRect(0, 0, canvas.width, canvas.height);
    const first = !this.info;
    this.info = { ...info, capturedMs: Date.now() };
    this.drawnAt = performance.now();
    if (first) this.changed();
  };
}"""


def area(pixels: Any, colour: tuple[int, int, int]) -> tuple[int, int, int, int] | None:
    """Return left, top, right and bottom of what has this colour; None if nothing has."""
    rows, columns = np.where(like(pixels, colour))
    if not len(rows):
        return None
    return int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1


PICTURE, INK = (255, 0, 255), (77, 243, 255)


@pytest.mark.parametrize(("size", "scale"), [("desktop", 2), ("phone", 1)])
def test_what_is_drawn_over_a_picture_is_where_it_belongs(show: Show, size: Size, scale: int) -> None:
    """The corners of a square are a quarter and three quarters of what is seen of the picture."""
    areas: list[Any] = []

    def are_both_seen() -> bool:
        pixels = seen(opened.page)
        areas[:] = area(pixels, PICTURE), area(pixels, INK)
        return None not in areas

    with show(STATES["overlays"], size, when=HERE, device_scale_factor=scale) as opened:
        opened.page.evaluate(_PLAIN)
        assert opened.until(are_both_seen, 40)  # a busy machine takes seconds for each picture
        (left, top, right, bottom), square = areas
        width, height = right - left, bottom - top
        assert width / height == pytest.approx(640 / 360, rel=0.01)
        expected = (left + width / 4, top + height / 4, right - width / 4, bottom - height / 4)
        assert square == pytest.approx(expected, abs=1.6 * scale)  # pixels of the line
        assert opened.complaints() == []


def test_stop_and_the_reason_remain_in_full_screen_and_overlays_can_be_off(show: Show, server: CannedServer) -> None:
    with show(STATES["overlays"]) as opened:
        opened.test("full-screen").click()
        assert opened.until("!!document.fullscreenElement && !!document.querySelector('.immersive')")
        assert opened.test("why").is_visible()
        opened.test("stop-one").click()
        assert opened.until(lambda: server.sent("estop"))
        opened.page.get_by_label("Leave full screen").click()
        opened.test("gear").click()
        opened.test("overlays").click()
        assert opened.until("!document.querySelector('[data-test=overlays-canvas]')")


def test_a_robots_own_stream_is_shown_in_a_frame_and_never_called_live(show: Show, server: CannedServer) -> None:
    reason = "pebble.driver.reason()?.code ?? ''"
    with show(STATES["own-stream"], when=HERE) as opened:
        assert opened.until(f"{reason} === ''")
        opened.test("gear").click()
        opened.test("open-stream").click()
        frame = opened.test("stream")
        assert frame.get_attribute("sandbox") == "allow-scripts allow-same-origin"
        text = opened.page.frame_locator("[data-test=stream]").locator("body")
        assert "own stream" in text.inner_text(timeout=5000)
        assert opened.until(f"{reason} === 'picture'")
        assert "not known" in opened.test("why").inner_text()
        opened.test("see").click()
        assert opened.until(f"{reason} === ''")
        opened.page.keyboard.down("KeyW")
        assert opened.until(lambda: any(one["z"] for one in server.sent("drive")))
        text.click()
        assert opened.until("!pebble.driver.gestureActive"), "keys go to the frame"
        opened.page.keyboard.up("KeyW")
        opened.test("close-stream").click()
        assert frame.count() == 0
        assert opened.complaints() == []
