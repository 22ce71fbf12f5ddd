"""Pages in Debian's Chromium, in the sizes and themes that people use, and everything they complain of.

Playwright's own waiting for an expression is stopped by the page's policy (CSP): use :meth:`Tab.until`.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest
from playwright.sync_api import Browser, BrowserContext, CDPSession, Error, Locator, Page, Route, sync_playwright

from tests.support import WAIT_S

Size = Literal["desktop", "phone", "landscape", "small"]
Theme = Literal["light", "dark"]

SIZES: dict[Size, tuple[int, int]] = {
    "desktop": (1280, 800),
    "phone": (390, 844),
    "landscape": (844, 390),
    "small": (320, 640),
}
_OPEN_S = 40.0
_COVERS = (
    ".tabs button:visible, [data-test=gear][aria-expanded=false]:visible, details.folded:not([open]) > summary:visible"
)
_LOOK_MS = 20  # between two looks: each costs three programs a millisecond
_VIOLATIONS = """addEventListener("securitypolicyviolation", (event) =>
  pebbleViolation(`${event.violatedDirective} ${event.blockedURI}`))"""
#: As if a viewer had opened the cards for engineers, and all plots: most tests look at one of them.
_ENGINEERS = """try {
  const key = `pebble cards ${decodeURIComponent(location.pathname.split("/r/")[1])}`;
  const opened = ["services", "mcus", "logs", "values", "system"];
  localStorage.setItem("pebble plots all", "true");
  if (!localStorage.getItem(key)) localStorage.setItem(key, JSON.stringify({ opened }));
} catch {}"""
_HIDE = """(hidden) => {
  Object.defineProperty(document, "hidden", { configurable: true, get: () => hidden });
  const state = hidden ? "hidden" : "visible";
  Object.defineProperty(document, "visibilityState", { configurable: true, get: () => state });
  document.dispatchEvent(new Event("visibilitychange"));
}"""


#: Of several lists the last one counts, so this has what Playwright switches off, too. The popups of the address bar
#: are pages of their own for each window: without them it opens in 0.28 s instead of 0.39 (Chromium 156, measured).
_WITHOUT = (
    "WebUIOmniboxPopup,WebUIOmniboxAimPopup,WebUIOmniboxFullPopup,OmniboxPopupWebUI,"
    "AvoidUnnecessaryBeforeUnloadCheckSync,DestroyProfileOnBrowserClose,HttpsUpgrades,LensOverlay,"
    "HttpsFirstBalancedModeAutoEnable,MediaRouter,PaintHolding,ThirdPartyStoragePartitioning,"
    "AvoidCorsURLLoaderRestartOnRedirect,OptimizationHints,NetworkTimeServiceQuerying,AimEnabled,PreconnectToSearch"
)
#: Beside those of Playwright.
_FLAGS = (
    "--disable-gpu", "--disable-quic", "--autoplay-policy=no-user-gesture-required", f"--disable-features={_WITHOUT}",
)  # fmt: skip


@contextmanager
def chromium(*flags: str) -> Iterator[Browser]:
    """Run a headless browser with further ``flags``.

    Skips the test without a Chromium, except where CI says it must be there.
    """
    program = shutil.which("chromium")
    if program is None:
        reason = "no Chromium: apt install chromium, or `sh tools/debian-packages.sh chromium=chromium`"
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(reason)
    args = [*_FLAGS, *flags]
    with sync_playwright() as all_, closing(all_.chromium.launch(executable_path=program, args=args)) as browser:
        yield browser


@dataclass
class Tab:
    """One open page, and what it complained of."""

    context: BrowserContext
    page: Page
    console: list[str] = field(default_factory=list)  # "type: text"
    errors: list[str] = field(default_factory=list)  # exceptions that nothing caught
    violations: list[str] = field(default_factory=list)  # of the content security policy
    _debugger: CDPSession | None = None

    def until(self, condition: Callable[[], object] | str, timeout: float = WAIT_S) -> bool:
        """Wait until ``condition()``, or a JavaScript expression, is true; assert on the result."""
        end = time.monotonic() + timeout
        while not (self.page.evaluate(condition) if isinstance(condition, str) else condition()):
            if time.monotonic() > end:
                return False
            self.page.wait_for_timeout(_LOOK_MS)  # not time.sleep: Playwright handles events meanwhile
        return True

    def uncover(self, name: str, within: float = WAIT_S) -> Locator:
        """The control of this name, once it is shown; it may be behind a tab of a phone, or folded."""
        found, end = self.page.locator(f'[data-test="{name}"]:visible'), time.monotonic() + within
        while time.monotonic() < end:
            for cover in (None, *self.page.locator(_COVERS).element_handles()):
                with suppress(Error):  # the one before has taken it away
                    if cover is not None:
                        cover.click(timeout=2000)
                if self.until(lambda: found.count(), 0.3):
                    return found
        raise AssertionError(f"the page shows no {name}")

    def test(self, name: str) -> Any:
        """The locator of the elements with this ``data-test``."""
        return self.page.locator(f'[data-test="{name}"]')

    def cdp(self) -> CDPSession:
        """Chromium's own protocol for this page."""
        return self.context.new_cdp_session(self.page)

    def freeze(self) -> None:
        """Its script stands still until ``thaw``, as in a tab that the system suspends.

        Page.setWebLifecycleState has no effect on the pages of Chromium 156: they are always visible.
        """
        self._debugger = self.cdp()
        self._debugger.send("Debugger.enable")
        self._debugger.send("Debugger.pause")

    def thaw(self) -> None:
        if self._debugger is not None:
            self._debugger.detach()
        self._debugger = None

    def hide(self, *, hidden: bool = True) -> None:
        """Hides the page as if another tab were in front: Playwright's pages are always visible."""
        self.page.evaluate(_HIDE, hidden)

    def blur(self) -> None:
        """Takes the focus away as if another window had it; Playwright's pages keep it."""
        self.page.evaluate("() => dispatchEvent(new Event('blur'))")

    def complaints(self) -> list[str]:
        """Errors and warnings of any kind; a good test ends with none."""
        bad = [line for line in self.console if line.startswith(("error", "warning"))]
        return [*self.errors, *self.violations, *bad]


