"""What is measured of the operator page: each case takes a rig and returns samples, by the key of their row."""

from __future__ import annotations

import asyncio
import gzip
import json
import os
import signal
import struct
import threading
import time
import urllib.request
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urldefrag, urlencode, urlsplit

import numpy as np

from pebble.bench.drivers import Driver
from pebble.bench.drivers import driving as others_drive
from pebble.bench.page_rig import Rig, monotonic
from pebble.bench.usage import cpu_s
from pebble.contract import CAMERA, CAPABILITIES, MQTT_VIDEO, ONLINE, VIDEO_CONTROL, codec
from pebble.contract.encodings import ALL_VIDEO
from pebble.contract.payloads import Capabilities, Heartbeat
from pebble.errors import PebbleError
from pebble.media.scene import Scene
from pebble.media.video import make_encoder
from pebble.rig.programs import children
from pebble.rig.testbed import ROBOTS
from pebble.transports import MqttSettings, QoS, Transport, create

if TYPE_CHECKING:
    from playwright.sync_api import Page

Samples = dict[str, list[float]]

KEY, ROBOT = "KeyW", "goob"
VIEWERS, ROBOTS_SHOWN = 30, 100
_HELD_S = 0.4
_CAN = "h264,pbvz,pbvd,json,jpeg"
_FLOW_S = 4.0  # until the camera is running and every viewer has a key frame
_LATER_S = 5.0  # the page has fetched its other screens by then
_REST_S = 8.0  # after the last viewer: the server lets go after 5, the camera rests then
_WIDE = "wide"  # a robot whose pictures are larger than the network carries
_FPS, _SIZE = 15, (640, 360)  # of its pictures
_OFFERED_BYTES = 35_000  # of each: 4.2 megabits a second
_BLUR = "() => { const at = bench.now(); dispatchEvent(new Event('blur')); return at; }"
_HIDE = """() => {
  Object.defineProperty(document, "hidden", { configurable: true, get: () => true });
  const at = bench.now();
  document.dispatchEvent(new Event("visibilitychange"));
  return at;
}"""


def keys(rig: Rig, scale: float) -> Samples:
    """A key is pressed and released again and again."""
    page = rig.drivable(ROBOT)
    found: Samples = defaultdict(list)
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
    undo = ExitStack()

    def frozen(page: Page) -> float:
        """Its script stands still; Page.setWebLifecycleState has no effect on visible pages, as all here are."""
        session = page.context.new_cdp_session(page)
        undo.callback(session.detach)
        session.send("Debugger.enable")
        return _timed(session.send, "Debugger.pause")

    def stalled(_page: Page) -> float:
        """The browser's process for the network stands still."""
        pid = _network_process()
        undo.callback(os.kill, pid, signal.SIGCONT)
        return _timed(os.kill, pid, signal.SIGSTOP)

    def server(number: signal.Signals) -> float:
        undo.callback(rig.stage.restart_server)
        undo.callback(rig.stage.server.thaw)
        return _timed(os.kill, rig.stage.server.pid, number)

    actions: dict[str, Callable[[Page], float]] = {
        "blur to stop": lambda page: monotonic(page.evaluate(_BLUR)),
        "hidden to stop": lambda page: monotonic(page.evaluate(_HIDE)),
        "frozen to stop": frozen,
        "closed to stop": lambda page: _timed(page.close),
        "stalled to stop": stalled,
        "server frozen to stop": lambda _: server(signal.SIGSTOP),
        "server killed to stop": lambda _: server(signal.SIGKILL),
    }
    found: Samples = defaultdict(list)
    for name in [name for name in actions for _ in range(max(1, round(8 * scale)))]:
        page = rig.drivable(ROBOT)
        while not rig.stage.wheels_turning(ROBOT):  # a busy machine interrupts gestures, too
            page.keyboard.up(KEY)
            rig.hold(page, ROBOT, KEY)
            rig.pause(page, _HELD_S)
        with undo:
            at = actions[name](page)
            found[name].append(1000 * (rig.stopped(None, ROBOT) - at))
        if not page.is_closed():
            page.context.close()
    return found


def _timed(act: Callable[..., object], *arguments: object) -> float:
    """Do it; when it began."""
    at = time.monotonic()
    act(*arguments)
    return at


