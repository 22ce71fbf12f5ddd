"""What is measured of the operator page: each case takes a rig and returns samples, by the key of their row."""

from __future__ import annotations

import gzip
import os
import signal
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urldefrag, urlsplit

from pebble.bench.drivers import Driver
from pebble.bench.page_rig import Rig, monotonic
from pebble.bench.usage import cpu_s
from pebble.contract.encodings import ALL_VIDEO
from pebble.errors import PebbleError
from pebble.rig.programs import children
from pebble.rig.testbed import ROBOTS

if TYPE_CHECKING:
    from playwright.sync_api import Page

Samples = dict[str, list[float]]

KEY, ROBOT = "KeyW", "goob"
VIEWERS, ROBOTS_SHOWN = 30, 100
_HELD_S = 0.4
_COUNT_S = 40.0  # for processes of viewers to answer, beyond their time
_LATER_S = 5.0  # the page has fetched its other screens by then
_REST_S = 8.0  # after the last viewer: the server lets go after 5, the camera rests then
_HIDE = """hidden => {
  Object.defineProperty(document, "hidden", { configurable: true, get: () => hidden });
  const at = bench.now();
  document.dispatchEvent(new Event("visibilitychange"));
  return at;
}"""
_BLUR = "() => { const at = bench.now(); dispatchEvent(new Event('blur')); return at; }"


def keys(rig: Rig, scale: float) -> Samples:
    """A key is pressed and released again and again."""
    page = rig.drivable(ROBOT)
    found: Samples = {"key to MQTT": [], "key to motors": [], "release to stop": []}
    for number in range(round(40 * scale)):
        page.keyboard.down(KEY)
        pressed = rig.stamp(page, "down")
        moved = rig.moved_after(page, ROBOT, pressed)
        found["key to MQTT"].append(1000 * (rig.command_after(page, ROBOT, pressed) - pressed))
        found["key to motors"].append(1000 * (moved - pressed))
        rig.pause(page, 0.15 + 0.007 * (number % 10))  # not in step with the page's own period
        page.keyboard.up(KEY)
        released = rig.stamp(page, "up")
        found["release to stop"].append(1000 * (rig.stopped(page, ROBOT) - released))
    return found


def interruptions(rig: Rig, scale: float) -> Samples:
    """A key is held, and something happens to the page, the connection or the server."""
    thaw: list[Callable[[], object]] = []

    def frozen(page: Page) -> float:
        """Its script stands still; Page.setWebLifecycleState has no effect on visible pages, as all here are."""
        session = page.context.new_cdp_session(page)
        session.send("Debugger.enable")
        at = time.monotonic()
        session.send("Debugger.pause")
        thaw.append(session.detach)
        return at

    def closed(page: Page) -> float:
        at = time.monotonic()
        page.close()
        return at

    def stalled(_page: Page) -> float:
        """The browser's process for the network stands still."""
        return _signal(_network_process(), signal.SIGSTOP)

    actions: dict[str, Callable[[Page], float]] = {
        "blur to stop": lambda page: monotonic(page.evaluate(_BLUR)),
        "hidden to stop": lambda page: monotonic(page.evaluate(_HIDE, True)),
        "frozen to stop": frozen,
        "closed to stop": closed,
        "stalled to stop": stalled,
        "server frozen to stop": lambda _: _signal(rig.stage.server.pid, signal.SIGSTOP),
        "server killed to stop": lambda _: _signal(rig.stage.server.pid, signal.SIGKILL),
    }
    found: Samples = {name: [] for name in actions}
    for name, act in actions.items():
        for _ in range(max(1, round(8 * scale))):
            page = rig.drivable(ROBOT)
            while not rig.stage.wheels_turning(ROBOT):  # a busy machine interrupts gestures, too
                page.keyboard.up(KEY)
                rig.hold(page, ROBOT, KEY)
                rig.pause(page, _HELD_S)
            at = act(page)
            found[name].append(1000 * (rig.stopped(None, ROBOT) - at))
            while thaw:
                thaw.pop()()
            _recover(rig, page)
    return found


def _signal(pid: int, number: signal.Signals) -> float:
    at = time.monotonic()
    os.kill(pid, number)
    return at


def _recover(rig: Rig, page: Page) -> None:
    _signal(_network_process(), signal.SIGCONT)
    if rig.stage.server.ended or _is_stopped(rig.stage.server.pid):
        rig.stage.server.thaw()
        rig.stage.restart_server()
    if not page.is_closed():
        page.context.close()


