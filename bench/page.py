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
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlencode, urlsplit

from pebble.bench.aims import outcome
from pebble.bench.comparison import Budget, Case, Comparison, Option, rounds
from pebble.bench.drivers import driving as others_drive
from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.page_rig import Rig, linked, monotonic, rig
from pebble.bench.results import Cell, Judged, percentile
from pebble.bench.tables import figure
from pebble.bench.usage import cpu_s
from pebble.contract.encodings import ALL_VIDEO
from pebble.errors import PebbleError
from pebble.rig.processes import children
from pebble.rig.testbed import ROBOTS

if TYPE_CHECKING:
    from playwright.sync_api import Page

Samples = dict[str, list[float]]  # by the key of their row
Measure = Callable[[Rig, float], Samples]  # the second argument scales the number of samples

_KEY, _ROBOT = "KeyW", "goob"
_VIEWERS, _ROBOTS_SHOWN = 30, 100
_HELD_S = 0.4
_FLOW_S = 4.0  # until the camera is running and every viewer has a key frame
_PICTURE_S = 10.0
_REST_S = 8.0  # after the last viewer: the server lets go after 5, the camera rests then
#: Up is from the server to the page.
_FAR = Condition("256 kbit/s, 100 ms, 2 %", up=Shape(kbit=256, loss=0.02, delay_ms=50), down=Shape(delay_ms=50))
_BLUR = "() => { const at = bench.now(); dispatchEvent(new Event('blur')); return at; }"
_HIDE = """() => {
  Object.defineProperty(document, "hidden", { configurable: true, get: () => true });
  const at = bench.now();
  document.dispatchEvent(new Event("visibilitychange"));
  return at;
}"""


class Row(NamedTuple):
    """What is measured, and its goal: bounds of the median and of the 95th percentile."""

    key: str
    p50: float = math.inf
    p95: float = math.inf
    unit: str = "ms"

    @property
    def goal(self) -> str:
        """In words; empty without one."""
        bounds = ["–" if math.isinf(bound) else f"{bound:g}" for bound in (self.p50, self.p95)]
        return "" if bounds == ["–", "–"] else f"≤ {' / '.join(bounds)}"

    def met(self, samples: Sequence[float]) -> bool:
        return percentile(samples, 50) <= self.p50 and percentile(samples, 95) <= self.p95

    def best(self, tries: Sequence[list[float]]) -> list[float]:
        """The try that comes nearest to the goal; no samples if all failed."""
        percent = 50 if math.isinf(self.p95) else 95
        return min(filter(None, tries), key=lambda samples: percentile(samples, percent), default=[])


class PageCase(NamedTuple):
    """Rows that are measured together."""

    measure: Measure
    rows: Sequence[Row]
    setting: Callable[[], AbstractContextManager[Rig]]


CASES: dict[str, PageCase] = {}


def _case(*rows: Row, setting: Callable[[], AbstractContextManager[Rig]] = rig) -> Callable[[Measure], Measure]:
    """The case of the function's name."""

    def add(measure: Measure) -> Measure:
        CASES[measure.__name__.replace("_", " ")] = PageCase(measure, rows, setting)
        return measure

    return add


_GOOB = partial(rig, _ROBOT)


@_case(Row("key to MQTT", 2, 5), Row("key to motors", 10, 20), Row("release to stop", 15, 60), setting=_GOOB)
def keys(rig: Rig, scale: float) -> Samples:
    """A key is pressed and released again and again."""
    page = rig.drivable(_ROBOT)
    found: Samples = defaultdict(list)
    for number in range(round(40 * scale)):
        page.keyboard.down(_KEY)
        pressed = rig.stamp(page, "down")
        moved = rig.moved_after(page, _ROBOT, pressed)
        found["key to MQTT"].append(1000 * (rig.command_after(page, _ROBOT, pressed) - pressed))
        found["key to motors"].append(1000 * (moved - pressed))
        rig.pause(page, 0.15 + 0.007 * (number % 10))  # not in step with the page's own period
        page.keyboard.up(_KEY)
        released = rig.stamp(page, "up")
        found["release to stop"].append(1000 * (rig.stopped(page, _ROBOT) - released))
    return found


