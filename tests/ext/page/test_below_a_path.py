"""The login in a browser, and the page below a path of a reverse proxy: all that browsers ask for lies below it."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.ext.page.attacker import PASSWORDS, Hall
from tests.ext.page.browser import Tab, tab
from tests.support import Broker
from tests.tcp_proxy import PrefixProxy

pytestmark = pytest.mark.page

#: Shown once the process that reads recordings has been started, which takes long on a busy machine.
EMPTY = "document.body.innerText.includes('Nothing is recorded yet')"
#: Where the page begins once it is installed.
STARTS = """async () => {
  const { href } = document.querySelector("link[rel=manifest]");
  return new URL((await (await fetch(href)).json()).start_url, href).href;
}"""


def log_in(opened: Tab, user: str, password: str) -> None:
    opened.page.get_by_label("User").fill(user)
    opened.page.get_by_label("Password").fill(password)
    opened.page.get_by_role("button", name="Log in").click()


def test_a_wrong_password_is_shown_and_no_login_leads_to_another_site(
    broker: Broker, browser: Browser, tmp_path: Path
) -> None:
    with Hall(broker.port, tmp_path) as hall, tab(browser, f"{hall.served.origin}/login", "small") as opened:
        why = lambda: opened.page.get_by_role("alert").inner_text()
        assert opened.page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
        log_in(opened, "viewer", "a wrong one")
        assert opened.until(lambda: why() == "User or password is wrong")
        opened.context.set_offline(True)
        log_in(opened, "viewer", PASSWORDS["viewer"])
        assert opened.until(lambda: why() == "No connection to the server")
        opened.context.set_offline(False)
        for target in ("//evil.test", "/r/\\\\evil.test", "javascript:alert(1)", ""):
            opened.page.goto("about:blank")  # what is open would notice that it is logged out, and go to the login
            opened.context.clear_cookies()
            opened.page.goto(f"{hall.served.origin}/login?next={target}")
            log_in(opened, "viewer", PASSWORDS["viewer"])
            assert opened.until(lambda: opened.page.url == f"{hall.served.origin}/"), target
        assert opened.page.evaluate("() => document.cookie") == "", "scripts do not see the session"


@pytest.mark.parametrize("prefix", ["/replay/", "/p%C3%A4th%20/"])  # one is a path of the page itself
def test_a_login_leads_to_the_screen_that_was_asked_for_and_each_screen_leads_on(
    broker: Broker, browser: Browser, tmp_path: Path, prefix: str
) -> None:
    with ExitStack() as opened:
        proxy = opened.enter_context(PrefixProxy(1, prefix))
        url = f"http://127.0.0.1:{proxy.port}{prefix}"
        hall = opened.enter_context(Hall(broker.port, tmp_path, names=(f"127.0.0.1:{proxy.port}",)))
        proxy.lead_to(hall.served.port)
        one = opened.enter_context(tab(browser, f"{url}r/pebble/robots/goob"))
        assert one.page.url == f"{url}login?next=/r/pebble/robots/goob"
        log_in(one, "driver", PASSWORDS["driver"])
        assert one.until(lambda: one.page.url == f"{url}r/pebble/robots/goob")
        assert one.until("window.pebble?.route.ref === 'pebble/robots/goob'")
        one.page.goto(url)
        assert one.until("window.pebble?.connection.isOpen")
        one.page.get_by_role("link", name="Recordings").first.click()
        assert one.until(lambda: one.page.url == f"{url}replay")
        assert one.until(EMPTY, 60)
        one.page.reload()
        assert one.until(EMPTY, 60)
        assert one.page.evaluate(STARTS) == url
        one.page.evaluate("() => { pebble.commands.logOut() }")
        assert one.until(lambda: one.page.url == f"{url}login")
        assert proxy.outside == []
