"""The cards of the fleet: what a press opens, many robots in groups, and the first steps of a newcomer."""

import pytest

from tests.web.canned import CannedServer, Show, State
from tests.web.states import GOOB, STATES, estop, robot

pytestmark = pytest.mark.page

#: Where the card is pressed, as parts of its width and height.
PLACES = {"top left": (0.02, 0.02), "centre": (0.5, 0.5), "bottom left": (0.02, 0.98)}


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_the_whole_card_opens_its_robot(show: Show, place: tuple[float, float]) -> None:
    with show(STATES["fleet"]) as opened:
        card = opened.test("card-goob")
        box = card.bounding_box()
        assert box is not None
        card.click(position={"x": place[0] * box["width"], "y": place[1] * box["height"]})
        assert opened.until(f"window.pebble.driver.ref === '{GOOB}'", 3)


def test_a_stop_of_a_card_opens_nothing(show: Show, server: CannedServer) -> None:
    with show(STATES["fleet"]) as opened:
        opened.test("stop-goob").click()
        assert opened.until(lambda: server.sent("estop"))
        assert opened.page.evaluate("location.pathname") == "/"


def test_many_robots_are_shown_by_what_they_need(show: Show) -> None:
    names = [f"pebble/robots/r{number:02}" for number in range(14)]

    def many(now: int) -> list[tuple[str, str, object, int]]:
        stopped = (names[3], "web/estop", {**estop(now), "latched": True}, 0)
        return [one for name in names for one in robot(now, name, "mqtt", 7.9)] + [stopped]

    with show(State("/", many)) as opened:
        group = opened.page.locator("section[aria-label='Need a look'] .fleet-card")
        assert opened.until(lambda: group.locator("h2").all_inner_texts() == ["r03"])
        assert opened.page.locator(".fleet-card").count() == 14
        assert opened.test("stopped").inner_text() == "1 stopped"


def test_the_first_steps_are_ticked_and_can_be_hidden(show: Show) -> None:
    with show(STATES["fleet"]) as opened:
        steps = opened.test("first-time")
        steps.get_by_text("Drive").click()
        assert opened.until("location.pathname !== '/'", 3)
        opened.page.go_back()
        assert opened.until(lambda: steps.locator(".step.done").count() == 1)
        opened.test("hide-first-time").click()
        assert steps.count() == 0
        opened.page.reload()
        opened.test("card-goob").wait_for()
        assert steps.count() == 0


def test_robots_without_a_camera_show_their_face(show: Show) -> None:
    with show(STATES["fleet"]) as opened:
        assert opened.test("card-minilamp").locator(".thumbnail use").get_attribute("href", timeout=3000)
        assert "no camera" in opened.test("card-minilamp").inner_text()
        assert opened.test("card-goob").get_by_text("live").is_visible()