def _is_stopped(pid: int) -> bool:
    """Whether SIGSTOP holds it."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"


def _network_process() -> int:
    """The process of our browser that has its connections."""
    waiting = [os.getpid()]
    while waiting:
        pid = waiting.pop()
        if b"network.mojom.NetworkService" in Path(f"/proc/{pid}/cmdline").read_bytes():
            return pid
        waiting += children(pid)
    raise PebbleError("the browser has no process for its network")


def stops(rig: Rig, scale: float) -> Samples:
    """STOP is clicked while other operators drive."""
    found: Samples = {}
    driver = driven_by_others(rig)
    for what, names, button in (("STOP", (ROBOT,), "stop-one"), ("STOP ALL", ROBOTS, "stop-all")):
        page = rig.page(ROBOT) if what == "STOP" else rig.fleet()
        stop, shown = found.setdefault(f"{what} to motors", []), found.setdefault(f"{what} to confirmed", [])
        refs = [rig.ref(name) for name in names]
        page.locator(f"[data-test={button}]").wait_for()
        for _ in range(max(1, round(10 * scale))):
            driver.choose(tuple(refs))
            rig.until(page, lambda: all(map(rig.stage.wheels_turning, names)), "the robots do not move")  # noqa: B023
            rig.pause(page, _HELD_S)
            page.evaluate("refs => bench.confirmed(refs)", refs)
            page.locator(f"[data-test={button}]").click()
            pressed = rig.stamp(page, "pointer")
            rig.until(page, lambda: page.evaluate("bench.mark"), "the stop was not confirmed")  # noqa: B023
            stop += [1000 * (rig.stopped(page, name) - pressed) for name in names]
            shown.append(1000 * (monotonic(page.evaluate("bench.mark")) - pressed))
            driver.choose(())
            reset(rig, page, refs)
        page.context.close()
    driver.close()
    return found


def driven_by_others(rig: Rig) -> Driver:
    """Another operator, who drives whichever robots are chosen."""
    driver = Driver(rig.stage.broker_port)
    threading.Thread(target=driver.run, name="another operator", daemon=True).start()
    return driver


def reset(rig: Rig, page: Page, refs: list[str]) -> None:
    """End the stops that the page shows."""
    value = "pebble.store.get(ref, 'web/estop')?.value"
    rig.pause(page, 0.6)  # robots refuse a reset of those who still drive
    page.evaluate(f"refs => refs.forEach((ref) => pebble.commands.reset(ref, {value}.owners))", refs)
    free = f"refs => refs.every((ref) => !{value}.latched)"
    rig.until(page, lambda: page.evaluate(free, refs), "the stops were not reset")
    rig.pause(page, 0.7)


def pictures(rig: Rig, scale: float) -> Samples:
    """Capture to drawn in each encoding, and the share of pictures that were not drawn."""
    page = rig.page(ROBOT)
    rig.until(page, lambda: page.evaluate("bench.picture"), "no picture")
    page.evaluate("bench.film()")
    found: Samples = {}
    for encoding in ALL_VIDEO:
        page.evaluate("([ref, one]) => pebble.commands.setEncoding(ref, one)", [rig.ref(ROBOT), encoding])
        rig.until(page, lambda: page.evaluate("bench.drawn.at(-1)?.[0]") == encoding, f"no {encoding}")  # noqa: B023
        rig.pause(page, 1.5)
        page.evaluate("bench.drawn.length = 0")
        rig.pause(page, 20 * scale)
        drawn = [one for one in page.evaluate("bench.drawn") if one[0] == encoding]
        found[f"scene, {encoding} to drawn"] = [at - captured for _, _, captured, at, _ in drawn]
        found[f"scene, {encoding} lost"] = [lost_percent([one[1] for one in drawn])]
    return found


def lost_percent(numbers: list[int]) -> float:
    """Per cent of the pictures between the first and the last that are missing, by their numbers."""
    if len(numbers) < 2:
        return 100.0
    return 100.0 * (1 - len(set(numbers)) / (max(numbers) - min(numbers) + 1))


def loading(rig: Rig, scale: float) -> Samples:
    """A visitor opens the fleet's page, then a robot's, whose camera rests."""
    found: Samples = {"first robot": [], "first picture": []}
    for _ in range(max(1, round(4 * scale))):
        for key, page, stamp in (("first robot", rig.fleet(), "robot"), ("first picture", rig.page(ROBOT), "picture")):
            rig.until(page, lambda: page.evaluate(f"bench.{stamp}"), f"no {stamp}")  # noqa: B023
            found[key].append(page.evaluate(f"bench.{stamp}"))
            page.context.close()
        time.sleep(_REST_S)
    return found


def files(rig: Rig, _scale: float) -> Samples:
    """Everything that a robot's page requests until it shows a picture, and what it fetches later."""
    page = rig.page(ROBOT)
    rig.until(page, lambda: page.evaluate("bench.picture"), "no picture")
    rig.pause(page, _LATER_S)
    entries = page.evaluate("performance.getEntriesByType('resource').map((one) => [one.name, one.startTime])")
    picture = page.evaluate("bench.picture")
    fetched = [(urldefrag(url).url, at) for url, at in entries if url.startswith("http")]  # one file of many icons
    urls = {page.url: 0.0} | dict(reversed(fetched))
    own = {url: at for url, at in urls.items() if urlsplit(url).netloc == urlsplit(rig.stage.url).netloc}
    bodies = {url: urllib.request.urlopen(url, timeout=5).read() for url in own}  # noqa: S310 - of our own server
    packed = {url: len(gzip.compress(body)) / 1000 for url, body in bodies.items()}
    before = [url for url, at in own.items() if at < picture]
    return {
        "page, kB": [sum(len(bodies[url]) for url in before) / 1000],
        "page, kB gz": [sum(packed[url] for url in before)],
        "with other screens, kB gz": [sum(packed.values())],
        "requests": [float(len(before))],
        "foreign hosts": [float(len(urls) - len(own))],
    }


