"""Controls of the page in a browser: each opens, sends what it is for, and nothing is complained of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from playwright.sync_api import Locator

from tests.ext.page.browser import Tab
from tests.ext.page.canned import CannedServer, Show, State
from tests.ext.page.states import (
    FRED,
    GOOB,
    GOOB_PATH,
    MAY_TAKE,
    STATES,
    at,
    changed,
    of,
    setting,
)

pytestmark = [pytest.mark.page, pytest.mark.timeout(180)]

FORM = {"tag_id": 7, "search": False, "family": "APRILTAG_36H11"}
#: State, what is done with controls by their names ("name=text" is filled in, "name!" is held, "name_" is pressed and
#: not released), what is sent: an op of this kind, each time with these fields.
SENDS: dict[str, tuple[str, str, str, list[dict[str, Any]]]] = {
    "lights": (
        "asked", "colour-blue lights-flash lights-off", "lights",
        [{"b": 1}, {"b": 1, "period": 2}, {"r": 0, "g": 0, "b": 0}],
    ),
    "a clip": ("asked", "sound-filter=99 clip", "soundboard", [{"file": "speech/number 99.wav"}]),
    "a clip that plays": ("asked-busy", "stop-sound", "soundboard", [{"file": ""}]),
    "a script": (
        "asked", "script-apriltag-follow set-tag_id=7 set-search more-settings set-family=APRILTAG_36H11 start-script",
        "autonomy", [{"file": "apriltag-follow", "config": FORM}],
    ),
    "a script that runs": ("asked-busy", "end-script", "autonomy", [{"file": ""}]),
    "a script that drives": ("script-drives", "stop-script", "autonomy", [{"file": ""}]),
    "an outlet": ("devices", "outlet-o2", "outlet", [{"outlet": "o2", "on": True}]),
    "a microcontroller": (
        "devices", "field-level=62.5 send-lamp field-angle=-12 field-k=1e-3 send-arm", "mcu",
        [{"uid": "lamp-1", "name": "lamp", "value": {"level": 62.5, "on": False}},
         {"uid": "lamp-1", "name": "arm", "value": {"angle": -12, "k": 0.001}}],
    ),
    "allowing driving of a silent board": (
        "a silent board", "board-extra board-allow", "board", [{"do": "allow", "extra": True}],
    ),
    "a silent board that is driven": (
        "a driven board", "board-clear board-withdraw", "board", [{"do": "clear"}, {"do": "withdraw"}],
    ),
    "a restart": ("operating", "service-restart ask-hold!", "action", [{"name": "service-restart"}]),
    "taking control": ("free", "take", "lease", [{"take": True}]),
    "releasing it": ("driving", "release", "lease", [{"take": False}]),
    "asking for it": ("kept", "ask", "lease", [{"take": True, "over": False}]),
    "asking no more": ("kept-and-asked", "give-up", "lease", [{"take": False}]),
    "letting another drive": ("others-ask", "let", "lease", [{"take": False}]),
    "taking over": ("kept", "take-over!", "lease", [{"take": True, "over": True}]),
    "a stop": ("driving", "stop-one", "estop", [{"ref": GOOB}]),
    "a stop, as soon as it is touched": ("driving", "stop-one_", "estop", [{"ref": GOOB}]),
    "a stop of all": ("driving", "stop-all", "estop", [{"ref": ""}]),
    "a stop in the fleet": ("fleet", "stop-goob", "estop", [{"ref": GOOB}]),
    "a stop of all in a recording": ("replay", "stop-all", "estop", [{"ref": ""}]),
    "a reset": ("stopped", "reset reset-hold!", "estop-reset", [{"ref": GOOB}]),
    "a reset of all": ("fleet-stopped", "stopped reset-all!", "estop-reset", [{"ref": GOOB}, {"ref": FRED}]),
}  # fmt: skip


_BOARD = {"silent": True, "by": "", "refused": "", "parked": "", "risk": "It may roll on."}
BOARDS = {
    name: of(
        GOOB_PATH, at(GOOB, "capabilities", {"t": 1, "value": {"announced": True, "assumed": True}}),
        at(GOOB, "web/board", _BOARD | more), welcome=MAY_TAKE,
    )
    for name, more in (("a silent board", {}), ("a driven board", {"by": "ann", "parked": "Clear it first"}))
}  # fmt: skip


def do(opened: Tab, what: str) -> None:
    """Use one control."""
    name, filled, text = what.rstrip("!_").partition("=")
    control = opened.uncover(name).first
    if what.endswith(("!", "_")):
        control.hover()
        opened.page.mouse.down()
        if what.endswith("!"):
            opened.page.wait_for_timeout(1200)
            assert opened.until(lambda: not opened.page.locator(".held").count())
            opened.page.mouse.up()
    elif not filled:
        control.click()
    elif control.evaluate("(one) => one.localName") == "select":
        control.select_option(text)
    else:
        control.fill(text)


@pytest.mark.parametrize("name", SENDS)
def test_a_control_sends_what_it_is_for(show: Show, server: CannedServer, name: str) -> None:
    state, steps, op, expected = SENDS[name]
    with show((STATES | BOARDS)[state]) as opened:
        for step in steps.split():
            do(opened, step)
        assert opened.until(lambda: len(server.sent(op)) == len(expected)), server.received
        sent = [{key: one[key] for key in fields} for one, fields in zip(server.sent(op), expected, strict=True)]
        assert sent == expected
        assert opened.complaints() == []


@pytest.mark.parametrize("size", ["desktop", "phone", "landscape"])
@pytest.mark.parametrize(("state", "names"), [("others-ask", ["let", "keep"]), ("driving", ["release"])])
def test_what_appears_beside_a_button_takes_no_press_of_it(show: Show, state: str, names: list[str], size: str) -> None:
    with show(STATES[state], size, when="document.querySelector('[data-test=see]')") as opened:
        assert opened.until(lambda: opened.test("see").count() == 0)  # the first picture is here
        boxes = [opened.test(name).bounding_box() for name in names]
        opened.page.evaluate("pebble.driver.page.pictureAge = () => 5000")
        opened.test("see").wait_for()
        for name, box in zip(names, boxes, strict=True):
            at = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
            there = opened.page.evaluate("(at) => document.elementFromPoint(...at).closest('button').dataset.test", at)
            assert there == name


def test_stops_are_read_aloud_whatever_comes_right_after_them(show: Show) -> None:
    with show(STATES["fleet"]) as opened:
        opened.test("bell").wait_for()
        opened.page.evaluate(
            """([stopped, gone]) => {
              const view = pebble.store.get(stopped, "web/estop").value;
              pebble.store.set(stopped, "web/estop", { ...view, latched: true, by: "eve" });
              pebble.store.set(gone, "web/liveness", { online: false });
            }""",
            [FRED, GOOB],
        )
        assert opened.until(lambda: "fred was stopped by eve. goob is" in opened.test("announcement").inner_text())


_OFF = """pebble.wereHeld = document.querySelectorAll('.held').length;
pebble.connection.may = () => false; pebble.connection.changed()"""


def test_a_button_that_is_switched_off_while_it_is_held_does_nothing(show: Show, server: CannedServer) -> None:
    with show(STATES["stopped"]) as opened:
        opened.test("reset").click()
        opened.test("reset-hold").hover()
        opened.page.evaluate("pebble.pressedAt = performance.now()")
        opened.page.evaluate(f"addEventListener('pointerdown', () => setTimeout(() => {{ {_OFF} }}, 300))")
        opened.page.mouse.down()
        assert opened.until("pebble.wereHeld === 1")
        assert opened.until(lambda: opened.page.locator(".held").count() == 0)
        opened.page.evaluate("delete pebble.connection.may; pebble.connection.changed()")
        assert opened.until("performance.now() - pebble.pressedAt > 1500")
        assert server.sent("estop-reset") == []


# -- the fleet


def names(cards: Locator) -> list[str]:
    return cards.locator("h2").all_inner_texts()


def test_of_a_thousand_those_on_the_screen_are_drawn_and_each_is_found(show: Show) -> None:
    with show(STATES["fleet-thousand"]) as opened:
        cards = opened.page.locator(".fleet-card")
        assert opened.until(lambda: 10 < cards.count() < 120)
        opened.page.evaluate("scrollTo(0, document.body.scrollHeight / 2)")
        assert opened.until(lambda: "robot-05" in names(cards)[40])
        assert cards.count() < 120
        online = opened.page.locator("[aria-label=Online] .fleet-card")
        opened.page.evaluate(
            "pebble.store.set('pebble/robots/robot-0030', 'charging-level', { value: 42, unit: '%' }), scrollTo(0, 0)"
        )
        opened.test("sort").select_option("battery")
        assert opened.until(lambda: names(online)[:2] == ["robot-0030", "robot-0001"])
        opened.test("filter").fill("0053 BOB")
        assert opened.until(lambda: names(cards) == ["robot-0053"])
        opened.test("card-robot-0053").get_by_role("link").click()
        assert opened.until("location.pathname !== '/'")
        opened.page.go_back()
        assert opened.until(lambda: names(cards) == ["robot-0053"])  # what was looked for is kept
        opened.test("filter").fill("stopped")
        assert opened.until(lambda: len(names(cards)) == 10)


def test_a_stop_of_all_shows_how_many_have_confirmed_it(show: Show) -> None:
    with show(STATES["fleet-thousand"]) as opened:
        opened.page.locator(".fleet-card").first.wait_for()
        opened.test("stop-all").click()
        confirm = """(number) => pebble.store.refs().forEach((ref, at) => pebble.store.set(ref, "web/estop", {
          ...pebble.store.get(ref, "web/estop").value, latched: true, stop: pebble.estop.pressed.stop,
          sending: at < number ? "confirmed" : "sent" }))"""
        for number, words in ((997, "997 of 1000 confirmed."), (1000, "all 1000 confirmed.")):
            opened.page.evaluate(confirm, number)
            assert opened.until(lambda: opened.test("tally").inner_text() == f"STOP ALL: {words}")  # noqa: B023
        assert opened.page.locator(".stops .banner").count() <= 51  # one resets all


# -- robots that write anything

MARKUP, LONG = "<img src=x onerror=alert(1)>", "long " * 400
FIELDS = [{"name": "f", "type": "u8"}] * 2
NASTY: list[Any] = [None, LONG, {"value": {MARKUP: 1}}, {"value": []}, {"shapes": [[[1e300, None]] * 300] * 50}]
NASTY += [{"value": {str(number): number for number in range(500)}}]
FORM_OF_MARKUP = {"file": MARKUP, "label": LONG, "configs": [setting(MARKUP, MARKUP, "string", MARKUP)]}
#: What of it the server lets pass: of each metric, payloads of any shape, and forms, manifests and texts.
HOSTILE = {
    "soundboard-status": {"playing": True, "file": LONG, "error": MARKUP},
    "autonomy-files": {"files": [FORM_OF_MARKUP]},
    "autonomy-status": {"running": True, "file": LONG, "error": MARKUP, "config": {MARKUP: LONG}},
    "mcu/lamp-1/describe": {
        "model": MARKUP,
        "interfaces": [{"name": MARKUP, "dir": "out", "encoding": {"fields": FIELDS}}] * 2,
    },
}
ANY = ("sensors/imu", "wheel-odometry", "video-overlays", "status", "charging-level", "outlets/o1/status")


def test_what_a_robot_writes_is_only_text_and_breaks_no_card(show: Show, server: CannedServer) -> None:
    state: State = replace(
        STATES["full"], values=changed(STATES["full"].values, *(at(GOOB, *one) for one in HOSTILE.items()))
    )
    with show(state) as opened:
        assert opened.until(lambda: MARKUP in opened.test("script-error").inner_text())
        opened.page.locator(".script-row").click()
        opened.page.locator(".ask-field").wait_for()
        for payload in NASTY:
            opened.page.evaluate(
                "([metrics, value]) => metrics.forEach((one) => pebble.store.set(pebble.route.ref, one, value))",
                [ANY, payload],
            )
            opened.page.wait_for_timeout(300)
            assert opened.page.locator(".failed, main img[src=x]").count() == 0, str(payload)[:40]
            assert opened.page.evaluate("document.documentElement.scrollWidth <= innerWidth"), str(payload)[:40]
        assert opened.errors == []
        do(opened, "stop-one")
        assert opened.until(lambda: server.sent("estop"))
