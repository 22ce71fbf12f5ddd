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
from tests.ext.page.media.robots import REF, VIDEO, PictureRobot, capabilities
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


def test_chromium_decodes_everything(browser: Browser, served: Served, robot: PictureRobot) -> None:
    with showing(browser, served) as one:
        assert one.page.evaluate("window.can") == ["h264", "pbvd", "json", "jpeg"]
        assert one.until("window.drawn.length > 20")
        assert one.errors + one.violations == []
    assert robot.requests[0] == {"enabled": True, "encoding": "h264"}


@pytest.mark.parametrize("encoding", ["h264", "pbvd", "json"])
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


def test_a_page_that_decodes_nothing_is_shown_jpegs(browser: Browser, served: Served, robot: PictureRobot) -> None:
    with showing(browser, served, []) as one:
        assert one.until("window.drawn.length > 5")
        assert all(info["rescue"] and info["encoding"] == "jpeg" for info in drawn(one))
        assert all(0 <= info["age"] < 5000 for info in drawn(one))
        assert one.page.evaluate("window.pictures.state.rescue")


def test_a_slow_page_is_shown_what_is_new(browser: Browser, served: Served, robot: PictureRobot) -> None:
    """Drawing takes 0.2 s; the robot sends 15 a second."""
    with showing(browser, served, ["pbvd"]) as one:
        assert one.until("window.drawn.length > 3")
        one.page.evaluate("window.delay = 200")
        one.page.wait_for_timeout(1500)
        one.page.evaluate("window.drawn.length = 0")
        assert one.until("window.drawn.length > 8")
        assert max(info["age"] for info in drawn(one)) < 3000


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


def test_another_component_and_none(browser: Browser, served: Served, robot: PictureRobot) -> None:
    with showing(browser, served) as one:
        assert one.until("window.drawn.length > 3")
        one.page.evaluate("window.pictures.show('pebble/robots/unknown')")
        one.page.wait_for_timeout(200)
        count = one.page.evaluate("window.drawn.length")
        one.page.wait_for_timeout(500)
        assert one.page.evaluate("window.drawn.length") == count
        one.page.evaluate("ref => window.pictures.show(ref)", REF)
        assert one.until(f"window.drawn.length > {count + 3}")
        one.page.evaluate("window.pictures.stop()")
        one.page.wait_for_timeout(200)
        count = one.page.evaluate("window.drawn.length")
        one.page.wait_for_timeout(300)
        assert one.page.evaluate("window.drawn.length") == count
        assert one.page.evaluate("window.pictures.state.connection") == "off"


def test_a_drawing_page_that_throws_goes_on(browser: Browser, served: Served, robot: PictureRobot) -> None:
    with showing(browser, served) as one:
        assert one.until("window.drawn.length > 3")
        one.page.evaluate(
            "() => { window.pictures.canvasDraw = (_, info) => { window.drawn.push(info); throw Error('x'); } }"
        )
        count = one.page.evaluate("window.drawn.length")
        assert one.until(f"window.drawn.length > {count + 10}")


def test_raw_jpegs_of_a_board(browser: Browser, served: Served, broker: Broker) -> None:
    import cv2
    import numpy as np

    video = {name: VIDEO[name] for name in ("available", "controls", "topic", "command_topic", "flag_topic")}
    with filming(broker, video={**video, "encoding": "jpeg"}) as robot:
        robot.mute = True
        with showing(browser, served) as one:
            assert one.until(lambda: robot.requests)
            for number in range(8):
                robot.send(cv2.imencode(".jpg", np.full((48, 64, 3), 20 * number, np.uint8))[1].tobytes())
                one.page.wait_for_timeout(100)
            assert one.until("window.drawn.length >= 4")  # a page that stands still is shown what is newest
            assert {info["encoding"] for info in drawn(one)} == {"jpeg"}
            assert not any(request.get("encoding") for request in robot.requests)
        robot.transport.publish(f"{REF}/outgoing/capabilities", capabilities(VIDEO), retain=True)
