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
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pebble.bench.impair.conditions import Condition
from pebble.bench.impair.network import CLONE_NEWNET, NamespaceNetwork, require_namespaces
from pebble.bench.impair.network import ROBOT_HOST as SERVER
from pebble.bench.usage import wall_clock_ahead_ns
from pebble.contract import DRIVE
from pebble.errors import PebbleError
from pebble.rig.processes import OPERATORS, Program
from pebble.rig.testbed import ROBOTS, Stage

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

Drives = list[tuple[float, dict[str, float]]]  # time and axes
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

#: Stamps inputs, first contents, drawn pictures and sent commands; runs before the page's own scripts.
_HOOKS = """
const now = () => performance.timeOrigin + performance.now();
window.bench = { now, drawn: [], sent: [], updates: 0 };
for (const input of ["keydown", "keyup", "pointerdown"])
  addEventListener(input, (event) => event.repeat || (bench[input] = now()), true);
const look = () => {
  bench.robot ||= document.querySelector('[data-test^="card-"]') && performance.now();
  bench.picture ||= window.pebble?.video?.info && pebble.video.drawnAt; // before what waits for it
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
bench.stop = (ref) => pebble.store.get(ref, "web/estop")?.value;
bench.confirmed = (refs, before = pebble.estop.pressed) => {
  const confirmed = (view) => view?.stop === pebble.estop.pressed.stop && view.sending === "confirmed";
  const done = () => pebble.estop.pressed !== before && refs.every((ref) => confirmed(bench.stop(ref)));
  const mark = () => requestAnimationFrame(done() ? () => (bench.mark = now()) : mark);
  bench.mark = 0;
  mark();
};
const send = WebSocket.prototype.send;
WebSocket.prototype.send = function (data) {
  const op = bench.number && String(data).includes('"op":"drive"') ? JSON.parse(data) : {};
  if (!op.x && !op.z) return send.call(this, data);
  op.y = (bench.number++ % 1000) / 1000; // tells the commands apart
  bench.sent.push([op.y, now()]);
  return send.call(this, JSON.stringify(op));
};
"""
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
    """One stage and one browser. ``drives`` are the commands to the robot that the broker has delivered so far."""

    def __init__(self, stage: Stage, browser: Browser, drives: Drives) -> None:
        self.stage, self.ref, self.drives, self._browser = stage, stage.ref, drives, browser

    def page(self, name: str = "") -> Page:
        """A robot's page; without a name the fleet's."""
        context = self._browser.new_context(viewport={"width": 1280, "height": 800})
        context.add_init_script(_HOOKS)
        page = context.new_page()
        page.goto(self.stage.robot_url(name) if name else self.stage.url, wait_until="domcontentloaded")
        return page

    def pause(self, page: Page | None, seconds: float) -> None:
        """Wait; the page's events are handled meanwhile."""
        if page is None:
            time.sleep(seconds)
        else:
            page.wait_for_timeout(1000 * seconds)

    def until(self, page: Page | None, condition: Test, what: Test, wait_s: float = _WAIT_S) -> Any:
        """The condition's first true value. Raises PebbleError with ``what`` is wrong, in words."""
        end = time.monotonic() + wait_s
        while not (found := condition() if callable(condition) else page and page.evaluate(condition)):
            if time.monotonic() > end:
                raise PebbleError(f"waited {wait_s:.0f} s: {what() if callable(what) else what}")
            self.pause(page, _STEP_S)
        return found

    def ready(self, page: Page) -> None:
        """Wait until the robot of that page can be driven."""
        self.until(page, lambda: not page.evaluate(_REASON), lambda: page.evaluate(_REASON))

    def hold(self, page: Page, key: str = KEY) -> None:
        """Hold a key until the robot drives; press it again if the page or the server interrupts the gesture."""
        for _ in range(_PRESSES):
            page.keyboard.up(key)
            self.ready(page)
            page.keyboard.down(key)
            with suppress(PebbleError):
                self.moved_after(page, self.stamp(page, "keydown"))
                self.pause(page, HELD_S)
                if self.stage.wheels_turning(ROBOT):
                    return
        raise PebbleError(f"{ROBOT} did not move")

    # -- when something happened

    def stamp(self, page: Page, event: str) -> float:
        """The newest input of this kind."""
        return monotonic(page.evaluate(f"bench.{event}"))

    def command_after(self, page: Page, since: float) -> float:
        """When the broker delivered the first command that moves the robot after ``since``."""

        def found() -> list[float]:
            return [at for at, axes in self.drives if at > since and (axes.get("x") or axes.get("z"))]

        return float(self.until(page, found, "no command reached the broker", _STOPPED_S)[0])

    def moved_after(self, page: Page, since: float) -> float:
        """When the robot's motors first ran after ``since``."""

        def found() -> list[float]:
            return [ns / 1e9 for ns, speeds in self.stage.motors(ROBOT) if ns / 1e9 > since and any(speeds)]

        return float(self.until(page, found, f"{ROBOT} did not move", _MOVED_S)[0])

    def stopped(self, page: Page | None, name: str = ROBOT) -> float:
        """When a robot's motors stopped, once they have."""

        def at_rest() -> float:
            last = self.stage.last_motion_ns(name) / 1e9
            return last if time.monotonic() - last > _AT_REST_S else 0.0

        return float(self.until(page, at_rest, f"{name} did not stop", _STOPPED_S))


def monotonic(page_ms: float) -> float:
    """A stamp of another process on this machine: epoch milliseconds, as time.monotonic()."""
    return page_ms / 1000 - wall_clock_ahead_ns() / 1e9


@contextmanager
def rig(*names: str, program: str | None = None, flags: tuple[str, ...] = (), **settings: Any) -> Iterator[Rig]:
    """Start everything; ``settings`` are of the stage and of the page's server. Raises PebbleError."""
    if shutil.which("mosquitto_sub") is None:
        raise PebbleError("mosquitto_sub is missing: apt install mosquitto-clients")
    drives: Drives = []

    def receive(line: bytes) -> None:
        at, axes = line.split(b" ", 1)
        drives.append((monotonic(1000 * float(at)), json.loads(axes)))

    with Stage(*(names or ROBOTS), **settings) as stage, chromium(*flags, program=program) as browser:
        options = ["-h", "127.0.0.1", "-p", str(stage.broker_port), "-t", DRIVE.topic(stage.ref(ROBOT)), "-F", "%U %p"]
        log = stage.folder / "subscriber.log"
        subscriber = stage.add(Program("subscriber", ["mosquitto_sub", *options], log, each=receive), OPERATORS)
        yield Rig(stage, browser, drives)
        if subscriber.ended or not subscriber.is_read:
            raise PebbleError("mosquitto_sub has ended: what it should have received is missing")


# -- the browser


def missing() -> str | None:
    """What to do before a page can be opened; None: nothing."""
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
