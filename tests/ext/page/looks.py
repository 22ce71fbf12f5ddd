"""How the page looks in a few states, pixel by pixel, and stored pictures of it: ``make long PART=looks``.

Time stands still on the page and at its server, nothing moves, and the camera shows flat colours; so a picture differs
only where the page does, and by how the browser smooths edges. Pictures are stored at half size: that is readable, and
all of them together are small.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from PIL import Image
from playwright.sync_api import Browser, Page

from tests.ext.page.browser import Tab, Theme
from tests.ext.page.canned import CannedServer, State, showing
from tests.ext.page.states import STATES
from tests.support import ROOT

STORED = ROOT / "tests/ext/page/page/looks"
FAILED = ROOT / "build" / "looks"
LEVELS, SHARE = 12, 0.0003  # a pixel differs by more than so many of 255 levels; this share of them may
AT = 1_795_341_630_000  # 22 November 2026, 10:00:30 UTC
SIZES = {"desktop": (1440, 900), "tall": (1440, 1960), "phone": (390, 844), "landscape": (844, 390)}

#: Both clocks of the page stand still; timers run.
FROZEN = f"""{{
  const Then = Date;
  window.Date = class extends Then {{
    constructor(...parts) {{ parts.length ? super(...parts) : super({AT}); }}
    static now() {{ return {AT}; }}
  }};
  performance.now = () => 5000;
}}"""
_HERE = """!document.querySelector('.loading, .bench:not([data-rests])') && document.fonts.status === 'loaded' &&
  [...document.images].every((one) => one.complete || one.hidden) &&
  (!pebble.video.ref || Boolean(pebble.video.info))"""
#: The first picture of a recording is drawn, and its timeline.
_REPLAYED = "Boolean(pebble.replay?.video.info && pebble.replay.day.timeline)"

Pixels = npt.NDArray[np.uint8]


#: What a person does with a page.
Act = Callable[[Page], None]


def nothing(_page: Page) -> None:
    pass


def press(*selectors: str) -> Act:
    """Return an act that presses these, one after another."""

    def act(page: Page) -> None:
        for selector in selectors:
            page.locator(selector).first.click()

    return act


@dataclass(frozen=True)
class Look:
    """One picture: a state of the server, a size and a theme, and what a person does then."""

    state: State
    size: str = "desktop"
    theme: Theme = "light"
    act: Act = nothing
    here: str = _HERE


LOOKS: dict[str, Look] = {
    "fleet": Look(STATES["fleet"]),
    "fleet-stopped": Look(STATES["fleet-stopped"], theme="dark"),
    "fleet-stops": Look(STATES["fleet-stopped"], size="phone", act=press("[data-test=stopped]")),
    "fleet-phone": Look(STATES["fleet"], size="phone", theme="dark"),
    "fleet-empty": Look(STATES["fleet-empty"]),
    "robot": Look(STATES["full"], size="tall"),
    "free": Look(STATES["free"], theme="dark"),
    "hint": Look(STATES["free"], act=lambda page: page.locator("[data-test=stick]").click(force=True)),
    "gear": Look(STATES["driving"], act=press("[data-test=gear]")),
    "script": Look(STATES["asked"], act=press("[data-test=script-apriltag-follow]"), size="tall", theme="dark"),
    "stopped": Look(STATES["stopped"], theme="dark"),
    "reset": Look(STATES["stopped"], size="phone", act=press("[data-test=reset]")),
    "taken": Look(STATES["taken"], size="phone", theme="dark"),
    "no-broker": Look(STATES["no-broker"]),
    "no-camera": Look(STATES["no-camera"], theme="dark"),
    "phone": Look(STATES["driving"], size="phone"),
    "landscape": Look(STATES["odometry"], size="landscape", theme="dark"),
    "settings": Look(STATES["driving"], act=press("[data-test=settings]"), theme="dark"),
    "recordings": Look(STATES["recordings"], size="phone"),
    "replay": Look(STATES["replay"], here=_REPLAYED),
}


def taken(server: CannedServer, browser: Browser, look: Look) -> Pixels:
    """The page as it looks, at half size."""
    state = replace(look.state, at=AT, still=True, repeated={})
    width, height = SIZES[look.size]
    options = {"reduced_motion": "reduce", "timezone_id": "UTC", "locale": "en-GB", "engineers": False}
    with showing(
        server,
        browser,
        state,
        "desktop" if width == SIZES["desktop"][0] else "phone",
        viewport={"width": width, "height": height},
        theme=look.theme,
        script=FROZEN,
        **options,
    ) as opened:
        assert opened.until(look.here, 60), f"{state.path} is not shown"
        look.act(opened.page)
        return _at_rest(opened)


def _at_rest(opened: Tab) -> Pixels:
    """A picture, once three in a row are the same: what is fetched later has come, and cards have their places."""
    seen: list[Pixels] = []

    def same() -> bool:
        picture = Image.open(io.BytesIO(opened.page.screenshot(animations="disabled"))).convert("RGB")
        half = picture.resize((picture.width // 2, picture.height // 2), Image.Resampling.BOX)
        seen.append(np.asarray(half))
        opened.page.wait_for_timeout(500)
        return len(seen) > 3 and all(difference(one, seen[-1]) == 0 for one in seen[-3:])

    assert opened.until(same, 90), "the page does not come to rest"
    return seen[-1]


def difference(one: Pixels, other: Pixels) -> float:
    """Return the share of the pixels that differ."""
    if one.shape != other.shape:
        return 1.0
    return float((np.abs(one.astype(np.int16) - other.astype(np.int16)) > LEVELS).any(axis=2).mean())


def check(name: str, found: Pixels) -> None:
    """An AssertionError names the picture that is not as it is stored; with PEBBLE_LOOKS=store it is stored anew."""
    target = STORED / f"{name}.webp"
    if os.environ.get("PEBBLE_LOOKS") == "store":
        Image.fromarray(found).save(target, lossless=True, quality=100, method=6)
    share = difference(found, np.asarray(Image.open(target).convert("RGB")))
    if share <= SHARE:
        return
    FAILED.mkdir(parents=True, exist_ok=True)
    Image.fromarray(found).save(actual := FAILED / f"{name}.png")
    raise AssertionError(
        f"{name} looks different in {share:.2%} of its pixels: see {actual.relative_to(ROOT)}. If it is meant to, "
        f"`make long PART=looks` renews {STORED.relative_to(ROOT)}"
    )
