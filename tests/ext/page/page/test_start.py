"""A page that loses one of its files: what it shows, and that it can stop robots all the same."""

from __future__ import annotations

import asyncio
import itertools
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import pytest
from playwright.sync_api import Browser, Page
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from tests.ext.page.browser import tab
from tests.ext.page.canned import CannedServer
from tests.ext.page.served import Served
from tests.ext.page.states import STATES
from tests.kit.played_robot import RecordingRobot
from tests.support import until

#: What happens to a file, how often, and what is sent of it; -1: no answer at all.
FAULTS: dict[str, tuple[int, float]] = {
    "lost once": (1, 0.0),
    "lost for ever": (sys.maxsize, 0.0),
    "cut off": (sys.maxsize, 0.5),
    "an error page": (sys.maxsize, 1.0),
    "never answered": (sys.maxsize, -1.0),
}
#: Of the start, fetched by that, fetched by the screen, looks, a worker; each is lost in two ways.
SAMPLE = {
    "fleet": ("main.js", "core/store.js", "ui/fleet/doubt.js", "app.css", "fleet.css"),
    "full": ("ui/robot/robot.js", "media/decode.js"),
}
#: Where all files of some names are fetched.
WHERE = (("recordings", "replay"), ("fleet", "fleet|many"), ("full", "^(?!.*(replay|fleet|many|login))"))
_AT_ONCE = 16
_STARTED_S, _FETCHED_S, _CALM_S = 20.0, 8.0, 3.5
_WAIT_MS = 1500
_SOON = f"globalThis.pebbleWaitMs = {_WAIT_MS}"
_PRESS = """() => setTimeout(() => {
  const form = document.querySelector("#start:not([hidden])");
  (form ?? document).querySelector(form ? "button" : "#app .stop").click();
})"""
#: Empty until the page shows a STOP as large as a finger.
_SHOWS = """() => {
  const form = document.getElementById("start");
  const words = (selector) => [...document.querySelectorAll(selector)].map((one) => one.innerText.trim()).join(" ");
  const ours = /179, 0, 27|168, 0, 25/;
  const red = [...document.querySelectorAll("#app .stop, #start button")].some((stop) => {
    const { width, height } = stop.getBoundingClientRect();
    const { backgroundColor, borderTopColor } = getComputedStyle(stop);
    return width > 60 && height > 35 && (ours.test(backgroundColor) || ours.test(borderTopColor));
  });
  if (!red) return "";
  if (form && !form.hidden) return form.firstElementChild.innerText;
  const loading = document.querySelector("#app main .loading") ? "Loading…" : "";
  const [picture] = words("#app .cover").match(/.*missing.*/) ?? [""];
  return words("#app .failed") || picture || loading || "the page";
}"""


@dataclass
class Row:
    """A page that loses ``name`` in one way, and what became of it."""

    path: str
    name: str
    fault: str
    shows: str = ""
    stops: bool = False
    asked: int = 0  # times that the file was


@dataclass
class LosingServer(CannedServer):
    """It has, for each page, one file that is lost, as the page's cookie says."""

    rows: list[Row] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    async def _static(self, request: Request) -> Response:
        answer = await super()._static(request)
        row = self.rows[int(request.cookies["row"])]
        if request.path_params["name"] != row.name:
            return answer
        row.asked += 1
        times, share = FAULTS[row.fault]
        if row.asked > times:
            return answer
        if share == 1.0:
            return PlainTextResponse("<h1>502 Bad Gateway</h1>", 502, media_type="text/html")
        return Part(answer, share)


class Part(Response):
    """A share of another response; then the connection ends, or where it is negative nothing happens."""

    def __init__(self, whole: Response, share: float) -> None:
        super().__init__()
        self._whole, self._share = whole, share

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if self._share < 0:
            while (await receive())["type"] != "http.disconnect":
                pass
            return
        await send({"type": "http.response.start", "status": 200, "headers": self._whole.raw_headers})
        part = bytes(self._whole.body)[: int(len(self._whole.body) * self._share)]
        await send({"type": "http.response.body", "body": part, "more_body": True})
        await asyncio.sleep(0.05)  # so that it leaves before the connection ends


