"""A stage, a browser and a subscriber at the broker: what all measurements of the operator page need.

Times are seconds of time.monotonic(), also those that the page stamps. The subscriber is mosquitto's own: one in this
process would wait for its other threads at the very moment that counts. The browser is Chromium, driven by Playwright,
which comes with the extra ``dev``; it may be behind an impaired network, by the namespaces of pebble impair.
"""

from __future__ import annotations

import ctypes
import json
import os
import shlex
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pebble.bench.impair.conditions import Condition
from pebble.bench.impair.network import ROBOT_HOST as SERVER
from pebble.bench.impair.network import NamespaceNetwork, why_no_namespaces
from pebble.contract import DRIVE
from pebble.errors import PebbleError
from pebble.rig.processes import OPERATORS, Program
from pebble.rig.testbed import ROBOTS, Stage

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

Drives = list[tuple[float, str, dict[str, float]]]  # time, base topic, and axes
Test = str | Callable[[], object]  # an expression of the page, or a function

_AT_REST_S = 0.2  # motors that are off for so long have stopped
_WAIT_S, _MOVED_S = 20.0, 3.0
_PRESSES = 3
_STEP_S = 0.01
_AT_ONCE_S = 2e-5
_PORT = 8080  # of the page's server, behind an impaired network
_CLONE_NEWNET = 0x40000000

#: Of several lists the last one counts, so this has what Playwright switches off, too. The popups of the address bar
#: are pages of their own for each window: without them it opens in 0.28 s instead of 0.39 (Chromium 156, measured).
_WITHOUT = (
    "WebUIOmniboxPopup,WebUIOmniboxAimPopup,WebUIOmniboxFullPopup,OmniboxPopupWebUI,"
    "AvoidUnnecessaryBeforeUnloadCheckSync,DestroyProfileOnBrowserClose,HttpsUpgrades,LensOverlay,"
    "HttpsFirstBalancedModeAutoEnable,MediaRouter,PaintHolding,ThirdPartyStoragePartitioning,"
    "AvoidCorsURLLoaderRestartOnRedirect,OptimizationHints,NetworkTimeServiceQuerying,AimEnabled,PreconnectToSearch"
)
_AUTOPLAY = "--autoplay-policy=no-user-gesture-required"
#: Beside those of Playwright.
_FLAGS = ("--disable-gpu", "--disable-quic", _AUTOPLAY, f"--disable-features={_WITHOUT}")

#: Stamps inputs, first contents, drawn pictures and sent commands; runs before the page's own scripts.
_HOOKS = """
const now = () => performance.timeOrigin + performance.now();
window.bench = { now, down: [], up: [], pointer: [], drawn: [], sent: [], mark: 0, updates: 0, robot: 0, picture: 0 };
addEventListener("keydown", (event) => event.repeat || bench.down.push(now()), true);
addEventListener("keyup", () => bench.up.push(now()), true);
addEventListener("pointerdown", () => bench.pointer.push(now()), true);
const look = () => {
  if (!bench.robot && document.querySelector('[data-test^="card-"]')) bench.robot = performance.now();
  if (!bench.picture && window.pebble?.video?.info) bench.picture = pebble.video.drawnAt; // before what waits for it
  if (!bench.robot || !bench.picture) requestAnimationFrame(look);
};
requestAnimationFrame(look);
bench.film = () => {
  const draw = pebble.video.draw;
  pebble.video.draw = function (bitmap, info) {
    draw.call(this, bitmap, info);
    bench.drawn.push([info.encoding, info.frame, info.capturedMs, now()]); // in ms
  };
};
bench.confirmed = (refs) => {
  const before = pebble.estop.pressed;
  const done = (ref) => {
    const view = pebble.store.get(ref, "web/estop")?.value;
    const { pressed } = pebble.estop;
    return pressed !== before && view?.stop === pressed.stop && view.sending === "confirmed";
  };
  const shown = () => (bench.mark = now());
  const mark = () => requestAnimationFrame(refs.every(done) ? shown : mark);
  bench.mark = 0;
  mark();
};
const send = WebSocket.prototype.send;
WebSocket.prototype.send = function (data) {
  if (!bench.number || typeof data !== "string" || !data.includes('"op":"drive"')) return send.call(this, data);
  const op = JSON.parse(data);
  if (!op.x && !op.z) return send.call(this, data);
  op.y = (bench.number++ % 1000) / 1000; // tells the commands apart
  bench.sent.push([op.y, now()]);
  return send.call(this, JSON.stringify(op));
};
"""
_READY = """() => {
  const driver = window.pebble?.driver;
  if (!driver) return "the page does not start";
  driver.inSight = true;
  const why = driver.reason();
  if (why?.action?.kind.startsWith("take")) pebble.commands.take(true);
  return why ? why.text : "";
}"""