@_case(
    Row("blur to stop", 15, 60), Row("hidden to stop", 15, 60), Row("frozen to stop", p95=300),
    Row("closed to stop", p95=300), Row("stalled to stop", p95=300), Row("server frozen to stop", p95=450),
    Row("server killed to stop", p95=450), setting=_GOOB,
)  # fmt: skip
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
        page = rig.drivable(_ROBOT)
        while not rig.stage.wheels_turning(_ROBOT):  # a busy machine interrupts gestures, too
            page.keyboard.up(_KEY)
            rig.hold(page, _ROBOT, _KEY)
            rig.pause(page, _HELD_S)
        with undo:
            at = actions[name](page)
            found[name].append(1000 * (rig.stopped(None, _ROBOT) - at))
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


@_case(
    Row("STOP to motors", p95=50), Row("STOP to confirmed", p95=300),
    Row("STOP ALL to motors", p95=150), Row("STOP ALL to confirmed", p95=300),
)  # fmt: skip
def stops(rig: Rig, scale: float) -> Samples:
    """STOP is clicked while other operators drive."""
    found: Samples = defaultdict(list)
    estop = "pebble.store.get(ref, 'web/estop')?.value"
    with others_drive(rig.stage.broker_port) as driver:
        for what, names, button in (("STOP", (_ROBOT,), "stop-one"), ("STOP ALL", ROBOTS, "stop-all")):
            page, refs = rig.page(_ROBOT if what == "STOP" else ""), tuple(map(rig.ref, names))
            page.locator(f"[data-test={button}]").wait_for()
            for _ in range(max(1, round(10 * scale))):
                driver.choose(refs)
                for name in names:
                    rig.until(page, partial(rig.stage.wheels_turning, name), f"{name} does not move")
                rig.pause(page, _HELD_S)
                page.evaluate("refs => bench.confirmed(refs)", refs)
                page.locator(f"[data-test={button}]").click()
                pressed = rig.stamp(page, "pointer")
                found[f"{what} to motors"] += [1000 * (rig.stopped(page, name) - pressed) for name in names]
                driver.choose(())
                rig.until(page, "bench.mark", "the stop was not confirmed")
                found[f"{what} to confirmed"].append(1000 * (monotonic(page.evaluate("bench.mark")) - pressed))
                rig.until(page, f"{json.dumps(refs)}.every((ref) => {estop}.latched)", "not shown")
                rig.pause(page, 0.6)  # robots refuse a reset of those who still drive
                page.evaluate(f"{json.dumps(refs)}.forEach((ref) => pebble.commands.reset(ref, {estop}.owners))")
                rig.until(page, f"{json.dumps(refs)}.every((ref) => !{estop}.latched)", "the stops were not reset")
                rig.pause(page, 0.7)
            page.context.close()
    return found


@_case(
    *(Row(f"scene, {one} to drawn", 25, 50) for one in ALL_VIDEO),
    *(Row(f"scene, {one} lost", 0, 0, unit="%") for one in ALL_VIDEO),
    setting=partial(rig, _ROBOT, room=False),  # pictures of the demo's room are up to 20 ms old when they are drawn
)
def pictures(rig: Rig, scale: float) -> Samples:
    """Capture to drawn in each encoding, and the share of pictures that were not drawn."""
    page = rig.watched(_ROBOT)
    page.evaluate("bench.film()")
    found: Samples = {}
    for encoding in ALL_VIDEO:
        page.evaluate("([ref, one]) => pebble.commands.setEncoding(ref, one)", [rig.ref(_ROBOT), encoding])
        rig.until(page, f"bench.drawn.at(-1)?.[0] === '{encoding}'", f"no {encoding}")
        rig.pause(page, 1.5)
        page.evaluate("bench.drawn.length = 0")
        rig.pause(page, 20 * scale)
        drawn = [one for one in page.evaluate("bench.drawn") if one[0] == encoding]
        found[f"scene, {encoding} to drawn"] = [at - captured for _, _, captured, at in drawn]
        found[f"scene, {encoding} lost"] = [lost_percent([one[1] for one in drawn])]
    return found