def _network_process() -> int:
    """The process of our browser that has its connections."""
    pids = [os.getpid()]
    for pid in pids:
        if b"network.mojom.NetworkService" in Path(f"/proc/{pid}/cmdline").read_bytes():
            return pid
        pids += children(pid)
    raise PebbleError("the browser has no process for its network")


def stops(rig: Rig, scale: float) -> Samples:
    """STOP is clicked while other operators drive."""
    found: Samples = defaultdict(list)
    with others_drive(rig.stage.broker_port) as driver:
        for what, names, button in (("STOP", (ROBOT,), "stop-one"), ("STOP ALL", ROBOTS, "stop-all")):
            page = rig.page(ROBOT if what == "STOP" else "")
            page.locator(f"[data-test={button}]").wait_for()
            for _ in range(max(1, round(10 * scale))):
                pressed, stopped = _stop(rig, page, driver, names, button)
                rig.until(page, "bench.mark", "the stop was not confirmed")
                found[f"{what} to motors"] += stopped
                found[f"{what} to confirmed"].append(1000 * (monotonic(page.evaluate("bench.mark")) - pressed))
                _reset(rig, page, names)
            page.context.close()
    return found


def _stop(
    rig: Rig, page: Page, driver: Driver, names: Sequence[str], button: str = "stop-one"
) -> tuple[float, list[float]]:
    """Click it while another operator drives: when, and ms until the motors of each robot stopped."""
    refs = tuple(map(rig.ref, names))
    driver.choose(refs)
    rig.until(page, lambda: all(map(rig.stage.wheels_turning, names)), "the robots do not move")
    rig.pause(page, _HELD_S)
    page.evaluate("refs => bench.confirmed(refs)", refs)
    page.locator(f"[data-test={button}]").click()
    pressed = rig.stamp(page, "pointer")
    stopped = [1000 * (rig.stopped(page, name) - pressed) for name in names]
    driver.choose(())
    return pressed, stopped


def _reset(rig: Rig, page: Page, names: Sequence[str]) -> None:
    """End the stops of these robots, once the page shows them."""
    refs, value = json.dumps(list(map(rig.ref, names))), "pebble.store.get(ref, 'web/estop')?.value"
    rig.until(page, f"{refs}.every((ref) => {value}.latched)", "not shown")
    rig.pause(page, 0.6)  # robots refuse a reset of those who still drive
    page.evaluate(f"{refs}.forEach((ref) => pebble.commands.reset(ref, {value}.owners))")
    rig.until(page, f"{refs}.every((ref) => !{value}.latched)", "the stops were not reset")
    rig.pause(page, 0.7)


def pictures(rig: Rig, scale: float) -> Samples:
    """Capture to drawn in each encoding, and the share of pictures that were not drawn."""
    page = rig.watched(ROBOT)
    page.evaluate("bench.film()")
    found: Samples = {}
    for encoding in ALL_VIDEO:
        page.evaluate("([ref, one]) => pebble.commands.setEncoding(ref, one)", [rig.ref(ROBOT), encoding])
        rig.until(page, f"bench.drawn.at(-1)?.[0] === '{encoding}'", f"no {encoding}")
        rig.pause(page, 1.5)
        drawn = [one for one in _drawn(rig, page, 20 * scale) if one[0] == encoding]
        found[f"scene, {encoding} to drawn"] = [at - captured for _, _, captured, at in drawn]
        found[f"scene, {encoding} lost"] = [lost_percent([one[1] for one in drawn])]
    return found


def _drawn(rig: Rig, page: Page, seconds: float) -> list[tuple[str, int, float, float]]:
    """The pictures drawn in this time, as the page notes them: encoding, number, captured and drawn (ms)."""
    page.evaluate("bench.drawn.length = 0")
    rig.pause(page, seconds)
    drawn: list[tuple[str, int, float, float]] = page.evaluate("bench.drawn")
    return drawn


def lost_percent(numbers: list[int]) -> float:
    """Per cent of the pictures between the first and the last that are missing, by their numbers."""
    if len(numbers) < 2:
        return 100.0
    return 100.0 * (1 - len(set(numbers)) / (max(numbers) - min(numbers) + 1))


