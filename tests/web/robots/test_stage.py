"""The stage and the browser that other tests stand on."""

from __future__ import annotations

import time
import urllib.request

import pytest
from playwright.sync_api import Browser

from pebble.contract import DRIVE, codec
from pebble.contract.payloads import Drive
from pebble.transports import MqttSettings, QoS, create
from tests.support import until
from tests.web.browser import tab
from tests.web.stage import Stage


def status(url: str) -> int:
    with urllib.request.urlopen(url, timeout=5) as answer:
        return int(answer.status)


def test_the_traces_show_what_a_robot_is_commanded(stage: Stage) -> None:
    transport = create("mqtt", "driver", MqttSettings(host="127.0.0.1", port=stage.broker_port))
    transport.open()
    began = time.monotonic_ns()
    assert not stage.wheels_turning("minilamp", since_ns=began)
    assert stage.last_motion_ns("minilamp") < began

    def drive(axes: Drive) -> None:
        transport.publish(
            f"{stage.ref('minilamp')}/incoming/drive-values", codec.encode(DRIVE, axes), qos=QoS.DELIVERED
        )

    drive(Drive(z=0.5))
    assert until(lambda: stage.wheels_turning("minilamp"))
    drive(Drive())
    assert until(lambda: not stage.wheels_turning("minilamp"))
    transport.close()
    assert stage.wheels_turning("minilamp", since_ns=began)
    assert began < stage.last_motion_ns("minilamp") < time.monotonic_ns()
    assert not stage.wheels_turning("minilamp", since_ns=stage.last_motion_ns("minilamp"))


def test_the_server_can_be_frozen_killed_and_started_again_at_its_address(stage: Stage) -> None:
    url = stage.url
    stage.server.freeze()
    with pytest.raises(TimeoutError):
        urllib.request.urlopen(url, timeout=0.3)
    stage.server.thaw()
    assert status(url) == 200
    stage.server.kill()
    stage.restart_server()
    assert stage.url == url
    assert status(url) == 200


@pytest.mark.page
@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_a_browser_opens_the_page_and_keeps_its_complaints(stage: Stage, browser: Browser, size: str) -> None:
    with tab(browser, stage.url, size, "dark") as opened:  # type: ignore[arg-type]
        assert opened.page.title() == "Pebble"
        assert opened.page.evaluate("matchMedia('(pointer: coarse)').matches") is (size == "phone")
        assert opened.page.evaluate("matchMedia('(prefers-color-scheme: dark)').matches")
        opened.page.evaluate(
            "() => { const one = document.createElement('script'); one.text = '1'; document.head.append(one) }"
        )
        assert opened.until(lambda: opened.violations)
        opened.page.evaluate("() => { setTimeout(() => { throw new Error('deliberate') }) }")
        assert opened.until(lambda: opened.errors == ["deliberate"])
