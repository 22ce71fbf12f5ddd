"""A value on the page ages by itself: on the fleet's screen nothing else draws it again."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.web.canned import CannedServer, Show
from tests.web.states import GOOB, STATES

pytestmark = pytest.mark.page

SEND = """async ([ref, count]) => {
  for (let i = 0; i < count; i++) {
    pebble.store.set(ref, "charging-level", { value: 7, unit: "v" });
    await new Promise((resolve) => setTimeout(resolve, 60));
  }
}"""


def test_a_value_that_stops_becomes_late_and_the_next_one_is_fresh(show: Show) -> None:
    state = replace(STATES["fleet"], repeated={})
    with show(state) as opened:
        level = opened.test("card-goob").get_by_text("7.00 V")
        opened.test("card-goob").wait_for()
        opened.page.evaluate(SEND, [GOOB, 6])
        assert opened.until(lambda: level.inner_text() == "7.00 V 0 s old", 3), level.inner_text()
        assert opened.until(lambda: level.inner_text() == "7.00 V 2 s old", 4), level.inner_text()
        opened.page.evaluate(SEND, [GOOB, 1])
        assert opened.until(lambda: level.inner_text() == "7.00 V", 1), level.inner_text()
        assert opened.until(lambda: level.inner_text() == "7.00 V 0 s old", 3), level.inner_text()


def test_the_state_of_an_earlier_connection_allows_no_driving(show: Show, server: CannedServer) -> None:
    state = replace(STATES["driving"], repeated={})
    reason = "pebble.driver.reason()?.code"
    with show(state) as opened:
        assert opened.until(f"window.pebble && {reason} === undefined", 10)
        # another server answers, and what it knows comes a moment later
        assert opened.page.evaluate(f"pebble.driver.socket.welcome(pebble.driver.socket.you), {reason}") == "server"
