"""Makes the README's pictures of the operator page, with four simulated robots: ``python -m tests.ext.page.pictures``.

They are docs/page-driving.jpg, in which the key W is held, and docs/page-fleet.jpg. It needs mosquitto and
Chromium.
"""

import io
import sys

from PIL import Image
from playwright.sync_api import Browser

from tests.ext.page.browser import chromium, tab
from tests.ext.page.console import console
from tests.ext.page.stage import Stage
from tests.support import ROOT

DOCS = ROOT / "docs"
WIDTH, QUALITY, MOST_BYTES = 1000, 78, 200_000
SHARP_S, SMALL_PICTURES_S, HELD_S = 4.0, 4.0, 0.4
CARDS = {"x": 0, "y": 0, "width": 1280, "height": 580}


def driving(browser: Browser, stage: Stage) -> bytes:
    """Return a picture of a robot's page while it drives ahead, with what its camera sees."""
    with console(browser, stage, "goob", engineers=False) as robot:
        assert robot.tab.until("window.pebble?.video?.info", 20), "no picture has arrived"
        robot.page.wait_for_timeout(1000 * SHARP_S)
        robot.take()
        assert robot.drive(), robot.reason
        robot.page.wait_for_timeout(1000 * HELD_S)
        taken: bytes = robot.page.screenshot()
        robot.let_go()
        assert robot.rests()
        return taken


def fleet(browser: Browser, stage: Stage) -> bytes:
    """Return a picture of all robots of the broker, with small pictures of those that have a camera."""
    with tab(browser, stage.url) as opened:
        opened.page.wait_for_timeout(1000 * SMALL_PICTURES_S)
        return opened.page.screenshot(clip=CARDS)


def save(name: str, png: bytes) -> int:
    """Writes one picture, and returns its size in bytes."""
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    target = DOCS / f"page-{name}.jpg"
    picture.save(target, quality=QUALITY, optimize=True)
    print(f"{target}: {target.stat().st_size} bytes")
    return target.stat().st_size


def main() -> int:
    with Stage() as stage, chromium() as browser:
        taken = {"driving": driving(browser, stage), "fleet": fleet(browser, stage)}
    sizes = [save(name, png) for name, png in taken.items()]
    return int(max(sizes) > MOST_BYTES)


if __name__ == "__main__":
    sys.exit(main())
