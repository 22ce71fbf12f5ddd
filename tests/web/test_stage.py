"""The stage and the browser that other tests stand on."""

from __future__ import annotations

import time
import urllib.request
from collections.abc import Callable

import pytest
from playwright.sync_api import Browser

from pebble.contract import DRIVE, codec
from pebble.contract.payloads import Drive
from pebble.transports import MqttSettings, QoS, create
from tests.support import gone, until
from tests.web.browser import tab
from tests.web.stage import Stage


def status(url: str) -> int:
    with urllib.request.urlopen(url, timeout=5) as answer:
        return int(answer.status)


def test_the_traces_show_what_a_robot_is_commanded(lamp: Stage) -> None:
    transport = create("mqtt", "driver", MqttSettings(host="127.0.0.1", port=lamp.broker_port))
    transport.open()
    began = time.monotonic_ns()
    assert not lamp.wheels_turning("minilamp", since_ns=began)
    assert lamp.last_motion_ns("minilamp") == 0

    def drive(axes: Drive) -> None:
        transport.publish(f"{lamp.ref('minilamp')}/incoming/drive-values", codec.encode(DRIVE, axes), qos=QoS.DELIVERED)

    drive(Drive(z=0.5))
    assert until(lambda: lamp.wheels_turning("minilamp"))
    drive(Drive())
    assert until(lambda: not lamp.wheels_turning("minilamp"))
    transport.close()
    assert lamp.wheels_turning("minilamp", since_ns=began)
    assert began < lamp.last_motion_ns("minilamp") < time.monotonic_ns()
    assert not lamp.wheels_turning("minilamp", since_ns=lamp.last_motion_ns("minilamp"))


def test_the_server_can_be_frozen_killed_and_started_again_at_its_address(lamp: Stage) -> None:
    url = lamp.url
    lamp.server.freeze()
    with pytest.raises(TimeoutError):
        urllib.request.urlopen(url, timeout=0.3)
    lamp.server.thaw()
    assert status(url) == 200
    lamp.server.kill()
    lamp.restart_server()
    assert lamp.url == url
    assert status(url) == 200


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_a_browser_opens_the_page_and_keeps_its_complaints(lamp: Stage, browser: Browser, size: str) -> None:
    with tab(browser, lamp.url, size, "dark") as opened:  # type: ignore[arg-type]
        assert opened.page.title() == "Pebble"
        assert opened.page.evaluate("matchMedia('(pointer: coarse)').matches") is (size == "phone")
        assert opened.page.evaluate("matchMedia('(prefers-color-scheme: dark)').matches")
        opened.page.evaluate(
            "() => { const one = document.createElement('script'); one.text = '1'; document.head.append(one) }"
        )
        assert opened.until(lambda: opened.violations)
        opened.page.evaluate("() => { setTimeout(() => { throw new Error('deliberate') }) }")
        assert opened.until(lambda: opened.errors == ["deliberate"])


def test_nothing_outlives_a_stage() -> None:
    with Stage("minilamp") as stage:
        pids = [stage.server.pid, *(program.pid for program in stage.robots["minilamp"].programs)]
        alive: Callable[[], list[int]] = lambda: [pid for pid in pids if not gone(pid)]
        assert alive() == pids
    assert alive() == []
