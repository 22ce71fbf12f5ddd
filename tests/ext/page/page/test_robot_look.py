"""The robot's page as it is meant to look: nothing that works a robot moves by itself, and nothing is covered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from playwright.sync_api import Page

from tests.ext.page.browser import Size, Tab
from tests.ext.page.canned import Show
from tests.ext.page.states import (
    FRED,
    GOOB,
    LAMP,
    MAY_TAKE,
    STATES,
    at,
    changed,
    driver,
    estop,
    liveness,
    services,
)

pytestmark = pytest.mark.page

SET = "([ref, metric, value]) => pebble.store.set(ref, metric, value)"
#: A late picture is not shown twice.
CALM = replace(STATES["full"], values=changed(STATES["full"].values, at(GOOB, "web/driver", driver())))
SHIFT = """window.shifted = 0;
new PerformanceObserver((list) => {
  for (const one of list.getEntries()) if (!one.hadRecentInput) window.shifted += one.value;
}).observe({ type: "layout-shift", buffered: true });"""
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


def test_cards_stay_in_their_places(show: Show) -> None:
    with show(CALM, viewport={"width": 1440, "height": 900}, engineers=False, script=SHIFT) as opened:
        for _ in ("as they come", "as they are remembered"):
            _ready(opened)
            opened.page.wait_for_timeout(3000)
            assert opened.page.evaluate("window.shifted") <= 0.02
            assert opened.page.evaluate(COVERED) == []
            opened.page.reload()


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
TROUBLE = (
    (GOOB, "nothing"),
    (GOOB, "it is stopped"),
    (GOOB, ASKED),
    (GOOB, "it is stopped and silent"),
    (FRED, "it is stopped"),
)


@pytest.mark.parametrize("size", ["desktop", "phone", "landscape"])
def test_trouble_moves_nothing_that_works_a_robot(show: Show, size: Size) -> None:
    with show(replace(STATES["driving"], repeated={"online": 1.0}), size) as opened:
        _ready(opened)
        before = opened.page.evaluate(PLACES)
        assert len(before) >= 5
        opened.page.evaluate("pebble.connection.show('Saved as goob.png')")
        for ref, what in TROUBLE:
            _happens(opened.page, ref, what, **{"web/driver": driver("alice", "laptop", you=True)})
            opened.page.wait_for_timeout(400)
            after = opened.page.evaluate(PLACES)
            assert {name: place for name, place in after.items() if before.get(name, place) != place} == {}, what
            if size != "landscape":  # there a band may lie over what is off meanwhile, which is hidden
                assert opened.page.evaluate(COVERED) == [], what
            _happens(opened.page, ref, "nothing", **{"web/driver": driver("alice", "laptop", you=True)})


#: Places of all that the header has on each screen, and whether the robot's name is read whole.
HEADER = """() => [...document.querySelectorAll(".top, .top .stop, .top .back, .picker, .top > button")]
  .filter((one) => one.checkVisibility())
  .map((one) => [one.className, one.getBoundingClientRect()])
  .map(([name, { x, y, width, height }]) => [name, ...[x, y, width, height].map(Math.round)])
  .concat([...document.querySelectorAll(".picker-name b")].map((name) => name.scrollWidth <= name.clientWidth))"""


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_the_header_never_moves_and_the_name_never_gives_way(show: Show, size: Size) -> None:
    widths = {"desktop": (761, 800, 900, 1010, 1011, 1024, 1180, 1240, 1241, 1440), "phone": (320, 360, 390, 480, 760)}
    with show(replace(STILL, path=f"/r/{LAMP}"), size) as opened:
        _ready(opened)
        for width in widths[size]:
            opened.page.set_viewport_size({"width": width, "height": 800})
            _happens(opened.page, LAMP, "nothing")
            before = opened.page.evaluate(HEADER)
            assert before[0][4] in (64, 65), f"{width} px: one line"
            assert before[-1], f"{width} px: the name is cut"
            for what in HAPPENS:
                _happens(opened.page, LAMP, what)
                assert opened.page.evaluate(HEADER) == before, f"{width} px, {what}"


#: Where what stops robots ends on the fleet, by its name; and the list of those that are stopped.
STOPS = """() => Object.fromEntries([...document.querySelectorAll(".top .stop, .stops summary, .fleet-card .stop")]
  .filter((one) => one.checkVisibility())
  .map((one) => [one.dataset.test, one.getBoundingClientRect()])
  .map(([name, { right, y, height }]) => [name, [right, y, height].map(Math.round)]))"""
SLOW = """void Object.defineProperty(pebble.connection.socket, "roundTripMs", { get: () => 900 });
  pebble.connection.changed()"""


@pytest.mark.parametrize("width", [320, 390, 760, 761, 1024, 1440, 1920])
def test_nothing_that_stops_moves_on_the_fleet(show: Show, width: int) -> None:
    size: Size = "phone" if width <= 760 else "desktop"
    with show(replace(STILL, path="/"), size, viewport={"width": width, "height": 900}) as opened:
        _ready(opened)
        places = opened.page.evaluate(STOPS)
        assert {"stop-all", "stop-goob", "stop-minilamp"} <= set(places)
        stays = [what for what, values in HAPPENS.items() if "web/liveness" not in values]  # else its card leaves
        for what in [*stays, "commands are slow"]:
            if what in HAPPENS:
                _happens(opened.page, GOOB, what)
            else:
                opened.page.evaluate(SLOW)
            found = opened.page.evaluate(STOPS)
            places |= {name: place for name, place in found.items() if name not in places}
            assert {name: place for name, place in found.items() if places[name] != place} == {}, what


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


def test_a_small_phone_shows_all_that_drives_at_once(show: Show) -> None:
    with show(STATES["driving"], "phone", viewport={"width": 360, "height": 640}) as opened:
        _ready(opened)
        tabs = opened.page.locator(".tabs").bounding_box()
        for name in ("stick", "speed", "release", "video"):
            box = opened.test(name).bounding_box()
            assert box is not None
            assert tabs is not None
            assert box["y"] + box["height"] <= tabs["y"] + 1, name
        stick = opened.test("stick").bounding_box()
        assert stick is not None
        assert stick["width"] >= 150
