"""The login page in a browser: what is refused is shown, and the right password leads to the page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.ext.page.attacker import PASSWORDS, Hall
from tests.ext.page.browser import Tab, tab
from tests.support import Broker

pytestmark = pytest.mark.page


@pytest.fixture
def hall(broker: Broker, tmp_path: Path) -> Iterator[Hall]:
    with Hall(broker.port, tmp_path) as hall:
        yield hall


def log_in(opened: Tab, user: str, password: str) -> None:
    opened.page.get_by_label("User").fill(user)
    opened.page.get_by_label("Password").fill(password)
    opened.page.get_by_role("button", name="Log in").click()


def why(opened: Tab) -> str:
    return opened.page.get_by_role("alert").inner_text()


def test_a_person_logs_in(hall: Hall, browser: Browser) -> None:
    origin = hall.served.origin
    with tab(browser, f"{origin}/r/pebble/robots/goob", "phone") as opened:
        assert opened.page.url == f"{origin}/login?next=/r/pebble/robots/goob"
        assert opened.page.title() == "Log in: hall"
        log_in(opened, "driver", "a wrong one")
        assert opened.until(lambda: why(opened) == "User or password is wrong")
        assert opened.page.get_by_label("Password").input_value() == ""
        opened.page.keyboard.type(PASSWORDS["driver"])
        opened.page.keyboard.press("Enter")
        assert opened.until(lambda: opened.page.url == f"{origin}/r/pebble/robots/goob")
        assert opened.page.evaluate("() => document.cookie") == "", "scripts do not see the session"
        assert [line for line in opened.complaints() if "401" not in line] == []


def test_it_leads_to_no_other_site(hall: Hall, browser: Browser) -> None:
    with tab(browser, f"{hall.served.origin}/login") as opened:
        for target in ("//evil.test", "https://evil.test", "/r/\\\\evil.test", "javascript:alert(1)", "/login", ""):
            opened.page.goto("about:blank")  # what is open would notice that it is logged out, and go to the login
            opened.context.clear_cookies()
            opened.page.goto(f"{hall.served.origin}/login?next={target}")
            log_in(opened, "viewer", PASSWORDS["viewer"])
            assert opened.until(lambda: opened.page.url == f"{hall.served.origin}/"), target


def test_a_server_that_is_gone_is_explained(hall: Hall, browser: Browser) -> None:
    with tab(browser, f"{hall.served.origin}/login") as opened:
        opened.context.set_offline(True)
        log_in(opened, "driver", PASSWORDS["driver"])
        assert opened.until(lambda: why(opened) == "No connection to the server")


def test_it_fits_and_its_controls_are_large_enough(hall: Hall, browser: Browser) -> None:
    with tab(browser, f"{hall.served.origin}/login", "small") as opened:
        assert opened.page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
        for control in opened.page.locator("input, button").all():
            box = control.bounding_box()
            assert box is not None
            assert box["height"] >= 44