@pytest.fixture(scope="module")
def losing() -> Iterator[LosingServer]:
    server = LosingServer()
    server.start()
    yield server
    server.close()


def fill(browser: Browser, server: LosingServer, rows: list[Row]) -> None:
    """Open a page for each row, some at once, look at it, and press its STOP."""
    for first in range(0, len(rows), _AT_ONCE):
        with ExitStack() as stack:
            pages = [(row, _opened(browser, server, row, stack)) for row in rows[first : first + _AT_ONCE]]
            _until(pages, _STARTED_S, lambda _, shows: bool(shows))
            _until(pages, _FETCHED_S, lambda row, _: bool(row.asked))
            _until(pages, _STARTED_S, lambda row, shows: shows == "the page" or not row.fault.endswith("once"))
            pages[0][1].wait_for_timeout(1000 * _CALM_S)
            for row, page in pages:
                row.shows = page.evaluate(_SHOWS)
                row.stops = bool(row.shows) and _stops(server, page)


def _until(pages: list[tuple[Row, Page]], timeout: float, is_so: Callable[[Row, str], bool]) -> None:
    """Wait until it is so of each page, or the time is over."""
    end = time.monotonic() + timeout
    while not all(is_so(row, page.evaluate(_SHOWS)) for row, page in pages) and time.monotonic() < end:
        pages[0][1].wait_for_timeout(200)


def _opened(browser: Browser, server: LosingServer, row: Row, stack: ExitStack) -> Page:
    cookie = {"name": "row", "value": str(len(server.rows)), "url": server.url}
    server.rows.append(row)
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    stack.callback(context.close)
    context.add_cookies([cookie])  # type: ignore[list-item]
    context.add_init_script(_SOON)
    page = context.new_page()
    page.goto(server.url + row.path, wait_until="commit")
    return page


def _stops(server: LosingServer, page: Page) -> bool:
    """True if the STOP that is shown reaches the server."""
    before = len(server.sent("estop")) + len(server.posted)
    page.evaluate(_PRESS)
    return until(lambda: len(server.sent("estop")) + len(server.posted) > before, 3)


def check(browser: Browser, server: LosingServer, state: str, losses: Iterable[tuple[str, str]]) -> None:
    rows = [Row(STATES[state].path, name, fault) for name, fault in losses]
    server.show(STATES[state])
    fill(browser, server, rows)
    assert [row for row in rows if not row.stops] == []
    assert [row for row in rows if row.fault.endswith("once") and row.shows != "the page"] == []


@pytest.mark.parametrize("state", SAMPLE)
def test_a_page_that_loses_a_file_stops_robots(browser: Browser, losing: LosingServer, state: str) -> None:
    names, faults = SAMPLE[state], itertools.cycle(FAULTS)
    check(browser, losing, state, [(name, fault) for name in names for fault in itertools.islice(faults, 2)])


@pytest.mark.page
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("state", "pattern"), WHERE)
def test_a_page_that_loses_any_file_stops_robots(
    browser: Browser, losing: LosingServer, state: str, pattern: str
) -> None:
    names = [name for name in losing.static.files if re.search(pattern, name) and not name.endswith(".html")]
    check(browser, losing, state, itertools.product(names, FAULTS))


def test_its_stop_is_a_form_that_the_server_takes(browser: Browser, served: Served, robot: RecordingRobot) -> None:
    lost = {"**/main.js": lambda route: route.abort(), "**/*.*/main.js": lambda route: route.abort()}
    with served.page() as other, tab(browser, served.origin, script=_SOON, routes=lost) as opened:
        assert other.knows(robot.base)
        assert opened.until(f"({_SHOWS})() !== ''")
        opened.page.get_by_role("button", name="STOP ALL").click()
        assert opened.until(lambda: robot.latched)
        assert opened.until("document.body.innerText.includes('Confirmed by')")
        assert opened.violations == []
