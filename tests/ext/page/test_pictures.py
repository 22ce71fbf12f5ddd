"""Pictures all the way from a robot to the canvas of a page in Chromium, through the real server."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from playwright.sync_api import Browser

from pebble.transports import MqttSettings, create
from tests.ext.page.browser import Tab, tab
from tests.ext.page.media.robots import REF, PictureRobot
from tests.ext.page.served import Served
from tests.support import Broker

pytestmark = pytest.mark.page

# A page of its own, so that nothing else of ours runs in it; its policy (CSP) is that of every page.
SHOW = """async ([media, can]) => {
  const { Pictures } = await import(media);
  if (can !== null) Pictures.canDecode = async () => can;
  window.drawn = [];
  window.states = [];
  window.delay = 0;
  const canvas = new OffscreenCanvas(1, 1);
  const draw = (bitmap, info) => {
    for (const end = performance.now() + window.delay; performance.now() < end; );
    Object.assign(canvas, { width: bitmap.width, height: bitmap.height });
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    window.drawn.push({ ...info, age: Date.now() - info.capturedMs });
  };
  window.pictures = new Pictures(draw, (state) => window.states.push(state));
  window.can = await Pictures.canDecode();
}"""


@pytest.fixture
def robot(broker: Broker) -> Iterator[PictureRobot]:
    with filming(broker) as robot:
        yield robot


@contextmanager
def filming(broker: Broker, **options: Any) -> Iterator[PictureRobot]:
    transport = create("mqtt", "camera", MqttSettings(host="127.0.0.1", port=broker.port))
    robot = PictureRobot(transport=transport.open(), **options)
    yield robot
    robot.close()


@contextmanager
def showing(browser: Browser, served: Served, can: list[str] | None = None) -> Iterator[Tab]:
    with tab(browser, f"{served.origin}/healthz") as one:
        one.page.evaluate(SHOW, [f"/static/{served.version}/media/pictures.js", can])
        assert one.until(lambda: REF in served.app.state.robots.components)
        one.page.evaluate("ref => window.pictures.show(ref)", REF)
        yield one


def drawn(one: Tab) -> list[dict[str, Any]]:
    return list(one.page.evaluate("window.drawn"))


@pytest.mark.parametrize("encoding", ["h264", "pbvd"])
def test_every_picture_is_drawn_in_order_and_soon(
    browser: Browser, served: Served, robot: PictureRobot, encoding: str
) -> None:
    with showing(browser, served, [encoding]) as one:
        assert one.until("window.drawn.some((info) => !info.rescue)")  # the last test's encoding may still come
        assert one.until("window.drawn.filter((info) => !info.rescue).length > 45", 15)
        shown = [info for info in drawn(one) if not info["rescue"]]
        assert all(b["key"] or b["frame"] == a["frame"] + 1 for a, b in itertools.pairwise(shown))
        assert len(shown) > 0.5 * (shown[-1]["frame"] - shown[0]["frame"])  # a busy machine leaves some out
        assert {(info["encoding"], info["rescue"], info["width"], info["height"]) for info in shown} == {
            (encoding, False, 160, 120)
        }
        assert sorted(info["age"] for info in shown)[len(shown) // 2] < 500  # 20 on a machine at rest
        assert one.errors + one.violations == []


def test_after_a_lost_connection_pictures_come_again(browser: Browser, broker: Broker, robot: PictureRobot) -> None:
    with Served(broker.port) as first, tab(browser, f"{first.origin}/healthz") as one:
        one.page.evaluate(SHOW, [f"/static/{first.version}/media/pictures.js", ["pbvd"]])
        assert one.until(lambda: REF in first.app.state.robots.components)
        one.page.evaluate("ref => window.pictures.show(ref)", REF)
        assert one.until("window.drawn.length > 3")
        port = first.port
        first.__exit__(None, None, None)
        assert one.until("window.pictures.state.connection === 'lost'")
        count = one.page.evaluate("window.drawn.length")
        with Served(broker.port, port=port):
            assert one.until(f"window.drawn.length > {count + 3}", 15)
            assert one.page.evaluate("window.pictures.state.connection") == "open"
