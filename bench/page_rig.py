"""A stage, a browser and subscribers at the broker: what all measurements of the operator page need.

Times are seconds of time.monotonic(), also those that the page stamps. The subscribers are mosquitto's own: one in this
process would wait for its other threads at the very moment that counts.
"""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import IO, TYPE_CHECKING, Any

from pebble.bench.chromium import chromium
from pebble.contract import CAMERA, DRIVE
from pebble.contract.channels import Channel
from pebble.errors import PebbleError
from pebble.rig.processes import OPERATORS
from pebble.rig.programs import Program
from pebble.rig.stage import Stage
from pebble.rig.testbed import ROBOTS

if TYPE_CHECKING:
    from playwright.sync_api import Page

AT_REST_S = 0.2  # motors that are off for so long have stopped
_WAIT_S, _MOVED_S = 20.0, 3.0
_PRESSES = 3
_STEP_MS = 10
_AT_ONCE_S = 2e-5

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
    bench.drawn.push([info.encoding, info.frame, info.capturedMs, now(), info.rescue]);
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
    """One stage and one browser. ``drives`` and ``frames`` are what the broker has delivered, with its time."""

    def __init__(self, stage: Stage, open_page: Callable[[], Page]) -> None:
        self.stage = stage
        self.drives: list[tuple[float, str, dict[str, Any]]] = []  # time, base topic, command
        self.frames: list[tuple[float, str, int]] = []  # time, base topic, bytes
        self._open_page = open_page

    def ref(self, name: str) -> str:
        return self.stage.ref(name)

    def fleet(self) -> Page:
        return self._goto(self.stage.url)

    def page(self, name: str) -> Page:
        return self._goto(self.stage.robot_url(name))

    def drivable(self, name: str) -> Page:
        """Its page, with the lease."""
        page = self.page(name)
        self.ready(page)
        return page

    def ready(self, page: Page) -> None:
        """Wait until the robot of that page can be driven."""
        self.until(page, lambda: page.evaluate(_READY) == "", lambda: str(page.evaluate(_READY)))

    def until(
        self, page: Page | None, condition: Callable[[], object], what: Callable[[], str] | str, wait_s: float = _WAIT_S
    ) -> None:
        """Wait for the condition. Raises PebbleError with ``what`` is wrong."""
        end = time.monotonic() + wait_s
        while not condition():
            if time.monotonic() > end:
                raise PebbleError(f"waited {wait_s:.0f} s: {what() if callable(what) else what}")
            self.pause(page, _STEP_MS / 1000)

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
        for attempt in range(_PRESSES):
            page.keyboard.down(key)
            try:
                self.moved_after(page, name, self.stamp(page, "down"), _MOVED_S)
            except PebbleError:
                page.keyboard.up(key)
                self.ready(page)
                if attempt == _PRESSES - 1:
                    raise
            else:
                return

    def moved_after(self, page: Page, name: str, since: float, wait_s: float = _MOVED_S) -> float:
        """When its motors first ran after ``since``."""

        def why() -> str:
            return f"{name} did not move: {page.evaluate('pebble.driver.reason()?.text') or 'no reason'}"

        self.until(page, lambda: self.stage.wheels_turning(name, int(1e9 * since)), why, wait_s)
        return next(ns / 1e9 for ns, speeds in self.stage.motors(name) if ns / 1e9 > since and any(speeds))

    def stopped(self, page: Page | None, name: str) -> float:
        """When its motors stopped, once they have."""

        def at_rest() -> bool:
            return time.monotonic() - self.stage.last_motion_ns(name) / 1e9 > AT_REST_S

        self.until(page, at_rest, f"{name} did not stop", 5.0)
        return self.stage.last_motion_ns(name) / 1e9

    def command_after(self, page: Page, name: str, since: float) -> float:
        """When the broker delivered the first command that moves it after ``since``."""

        def found() -> list[float]:
            return [at for at, ref, axes in self.drives if ref == self.ref(name) and at > since and _moves(axes)]

        self.until(page, found, "no command reached the broker", 5.0)
        return found()[0]

    def _goto(self, url: str) -> Page:
        page = self._open_page()
        page.goto(url, wait_until="domcontentloaded")
        return page

    # -- threads that read what was received

    def receive_drives(self, lines: IO[bytes]) -> None:
        for at, topic, payload in _received(lines):
            self.drives.append((at, topic.removesuffix(f"/{DRIVE.suffix}"), json.loads(payload)))

    def receive_frames(self, lines: IO[bytes]) -> None:
        for at, topic, size in _received(lines):
            self.frames.append((at, topic.removesuffix(f"/{CAMERA.suffix}"), int(size)))


def _received(lines: IO[bytes]) -> Iterator[tuple[float, str, bytes]]:
    for line in lines:
        at, topic, rest = line.split(b" ", 2)
        yield monotonic(1000 * float(at)), topic.decode(), rest


def _moves(axes: dict[str, Any]) -> bool:
    return bool(axes.get("x") or axes.get("z"))


def monotonic(page_ms: float) -> float:
    """A stamp of another process on this machine: epoch milliseconds, as time.monotonic()."""
    while True:
        before, wall, after = time.monotonic(), time.time(), time.monotonic()
        if after - before < _AT_ONCE_S:  # else this thread stood still in between
            return page_ms / 1000 - wall + (before + after) / 2


@contextmanager
def rig(*names: str, program: str | None = None, flags: tuple[str, ...] = (), **settings: Any) -> Iterator[Rig]:
    """Start everything; ``settings`` are of the page's server. Raises PebbleError."""
    with ExitStack() as stack:
        stage = stack.enter_context(Stage(*(names or ROBOTS), **settings))
        browser = stack.enter_context(chromium(*flags, program=program))

        def open_page() -> Page:
            context = browser.new_context(viewport={"width": 1280, "height": 800})
            context.add_init_script(_HOOKS)
            return context.new_page()

        made = Rig(stage, open_page)
        stack.enter_context(_subscribed(stage, DRIVE, "%U %t %p", made.receive_drives))
        stack.enter_context(_subscribed(stage, CAMERA, "%U %t %l", made.receive_frames))
        yield made


@contextmanager
def _subscribed(stage: Stage, channel: Channel, line: str, receive: Callable[[IO[bytes]], None]) -> Iterator[None]:
    """``receive`` reads a line for each message, on a thread; ``line`` is mosquitto_sub's format."""
    program = shutil.which("mosquitto_sub")
    if program is None:
        raise PebbleError("mosquitto_sub is missing: apt install mosquitto-clients")
    command = [program, "-h", "127.0.0.1", "-p", str(stage.broker_port), "-t", channel.filter("+/+/+"), "-F", line]
    subscriber = stage.add(Program("mosquitto_sub", command, stage.folder / "subscriber.log", reports=True), OPERATORS)
    reader = threading.Thread(target=receive, args=(subscriber.reports,), name="subscriber", daemon=True)
    reader.start()
    yield
    if subscriber.ended or not reader.is_alive():
        raise PebbleError("mosquitto_sub has ended: what it should have received is missing")