@contextmanager
def tab(
    browser: Browser,
    url: str,
    size: Size = "desktop",
    theme: Theme = "light",
    *,
    script: str = "",
    engineers: bool = True,
    here: Literal["commit", "domcontentloaded"] = "domcontentloaded",
    routes: Mapping[Any, Callable[[Route], object]] | None = None,
    **options: Any,
) -> Iterator[Tab]:
    """Open ``url`` in a context of its own; ``script`` runs before the page's; ``options`` are those of a context.

    ``engineers``: the cards for engineers are open, and all plots are shown. ``here``: until when it waits for the
    page. ``routes`` answer requests instead of the server, by what their addresses match.
    """
    width, height = SIZES[size]
    touch = size != "desktop"
    usual = {"viewport": {"width": width, "height": height}, "has_touch": touch, "is_mobile": touch}
    context = browser.new_context(**{**usual, "color_scheme": theme, **options})
    try:
        for pattern, answer in (routes or {}).items():
            context.route(pattern, answer)
        opened = _prepared(context, (_ENGINEERS if engineers else "") + script)
        opened.page.goto(url, timeout=1000 * _OPEN_S, wait_until=here)
        yield opened
    finally:
        context.close()


def _prepared(context: BrowserContext, script: str) -> Tab:
    page = context.new_page()
    opened = Tab(context, page)
    page.on("console", lambda message: opened.console.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: opened.errors.append(str(error)))
    page.expose_function("pebbleViolation", lambda text: opened.violations.append(text))
    for one in (_VIOLATIONS, script):
        page.add_init_script(one or ";")
    return opened
