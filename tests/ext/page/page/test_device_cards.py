"""The cards of outlets and microcontrollers, and all values, in a browser before a server of given states."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from tests.ext.page.browser import Tab
from tests.ext.page.canned import CannedServer, Show, State, Value
from tests.ext.page.states import GOOB, STATES, at, changed, devices, outlet

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


def with_values(*more: Callable[[int], Value], **fields: Any) -> State:
    return replace(STATES["devices"], values=changed(devices, *more), **fields)


# -- outlets


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


def test_values_have_their_unit_and_their_rate(cards: Tab) -> None:
    assert cards.test("mcu-out-lamp").inner_text().splitlines()[-1].endswith("62.5 %")
    assert cards.until(lambda: "/s" in cards.test("mcu-out-glow").inner_text())


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
