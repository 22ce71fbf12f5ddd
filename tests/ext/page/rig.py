"""A stage with the operator page in a headless Chromium, which may be behind an impaired network.

Playwright drives the browser; it comes with the extra ``dev``. Times are seconds of time.monotonic().
"""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.impair.conditions import Condition
from pebble.extensions.lab.bench.impair.network import CLONE_NEWNET, NamespaceNetwork, require_namespaces
from pebble.extensions.lab.bench.impair.network import ROBOT_HOST as SERVER
from pebble.extensions.lab.rig.testbed import ROBOTS
from tests.ext.page.stage import Stage

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

Test = str | Callable[[], Any]  # an expression of the page, or a function

ROBOT, KEY = "goob", "KeyW"  # that are driven, by default
HELD_S = 0.4  # a robot is driven for so long before something happens
_AT_REST_S = 0.2  # motors that are off for so long have stopped
_WAIT_S, _MOVED_S, _STOPPED_S = 20.0, 3.0, 5.0
_PRESSES = 3
_STEP_S = 0.01
_PORT = 8080  # of the page's server, behind an impaired network

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

#: Empty when the robot of the page can be driven, else why it cannot.
_REASON = """() => {
  const driver = window.pebble?.driver;
  if (!driver) return "the page does not start";
  driver.inSight = true;
  const why = driver.reason();
  if (why?.action?.kind.startsWith("take")) pebble.commands.take(true);
  return why ? why.text : "";
}"""


class Rig:
    """One stage and one browser."""

    def __init__(self, stage: Stage, browser: Browser) -> None:
        self.stage, self._browser = stage, browser

    def page(self, name: str = "") -> Page:
        """Open a robot's page; without a name the fleet's."""
        page = self._browser.new_context(viewport={"width": 1280, "height": 800}).new_page()
        page.goto(self.stage.robot_url(name) if name else self.stage.url, wait_until="domcontentloaded")
        return page

    def pause(self, page: Page, seconds: float) -> None:
        """Wait; the page's events are handled meanwhile."""
        page.wait_for_timeout(1000 * seconds)

    def until(self, page: Page, condition: Test, what: Test, wait_s: float = _WAIT_S) -> None:
        """Wait until the condition is true. Raises PebbleError with ``what`` is wrong, in words."""
        end = time.monotonic() + wait_s
        while not (condition() if callable(condition) else page.evaluate(condition)):
            if time.monotonic() > end:
                raise PebbleError(f"waited {wait_s:.0f} s: {what() if callable(what) else what}")
            self.pause(page, _STEP_S)

    def ready(self, page: Page) -> None:
        """Wait until the robot of that page can be driven."""
        self.until(page, lambda: not page.evaluate(_REASON), lambda: page.evaluate(_REASON))

    def hold(self, page: Page, key: str = KEY) -> None:
        """Hold a key until the robot drives; press it again if the page or the server interrupts the gesture."""
        for _ in range(_PRESSES):
            page.keyboard.up(key)
            self.ready(page)
            pressed = time.monotonic()
            page.keyboard.down(key)
            with suppress(PebbleError):
                self.until(page, lambda since=pressed: self._moved_since(since), f"{ROBOT} did not move", _MOVED_S)
                self.pause(page, HELD_S)
                if self.stage.wheels_turning(ROBOT):
                    return
        raise PebbleError(f"{ROBOT} did not move")

    def stopped(self, page: Page, name: str = ROBOT) -> None:
        """Wait until a robot's motors have stopped."""

        def at_rest() -> bool:
            return time.monotonic() - self.stage.last_motion_ns(name) / 1e9 > _AT_REST_S

        self.until(page, at_rest, f"{name} did not stop", _STOPPED_S)

    def _moved_since(self, since: float) -> bool:
        """True if the robot's motors have begun to run since then."""
        return any(ns / 1e9 > since and any(speeds) for ns, speeds in self.stage.motors(ROBOT))


@contextmanager
def rig(*names: str, program: str | None = None, flags: tuple[str, ...] = (), **settings: Any) -> Iterator[Rig]:
    """Start everything; ``settings`` are of the stage and of the page's server. Raises PebbleError."""
    with Stage(*(names or ROBOTS), **settings) as stage, chromium(*flags, program=program) as browser:
        yield Rig(stage, browser)


# -- the browser


def missing() -> str | None:
    """Return what to install before a page can be opened; None: nothing."""
    if shutil.which("chromium") is None:
        return "no Chromium: apt install chromium"
    return None if find_spec("playwright") else "no Playwright: pip install 'pebble-robot[dev]'"


@contextmanager
def chromium(*flags: str, program: str | None = None, beside: Browser | None = None) -> Iterator[Browser]:
    """Run one with further ``flags``; ``program`` starts it in another way. Raises PebbleError with what to install.

    ``beside`` is one that runs already: a thread has one Playwright.
    """
    if problem := missing():
        raise PebbleError(problem)
    from playwright.sync_api import Error, sync_playwright  # optional

    with ExitStack() as stack:
        kind = stack.enter_context(sync_playwright()).chromium if beside is None else beside.browser_type
        path = program or shutil.which("chromium")
        try:
            with closing(kind.launch(executable_path=path, args=[*_FLAGS, *flags])) as browser:
                yield browser
        except Error as error:
            raise PebbleError(f"the browser: {error.message.splitlines()[0]}") from error


# -- the browser behind an impaired network


@contextmanager
def linked(condition: Condition, *names: str, flags: tuple[str, ...] = ()) -> Iterator[Rig]:
    """Everything but the browser, which has further ``flags``, is on the robot's side of the network.

    So is this thread meanwhile. Needs root. Raises PebbleError.
    """
    require_namespaces()
    secure = f"--unsafely-treat-insecure-origin-as-secure=http://{SERVER}:{_PORT}"  # as https would be
    libc = ctypes.CDLL(None, use_errno=True)
    with closing(NamespaceNetwork()) as network, tempfile.TemporaryDirectory() as folder:
        program, robot_side = Path(folder) / "chromium", network.on_robot(())[1].removeprefix("--net=")
        program.write_text(f'#!/bin/sh\nexec {shlex.join(network.on_remote(["chromium"]))} "$@"\n')
        program.chmod(0o700)
        with Path("/proc/thread-self/ns/net").open() as own, Path(robot_side).open() as robots:
            if libc.setns(robots.fileno(), CLONE_NEWNET):
                raise PebbleError(f"the network namespace cannot be entered: {os.strerror(ctypes.get_errno())}")
            try:
                with rig(*names, program=str(program), flags=(secure, *flags), host=SERVER, port=_PORT) as made:
                    network.apply(condition)
                    yield made
            finally:
                libc.setns(own.fileno(), CLONE_NEWNET)