def loading(rig: Rig, scale: float) -> Samples:
    """A visitor opens the fleet's page, then a robot's, whose camera rests."""
    found: Samples = defaultdict(list)
    for _ in range(max(1, round(4 * scale))):
        for key, page, stamp in (("first robot", rig.page(), "robot"), ("first picture", rig.page(ROBOT), "picture")):
            rig.until(page, f"bench.{stamp}", f"no {stamp}")
            found[key].append(page.evaluate(f"bench.{stamp}"))
            page.context.close()
        time.sleep(_REST_S)
    return found


def files(rig: Rig, _scale: float) -> Samples:
    """Everything that a robot's page requests until it shows a picture, and what it fetches later."""
    page = rig.watched(ROBOT)
    rig.pause(page, _LATER_S)
    entries = page.evaluate("performance.getEntriesByType('resource').map((one) => [one.name, one.startTime])")
    picture = page.evaluate("bench.picture")
    fetched = [(urldefrag(url).url, at) for url, at in entries if url.startswith("http")]  # one file of many icons
    urls = {page.url: 0.0} | dict(reversed(fetched))
    own = [url for url in urls if url.startswith(rig.stage.url)]
    before = [url for url in own if urls[url] < picture]
    bodies = {url: urllib.request.urlopen(url, timeout=5).read() for url in own}  # noqa: S310 - of our own server
    packed = {url: len(gzip.compress(body)) / 1000 for url, body in bodies.items()}
    return {
        "page, kB": [sum(len(bodies[url]) for url in before) / 1000],
        "page, kB gz": [sum(packed[url] for url in before)],
        "with other screens, kB gz": [sum(packed.values())],
        "requests": [float(len(before))],
        "foreign hosts": [float(len(urls) - len(own))],
    }


def driving(rig: Rig, scale: float) -> Samples:
    """The server while one page shows pictures and drives."""
    page = rig.watched(ROBOT)
    rig.ready(page)
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
    with ThreadPoolExecutor(1) as pool:  # this thread has Playwright's event loop
        watching = pool.submit(asyncio.run, _view(rig.stage.url, rig.ref(ROBOT), count, seconds))
        began, ended, frames = watching.result()
    published = [size for at, ref, size in rig.frames if ref == rig.ref(ROBOT) and began <= at < ended]
    if not published:
        raise PebbleError("the robot published no pictures")
    return sum(published) / (ended - began), [100 * one / len(published) for one in frames]


async def _view(url: str, ref: str, count: int, seconds: float) -> tuple[float, float, list[int]]:
    """Viewers without a browser: when they began to count and stopped, and the pictures of each between."""
    from websockets.asyncio.client import connect  # optional

    host, frames, counting = urlsplit(url).netloc, [0] * count, False
    address = f"ws://{host}/ws/media?{urlencode({'ref': ref, 'can': _CAN})}"

    async def watch(number: int) -> None:
        """Acknowledges every picture at once, as a fast page does."""
        async with connect(address, origin=f"http://{host}", compression=None, max_size=None) as socket:  # type: ignore[arg-type]
            async for message in socket:
                frames[number] += counting
                await socket.send(message[:4] + struct.pack(">B", 0))  # type: ignore[operator]

    tasks = [asyncio.create_task(watch(number)) for number in range(count)]
    await asyncio.sleep(_FLOW_S)
    began, counting = time.monotonic(), True
    await asyncio.sleep(seconds)
    ended, counting = time.monotonic(), False
    await asyncio.sleep(0.2)  # what the robot published is under way to its subscriber
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return began, ended, frames


def crowd(rig: Rig, scale: float) -> Samples:
    """A hundred robots on the fleet's screen."""
    broker = f"mqtt://127.0.0.1:{rig.stage.broker_port}"
    rig.stage.robot("the fleet", "pebble.cli", "sim", "fleet", "-n", ROBOTS_SHOWN, "--broker", broker)
    page = rig.page()
    count = "document.querySelectorAll('[data-test^=\"card-\"]').length"
    rig.until(page, f"{count} > {ROBOTS_SHOWN}", lambda: f"{page.evaluate(count)} robots", 60.0)
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


# -- with the browser behind an impaired network


