"""What people see in every state of the page: pictures in build/page, accessibility, sizes, and distances to STOP."""

from __future__ import annotations

import re
import time
from typing import Any, NamedTuple

import pytest
from playwright.sync_api import Page

from tests.ext.page.browser import Size, Tab, Theme
from tests.ext.page.canned import Show
from tests.ext.page.looks import Act, nothing, press
from tests.ext.page.states import STATES
from tests.kit.npm import package
from tests.support import ROOT

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


def _at(place: str, *pressed: str) -> Act:
    """Show this place below the header, once these were pressed."""
    top = "(place) => scrollBy(0, place.getBoundingClientRect().top - 90)"
    return _all(press(*pressed), lambda page: page.locator(place).first.evaluate(top))


def _until(place: str) -> Act:
    return lambda page: page.locator(place).first.wait_for()


def _trouble(page: Page) -> None:
    """Robots go and come back, batteries are low, and a service ends: the bell counts it."""
    page.locator("[data-test=announcement]").wait_for(state="attached")
    page.evaluate(
        """async () => {
          const set = (name, metric, value) => pebble.store.set(`pebble/robots/${name}`, metric, value);
          const later = () => new Promise((resolve) => setTimeout(resolve, 150));
          for (let i = 0; i < 3; i++) {
            set("minilamp", "web/liveness", { online: i % 2 === 1, silent_s: 0, latency_ms: 1, whole_seconds: false });
            await later();
          }
          const estop = pebble.store.get("pebble/robots/fred", "web/estop").value;
          set("fred", "web/estop", { ...estop, latched: true, by: "eve on phone" });
          const imu = { state: "failed", restarts: 5, last_exit: "exit code 1" };
          set("goob", "status", { value: { services: { autonomy_manager: imu } } });
          set("goob", "charging-level", { value: 12, unit: "%" });
          await later();
        }"""
    )


def _do(script: str) -> Act:
    return _all(lambda page: page.evaluate(f"() => {{ {script} }}"), lambda page: page.wait_for_timeout(200))


def _timeline(page: Page) -> None:
    """The day is here. Playwright's own waiting for it is stopped by the page's policy."""
    while not page.evaluate("Boolean(pebble.replay?.day.timeline)"):
        page.wait_for_timeout(50)


#: The help with a gamepad in use.
_PAD = """const buttons = Array.from({ length: 11 }, (_, i) => ({ pressed: i === 3 }));
const one = { id: "Logitech Logitech Attack 3", index: 0, connected: true, timestamp: 1, mapping: "",
  axes: [0.31, -0.84, 1], buttons };
navigator.getGamepads = () => [one];
pebble.panels.show("help");"""


def _drive(page: Page) -> None:
    page.keyboard.down("KeyW")
    page.keyboard.down("KeyD")


def _mistaken(page: Page) -> None:
    """Fill a form in, with two mistakes."""
    page.locator('[data-test="script-apriltag-follow"]').click()
    page.locator('[data-test="more-settings"]').click()
    page.locator('[data-test="set-distance_m"]').fill("9")
    page.locator('[data-test="set-search"]').uncheck()


def _on_phone(tab_: str, then: Act = nothing) -> Act:
    return _all(press(f'[data-test="tab-{tab_}"]'), lambda page: page.locator(".card button").first.wait_for(), then)


def _listen(page: Page) -> None:
    tab_of_sound = page.locator("[data-test=tab-sound]")
    if tab_of_sound.count():
        tab_of_sound.click()
    page.locator("[data-test=listen]").click()
    page.locator("[data-test=listen]", has_text=re.compile("Silence|Stop listening")).wait_for()


class Screen(NamedTuple):
    """One picture: a state of the server, and what a person does then."""

    name: str
    state: str
    act: Act = nothing
    sizes: tuple[Size, ...] = ("desktop", "phone")
    hold: Act = nothing  # after the measurements, which change the window's size


