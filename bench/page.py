"""Measures the operator page: what a driver feels, and what its server costs, beside the goals.

A case is measured several times, each time with new robots, a new server and a new browser; the best time counts.
"""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlencode, urlsplit

from pebble.bench.clients import driving as others_drive
from pebble.bench.comparison import Budget, Case, Comparison, Measuring, Option, Report, rounds
from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.judging.aims import outcome
from pebble.bench.page_rig import HELD_S, KEY, ROBOT, Rig, linked, monotonic, rig
from pebble.bench.results import Cell, Judged, percentile
from pebble.bench.tables import figure
from pebble.bench.usage import cpu_s
from pebble.contract.encodings import ALL_VIDEO
from pebble.errors import PebbleError
from pebble.rig.processes import children
from pebble.rig.testbed import ROBOTS

Samples = Iterator[tuple[str, float]]  # each with the key of its row

_FLOW_S = 4.0  # until the camera is running and every viewer has a key frame
_PICTURE_S = 10.0
_REST_S = 8.0  # after the last viewer: the server lets go after 5, the camera rests then
_COST_S = 20.0
#: Up is from the server to the page.
_FAR = Condition("256 kbit/s, 100 ms, 2 %", up=Shape(kbit=256, loss=0.02, delay_ms=50), down=Shape(delay_ms=50))
_BLUR = "() => { const at = bench.now(); dispatchEvent(new Event('blur')); return at; }"
_HIDE = """() => {
  Object.defineProperty(document, "hidden", { configurable: true, get: () => true });
  const at = bench.now(); document.dispatchEvent(new Event('visibilitychange')); return at;
}"""


def keys(rig: Rig, scale: float) -> Samples:
    """A key is pressed and released again and again."""
    page = rig.page(ROBOT)
    rig.ready(page)
    for number in range(round(40 * scale)):
        page.keyboard.down(KEY)
        pressed = rig.stamp(page, "keydown")
        moved = rig.moved_after(page, pressed)
        yield "key to MQTT", 1000 * (rig.command_after(page, pressed) - pressed)
        yield "key to motors", 1000 * (moved - pressed)
        rig.pause(page, 0.15 + 0.007 * (number % 10))  # not in step with the page's own period
        page.keyboard.up(KEY)
        released = rig.stamp(page, "keyup")
        yield "release to stop", 1000 * (rig.stopped(page) - released)


def interruptions(rig: Rig, scale: float) -> Samples:
    """A key is held, and something happens to the page, the connection or the server."""
    for name in [row.key for row in CASES["interruptions"].rows for _ in range(max(1, round(8 * scale)))]:
        page, server = rig.page(ROBOT), rig.stage.server
        rig.hold(page)
        session, network = page.context.new_cdp_session(page), _network_process()
        acts: dict[str, Callable[[], Any]] = {
            "blur to stop": partial(page.evaluate, _BLUR),
            "hidden to stop": partial(page.evaluate, _HIDE),
            # Its script stands still; Page.setWebLifecycleState has no effect on visible pages, as all here are.
            "frozen to stop": partial(session.send, "Debugger.pause"),
            "closed to stop": page.close,
            "stalled to stop": partial(os.kill, network, signal.SIGSTOP),
            "server frozen to stop": server.freeze,
            "server killed to stop": server.kill,
        }
        if name == "frozen to stop":
            session.send("Debugger.enable")
        try:
            began, stamp = time.monotonic(), acts[name]()  # the page's stamp, if it did it
            yield name, 1000 * (rig.stopped(None) - (monotonic(stamp) if stamp else began))
        finally:
            os.kill(network, signal.SIGCONT)
        if name.startswith("server"):
            server.thaw()
            rig.stage.restart_server()
        page.context.close()


def _network_process() -> int:
    """The browser's process that has its connections."""
    pids = [os.getpid()]
    for pid in pids:
        if b"network.mojom.NetworkService" in Path(f"/proc/{pid}/cmdline").read_bytes():
            return pid
        pids += children(pid)
    raise PebbleError("the browser has no process for its network")