def thin(rig: Rig, scale: float) -> Samples:
    """The age of pictures that offer more than the link carries."""
    with _wide_robot(rig.stage.broker_port):
        page = rig.watched(_WIDE, 30.0)
        page.evaluate("bench.film()")
        rig.pause(page, 3.0)
        began = time.monotonic()
        drawn = _drawn(rig, page, 20 * scale)
        took_s = time.monotonic() - began
        offered = sum(size for at, ref, size in rig.frames if ref == rig.ref(_WIDE) and at >= began)
    return {
        "2 Mbit/s: picture age": [at - captured for _, _, captured, at in drawn if captured],
        "2 Mbit/s: offered": [8 * offered / 1e6 / took_s],
        "2 Mbit/s: drawn a second": [len(drawn) / took_s],
    }


@contextmanager
def _wide_robot(port: int) -> Iterator[None]:
    """A robot that only sends pictures, four megabits of them a second, whether or not they are requested."""
    base, ending = f"pebble/robots/{_WIDE}", threading.Event()
    topics = {"topic": CAMERA, "command_topic": VIDEO_CONTROL, "flag_topic": MQTT_VIDEO}
    video = {name: channel.topic(base) for name, channel in topics.items()}
    value = {"video": {"available": True, "controls": True, "encodings": ["pbvd"], **video}}
    payload = codec.encode(CAPABILITIES, Capabilities(t=_now_ms(), value=value))
    with create("mqtt", _WIDE, MqttSettings(host="127.0.0.1", port=port)) as robot, ThreadPoolExecutor(1) as pool:
        robot.publish(CAPABILITIES.topic(base), payload, retain=True, qos=QoS.DELIVERED)
        filming = pool.submit(_film, robot, base, ending)
        try:
            yield
        finally:
            ending.set()
        filming.result()  # raises what ended it early


def _film(robot: Transport, base: str, ending: threading.Event) -> None:
    scene, picture = Scene(*_SIZE), np.empty((_SIZE[1], _SIZE[0], 3), np.uint8)
    noise = np.random.default_rng(1).integers(0, 60, (8, *picture.shape), np.uint8)
    encoder = make_encoder("pbvd", fps=_FPS, quality=50)
    number, due = 0, time.monotonic()
    while not ending.wait(max(0.0, due - time.monotonic())):
        due += 1 / _FPS
        scene.render(number, picture)
        payload = encoder.encode(picture // 2 + noise[number % 8], _now_ms())
        encoder.quality = min(95.0, max(5.0, encoder.quality * (_OFFERED_BYTES / len(payload)) ** 0.3))
        robot.publish(CAMERA.topic(base), payload)
        if number % _FPS == 0:
            robot.publish(ONLINE.topic(base), codec.encode(ONLINE, Heartbeat(t=_now_ms())))
        number += 1


def _now_ms() -> int:
    return int(1000 * time.time())


def far(rig: Rig, scale: float) -> Samples:
    """Driving, and the emergency stop, over a link that is slow, far and lossy."""
    page = rig.drivable(ROBOT)
    page.evaluate("bench.number = 1")
    interrupted, end = -1.0, time.monotonic() + 20 * scale
    while time.monotonic() < end:
        if not page.evaluate("pebble.driver.gestureActive"):
            interrupted += 1
            page.keyboard.up(KEY)
            with suppress(PebbleError):  # the page may refuse for a while, because commands are late
                rig.ready(page)
                rig.hold(page, ROBOT, KEY)
        rig.pause(page, 0.1)
    page.keyboard.up(KEY)
    rig.pause(page, 1.0)
    sent = page.evaluate("bench.sent")
    arrived = {round(axes.get("y", 0.0), 3): at for at, base, axes in rig.drives if base == rig.ref(ROBOT)}
    late = [1000 * (arrived[round(y, 3)] - monotonic(at)) for y, at in sent if round(y, 3) in arrived]
    stopped: list[float] = []
    with others_drive(rig.stage.broker_port) as driver:
        for _ in range(max(1, round(8 * scale))):
            stopped += _stop(rig, page, driver, [ROBOT])[1]
            _reset(rig, page, [ROBOT])
    return {
        "256 kbit/s: drive": late,
        "256 kbit/s: drive, arrived": [100 * len(late) / max(1, len(sent))],
        "256 kbit/s: gestures interrupted": [interrupted],
        "256 kbit/s: STOP to motors": stopped,
        "256 kbit/s: round trip shown": [page.evaluate("pebble.connection.socket.roundTripMs")],
    }
