"""What people see in every state of the page: pictures in build/page, accessibility, sizes, and distances to STOP."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, NamedTuple

import pytest
from playwright.sync_api import Browser, Page

from tests.ext.page.browser import Size, Tab, Theme
from tests.ext.page.canned import CannedServer, Show
from tests.ext.page.looks import LOOKS, Act, check, nothing, press, taken
from tests.ext.page.states import (
    FRED,
    GOOB,
    LAMP,
    MAY_TAKE,
    STATES,
    driver,
    estop,
    liveness,
    services,
)
from tests.kit.npm import package
from tests.support import ROOT, SOON_S

PICTURES = ROOT / "build" / "page"
WIDTHS: dict[Size, tuple[int, ...]] = {
    "desktop": (1280, 844),
    "phone": (390, 320),
    "landscape": (844,),
    "small": (320,),
}

pytestmark = [pytest.mark.page, pytest.mark.timeout(180)]


def _all(*acts: Act) -> Act:
    """One after another."""

    def act(page: Page) -> None:
        for one in acts:
            one(page)

    return act


def _do(script: str) -> Act:
    return _all(lambda page: page.evaluate(f"() => {{ {script} }}"), lambda page: page.wait_for_timeout(200))


def _timeline(page: Page) -> None:
    """The day is here. Playwright's own waiting for it is stopped by the page's policy."""
    while not page.evaluate("Boolean(pebble.replay?.day.timeline)"):
        page.wait_for_timeout(50)


def _mistaken(page: Page) -> None:
    """Fill a form in, with a mistake."""
    press("[data-test=script-apriltag-follow]", "[data-test=more-settings]")(page)
    page.locator("[data-test=set-distance_m]").fill("9")


class Screen(NamedTuple):
    """One picture: a state of the server, and what a person does then."""

    name: str
    state: str
    act: Act = nothing
    sizes: tuple[Size, ...] = ("desktop", "phone")
    hold: Act = nothing  # after the measurements, which change the window's size


ALL: tuple[Size, ...] = ("desktop", "phone", "landscape")
WHOLE = ("driving", "taken", "others-ask", "stopped", "lost", "silent", "no-camera")  # looked at in all sizes
#: Text that shows that a state has been reached, where it takes a while.
WHEN = {
    "recordings": "Tuesday, 14 November 2023",
    "map-silent": "goob is silent since",
    "fleet-stopped": "2 stopped",
    "fleet-undriveable": "Cannot be driven: serial",
    "fleet-lost": "No connection to the server since",
    "lost": "No connection to the server since",
    "others-drive": "Someone else drives, too",
    "stopped": "Also stopped",
    "stop-sent": "NOT CONFIRMED by goob, and sent again",
    "stop-old": "cannot be held",
    "not-confirmed": "NOT CONFIRMED",
    "one-broker": "broker spare.lab:8884 refused us",
    "silent": "goob is silent since",
    "old-picture": "The picture is ",
    "no-picture": "There is no picture yet",
}
_MORE, _SOUND = press("[data-test=tab-more]"), press("[data-test=tab-sound]")
DESKTOP: tuple[Size, ...] = ("desktop",)
PHONE: tuple[Size, ...] = ("phone",)
SCREENS = [
    *(Screen(name, name, sizes=ALL if name in WHOLE else ("desktop", "phone")) for name in STATES),
    *(Screen(f"more-{name}", name, _MORE, PHONE) for name in ("full", "devices", "devices-viewer", "operating")),
    Screen("sensors", "odometry", press("[data-test=tab-sensors]"), PHONE),
    Screen("sounds", "asked-busy", _SOUND, PHONE),
    Screen("stream-open", "own-stream", press("[data-test=gear]", "[data-test=open-stream]")),
    Screen("gear", "driving", press("[data-test=gear]"), DESKTOP),
    Screen("driving-now", "driving", sizes=DESKTOP, hold=lambda page: page.keyboard.down("KeyW")),
    Screen("fleet-more", "fleet", press("[data-test=fleet-more]")),
    Screen("settings", "driving", press(".me"), DESKTOP),
    Screen("settings", "driving", _all(_MORE, press(".wide")), PHONE),
    Screen("help", "driving", _do("pebble.panels.show('help')")),
    Screen("open-on-phone", "fleet", _do("pebble.panels.show('phone')")),
    Screen("left-handed", "driving", _do("pebble.settings.set('side', 'left')"), ("landscape",)),
    Screen("reset-asked", "stopped", press(".banner-actions button")),
    Screen("drawer", "driving", press(".round"), ("landscape",)),
    Screen("small", "driving", sizes=("small",)),
    Screen("form", "asked", _mistaken, DESKTOP),
    Screen("form", "asked", _all(_MORE, _mistaken), PHONE),
    Screen("system-ask", "operating", press("[data-test=service-restart]"), DESKTOP),
    Screen("notices", "driving", press("[data-test=bell]"), DESKTOP),
    *(Screen(f"help-{name}", name, _do("pebble.panels.show('help')")) for name in ("stopped", "kept", "fleet-stopped")),
    *(Screen(f"gear-{name}", name, press("[data-test=gear]"), DESKTOP) for name in ("stopped", "script-drives")),
    Screen("replay-timeline", "replay", _timeline, ("landscape", "small")),
    Screen("replay-days", "replay", _timeline, hold=press("[data-test=open-days]")),
    Screen("replay-marked", "replay", _timeline, hold=press("[data-test=open-download]", "[data-test=mark-in]")),
]
CASES = [(screen, size) for screen in SCREENS for size in screen.sizes]


@pytest.fixture(scope="module")
def axe() -> str:
    return (package("axe-core") / "axe.min.js").read_text()


@pytest.mark.parametrize(("screen", "size"), CASES, ids=[f"{screen.name}-{size}" for screen, size in CASES])
def test_screen(show: Show, axe: str, screen: Screen, size: Size) -> None:
    with show(STATES[screen.state], size) as opened:
        _wait(opened, WHEN.get(screen.state, ""))
        screen.act(opened.page)
        problems = _measured(opened.page, size)
        screen.hold(opened.page)
        for theme in ("light", "dark"):
            _show(opened, theme)
            opened.page.screenshot(path=PICTURES / f"{screen.name}-{size}-{theme}.png", full_page=True)
            problems += [f"{theme}: {violation}" for violation in _violations(opened.page, axe)]
        problems += opened.complaints()
        assert not problems, "\n".join(problems)


def _wait(opened: Tab, text: str) -> None:
    shown = f"() => !!window.pebble?.connection.you && document.body.innerText.includes({text!r})"
    assert opened.until(shown), f"{text!r} is not shown"
    opened.until("() => !location.pathname.startsWith('/replay/') || pebble.replay?.isHere", 10)
    if text not in ("There is no picture yet", "goob is silent since"):
        opened.until("() => !pebble.video.ref || !!pebble.video.info", 5)


def _show(opened: Tab, theme: Theme) -> None:
    opened.page.emulate_media(color_scheme=theme, reduced_motion="reduce")
    opened.page.wait_for_timeout(120)


def _violations(page: Page, axe: str) -> list[str]:
    page.evaluate(axe)
    found: list[Any] = page.evaluate("async () => (await axe.run()).violations")
    return [f"{one['id']}: {node['html'][:200]}" for one in found for node in one["nodes"]]


TAPPABLE = "button, a[href], select, input, summary, [role=application]"
_SMALL = """(selector) => [...document.querySelectorAll(selector)]
  .map((one) => one.matches("[type=checkbox], [type=radio]") ? one.closest("label") : one)
  .filter((one) => one.checkVisibility() && one.getBoundingClientRect().bottom > 0)
  .map((one) => [one.outerHTML.slice(0, 120), one.getBoundingClientRect()])
  .filter(([, box]) => box.width < 43.9 || box.height < 43.9)
  .map(([html, box]) => `too small, ${box.width.toFixed(0)}x${box.height.toFixed(0)}: ${html}`)"""
#: At any position of scrolling, the 24 px around STOP belong to nothing that can be tapped.
_NEAR = """([selector, offset]) => {
  scrollTo(0, offset);
  const found = new Set();
  const around = (low, high) => [low - 23, low - 12, low - 2, high + 2, high + 12, high + 23];
  const along = (low, high) => Array.from({ length: Math.floor((high - low) / 5) + 1 }, (_, i) => low + 5 * i);
  for (const stop of document.querySelectorAll(".stop")) {
    if (!stop.checkVisibility({ visibilityProperty: true })) continue;
    const { left, right, top, bottom } = stop.getBoundingClientRect();
    if (bottom < 0 || top > innerHeight) continue;
    const places = along(left - 23, right + 23).flatMap((x) => around(top, bottom).map((y) => [x, y]));
    places.push(...along(top, bottom).flatMap((y) => around(left, right).map((x) => [x, y])));
    for (const place of places) {
      const hit = document.elementFromPoint(...place)?.closest(selector);
      if (hit && hit !== stop) found.add(`near ${stop.textContent}: ${hit.outerHTML.slice(0, 120)}`);
    }
  }
  return [...found];
}"""
#: A name of usual length is read whole, and so is what is beside it.
_CUT = """() => [...document.querySelectorAll(".picker-name b, .picker-state")]
  .filter((one) => one.checkVisibility() && one.scrollWidth > one.clientWidth)
  .map((one) => `cut: ${one.textContent}`)"""
#: What lies beside the bar that it belongs to, and over something else.
_OUT_OF_BAR = """() => [...document.querySelectorAll(".picture-bar :is(button, label, select, output)")]
  .filter((one) => one.checkVisibility())
  .filter((one) => one.getBoundingClientRect().right > one.closest(".picture-bar").getBoundingClientRect().right)
  .map((one) => `out of its bar: ${one.outerHTML.slice(0, 120)}`)"""
_TOO_WIDE = "() => document.documentElement.scrollWidth > innerWidth"


#: Where STOP lies, and what somebody may need at once but cannot press: something else lies over it.
REACHED = """(() => {
  const middle = (one, { x, y, width, height } = one.getBoundingClientRect()) => [x + width / 2, y + height / 2];
  const top = (one) => document.elementFromPoint(...middle(one));
  const urgent = [...document.querySelectorAll(".top .stop, .banner button, [data-test=take]")];
  const shown = urgent.filter((one) => one.checkVisibility());
  const covered = shown.filter((one) => top(one) && !one.contains(top(one))).map((one) => one.innerText);
  return [[...document.querySelectorAll(".top .stop")].map((one) => middle(one).map(Math.round)), covered];
})()"""


def _measured(page: Page, size: Size) -> list[str]:
    """What stays wrong at each width: a busy machine takes a moment to draw another layout."""
    before = page.viewport_size
    assert before is not None
    problems: list[str] = []
    for width in WIDTHS[size]:
        page.set_viewport_size({"width": width, "height": before["height"]})
        deadline = time.monotonic() + SOON_S
        page.wait_for_timeout(60)
        while (wrong := _wrong(page)) and time.monotonic() < deadline:
            page.wait_for_timeout(60)
        problems += [f"{width} px: {text}" for text in wrong]
    page.set_viewport_size(before)
    page.evaluate("() => scrollTo(0, 0)")
    return problems


def _wrong(page: Page) -> list[str]:
    found = ["scrolls sideways"] * page.evaluate(_TOO_WIDE)
    found += page.evaluate(_SMALL, TAPPABLE) + page.evaluate(_OUT_OF_BAR) + page.evaluate(_CUT)
    found += [f"covered: {text}" for text in page.evaluate(REACHED)[1]]
    return found + [text for offset in (0, 40, 90, 150, 230) for text in page.evaluate(_NEAR, [TAPPABLE, offset])]


# -- nothing that works a robot moves by itself, and nothing is covered

SET = "([ref, metric, value]) => pebble.store.set(ref, metric, value)"
#: Places of all that drives and stops a robot, and of the buttons beside them, by what they are called.
PLACES = """() => Object.fromEntries([...document.querySelectorAll(
  ".stick, input[type=range], button, select, summary")]
  .filter((one) => one.closest(".top, .stage, .drive, .phone-drive, .float-pad, .tabs"))
  .filter((one) => one.checkVisibility() && !one.closest(".banners, .slot, .why-actions"))
  .map((one, n) => [`${n} ${one.dataset.test ?? one.textContent.trim()}`, one.getBoundingClientRect().toJSON()])
  .map(([name, { x, y, width, height }]) => [name, [x, y, width, height].map(Math.round)]))"""
#: Controls whose middle another element has.
COVERED = """() => [...document.querySelectorAll("main button, main select, main input, main a, main summary, .stick")]
  .filter((one) => one.checkVisibility({ visibilityProperty: true }))
  .filter((one) => {
    const { x, y, width, height } = one.getBoundingClientRect();
    const hit = document.elementFromPoint(x + width / 2, y + height / 2);
    return hit && !hit.closest("header, .tabs") && hit !== one && !one.contains(hit) && !hit.contains(one) &&
      !hit.closest("label")?.contains(one);
  }).map((one) => one.outerHTML.slice(0, 120))"""


def _ready(opened: Tab) -> None:
    assert opened.until("!!window.pebble?.connection.you && document.querySelectorAll('.loading').length === 0", 60)
    opened.until("!pebble.video.ref || !!pebble.video.info", 4)
    opened.page.wait_for_timeout(1800)  # cards have settled


#: Whatever happens to a robot, as values of it.
HAPPENS: dict[str, dict[str, Any]] = {
    "nothing": {},
    "it is taken": {"web/driver": driver("bob with a name of 32 characters", "phone", keeps=True)},
    "it is driven": {"web/driver": driver("alice", you=True)},
    "it drives itself": {"autonomy-status": {"running": True, "file": "x", "label": "Follow a tag, also out of sight"}},
    "it cannot be driven": {"status": services(driveable={"state": "no", "why": "serial: no such device " * 8})},
    "it is stopped": {"web/estop": estop(1_700_000_000_000, "eve on phone")},
    "it is stopped and silent": {
        "web/estop": estop(1_700_000_000_000, "eve on phone"),
        "web/liveness": liveness(online=False, silent_s=4.0),
    },
}
ASKED = "one is asked before its reset"
HAPPENS[ASKED] = HAPPENS["it is stopped"]
REST = {"web/driver": driver(), "autonomy-status": {}, "web/estop": estop(0), "web/liveness": liveness(), "status": {}}
STILL = replace(STATES["free"], repeated={"online": 1.0}, welcome=MAY_TAKE)


def _happens(page: Page, ref: str, what: str, **more: Any) -> None:
    for metric, value in (REST | HAPPENS[what] | more).items():
        page.evaluate(SET, [ref, metric, value])
    page.wait_for_timeout(150)
    page.evaluate("(asks) => asks && document.querySelector('[data-test=reset]')?.click()", what is ASKED)


#: What goes wrong while a robot is driven.
TROUBLE = ((GOOB, "nothing"), (GOOB, ASKED), (GOOB, "it is stopped and silent"), (FRED, "it is stopped"))
MINE = driver("alice", "laptop", you=True)


@pytest.mark.parametrize("size", ["desktop", "phone", "landscape"])
def test_trouble_moves_nothing_that_works_a_robot(show: Show, size: Size) -> None:
    with show(replace(STATES["driving"], repeated={"online": 1.0}), size) as opened:
        _ready(opened)
        before = opened.page.evaluate(PLACES)
        assert len(before) >= 5
        opened.page.evaluate("pebble.connection.show('Saved as goob.png')")
        for ref, what in TROUBLE:
            _happens(opened.page, ref, what, **{"web/driver": MINE})
            opened.page.wait_for_timeout(400)
            after = opened.page.evaluate(PLACES).items()
            assert [name for name, place in after if before.get(name, place) != place] == [], what
            if size != "landscape":  # there a band may lie over what is off meanwhile, which is hidden
                assert opened.page.evaluate(COVERED) == [], what
            _happens(opened.page, ref, "nothing", **{"web/driver": MINE})


#: Places of what stops a robot, of all else in the header, and of the list of those that are stopped, by name.
STOPS = """() => Object.fromEntries([...document.querySelectorAll(
  ".top, .top .stop, .top .back, .picker, .top > button, .stops summary, .fleet-card .stop")]
  .filter((one) => one.checkVisibility())
  .map((one) => [one.dataset.test ?? one.className, one.getBoundingClientRect(), one.localName === "summary"])
  .map(([name, { x, right, y, height }, grows]) => [name, [grows ? right : x, right, y, height].map(Math.round)]))"""


@pytest.mark.parametrize(
    ("path", "size", "widths"),
    [
        (f"/r/{LAMP}", "desktop", (761, 800, 1010, 1011, 1240, 1241)),
        (f"/r/{LAMP}", "phone", (320, 390, 760)),
        ("/", "desktop", (761, 1440)),
        ("/", "phone", (320, 760)),
    ],
)
def test_nothing_that_stops_moves(show: Show, path: str, size: Size, widths: tuple[int, ...]) -> None:
    ref = {"/": GOOB}.get(path, LAMP)
    stays = [what for what, values in HAPPENS.items() if ref == LAMP or "web/liveness" not in values]  # else it leaves
    with show(replace(STILL, path=path), size) as opened:
        _ready(opened)
        for width in widths:
            opened.page.set_viewport_size({"width": width, "height": 900})
            _happens(opened.page, ref, "nothing")
            places = opened.page.evaluate(STOPS)
            assert places["top"][-1] in (64, 65), f"{width} px: one line"
            for what in stays:
                _happens(opened.page, ref, what)
                found = opened.page.evaluate(STOPS)
                assert {
                    name: place for name, place in found.items() if places.setdefault(name, place) != place
                } == {}, what


#: Parts of what stops a robot, or gives control over it, over which something lies while each of the panels is open.
COVERED_BY_PANELS = """async () => {
  const press = (selector) => () => document.querySelector(selector)?.click();
  const panels = Object.fromEntries([
    ...["settings", "help", "phone"].map((name) => [name, () => pebble.panels.show(name)]),
    ...["bell", "gear", "drawer"].map((name) => [name, press(`[data-test=${name}]`)]),
  ]);
  const close = () => {
    pebble.panels.show("");
    for (const one of document.querySelectorAll(".panel [data-test^=close], [data-test=drawer][aria-expanded=true]," +
      "[data-test=gear][aria-expanded=true]")) one.click();
  };
  const along = (from, length, count) =>
    Array.from({ length: count }, (_, n) => from + 5 + ((length - 10) * n) / (count - 1)); // within round corners
  const isCovered = (part) => {
    const { x, y, width, height } = part.getBoundingClientRect();
    return along(x, width, 9).some((px) => along(y, height, 5).some((py) => {
      const hit = document.elementFromPoint(px, py);
      return hit && !part.contains(hit) && !hit.contains(part) && !hit.closest(".stop-area"); // around STOP
    }));
  };
  const found = [];
  for (const [name, open] of Object.entries(panels)) {
    open();
    await new Promise((resolve) => setTimeout(resolve, 60));
    const parts = [...document.querySelectorAll(".top .stop, .banner, [data-test^=reset], [data-test^=take]," +
      "[data-test=ask], [data-test=stop-script]")].filter((one) => one.checkVisibility({ visibilityProperty: true }));
    found.push(...parts.filter(isCovered).map((one) => `${name}: ${one.outerHTML.slice(0, 120)}`));
    close();
  }
  return found;
}"""


@pytest.mark.parametrize("path", [STILL.path, f"/r/{LAMP}", "/"])
@pytest.mark.parametrize(
    ("size", "width", "height"),
    [
        ("desktop", 1440, 900), ("desktop", 1024, 768), ("desktop", 800, 900),
        ("phone", 390, 844), ("phone", 320, 640), ("landscape", 844, 390),
    ],
)  # fmt: skip
def test_no_panel_covers_a_part_of_what_stops_or_takes(
    show: Show, size: Size, width: int, height: int, path: str
) -> None:
    with show(replace(STILL, path=path), size, viewport={"width": width, "height": height}) as opened:
        assert opened.until("!!window.pebble?.connection.you && !document.querySelector('main .loading')", 60)
        opened.page.evaluate(COVERED_BY_PANELS)  # what they are made of is here now
        ref, problems = {"/": GOOB}.get(path, path.removeprefix("/r/")), {}
        for what in HAPPENS:
            _happens(opened.page, ref, what)
            problems[what] = opened.page.evaluate(COVERED_BY_PANELS)
        assert [(what, one) for what, found in problems.items() for one in found] == []


@pytest.mark.parametrize("name", LOOKS)
def test_a_state_looks_as_it_is_stored(server: CannedServer, browser: Browser, name: str) -> None:
    check(name, taken(server, browser, LOOKS[name]))