def stops(rig: Rig, scale: float) -> Samples:
    """STOP is clicked while other operators drive."""
    with others_drive(rig.stage.broker_port) as driver:
        for what, names, button in (("STOP", (ROBOT,), "stop-one"), ("STOP ALL", ROBOTS, "stop-all")):
            page, bases = rig.page(ROBOT if what == "STOP" else ""), tuple(map(rig.ref, names))
            refs = json.dumps(bases)
            page.locator(f"[data-test={button}]").wait_for()
            for _ in range(max(1, round(10 * scale))):
                driver.choose(bases)
                for name in names:
                    rig.until(page, partial(rig.stage.wheels_turning, name), f"{name} does not move")
                rig.pause(page, HELD_S)
                page.evaluate(f"bench.confirmed({refs})")
                page.locator(f"[data-test={button}]").click()
                pressed = rig.stamp(page, "pointerdown")
                yield from ((f"{what} to motors", 1000 * (rig.stopped(page, name) - pressed)) for name in names)
                driver.choose(())
                confirmed = monotonic(rig.until(page, "bench.mark", "the stop was not confirmed"))
                yield f"{what} to confirmed", 1000 * (confirmed - pressed)
                rig.until(page, f"{refs}.every((ref) => bench.stop(ref).latched)", "not shown")
                rig.pause(page, 0.6)  # robots refuse a reset of those who still drive
                page.evaluate(f"{refs}.forEach((ref) => pebble.commands.reset(ref, bench.stop(ref).owners))")
                rig.until(page, f"{refs}.every((ref) => !bench.stop(ref).latched)", "the stops were not reset")
                rig.pause(page, 0.7)
            page.context.close()


def pictures(rig: Rig, scale: float) -> Samples:
    """Capture to drawn in each encoding, and the share of pictures that were not drawn."""
    page = rig.page(ROBOT)
    rig.until(page, "bench.picture", "no picture")
    page.evaluate("bench.film()")
    for encoding in ALL_VIDEO:
        page.evaluate("([ref, one]) => pebble.commands.setEncoding(ref, one)", [rig.ref(ROBOT), encoding])
        rig.until(page, f"bench.drawn.at(-1)?.[0] === '{encoding}'", f"no {encoding}")
        rig.pause(page, 1.5)
        page.evaluate("bench.drawn.length = 0")
        rig.pause(page, 20 * scale)
        drawn = [one for one in page.evaluate("bench.drawn") if one[0] == encoding]
        yield from ((f"scene, {encoding} to drawn", at - captured) for _, _, captured, at in drawn)
        yield f"scene, {encoding} lost", lost_percent([one[1] for one in drawn])


def lost_percent(numbers: list[int]) -> float:
    """Per cent of the pictures between the first and the last that are missing, by their numbers."""
    if len(numbers) < 2:
        return 100.0
    return 100.0 * (1 - len(set(numbers)) / (max(numbers) - min(numbers) + 1))


def loading(rig: Rig, scale: float) -> Samples:
    """A visitor opens the fleet's page, and a robot's, whose camera rests."""
    for _ in range(max(1, round(4 * scale))):
        for stamp, page in (("robot", rig.page()), ("picture", rig.page(ROBOT))):
            yield f"first {stamp}", rig.until(page, f"bench.{stamp}", f"no {stamp}")
            page.context.close()
        time.sleep(_REST_S)


def _cost(rig: Rig, what: str, wait: Callable[[], object]) -> Samples:
    """CPU and memory of the server, meanwhile."""
    pid = rig.stage.server.pid
    before, began = cpu_s([pid]), time.monotonic()
    wait()
    yield f"{what}: CPU", 100 * (cpu_s([pid]) - before) / (time.monotonic() - began)
    status = Path(f"/proc/{pid}/status").read_text()
    yield f"{what}: RSS", int(status.partition("VmRSS:")[2].split()[0]) / 1000


def driving(rig: Rig, scale: float) -> Samples:
    """The server while one page shows pictures and drives."""
    page = rig.page(ROBOT)
    rig.until(page, "bench.picture", "no picture")
    rig.hold(page, "KeyA")
    yield from _cost(rig, "1 viewer, driving", lambda: rig.pause(page, _COST_S * scale))