class Rig:
    """One stage and one browser. ``drives`` are the commands that the broker has delivered so far."""

    def __init__(self, stage: Stage, browser: Browser, drives: Drives) -> None:
        self.stage, self.ref, self.drives, self._browser = stage, stage.ref, drives, browser

    def page(self, name: str = "") -> Page:
        """A robot's page; without a name the fleet's."""
        context = self._browser.new_context(viewport={"width": 1280, "height": 800})
        context.add_init_script(_HOOKS)
        page = context.new_page()
        page.goto(self.stage.robot_url(name) if name else self.stage.url, wait_until="domcontentloaded")
        return page

    def watched(self, name: str) -> Page:
        """Its page, once it shows pictures."""
        page = self.page(name)
        self.until(page, "bench.picture", "no picture")
        return page

    def drivable(self, name: str) -> Page:
        """Its page, with the lease."""
        page = self.page(name)
        self.ready(page)
        return page

    def ready(self, page: Page) -> None:
        """Wait until the robot of that page can be driven."""
        self.until(page, lambda: page.evaluate(_READY) == "", lambda: str(page.evaluate(_READY)))

    def until(self, page: Page | None, condition: Test, what: Test, wait_s: float = _WAIT_S) -> None:
        """Wait for the condition. Raises PebbleError with ``what`` is wrong, in words."""
        end = time.monotonic() + wait_s
        while not (condition() if callable(condition) else page and page.evaluate(condition)):
            if time.monotonic() > end:
                raise PebbleError(f"waited {wait_s:.0f} s: {what() if callable(what) else what}")
            self.pause(page, _STEP_S)

    def pause(self, page: Page | None, seconds: float) -> None:
        """Wait; the page's events are handled meanwhile."""
        if page is None or page.is_closed():
            time.sleep(seconds)
        else:
            page.wait_for_timeout(1000 * seconds)

    # -- time

    def stamp(self, page: Page, name: str) -> float:
        """The newest stamp of the page in this list."""
        return monotonic(page.evaluate(f"bench.{name}.at(-1)"))

    def hold(self, page: Page, name: str, key: str) -> None:
        """Hold a key until the robot moves; press it again if the page or the server interrupts the gesture."""
        for _ in range(_PRESSES):
            page.keyboard.down(key)
            with suppress(PebbleError):
                self.moved_after(page, name, self.stamp(page, "down"))
                return
            page.keyboard.up(key)
            self.ready(page)
        raise PebbleError(f"{name} did not move")

    def moved_after(self, page: Page, name: str, since: float) -> float:
        """When its motors first ran after ``since``."""
        turned = partial(self.stage.wheels_turning, name, int(1e9 * since))
        self.until(page, turned, f"{name} did not move", _MOVED_S)
        return next(ns / 1e9 for ns, speeds in self.stage.motors(name) if ns / 1e9 > since and any(speeds))

    def stopped(self, page: Page | None, name: str) -> float:
        """When its motors stopped, once they have."""

        def at_rest() -> bool:
            return time.monotonic() - self.stage.last_motion_ns(name) / 1e9 > _AT_REST_S

        self.until(page, at_rest, f"{name} did not stop", 5.0)
        return self.stage.last_motion_ns(name) / 1e9

    def command_after(self, page: Page, name: str, since: float) -> float:
        """When the broker delivered the first command that moves it after ``since``."""

        def found() -> list[float]:
            drives = [(at, axes) for at, base, axes in self.drives if base == self.ref(name) and at > since]
            return [at for at, axes in drives if axes.get("x") or axes.get("z")]

        self.until(page, found, "no command reached the broker", 5.0)
        return found()[0]