def lost_percent(numbers: list[int]) -> float:
    """Per cent of the pictures between the first and the last that are missing, by their numbers."""
    if len(numbers) < 2:
        return 100.0
    return 100.0 * (1 - len(set(numbers)) / (max(numbers) - min(numbers) + 1))


@_case(Row("first robot", p95=1000), Row("first picture", p95=3000))
def loading(rig: Rig, scale: float) -> Samples:
    """A visitor opens the fleet's page, then a robot's, whose camera rests."""
    found: Samples = defaultdict(list)
    for _ in range(max(1, round(4 * scale))):
        for key, page, stamp in (("first robot", rig.page(), "robot"), ("first picture", rig.page(_ROBOT), "picture")):
            rig.until(page, f"bench.{stamp}", f"no {stamp}")
            found[key].append(page.evaluate(f"bench.{stamp}"))
            page.context.close()
        time.sleep(_REST_S)
    return found


def _cost_rows(what: str, percent: float, mb: float) -> tuple[Row, Row]:
    return Row(f"{what}: CPU", percent, unit="%"), Row(f"{what}: RSS", mb, unit="MB")


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


@_case(*_cost_rows("1 viewer, driving", 8, 60), setting=_GOOB)
def driving(rig: Rig, scale: float) -> Samples:
    """The server while one page shows pictures and drives."""
    page = rig.watched(_ROBOT)
    rig.ready(page)
    rig.hold(page, _ROBOT, "KeyA")
    with _cost(rig, "1 viewer, driving") as found:
        rig.pause(page, 20 * scale)
    page.keyboard.up("KeyA")
    return found


@_case(*_cost_rows(f"{_VIEWERS} viewers", 25, 80), setting=_GOOB)
def viewers(rig: Rig, scale: float) -> Samples:
    """The server while many watch one robot, without a browser."""
    from websockets.exceptions import WebSocketException  # optional
    from websockets.sync.client import connect

    host, ending = urlsplit(rig.stage.url).netloc, threading.Event()
    address = f"ws://{host}/ws/media?{urlencode({'ref': rig.ref(_ROBOT), 'can': 'h264,pbvz,pbvd,json,jpeg'})}"
    options: dict[str, Any] = {"origin": f"http://{host}", "compression": None, "max_size": None}

    def watch(_number: int) -> int:
        """Acknowledges every picture at once, as a fast page does; returns how many came."""
        received = 0
        with suppress(TimeoutError, WebSocketException), connect(address, **options) as socket:
            while not ending.is_set():
                picture = socket.recv(_PICTURE_S)
                socket.send(picture[:4] + b"\0")  # type: ignore[operator]
                received += 1
        return received

    with ThreadPoolExecutor(_VIEWERS) as pool, ExitStack() as stack:
        stack.callback(ending.set)
        received = pool.map(watch, range(_VIEWERS))
        time.sleep(_FLOW_S)
        with _cost(rig, f"{_VIEWERS} viewers") as found:
            time.sleep(20 * scale)
    if not all(received):
        raise PebbleError("a viewer received no pictures")
    return found


_R = f"{_ROBOTS_SHOWN} robots"


@_case(Row(f"{_R}: ms an update", 8), *_cost_rows(_R, 10, 80), setting=partial(rig, "minilamp"))
def crowd(rig: Rig, scale: float) -> Samples:
    """A hundred robots on the fleet's screen."""
    broker = f"mqtt://127.0.0.1:{rig.stage.broker_port}"
    rig.stage.robot("the fleet", "pebble.cli", "sim", "fleet", "-n", _ROBOTS_SHOWN, "--broker", broker)
    page = rig.page()
    count = "document.querySelectorAll('[data-test^=\"card-\"]').length"
    rig.until(page, f"{count} > {_ROBOTS_SHOWN}", lambda: f"{page.evaluate(count)} robots", 60.0)
    rig.pause(page, 5.0)
    page.evaluate("new MutationObserver(() => bench.updates++).observe(document.body, "
                  "{ subtree: true, childList: true, characterData: true, attributes: true })")  # fmt: skip
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")
    before = _busy_s(session.send("Performance.getMetrics"))
    with _cost(rig, _R) as found:
        rig.pause(page, 20 * scale)
    busy_ms = 1000 * (_busy_s(session.send("Performance.getMetrics")) - before)
    return {**found, f"{_R}: ms an update": [busy_ms / max(1, page.evaluate("bench.updates"))]}


