"""The form of a script with many settings, before canned values: Start is in view and covers nothing, at all sizes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.ext.page.browser import Size
from tests.ext.page.canned import Show
from tests.ext.page.states import ASKED, GOOB, MINE, STATES, at, changed, setting

pytestmark = pytest.mark.page

MANY = [setting(f"n{number}", f"Setting {number}", "float", 0.5, min=0, max=1) for number in range(18)]
FOLLOW = {"file": "follow", "label": "Follow", "summary": "Follows a tag.", "main": ["n2", "n1", "n0"], "configs": MANY}
STATE = replace(STATES["asked"], values=changed(ASKED, MINE, at(GOOB, "autonomy-files", {"files": [FOLLOW]})))
#: What is pressed until the card is there.
WAY: dict[Size, str] = {"phone": "[data-test=tab-more]", "small": "[data-test=tab-more]", "landscape": ".round"}
#: Whether the middle of an element belongs to it, in the window.
_SEEN = """(one) => {
  const { left, top, width, height } = one.getBoundingClientRect();
  return one.contains(document.elementFromPoint(left + width / 2, top + height / 2));
}"""


@pytest.mark.parametrize("size", ["desktop", "phone", "small", "landscape"])
def test_start_stays_in_view_and_covers_no_field(show: Show, size: Size) -> None:
    with show(STATE, size) as opened:
        if size in WAY:
            opened.page.locator(WAY[size]).first.click()
        opened.test("script-follow").click()
        main = opened.page.locator(".scripts > li > form > .ask-form input")
        assert [one.get_attribute("data-test") for one in main.all()] == ["set-n2", "set-n1", "set-n0"]
        assert [one.input_value() for one in main.all()] == ["0.5"] * 3
        opened.test("more-settings").click()
        start = opened.test("start-script")
        for number in (2, 0, 3, 10, 17):
            field = opened.test(f"set-n{number}")
            field.scroll_into_view_if_needed()
            field.focus()
            assert field.evaluate(_SEEN), number
            assert start.evaluate(_SEEN), number
        assert opened.complaints() == []
