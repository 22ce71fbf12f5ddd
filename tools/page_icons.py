"""Draws app-icon.svg as the PNGs that the web manifest needs beside it: ``python tools/page_icons.py``, with Chromium.

Launchers of phones that cut an icon to their own shape take 192 and 512 px, and some show no SVG.
"""

import io
from pathlib import Path

from PIL import Image

from pebble.bench.page_rig import chromium

STATIC = Path(__file__).resolve().parent.parent / "pebble" / "web" / "static"
SIZES = (192, 512)
COLOURS = 64  # of its palette


def main() -> None:
    drawing = (STATIC / "app-icon.svg").read_text()
    page = f"<style>body {{ margin: 0 }} svg {{ display: block; width: 100vw }}</style>{drawing}"
    with chromium() as browser:
        for size in SIZES:
            tab = browser.new_page(viewport={"width": size, "height": size})
            tab.set_content(page.replace(' rx="15"', ""))  # maskable: its corners are cut by the phone
            picture = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
            target = STATIC / f"app-icon-{size}.png"
            picture.quantize(COLOURS, dither=Image.Dither.NONE).save(target, optimize=True)
            print(f"{target}: {target.stat().st_size} bytes")


if __name__ == "__main__":
    main()