def _busy_s(answer: dict[str, Any]) -> float:
    """Of script, style and layout so far."""
    values = {one["name"]: one["value"] for one in answer["metrics"]}
    return float(sum(values[name] for name in ("ScriptDuration", "LayoutDuration", "RecalcStyleDuration")))


@_case(
    Row("256 kbit/s: drive", p95=110), Row("256 kbit/s: drive, arrived", unit="%"),
    setting=partial(linked, _FAR, _ROBOT),
)  # fmt: skip
def far_link(rig: Rig, scale: float) -> Samples:
    """Driving over a link that is slow, far and lossy."""
    page = rig.drivable(_ROBOT)
    page.evaluate("bench.number = 1")
    end = time.monotonic() + 20 * scale
    while time.monotonic() < end:
        if not page.evaluate("pebble.driver.gestureActive"):
            page.keyboard.up(_KEY)
            with suppress(PebbleError):  # the page may refuse for a while, because commands are late
                rig.ready(page)
                rig.hold(page, _ROBOT, _KEY)
        rig.pause(page, 0.1)
    page.keyboard.up(_KEY)
    rig.pause(page, 1.0)
    sent = page.evaluate("bench.sent")
    arrived = {round(axes.get("y", 0.0), 3): at for at, base, axes in rig.drives if base == rig.ref(_ROBOT)}
    late = [1000 * (arrived[round(y, 3)] - monotonic(at)) for y, at in sent if round(y, 3) in arrived]
    return {"256 kbit/s: drive": late, "256 kbit/s: drive, arrived": [100 * len(late) / max(1, len(sent))]}


# -- the comparison

ROWS = {row.key: row for case in CASES.values() for row in case.rows}


def measure(case: Case) -> Iterator[Cell]:
    """One try. One that fails is noted, and its rows are empty."""
    name, notes = str(case.condition["case"]), case.run.notes
    about, samples = CASES[name], Samples()
    notes.append(f"{name}, try {case.number + 1}: load {os.getloadavg()[0]:.2f}")
    try:
        with about.setting() as made:
            samples = about.measure(made, case.run["scale"])
    except PebbleError as error:
        notes.append(f"{name}, try {case.number + 1}: {error}")
        case.run.console.print(notes[-1], style="red", highlight=False, markup=False)
    for row in about.rows:
        yield case.cell(row.key, row.unit, samples.get(row.key, []))


def goals(cells: Sequence[Cell]) -> Iterator[str | Judged]:
    """The goals as aims, each judged by the best try."""
    for cell in cells:
        row = ROWS[cell.measure]
        best = row.best(cell.rounds)
        measured = f"{figure(percentile(best, 50))} / {figure(percentile(best, 95))} {row.unit}"
        if row.goal:
            what = f"{row.key}, p50 / p95 {row.goal} {row.unit}"
            yield Judged(what=what, outcome=outcome(row.met(best), judged=bool(best)), measured=measured)
        else:
            yield f"{row.key}: {measured}"


PAGE = Comparison(
    name="page",
    title="The operator page",
    what="What a driver feels in a browser, and what the page's server costs, beside the goals.",
    help="""The operator page in a browser: what a driver feels, and what its server costs.

    From a key to the motors of a simulated robot, from whatever interrupts a driver to their stop, from the camera to
    the screen; many viewers, many robots, a slow link. Needs mosquitto and its clients, chromium, the extra dev, and
    root for the link.
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
    measure=measure,
    assessment=(goals,),
    reported=None,
)  # fmt: skip
