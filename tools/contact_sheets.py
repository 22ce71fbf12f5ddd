"""Puts the pictures of the page's states in build/page together: docs/page-states-desktop.jpg and -phone.jpg.

Run it after ``pytest tests/web/page/test_look.py``, and look at both.
"""

import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

ROOT = Path(__file__).resolve().parent.parent
PICTURES, DOCS = ROOT / "build" / "page", ROOT / "docs"
#: Size of the page, scale, columns, quality; what is also on the sheet.
SHEETS = {
    "desktop": ((1280, 800), 0.17, 8, 36, ()),
    "phone": ((390, 844), 0.23, 16, 36, ("landscape", "small")),
}
LABEL, GAP = 22, 10
BACKGROUND, INK = (64, 70, 76), (255, 255, 255)
MOST_BYTES = 1_000_000  # both together


def sheet(size: str) -> int:
    """Write one sheet, light beside dark for each state; its size in bytes."""
    (width, height), scale, columns, quality, others = SHEETS[size]
    named = [(path, *path.stem.rsplit("-", 2)) for path in sorted(PICTURES.glob("*.png"))]
    paths = [(path, f"{name} {theme}") for kind in (size, *others) for path, name, of, theme in named if of == kind]
    if not paths:
        sys.exit(f"{PICTURES} has no pictures: run pytest tests/web/page/test_look.py first")
    tile = int(width * scale), int(height * scale)
    step = tile[0] + GAP, tile[1] + LABEL + GAP
    rows = -(-len(paths) // columns)
    whole = Image.new("RGB", (GAP + columns * step[0], GAP + rows * step[1]), BACKGROUND)
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(min(13, tile[0] // 10))
    for number, (path, label) in enumerate(paths):
        left, top = GAP + number % columns * step[0], GAP + number // columns * step[1]
        picture = Image.open(path).convert("RGB")
        picture.thumbnail(tile, Image.Resampling.LANCZOS)
        draw.text((left, top + 2), label[: tile[0] // 5], INK, font)
        whole.paste(picture, (left, top + LABEL))
    target = DOCS / f"page-states-{size}.jpg"
    whole.save(target, quality=quality, optimize=True)
    return target.stat().st_size


if __name__ == "__main__":
    total = sum(map(sheet, SHEETS))
    print(f"{total} bytes")
    if total > MOST_BYTES:
        sys.exit(f"more than {MOST_BYTES} bytes")
