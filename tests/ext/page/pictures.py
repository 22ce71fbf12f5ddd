"""Makes the README's pictures of the operator page, with four simulated robots: ``python -m tests.ext.page.pictures``.

They are docs/page-driving.jpg, in which the key W is held, and docs/page-fleet.jpg. It needs mosquitto and
Chromium.
"""

import io
import sys

from PIL import Image

from tests.ext.page.rig import KEY, ROBOT, Rig, rig
from tests.support import ROOT

DOCS = ROOT / "docs"
WIDTH, QUALITY, MOST_BYTES = 1000, 78, 200_000
SHARP_S, SMALL_PICTURES_S = 4.0, 4.0
CARDS = {"x": 0, "y": 0, "width": 1280, "height": 580}


def driving(made: Rig) -> bytes:
    """A picture of a robot's page while it drives ahead, with what its camera sees."""
    page = made.page(ROBOT)
    made.until(page, "window.pebble?.video?.info", "no picture has arrived")
    made.pause(page, SHARP_S)
    made.hold(page, KEY)
    taken = page.screenshot()
    page.keyboard.up(KEY)
    made.stopped(page)
    return taken


def fleet(made: Rig) -> bytes:
    """A picture of all robots of the broker, with small pictures of those that have a camera."""
    page = made.page()
    made.pause(page, SMALL_PICTURES_S)
    return page.screenshot(clip=CARDS)


def save(name: str, png: bytes) -> int:
    """Writes one picture, and returns its size in bytes."""
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    target = DOCS / f"page-{name}.jpg"
    picture.save(target, quality=QUALITY, optimize=True)
    print(f"{target}: {target.stat().st_size} bytes")
    return target.stat().st_size


def main() -> int:
    with rig() as made:
        taken = {"driving": driving(made), "fleet": fleet(made)}
    sizes = [save(name, png) for name, png in taken.items()]
    return int(max(sizes) > MOST_BYTES)


if __name__ == "__main__":
    sys.exit(main())
