"""Recordings on the page, in Chromium, before the real routes of recordings: /replay never sends a robot anything."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from tests.ext.page.browser import Tab
from tests.ext.page.canned import CannedServer, Show
from tests.ext.page.states import STATES
from tests.ext.recordings.playing import GOOB, ms
from tests.support import WAIT_S

pytest.importorskip("duckdb")  # it makes timelines
pytestmark = [pytest.mark.page, pytest.mark.timeout(180)]

AT = ms(30)
#: What every page sends of itself, on any screen.
USUAL = {"hello", "echo", "watch"}
_DRAWN = """(at) => { const { feed, video } = window.pebble?.replay ?? {};
  return Boolean(feed) && !feed.seeking && video.info?.receivedMs === at; }"""


@pytest.fixture
def replay(show: Show, server: CannedServer) -> Iterator[Tab]:
    """Half a minute after the begin, paused; whatever a test does there, no robot is sent anything."""
    with show(STATES["replay"]) as opened:
        assert shown(opened, AT)
        assert opened.until("!!window.pebble?.replay?.day.timeline")
        yield opened
        assert {message["op"] for message in server.received} <= USUAL
        assert [message["ref"] for message in server.sent("watch")] == [""] * len(server.sent("watch"))
        assert opened.complaints() == []


def shown(opened: Tab, at: int, within: float = WAIT_S) -> bool:
    """Whether the picture that was received at this time is drawn, after the newest seek."""
    return opened.until(lambda: opened.page.evaluate(_DRAWN, at), within)


def position(opened: Tab) -> float:
    return float(opened.page.evaluate("pebble.replay.feed.position"))


def seek(opened: Tab, at: float) -> None:
    opened.page.evaluate("(at) => pebble.replay.seek(at)", at)


def test_the_way_to_a_day_and_a_robot(show: Show) -> None:
    with show(replace(STATES["recordings"], path="/")) as opened:
        opened.page.get_by_role("link", name="Recordings", exact=True).click()
        assert opened.until("window.pebble?.replay?.video.info")  # a picture is there at once
        assert ms(0) <= position(opened) <= ms(10)  # the first one
        opened.test("open-days").click()
        opened.page.get_by_role("link", name="All days").click()
        day = opened.test("day-2023-11-14")
        day.wait_for()
        assert "22:13 to 22:14" in day.inner_text()
        day.get_by_role("link", name="goob").click()
        assert opened.until("window.pebble?.replay?.feed.seeks > 0")
        assert ms(0) <= position(opened) <= ms(10)
        opened.test("badge").get_by_role("link").click()
        assert opened.until(lambda: opened.page.url.endswith(f"/r/{GOOB}"))
        assert opened.until("pebble.route.ref !== '' && pebble.replay === null")
        # Who leaves the robot's page so soon closes its line for pictures before that is there.
        assert [one for one in opened.complaints() if "closed before the connection is established" not in one] == []


def test_the_cards_show_that_time_and_none_of_them_sends(replay: Tab) -> None:
    cards = replay.page.locator("[data-card]").evaluate_all("(all) => all.map((one) => one.dataset.card)")
    assert {"telemetry", "plots", "logs", "values"} <= set(cards)
    assert not {"lights", "sounds", "autonomy", "outlets", "mcus", "system", "drive"} & set(cards)
    replay.page.locator("[data-card=logs] .card-head [aria-expanded]").click()  # those for engineers are closed
    assert replay.until(lambda: "98.0" in replay.page.locator("[data-card=telemetry]").inner_text())
    assert replay.until(lambda: "line 1250" in replay.test("log-lines").inner_text())
    seek(replay, AT - 20_000)
    assert replay.until(lambda: "line 1250" not in replay.test("log-lines").inner_text())
    assert replay.until(lambda: "line 250" in replay.test("log-lines").inner_text())


def test_the_sound_of_then_is_heard_also_after_a_seek(replay: Tab) -> None:
    heard = "pebble.replay.sound.link.stats?.received > 10"
    for name in ("listen", "play"):
        replay.test(name).click()
    assert replay.until(heard)
    seek(replay, AT + 3000)
    assert replay.until(f"!({heard})")
    assert replay.until(heard)


def test_seeks_leave_nothing_behind(show: Show, server: CannedServer) -> None:
    """Bitmaps that were drawn are closed."""
    counting = """window.bitmaps = new Set();
      const { close } = ImageBitmap.prototype, drawn = CanvasRenderingContext2D.prototype.drawImage;
      CanvasRenderingContext2D.prototype.drawImage = function (image, ...more) {
        if (image instanceof ImageBitmap) bitmaps.add(image);
        return drawn.call(this, image, ...more);
      };
      ImageBitmap.prototype.close = function () { bitmaps.delete(this); return close.call(this); };"""
    with show(STATES["replay"], script=counting) as opened:
        assert shown(opened, AT)
        for number in range(20):
            seek(opened, at := ms(2 * number))
            assert shown(opened, at)
        assert opened.page.evaluate("bitmaps.size") == 0
        assert opened.complaints() == []
