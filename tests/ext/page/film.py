"""Makes docs/demo.webp and docs/page-fleet.jpg of the page with simulated robots: ``python -m tests.ext.page.film``.

In the film, of eight seconds, Goob is driven by keys until STOP, and then by a finger on a phone. The picture has all
robots. It needs mosquitto, Chromium and a quiet machine.
"""

import io
import sys
import time
from collections.abc import Iterator
from itertools import pairwise

from PIL import Image
from playwright.sync_api import Browser

from tests.ext.page.browser import chromium, tab
from tests.ext.page.console import Console, console
from tests.ext.page.stage import Stage
from tests.support import ROOT

FILM, MOST_BYTES = ROOT / "docs" / "demo.webp", 3_000_000
SIZE, BACKGROUND = (960, 600), "#e9eef1"
DRIVEN_S, STOPPED_S, PHONE_S, PAUSE_S = 3.5, 2.0, 2.5, 0.12
SHARP_S = 4.0
QUALITY = 55
FLEET, FLEET_BYTES, FLEET_QUALITY = ROOT / "docs" / "page-fleet.jpg", 200_000, 78
FLEET_WIDTH, SMALL_PICTURES_S = 1000, 4.0
CARDS = {"x": 0, "y": 0, "width": 1280, "height": 580}

Frame = tuple[float, Image.Image]


def desktop(browser: Browser, stage: Stage) -> Iterator[Frame]:
    """Drive by keys, in a curve, until STOP is pressed."""
    with console(browser, stage, "goob", engineers=False) as robot:
        ready(robot)
        robot.page.keyboard.down("w")
        yield from frames(robot, 0.6 * DRIVEN_S)
        robot.page.keyboard.down("d")
        yield from frames(robot, 0.4 * DRIVEN_S)
        robot.test("stop-one").click()
        yield from frames(robot, STOPPED_S)
        for key in "wd":
            robot.page.keyboard.up(key)
        robot.reset()


def phone(browser: Browser, stage: Stage) -> Iterator[Frame]:
    """Drive on a phone that lies, by a finger on the stick."""
    with console(browser, stage, "goob", "landscape", engineers=False) as robot:
        ready(robot)
        x, y, width = robot.place("stick")
        robot.page.mouse.move(x, y)
        robot.page.mouse.down()
        robot.page.mouse.move(x, y - 0.4 * width, steps=4)
        yield from frames(robot, PHONE_S)
        robot.page.mouse.up()


def fleet(browser: Browser, stage: Stage) -> Image.Image:
    """Return a picture of all robots, with small pictures of those that have a camera."""
    with tab(browser, stage.url) as opened:
        opened.page.wait_for_timeout(1000 * SMALL_PICTURES_S)
        taken = Image.open(io.BytesIO(opened.page.screenshot(clip=CARDS))).convert("RGB")
    taken.thumbnail((FLEET_WIDTH, FLEET_WIDTH), Image.Resampling.LANCZOS)
    return taken


def ready(robot: Console) -> None:
    """Wait for a sharp picture, and take control."""
    assert robot.tab.until("window.pebble?.video?.info"), "no picture has arrived"
    robot.take()
    robot.page.wait_for_timeout(1000 * SHARP_S)


def frames(robot: Console, seconds: float) -> Iterator[Frame]:
    """Yield pictures of the tab and the times at which they were taken."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        at = time.monotonic()
        taken = Image.open(io.BytesIO(robot.page.screenshot())).convert("RGB")
        taken.thumbnail(SIZE, Image.Resampling.LANCZOS)
        whole = Image.new("RGB", SIZE, BACKGROUND)
        whole.paste(taken, ((SIZE[0] - taken.width) // 2, (SIZE[1] - taken.height) // 2))
        yield at, whole
        time.sleep(max(0.0, at + PAUSE_S - time.monotonic()))


def _shown_ms(times: list[float]) -> list[int]:
    """Return how long each picture is shown: until the next one was taken."""
    return [*(round(1000 * (after - at)) for at, after in pairwise(times)), 300]


def main() -> int:
    """Write both; return 1 if one has too many bytes."""
    with Stage() as stage, chromium() as browser:
        fleet(browser, stage).save(FLEET, quality=FLEET_QUALITY, optimize=True)
        parts = [list(desktop(browser, stage)), list(phone(browser, stage))]
    pictures = [picture for part in parts for _, picture in part]
    shown_ms = [shown for part in parts for shown in _shown_ms([at for at, _ in part])]
    options = {"save_all": True, "append_images": pictures[1:], "duration": shown_ms, "loop": 0, "quality": QUALITY}
    pictures[0].save(FILM, method=6, **options)
    print(f"{FILM}: {len(pictures)} pictures, {sum(shown_ms) / 1000:.1f} s, {FILM.stat().st_size} bytes")
    print(f"{FLEET}: {FLEET.stat().st_size} bytes")
    return int(FILM.stat().st_size > MOST_BYTES or FLEET.stat().st_size > FLEET_BYTES)


if __name__ == "__main__":
    sys.exit(main())
