"""The cards of outlets and microcontrollers, and all values, in a browser before a server of given states."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from tests.ext.page.browser import PIXELS, Tab
from tests.ext.page.canned import CannedServer, Show, State, Value
from tests.ext.page.states import GOOB, STATES, at, changed, devices, liveness, outlet

pytestmark = pytest.mark.page

O2 = "outlets/o2/status"


@pytest.fixture(scope="module")
def cards(show: Show) -> Iterator[Tab]:
    """The page of a robot with outlets and microcontrollers; its tests send, but change nothing."""
    with show(STATES["devices"]) as opened:
        opened.test("mcu-lamp-1").wait_for()
        opened.test("outlet-o1").wait_for()
        yield opened
        assert opened.complaints() == []


def reason(opened: Tab, name: str) -> str:
    """What describes why a control is off."""
    ids = opened.test(name).get_attribute("aria-describedby") or ""
    return " ".join(opened.page.locator(f'[id="{one}"]').inner_text() for one in ids.split())


def with_values(*more: Callable[[int], Value], **fields: Any) -> State:
    return replace(STATES["devices"], values=changed(devices, *more), **fields)


# -- outlets


def test_outlets_have_their_state_and_the_reason_why_they_are_off(cards: Tab) -> None:
    states = {name: cards.test(f"outlet-state-{name}").inner_text() for name in ("o1", "o2", "o4")}
    assert states == {"o1": "on", "o2": "off", "o4": "off"}
    assert "Desk lamp (o1)" in cards.page.locator('[data-card="outlets"]').inner_text()
    assert [cards.test(f"outlet-{name}").is_disabled() for name in ("o1", "o2", "o3", "o4", "o5")] == [
        False,
        False,
        True,
        True,
        True,
    ]
    assert reason(cards, "outlet-o4") == "outlet is unreachable"
    assert reason(cards, "outlet-o5") == "no device is bound to this outlet"
    assert "no control" in reason(cards, "outlet-o3")


def test_what_was_asked_is_shown_until_the_outlet_reports_it(show: Show, server: CannedServer) -> None:
    report = outlet("o2")
    with show(with_values(lambda _now: (GOOB, O2, report, 0.0), repeated={O2: 0.1})) as opened:
        opened.test("outlet-o2").click()
        assert opened.until(lambda: server.sent("outlet"))
        assert server.sent("outlet") == [{"op": "outlet", "ref": GOOB, "outlet": "o2", "on": True}]
        assert opened.test("outlet-asked-o2").inner_text() == "asked: on"
        assert opened.test("outlet-o2").get_attribute("aria-checked") == "false"
        assert opened.until(lambda: opened.test("outlet-asked-o2").inner_text() == "asked: on, not confirmed")
        report["value"]["on"] = True
        assert opened.until(lambda: opened.test("outlet-o2").get_attribute("aria-checked") == "true")
        assert opened.test("outlet-asked-o2").count() == 0
        opened.test("outlet-o2").click()
        assert opened.until(lambda: [one["on"] for one in server.sent("outlet")] == [True, False])


def test_a_refusal_stands_at_what_was_asked(show: Show) -> None:
    with show(replace(STATES["devices"], refused="No, why")) as opened:
        opened.test("outlet-o2").click()
        card = opened.page.locator('[data-card="outlets"]')
        assert opened.until(lambda: card.get_by_text("not done: No, why").count() == 1)
        assert "not done" in opened.page.locator("li.outlet", has=opened.test("outlet-o2")).inner_text()
        assert opened.test("outlet-asked-o2").count() == 0
        form = opened.test("mcu-in-lamp")
        form.locator('[data-test="field-level"]').fill("1")
        opened.test("send-lamp").click()
        assert opened.until(lambda: "not done: No, why" in form.inner_text())
        assert "not done" not in opened.test("mcu-in-arm").inner_text()


def test_what_is_on_can_be_switched_off_while_the_robot_is_silent(show: Show, server: CannedServer) -> None:
    silent = at(GOOB, "web/liveness", liveness(online=False, silent_s=9.0, latency_ms=None))
    with show(with_values(silent)) as opened:
        assert opened.until(lambda: opened.test("outlet-o2").is_disabled())
        assert reason(opened, "outlet-o2") == "goob is silent"
        assert opened.test("outlet-state-o1").inner_text() == "was on"
        opened.test("outlet-o1").click()
        assert opened.until(lambda: [one["on"] for one in server.sent("outlet")] == [False])


def test_a_viewer_may_look(show: Show) -> None:
    with show(STATES["devices-viewer"]) as opened:
        assert opened.until(lambda: opened.test("outlet-o1").is_disabled())
        assert reason(opened, "outlet-o1") == "Log in as driver to use this"
        assert opened.test("send-lamp").is_disabled()
        assert reason(opened, "send-lamp") == "Log in as driver to use this"


# -- microcontrollers


def test_a_form_sends_exactly_the_declared_fields_in_their_types(cards: Tab, server: CannedServer) -> None:
    form = cards.test("mcu-in-lamp")
    form.locator('[data-test="field-level"]').fill("200")
    cards.test("send-lamp").click()
    assert cards.page.evaluate("document.activeElement.dataset.test") == "field-level"  # it holds 0 to 127.5
    form.locator('[data-test="field-level"]').fill("62.5")
    form.locator('[data-test="field-on"]').check()
    cards.test("send-lamp").click()
    arm = cards.test("mcu-in-arm")
    arm.locator('[data-test="field-angle"]').fill("-12")
    arm.locator('[data-test="field-k"]').fill("1e-3")
    arm.locator('[data-test="field-k"]').press("Enter")
    assert cards.until(lambda: len(server.sent("mcu")) == 2)
    head = {"op": "mcu", "ref": GOOB, "uid": "lamp-1"}
    assert server.sent("mcu") == [
        head | {"name": "lamp", "value": {"level": 62.5, "on": True}},
        head | {"name": "arm", "value": {"angle": -12, "k": 0.001}},
    ]
    assert cards.until(lambda: "sent at" in arm.inner_text())


def test_values_have_their_unit_and_a_line_of_the_last_minute(cards: Tab) -> None:
    assert cards.test("mcu-out-lamp").inner_text().splitlines()[-1].endswith("62.5 %")
    reading = cards.test("reading-lux")
    reading.click()
    assert reading.get_attribute("aria-expanded") == "true"
    drawn = """() => { PIXELS const canvas = document.querySelector("[data-test=minute] canvas");
      return canvas?.width > 100 && pixelsOf(canvas).some((byte) => byte > 0); }"""
    assert cards.until(drawn.replace("PIXELS", PIXELS))
    assert "last minute" in cards.test("minute").inner_text()
    assert cards.until(lambda: "/s" in cards.test("mcu-out-glow").inner_text())
    reading.click()
    assert cards.test("minute").count() == 0


def nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = {"a": value}
    return value


SCRIPT = "<img src=x onerror=alert(1)>"
#: Manifests that the server lets pass.
HOSTILE: dict[str, Any] = {
    "script": {
        "model": SCRIPT,
        "interfaces": [{"name": SCRIPT, "dir": "out", "encoding": {"fields": [{"name": SCRIPT}]}}],
    },
    "twice": {
        "interfaces": [{"name": "x", "dir": "out", "encoding": {"fields": [{"name": "f", "type": "u8"}] * 2}}] * 2
    },
    "names": {
        "interfaces": [{"name": "x", "dir": "in", "encoding": {"fields": [{"name": "__proto__", "type": "u8"}]}}]
    },
    "huge": {
        "interfaces": [
            {
                "name": f"i{n}",
                "dir": ("in", "out")[n % 2],
                "encoding": {"fields": [{"name": "y" * 60, "type": "f32"}] * 9},
            }
            for n in range(60)
        ]
    },
}


def test_hostile_manifests_reports_and_capabilities_do_no_harm(show: Show, server: CannedServer) -> None:
    odd = [
        at(GOOB, f"mcu/{SCRIPT.replace('/', '')} {name}/describe", manifest) for name, manifest in HOSTILE.items()
    ]  # fmt: skip
    odd += [
        at(GOOB, f"outlets/odd{n}/status", value) for n, value in enumerate([7, "x", [], {}, {"value": []}, nested(30)])
    ]
    odd += [at(GOOB, "mcu/lamp-1/lamp", [1]), at(GOOB, "mcu/lamp-1/glow", {"value": {"lux": {"a": nested(25)}}})]
    with show(with_values(*odd)) as opened:
        opened.test("mcu-hs105-sta").wait_for()
        assert opened.until(lambda: opened.page.locator(".mcu").count() == len(HOSTILE) + 2)
        assert opened.page.locator(".mcu img, .card .failed").count() == 0
        opened.test("outlet-o2").click()
        assert opened.until(lambda: server.sent("outlet"))
        assert opened.complaints() == []


# -- all values


def test_values_of_a_component_of_any_type_are_shown_in_lines(show: Show) -> None:
    with show(STATES["satellite"]) as opened:
        shown = opened.test("value-status")
        shown.wait_for()
        assert [" ".join(line.split()) for line in shown.locator("li").all_inner_texts()] == [
            "lat_deg 52.1",
            "lon_deg 13.4",
            "alt_km 412.5",
            "mode sun pointing",
        ]
        assert opened.test("value-charging-level").locator("li").inner_text() == "81 %"
        assert "ago" in shown.locator("dt").inner_text()