def driving(rig: Rig, scale: float) -> Samples:
    """The server while one page shows pictures and drives."""
    page = rig.drivable(ROBOT)
    rig.until(page, lambda: page.evaluate("bench.picture"), "no picture")
    rig.hold(page, ROBOT, "KeyA")
    with _cost(rig, "1 viewer, driving") as found:
        rig.pause(page, 20 * scale)
    page.keyboard.up("KeyA")
    return found


def viewers(rig: Rig, scale: float) -> Samples:
    """Many viewers of one robot, of which none may lose pictures or cost the robot anything."""
    one, _ = _watched(rig, 1, 10 * scale)
    with _cost(rig, f"{VIEWERS} viewers") as found:
        many, shares = _watched(rig, VIEWERS, 20 * scale)
    return {**found, "frames of each viewer": shares, "robot's uplink, of that with 1 viewer": [100 * many / one]}


def _watched(rig: Rig, count: int, seconds: float) -> tuple[float, list[float]]:
    """Bytes a second of the robot, and per cent of its frames that each viewer received."""
    viewers = rig.stage.worker("viewers", "pebble.bench.page_viewers", rig.stage.url, rig.ref(ROBOT), count, seconds)
    answer = viewers.answer(seconds + _COUNT_S)
    rig.stage.end(viewers)
    began, ended = answer["began"], answer["ended"]
    published = [size for at, ref, size in rig.frames if ref == rig.ref(ROBOT) and began <= at < ended]
    if not published:
        raise PebbleError("the robot published no pictures")
    return sum(published) / (ended - began), [100 * frames / len(published) for frames in answer["frames"]]


def crowd(rig: Rig, scale: float) -> Samples:
    """A hundred robots on the fleet's screen."""
    broker = f"mqtt://127.0.0.1:{rig.stage.broker_port}"
    robots = rig.stage.robot("the fleet", "pebble.cli", "sim", "fleet", "-n", ROBOTS_SHOWN, "--broker", broker)
    try:
        page = rig.fleet()
        count = "document.querySelectorAll('[data-test^=\"card-\"]').length"
        rig.until(page, lambda: page.evaluate(count) > ROBOTS_SHOWN, lambda: f"{page.evaluate(count)} robots", 60.0)
        rig.pause(page, 5.0)
        page.evaluate("new MutationObserver(() => bench.updates++).observe(document.body, "
                      "{ subtree: true, childList: true, characterData: true, attributes: true })")  # fmt: skip
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable")
        before = _busy(session.send("Performance.getMetrics"))
        with _cost(rig, f"{ROBOTS_SHOWN} robots") as found:
            rig.pause(page, 20 * scale)
        busy = _busy(session.send("Performance.getMetrics")) - before
        return {**found, f"{ROBOTS_SHOWN} robots: ms an update": [1000 * busy / max(1, page.evaluate("bench.updates"))]}
    finally:
        rig.stage.end(robots)


def _busy(answer: dict[str, Any]) -> float:
    """Seconds of script, style and layout so far."""
    values = {one["name"]: one["value"] for one in answer["metrics"]}
    return float(sum(values[name] for name in ("ScriptDuration", "LayoutDuration", "RecalcStyleDuration")))


@contextmanager
def _cost(rig: Rig, what: str) -> Iterator[Samples]:
    """CPU and memory of the server during the block."""
    found: Samples = {}
    pid = rig.stage.server.pid
    before, began = cpu_s([pid]), time.monotonic()
    yield found
    found[f"{what}: CPU"] = [100 * (cpu_s([pid]) - before) / (time.monotonic() - began)]
    status = Path(f"/proc/{pid}/status").read_text()
    found[f"{what}: RSS"] = [int(status.partition("VmRSS:")[2].split()[0]) / 1000]
