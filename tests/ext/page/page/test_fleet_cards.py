"""The cards of the fleet: what a press opens, many robots in groups, and the first steps of a newcomer."""

import pytest
from playwright.sync_api import Locator

from tests.ext.page.canned import Show
from tests.ext.page.states import STATES

pytestmark = pytest.mark.page


def test_the_first_steps_are_ticked_and_can_be_hidden(show: Show) -> None:
    with show(STATES["fleet"]) as opened:
        steps = opened.test("first-time")
        steps.get_by_text("Drive").click()
        assert opened.until("location.pathname !== '/'", 3)
        opened.page.go_back()
        steps.wait_for()
        assert steps.locator(".step.done").count() == 0, "it was not driven"
        opened.page.evaluate("pebble.settings.begin('drive')")
        assert opened.until(lambda: steps.locator(".step.done").count() == 1)
        opened.test("hide-first-time").click()
        assert steps.count() == 0
        opened.page.reload()
        opened.test("card-goob").wait_for()
        assert steps.count() == 0


@pytest.mark.parametrize(
    ("state", "button", "words", "inside"),
    [
        ("fleet", "fleet-more", ["Thumbnails"], "thumbnails"),
        ("fleet-stopped", "stopped", ["goob is stopped", "fred is stopped"], "reset"),
        ("free", "gear", ["Picture from"], "picture-from"),
    ],
)
def test_a_list_stays_open_while_its_words_are_pressed(
    show: Show, state: str, button: str, words: list[str], inside: str
) -> None:
    with show(STATES[state]) as opened:
        opened.test(button).click()
        for text in words:
            opened.page.get_by_text(text, exact=True).first.click()
            assert opened.test(inside).first.is_visible()
        assert opened.complaints() == []


def shown(cards: Locator) -> list[str]:
    return cards.locator("h2").all_inner_texts()


def test_small_cards_are_in_the_order_that_was_chosen(show: Show) -> None:
    with show(STATES["fleet-forty"]) as opened:
        cards = opened.page.locator("[aria-label=Online] .fleet-card")
        assert opened.until(lambda: cards.count() == 34)
        assert shown(cards)[:3] == ["robot-0001", "robot-0002", "robot-0003"]
        opened.page.evaluate(
            """pebble.store.set("pebble/robots/robot-0030", "charging-level", { value: 42, unit: "%" });
            pebble.store.set("pebble/robots/robot-0012", "charging-level", { value: 63, unit: "%" })"""
        )
        opened.test("sort").select_option("battery")
        assert opened.until(lambda: shown(cards)[:3] == ["robot-0030", "robot-0012", "robot-0001"])
    with show(STATES["fleet"]) as opened:
        opened.test("filter").wait_for()
        assert opened.test("sort").count() == 0


def test_of_a_thousand_only_those_on_the_screen_are_drawn(show: Show) -> None:
    with show(STATES["fleet-thousand"]) as opened:
        page, cards = opened.page, opened.page.locator(".fleet-card")
        assert opened.until(lambda: 10 < cards.count() < 120)
        assert page.evaluate("document.querySelectorAll('*').length") < 4000
        page.evaluate("scrollTo(0, document.body.scrollHeight / 2)")
        assert opened.until(lambda: "robot-05" in shown(cards)[40])
        assert cards.count() < 120
        stop, card = opened.page.locator(".fleet-card .stop-small").nth(40), cards.nth(40)
        inner, outer = stop.bounding_box(), card.bounding_box()
        assert inner is not None
        assert outer is not None
        assert inner["y"] + inner["height"] < outer["y"] + outer["height"]
        page.keyboard.press("End")
        assert opened.until(lambda: "robot-0984" in page.locator(".away").inner_text())


def test_one_of_a_thousand_is_found_by_name_driver_and_state(show: Show) -> None:
    with show(STATES["fleet-thousand"]) as opened:
        cards = opened.page.locator(".fleet-card")
        opened.test("filter").fill("0053 BOB")
        assert opened.until(lambda: shown(cards) == ["robot-0053"])
        opened.test("card-robot-0053").get_by_role("link").click()
        assert opened.until("location.pathname !== '/'", 3)
        opened.page.go_back()
        assert opened.until(lambda: shown(cards) == ["robot-0053"])  # what was looked for is kept
        opened.test("filter").fill("stopped")
        assert opened.until(lambda: len(shown(cards)) == 10)
        opened.test("filter").fill("offline")
        assert opened.until(lambda: cards.count() == 0 and opened.page.locator(".away-row").count() > 5)


def test_a_stop_of_all_shows_how_many_have_confirmed_it(show: Show) -> None:
    with show(STATES["fleet-thousand"]) as opened:
        opened.page.locator(".fleet-card").first.wait_for()
        opened.test("stop-all").click()
        confirm = """(number) => pebble.store.refs().forEach((ref, at) => pebble.store.set(ref, "web/estop", {
          ...pebble.store.get(ref, "web/estop").value, latched: true, stop: pebble.estop.pressed.stop,
          sending: at < number - 3 ? "confirmed" : "sent" }))"""
        opened.page.evaluate(confirm, 1000)
        assert opened.until(lambda: opened.test("tally").inner_text() == "STOP ALL: 997 of 1000 confirmed.")
        opened.page.evaluate(confirm.replace("number - 3", "number"), 1000)
        assert opened.until(lambda: opened.test("tally").inner_text() == "STOP ALL: all 1000 confirmed.")
        assert opened.page.locator(".stops .banner").count() <= 51  # one resets all