ALL: tuple[Size, ...] = ("desktop", "phone", "landscape")
WHOLE = (
    "driving",
    "taken",
    "others-ask",
    "stopped",
    "lost",
    "silent",
    "no-camera",
)  # states that are looked at in all sizes
#: Text that shows that a state has been reached, where it takes a while.
WHEN = {
    "recordings": "Sunday, 22 November 2026",
    "recordings-none": "Nothing is recorded yet",
    "recordings-failed": "Permission denied",
    "recordings-lost": "No connection to the server since",
    "map-empty": "No trail yet",
    "map-silent": "goob is silent since",
    "fleet": "4 robots",
    "fleet-stopped": "2 stopped",
    "fleet-empty": "No robot has been seen",
    "fleet-undriveable": "Cannot be driven: serial",
    "undriveable": "Cannot be driven: serial",
    "fleet-lost": "No connection to the server since",
    "lost": "No connection to the server since",
    "free": "Take control",
    "taken": "Hold to take over",
    "kept": "Ask for it",
    "kept-and-asked": "Do not ask",
    "others-ask": "Let otto drive",
    "others-drive": "Someone else drives, too",
    "viewer": "Log in as driver",
    "stopped": "Also stopped",
    "stop-sent": "NOT CONFIRMED by goob, and sent again",
    "stop-old": "cannot be held",
    "not-confirmed": "NOT CONFIRMED",
    "no-broker": "connection refused",
    "one-broker": "broker spare.lab:8884 refused us",
    "silent": "goob is silent since",
    "old-picture": "The picture is ",
    "no-picture": "There is no picture yet",
    "thin-link": "Pictures wait for driving",
    "old-page": "older than the server",
    "plain-http": "not encrypted",
    "tower": "live",
    "other-camera": "seen from tower-1",
    "script-drives": "Stop script",
}
#: What browsers complain of where the server is meant to fail.
MEANT = {"recordings-failed": "422"}
_CARD = '[data-card="{}"]'.format
_OUTLETS, _VALUES = map(_CARD, ("outlets", "values"))
_SENSORS, _MORE = press("[data-test=tab-sensors]"), press("[data-test=tab-more]")
_AUDIT = _until("[data-test=audit-line]")
_LAMP = '[data-test="mcu-lamp-1"]'
SCREENS = [
    *(
        Screen(name, name, sizes=ALL if name in WHOLE else ("desktop", "phone"))
        for name in STATES
        if not name.startswith(("asked", "full", "map"))  # below the picture
    ),
    Screen("plots", "odometry", hold=_at(_CARD("plots")), sizes=("desktop",)),
    Screen("plots", "odometry", press(".tabs button:nth-child(2)"), ("phone",), hold=_at(_CARD("plots"))),
    Screen("map", "odometry", press(".tabs button:nth-child(2)"), ("phone",), hold=_at(_CARD("map"))),
    *(Screen(name, name, hold=_at(_CARD("map")), sizes=("desktop",)) for name in ("map-empty", "map-silent")),
    Screen("stream-open", "own-stream", press("[data-test=gear]", "[data-test=open-stream]")),
    Screen("gear", "driving", press("[data-test=gear]"), ("desktop",)),
    Screen("listening-now", "listening", _listen),
    Screen("sound", "no-sound", press("[data-test=tab-sound]"), ("phone",)),
    Screen("driving-now", "driving", sizes=("desktop",), hold=_drive),
    Screen("fleet-more", "fleet", press("[data-test=fleet-more]")),
    Screen("settings", "driving", press(".me"), ("desktop",)),
    Screen("help", "driving", _do("pebble.panels.show('help')")),
    Screen("gamepad", "driving", _do(_PAD)),
    Screen("open-on-phone", "fleet", _do("pebble.panels.show('phone')")),
    Screen("left-handed", "driving", _do("pebble.settings.set('side', 'left')"), ("landscape",)),
    Screen("reset-asked", "stopped", press(".banner-actions button")),
    Screen("sensors", "driving", _SENSORS, ("phone",)),
    Screen("more", "driving", _MORE, ("phone",)),
    Screen("settings", "driving", press("[data-test=tab-more]", ".wide"), ("phone",)),
    Screen("drawer", "driving", press(".round"), ("landscape",)),
    Screen("outlets", "devices", sizes=("desktop",), hold=_at(_OUTLETS)),
    Screen("outlets", "devices", _MORE, ("phone",), _at(_OUTLETS)),
    Screen("outlets-viewer", "devices-viewer", _MORE, ("phone",), _at(_OUTLETS)),
    Screen("mcus", "devices", sizes=("desktop",), hold=_at(_LAMP)),
    Screen("mcus", "devices", _MORE, ("phone",), _at(_LAMP)),
    Screen("values", "devices", sizes=("desktop",), hold=_at(_VALUES, f"{_VALUES} summary")),
    Screen("small", "driving", sizes=("small",)),
    Screen("lights", "asked", press('[data-test="colour-blue"]'), ("desktop",), _at(_CARD("lights"))),
    Screen("sounds", "asked-busy", sizes=("desktop",), hold=_at(_CARD("sounds"))),
    Screen("scripts", "asked-busy", sizes=("desktop",), hold=_at(_CARD("autonomy"))),
    Screen("form", "asked", _mistaken, ("desktop",), _at(_CARD("autonomy"))),
    Screen("failed", "asked-failed", sizes=("desktop",), hold=_at(_CARD("autonomy"))),
    Screen("not-asked", "asked-viewer", sizes=("desktop",), hold=_at(_CARD("autonomy"))),
    Screen("lights", "asked", _on_phone("more"), ("phone",), _at(_CARD("lights"))),
    Screen("sounds", "asked-busy", _on_phone("sound"), ("phone",)),
    Screen("scripts", "asked-busy", _on_phone("more"), ("phone",), _at(_CARD("autonomy"))),
    Screen("form", "asked", _on_phone("more", _mistaken), ("phone",), _at(_CARD("autonomy"))),
    Screen("logs", "operating", sizes=("desktop",), hold=_at(".log-foot")),
    Screen("logs", "operating", _MORE, ("phone",), _at(".log-foot")),
    Screen("system", "operating", sizes=("desktop",), hold=_at(".system .flag:last-child")),
    Screen("system", "operating", _MORE, ("phone",), _at(".system .flag:last-child")),
    Screen("services", "operating", _MORE, ("phone",), _at(".services-list li:last-child")),
    Screen("boards", "undriveable", _MORE, ("phone",), _at("[data-test=mcu-line-relays]")),
    Screen("system-ask", "operating", press("[data-test=service-restart]"), ("desktop",)),
    Screen("system-ask", "operating", press("[data-test=tab-more]", "[data-test=service-restart]"), ("phone",)),
    Screen("audit", "operating", press("[data-test=audit]"), ("desktop",), _AUDIT),
    Screen("audit", "operating", _all(_MORE, press("[data-test=audit]")), ("phone",), _AUDIT),
    Screen("audit", "operating", press(".round"), ("landscape",), _all(press("[data-test=audit]"), _AUDIT)),
    Screen("notices", "driving", _all(_trouble, press("[data-test=bell]")), ("desktop",)),
    Screen("notices", "driving", _all(_trouble, press("[data-test=tab-more]", ".wide")), ("phone",)),
    Screen("fleet-notices", "fleet", sizes=("desktop",), hold=_all(_trouble, press("[data-test=bell]"))),
    Screen("fleet-notices", "fleet", sizes=("phone",), hold=_all(_trouble, press(".me"))),
    Screen("bell", "driving", _trouble, ("desktop", "phone")),
    Screen("own-name", "operating", press(".me"), ("desktop",)),
    Screen("replay-timeline", "replay", _timeline, ("desktop", "phone", "landscape", "small")),
    Screen("replay-days", "replay", _timeline, hold=press("[data-test=open-days]")),
    Screen("replay-marked", "replay-gap", _timeline, hold=press("[data-test=open-download]", "[data-test=mark-in]")),
    Screen("recordings-link", "driving-recorded", _until("role=link[name='Recordings']"), ("desktop",)),
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
            opened.page.screenshot(path=PICTURES / f"{screen.name}-{size}-{theme}.png")
            problems += [f"{theme}: {violation}" for violation in _violations(opened.page, axe)]
        problems += [one for one in opened.complaints() if MEANT.get(screen.state, "\0") not in one]
        assert not problems, "\n".join(problems)


def _wait(opened: Tab, text: str) -> None:
    shown = f"() => !!window.pebble?.connection.you && document.body.innerText.includes({text!r})"
    assert opened.until(shown), f"{text!r} is not shown"
    opened.until("() => !location.pathname.startsWith('/replay/') || pebble.replay?.isHere", 10)
    if text not in ("There is no picture yet", "Pictures wait for driving", "goob is silent since"):
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
#: Without scrolling, nothing that can be tapped is even drawn there; and nothing that scrolls within itself can bring
#: what it has to edges that lie there.
_CLOSE = """(selector) => {
  scrollTo(0, 0);
  const found = [];
  const scrolls = (one) => one.scrollHeight > one.clientHeight && /auto|scroll/.test(getComputedStyle(one).overflowY) &&
    one.querySelector(selector);
  for (const stop of document.querySelectorAll(".stop")) {
    if (!stop.checkVisibility({ visibilityProperty: true })) continue;
    const a = stop.getBoundingClientRect();
    for (const other of document.querySelectorAll("body *")) {
      if (other.contains(stop) || !other.checkVisibility() || !(other.matches(selector) || scrolls(other))) continue;
      const b = other.getBoundingClientRect();
      const x = Math.max(b.left - a.right, a.left - b.right, 0);
      const y = Math.max(b.top - a.bottom, a.top - b.bottom, 0);
      const text = `${Math.hypot(x, y).toFixed(0)} px from ${stop.textContent}: ${other.outerHTML.slice(0, 120)}`;
      if (b.bottom > 0 && Math.hypot(x, y) < 23.9) found.push(text);
    }
  }
  return found;
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


def _measured(page: Page, size: Size) -> list[str]:
    """What stays wrong at each width: a busy machine takes a moment to draw another layout."""
    before = page.viewport_size
    assert before is not None
    problems: list[str] = []
    for width in WIDTHS[size]:
        page.set_viewport_size({"width": width, "height": before["height"]})
        deadline = time.monotonic() + 2
        page.wait_for_timeout(60)
        while (wrong := _wrong(page)) and time.monotonic() < deadline:
            page.wait_for_timeout(60)
        problems += [f"{width} px: {text}" for text in wrong]
    page.set_viewport_size(before)
    page.evaluate("() => scrollTo(0, 0)")
    return problems


def _wrong(page: Page) -> list[str]:
    found = ["scrolls sideways"] * page.evaluate(_TOO_WIDE)
    found += page.evaluate(_SMALL, TAPPABLE) + page.evaluate(_CLOSE, TAPPABLE)
    found += [text for script in (_OUT_OF_BAR, _CUT) for text in page.evaluate(script)]
    return found + [text for offset in (0, 40, 90, 150, 230) for text in page.evaluate(_NEAR, [TAPPABLE, offset])]