def viewers(rig: Rig, scale: float) -> Samples:
    """The server while 30 watch one robot, without a browser."""
    from websockets.exceptions import WebSocketException  # optional
    from websockets.sync.client import connect

    host, ending = urlsplit(rig.stage.url).netloc, threading.Event()
    address = f"ws://{host}/ws/media?{urlencode({'ref': rig.ref(ROBOT), 'can': 'h264,pbvz,pbvd,json,jpeg'})}"
    options: dict[str, Any] = {"origin": f"http://{host}", "compression": None, "max_size": None}

    def watch(_number: int) -> bool:
        """Acknowledges every picture at once, as a fast page does; whether they came until the end."""
        with suppress(TimeoutError, WebSocketException), connect(address, **options) as socket:
            while not ending.is_set():
                picture: Any = socket.recv(_PICTURE_S)
                socket.send(picture[:4] + b"\0")
            return True
        return False

    with ThreadPoolExecutor(30) as pool, ExitStack() as stack:
        stack.callback(ending.set)
        watched = pool.map(watch, range(30))
        time.sleep(_FLOW_S)
        yield from _cost(rig, "30 viewers", lambda: time.sleep(_COST_S * scale))
    if not all(watched):
        raise PebbleError("a viewer received no pictures, or not until the end")


def crowd(rig: Rig, scale: float) -> Samples:
    """A hundred robots on the fleet's screen."""
    broker = f"mqtt://127.0.0.1:{rig.stage.broker_port}"
    rig.stage.robot("the fleet", "pebble.cli", "sim", "fleet", "-n", 100, "--broker", broker)
    page = rig.page()
    rig.until(page, "parseInt(document.querySelector('h1')?.textContent) > 100", "too few robots", 60.0)
    rig.pause(page, 5.0)
    page.evaluate("new MutationObserver(() => bench.updates++).observe(document.body, "
                  "{ subtree: true, childList: true, characterData: true, attributes: true })")  # fmt: skip
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")

    def busy_s() -> float:
        """The processor time of script, style and layout so far."""
        values = {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}
        return float(sum(values[name] for name in ("ScriptDuration", "LayoutDuration", "RecalcStyleDuration")))

    before = busy_s()
    yield from _cost(rig, "100 robots", lambda: rig.pause(page, _COST_S * scale))
    yield "100 robots: ms an update", 1000 * (busy_s() - before) / max(1, page.evaluate("bench.updates"))


def far_link(rig: Rig, scale: float) -> Samples:
    """Driving over a link that is slow, far and lossy."""
    page = rig.page(ROBOT)
    rig.ready(page)
    page.evaluate("bench.number = 1")
    end = time.monotonic() + 20 * scale
    while time.monotonic() < end:
        if not page.evaluate("pebble.driver.gestureActive"):
            with suppress(PebbleError):  # the page may refuse for a while, because commands are late
                rig.hold(page)
        rig.pause(page, 0.1)
    page.keyboard.up(KEY)
    rig.pause(page, 1.0)
    sent = page.evaluate("bench.sent")
    arrived = {round(axes.get("y", 0.0), 3): at for at, axes in rig.drives}
    late = [1000 * (arrived[round(y, 3)] - monotonic(at)) for y, at in sent if round(y, 3) in arrived]
    yield from (("256 kbit/s: drive", one) for one in late)
    yield "256 kbit/s: drive, lost", 100 * (1 - len(late) / max(1, len(sent)))


# -- the comparison


class Row(NamedTuple):
    """What is measured, and its goal: bounds of the median and of the 95th percentile."""

    key: str
    p50: float = math.inf
    p95: float = math.inf
    unit: str = "ms"


class PageCase(NamedTuple):
    """Rows that are measured together."""

    measure: Callable[[Rig, float], Samples]  # the second argument scales the number of samples
    setting: Callable[[], AbstractContextManager[Rig]]
    rows: Sequence[Row]


def _cost_rows(what: str, percent: float, mb: float) -> tuple[Row, Row]:
    return Row(f"{what}: CPU", percent, unit="%"), Row(f"{what}: RSS", mb, unit="MB")


