"""Plots, the map of the odometry, what is drawn over pictures, snapshots, and a robot's own stream; in Chromium."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser

from tests.ext.page.browser import Tab
from tests.ext.page.canned import CannedServer, Show, showing
from tests.ext.page.states import (
    SENSORS,
    STATES,
)

pytestmark = pytest.mark.page


@pytest.fixture(scope="module")
def show(server: CannedServer, browser: Browser) -> Show:
    return partial(showing, server, browser, when="!!window.pebble?.connection.you")


@pytest.fixture(scope="module")
def _sensors(show: Show) -> Iterator[Tab]:
    with show(SENSORS) as opened:
        yield opened


@pytest.fixture
def sensors(_sensors: Tab) -> Iterator[Tab]:
    """One page for several tests."""
    yield _sensors
    assert _sensors.complaints() == []


def seen(place: Any) -> Any:
    """Return the pixels of a page, or of an element."""
    return np.asarray(Image.open(io.BytesIO(place.screenshot())).convert("RGB")).astype(int)


def like(pixels: Any, colour: tuple[int, ...]) -> Any:
    """Return which pixels have this colour."""
    return np.abs(pixels - np.array(colour)).sum(axis=2) < 60


def inked(opened: Tab, canvas: str, ink: str) -> Any:
    """Return which pixels of a canvas have a colour of its style."""
    place = opened.page.locator(canvas)
    colour = place.evaluate("(canvas, ink) => getComputedStyle(canvas).getPropertyValue(ink).trim()", ink)
    return like(seen(place), tuple(int(colour[at : at + 2], 16) for at in (1, 3, 5)))


# -- plots and map


def test_a_plot_is_drawn_up_to_now_and_its_newest_value_is_text(sensors: Tab) -> None:
    for name in ("battery", "attitude", "touch"):
        canvas = f"[data-test=plot-{name}] canvas"
        late = lambda canvas=canvas: np.array_split(inked(sensors, canvas, "--line-0"), 5, axis=1)[-1]
        assert sensors.until(lambda: late().sum() > 5)  # noqa: B023
    texts = sensors.test("plot-battery").locator("li").all_inner_texts()
    assert [" ".join(text.split()) for text in texts] == ["battery 7.92 V"]


@pytest.mark.parametrize("language", ["C", "en-US@posix"])
def test_plots_are_drawn_where_the_language_has_a_name_that_browsers_do_not_know(show: Show, language: str) -> None:
    named = f"Object.defineProperty(Navigator.prototype, 'language', {{ get: () => {language!r} }})"
    with show(SENSORS, script=named) as opened:
        opened.test("plot-battery").scroll_into_view_if_needed()
        assert opened.until("document.querySelector('[data-test=plot-battery] canvas') !== null")
        assert opened.complaints() == []


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


def assert_a_square_in_the_middle(opened: Tab, pixel: float = 1.0) -> None:
    """Its corners are a quarter and three quarters of what is seen of the picture; ``pixel``: of the line."""
    areas: list[Any] = []

    def are_both_seen() -> bool:
        pixels = seen(opened.page)
        areas[:] = area(pixels, PICTURE), area(pixels, INK)
        return None not in areas

    assert opened.until(are_both_seen, 40)  # a busy machine takes seconds for each picture
    (left, top, right, bottom), square = areas
    assert (right - left) / (bottom - top) == pytest.approx(640 / 360, rel=0.01)
    width, height = right - left, bottom - top
    expected = (left + width / 4, top + height / 4, right - width / 4, bottom - height / 4)
    assert square == pytest.approx(expected, abs=1.6 * pixel)


OVERLAYS = STATES["overlays"]


@pytest.mark.parametrize(
    ("size", "options"),
    [
        ("desktop", {"viewport": {"width": 1100, "height": 560}}),  # bars on both sides of the picture
        ("desktop", {"viewport": {"width": 1281, "height": 701}, "device_scale_factor": 2}),
        ("phone", {}),
    ],
)
def test_what_is_drawn_over_a_picture_is_where_it_belongs(show: Show, size: Any, options: dict[str, Any]) -> None:
    with show(OVERLAYS, size, **options) as opened:
        opened.page.evaluate(_PLAIN)
        assert_a_square_in_the_middle(opened, options.get("device_scale_factor", 1))
        assert opened.complaints() == []


def test_overlays_in_full_screen_where_stop_and_the_reason_remain_and_overlays_that_are_off(
    show: Show, server: CannedServer
) -> None:
    with show(OVERLAYS) as opened:
        opened.page.evaluate(_PLAIN)
        opened.test("full-screen").click()
        assert opened.until("!!document.fullscreenElement && !!document.querySelector('.immersive')")
        assert opened.test("stop-one").is_visible()
        assert opened.test("why").is_visible()
        assert_a_square_in_the_middle(opened)
        opened.test("stop-one").click()
        assert opened.until(lambda: server.sent("estop"))
        opened.page.get_by_label("Leave full screen").click()
        opened.test("gear").click()
        opened.test("overlays").click()
        assert opened.until("!document.querySelector('[data-test=overlays-canvas]')")


def test_a_snapshot_is_what_is_on_the_canvas_under_its_time(show: Show) -> None:
    with show(STATES["driving"]) as opened:
        with opened.page.expect_download() as saved:
            opened.test("snapshot").click()
        name = saved.value.suggested_filename
        picture = Image.open(saved.value.path())
        assert (picture.format, picture.size) == ("PNG", (640, 360))
        assert np.asarray(picture.convert("RGB")).std() > 10
        taken = time.mktime(time.strptime(name, "goob-%Y-%m-%dT%H-%M-%S.png"))
        assert abs(time.time() - taken) < 10
        assert opened.complaints() == []


def test_a_snapshot_that_would_be_noise_is_not_saved(show: Show) -> None:
    """As Firefox reads canvases where it resists fingerprinting."""
    noise = """CanvasRenderingContext2D.prototype.getImageData = (x, y, width, height) =>
      new ImageData(crypto.getRandomValues(new Uint8ClampedArray(4 * width * height)), width, height)"""
    with show(STATES["driving"], script=noise) as opened:
        opened.test("snapshot").click()
        assert opened.until("document.body.innerText.includes('Not saved: this browser gives pages other pictures')")


# -- the robot's own stream

OWN = STATES["own-stream"]


def test_a_robots_own_stream_is_shown_in_a_frame_and_never_called_live(show: Show, server: CannedServer) -> None:
    reason = "pebble.driver.reason()?.code ?? ''"
    with show(OWN) as opened:
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
