"""Makes docs/page-fleet.jpg, with four simulated robots: ``python -m tests.ext.page.pictures``.

It needs mosquitto and Chromium.
"""

import io
import sys

from PIL import Image
from playwright.sync_api import Browser

from tests.ext.page.browser import chromium, tab
from tests.ext.page.stage import Stage
from tests.support import ROOT

DOCS = ROOT / "docs"
WIDTH, QUALITY, MOST_BYTES = 1000, 78, 200_000
SMALL_PICTURES_S = 4.0
CARDS = {"x": 0, "y": 0, "width": 1280, "height": 580}


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
        return int(save("fleet", fleet(browser, stage)) > MOST_BYTES)


if __name__ == "__main__":
    sys.exit(main())