_ALONE = partial(rig, ROBOT)
CASES = {
    "keys": PageCase(keys, _ALONE, (
        Row("key to MQTT", 2, 5), Row("key to motors", 10, 20), Row("release to stop", 15, 60),
    )),
    "interruptions": PageCase(interruptions, _ALONE, (
        Row("blur to stop", 15, 60), Row("hidden to stop", 15, 60), Row("frozen to stop", p95=300),
        Row("closed to stop", p95=300), Row("stalled to stop", p95=300), Row("server frozen to stop", p95=450),
        Row("server killed to stop", p95=450),
    )),
    "stops": PageCase(stops, rig, (
        Row("STOP to motors", p95=50), Row("STOP to confirmed", p95=300),
        Row("STOP ALL to motors", p95=150), Row("STOP ALL to confirmed", p95=300),
    )),
    # Pictures of the demo's room are up to 20 ms old when they are drawn.
    "pictures": PageCase(pictures, partial(rig, ROBOT, room=False), (
        *(Row(f"scene, {one} to drawn", 25, 50) for one in ALL_VIDEO),
        *(Row(f"scene, {one} lost", 0, 0, unit="%") for one in ALL_VIDEO),
    )),
    "loading": PageCase(loading, rig, (Row("first robot", p95=1000), Row("first picture", p95=3000))),
    "driving": PageCase(driving, _ALONE, _cost_rows("1 viewer, driving", 8, 60)),
    "viewers": PageCase(viewers, _ALONE, _cost_rows("30 viewers", 25, 80)),
    "crowd": PageCase(crowd, partial(rig, "minilamp"), (
        Row("100 robots: ms an update", 8), *_cost_rows("100 robots", 10, 80),
    )),
    "far link": PageCase(far_link, partial(linked, _FAR, ROBOT), (
        Row("256 kbit/s: drive", p95=110), Row("256 kbit/s: drive, lost", unit="%"),
    )),
}  # fmt: skip
ROWS = {row.key: row for case in CASES.values() for row in case.rows}


def measure(case: Case) -> Iterator[Cell]:
    """One try. One that fails is noted, and its rows are empty."""
    about, run, samples = CASES[str(case.condition["case"])], case.run, list[tuple[str, float]]()
    note = f"{case.condition['case']}, try {case.number + 1}"
    run.notes.append(f"{note}: load {os.getloadavg()[0]:.2f}")
    try:
        with about.setting() as made:
            samples = list(about.measure(made, run["scale"]))
    except PebbleError as error:
        run.notes.append(f"{note}: {error}")
        run.console.print(run.notes[-1], style="red", highlight=False, markup=False)
    for row in about.rows:
        yield case.cell(row.key, row.unit, [value for key, value in samples if key == row.key])


def goals(cells: Sequence[Cell]) -> Iterator[str | Judged]:
    """The goals as aims, each judged by its best try."""
    for cell in cells:
        row = ROWS[cell.measure]
        tries = [(percentile(one, 50), percentile(one, 95)) for one in cell.rounds if one] or [(math.nan, math.nan)]
        p50, p95 = min(tries, key=lambda one: (one[0] > row.p50 or one[1] > row.p95, one[math.isfinite(row.p95)]))
        goal = " / ".join("–" if math.isinf(bound) else f"{bound:g}" for bound in (row.p50, row.p95))
        measured = f"{figure(p50)} / {figure(p95)} {row.unit}"
        if goal == "– / –":
            yield f"{row.key}: {measured}"
        else:
            met = outcome(p50 <= row.p50 and p95 <= row.p95, judged=not math.isnan(p50))
            yield Judged(what=f"{row.key}, p50 / p95 ≤ {goal} {row.unit}", outcome=met, measured=measured)


PAGE = Comparison(
    name="page",
    title="The operator page",
    what="What a driver feels in a browser, and what the page's server costs, beside the goals.",
    help="""The operator page in a browser: what a driver feels, and what its server costs.

    Needs mosquitto and its clients, chromium, the extra dev, and root for a slow link.
    """,
    options=(
        Option(name="only", sets="cases", many=True, known=list(CASES), metavar="NAMES",
               recorded=False, help="Some of the cases, separated by commas."),
        rounds("How often each case is measured; the best time counts."),
    ),
    full=Budget(1800, cases=list(CASES), rounds=3, scale=1.0),
    quick=Budget(300, rounds=1, scale=0.25),  # of the samples
    folder=Path("build/page"),
    variants=("page",),
    conditions=lambda run: [{"case": name} for name in CASES if name in run["cases"]],
    measuring=Measuring(measure=measure),
    report=Report(assessment=(goals,), reported=None),
)  # fmt: skip