def monotonic(page_ms: float) -> float:
    """A stamp of another process on this machine: epoch milliseconds, as time.monotonic()."""
    while True:
        before, wall, after = time.monotonic(), time.time(), time.monotonic()
        if after - before < _AT_ONCE_S:  # else this thread stood still in between
            return page_ms / 1000 - wall + (before + after) / 2


@contextmanager
def rig(*names: str, program: str | None = None, flags: tuple[str, ...] = (), **settings: Any) -> Iterator[Rig]:
    """Start everything; ``settings`` are of the stage and of the page's server. Raises PebbleError."""
    with (
        Stage(*(names or ROBOTS), **settings) as stage,
        chromium(*flags, program=program) as browser,
        _drives(stage) as drives,
    ):
        yield Rig(stage, browser, drives)


@contextmanager
def _drives(stage: Stage) -> Iterator[Drives]:
    """The commands that the broker delivers; received on a thread."""
    program = shutil.which("mosquitto_sub")
    if program is None:
        raise PebbleError("mosquitto_sub is missing: apt install mosquitto-clients")
    options = ["-h", "127.0.0.1", "-p", str(stage.broker_port), "-t", DRIVE.filter("+/+/+"), "-F", "%U %t %p"]
    received: Drives = []

    def receive(line: bytes) -> None:
        at, topic, axes = line.split(b" ", 2)
        base = topic.decode().removesuffix(f"/{DRIVE.suffix}")
        received.append((monotonic(1000 * float(at)), base, json.loads(axes)))

    log = stage.folder / "subscriber.log"
    subscriber = stage.add(Program("mosquitto_sub", [program, *options], log, each=receive), OPERATORS)
    yield received
    if subscriber.ended or not subscriber.is_read:
        raise PebbleError("mosquitto_sub has ended: what it should have received is missing")


# -- the browser


def missing() -> str | None:
    """What to do before a page can be opened; None: nothing."""
    if shutil.which("chromium") is None:
        return "no Chromium: apt install chromium"
    return None if find_spec("playwright") else "no Playwright: pip install 'pebble-robot[dev]'"


@contextmanager
def chromium(*flags: str, program: str | None = None) -> Iterator[Browser]:
    """Run one with further ``flags``; ``program`` starts it in another way. Raises PebbleError with what to install."""
    if problem := missing():
        raise PebbleError(problem)
    from playwright.sync_api import sync_playwright  # optional

    with sync_playwright() as playwright:
        path = program or shutil.which("chromium")
        with closing(playwright.chromium.launch(executable_path=path, args=[*_FLAGS, *flags])) as browser:
            yield browser


# -- the browser behind an impaired network


@contextmanager
def linked(condition: Condition, *names: str, flags: tuple[str, ...] = ()) -> Iterator[Rig]:
    """Everything but the browser, which has further ``flags``, is on the robot's side of the network.

    Needs root. Raises PebbleError.
    """
    if problem := why_no_namespaces():
        raise PebbleError(f"no network namespaces: {problem}")
    secure = f"--unsafely-treat-insecure-origin-as-secure=http://{SERVER}:{_PORT}"  # as https would be
    with NamespaceNetwork() as network, tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "chromium"
        program.write_text(f'#!/bin/sh\nexec {shlex.join(network.on_remote(["chromium"]))} "$@"\n')
        program.chmod(0o700)
        with (
            _inside(network.on_robot(())[1].removeprefix("--net=")),
            rig(*names, program=str(program), flags=(secure, *flags), host=SERVER, port=_PORT) as made,
        ):
            network.apply(condition)
            yield made


@contextmanager
def _inside(namespace: str) -> Iterator[None]:
    """This thread, and all that it starts, use that network."""
    libc = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/thread-self/ns/net").open() as own, Path(namespace).open() as other:
        if libc.setns(other.fileno(), _CLONE_NEWNET):
            raise PebbleError(f"the network namespace cannot be entered: {os.strerror(ctypes.get_errno())}")
        try:
            yield
        finally:
            libc.setns(own.fileno(), _CLONE_NEWNET)
