"""A robot, the page's server, and two tabs before the robot, of which one is connected by a proxy that stalls."""

from __future__ import annotations

import time
from contextlib import ExitStack

from tests.support import until
from tests.tcp_proxy import TcpProxy
from tests.web.browser import chromium
from tests.web.chromium_schedules.rules import BUSY_S, CERTAIN_S, PAGE_S, SILENCE_S, VALID_S, Motors, Press, problems
from tests.web.chromium_schedules.schedules import ACTIVE_S, Schedule, Step
from tests.web.console import Console, console
from tests.web.stage import Stage

_ANSWER_S = 0.4
_NO_PICTURE = "localStorage.setItem('pebble video {ref}', 'false')"  # its age is another test's
_REFUSALS = """() => {
  const { driver } = window.pebble;
  const before = driver.refused.bind(driver);
  window.refusals = new Set();
  driver.refused = (message) => { window.refusals.add(message.why); before(message); };
}"""
_PAGE = """() => {
  const { driver } = window.pebble;
  const { gesture, inputs } = driver;
  const [focus, element] = [document.hasFocus(), document.activeElement?.outerHTML.slice(0, 80)];
  const { number, active, mustRelease } = gesture;
  const held = [...inputs.keys.keys(), ...inputs.waiting.keys(), inputs.pointer];
  const refusals = [...window.refusals];
  return JSON.stringify({ reason: driver.reason(), number, active, mustRelease, held, focus, element, refusals });
}"""
_BUSY = "(ms) => { setTimeout(() => { const end = Date.now() + ms; while (Date.now() < end); }) }"


class World:
    """A world for many schedules; ``events`` are those of the present one. Tab 1 is the one behind the proxy."""

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self.events: list[tuple[float, str]] = []
        self._presses: list[Press] = []
        with ExitStack() as opened:
            self._proxy = TcpProxy(1)
            opened.callback(self._proxy.cut)
            names = ["127.0.0.1", f"127.0.0.1:{self._proxy.port}"]
            self.stage = opened.enter_context(Stage(robot, names=names))
            self._proxy.lead_to(int(self.stage.url.rpartition(":")[2].rstrip("/")))
            browser = opened.enter_context(chromium())
            script = _NO_PICTURE.format(ref=self.stage.ref(robot))
            urls = {1: f"http://127.0.0.1:{self._proxy.port}/", 2: self.stage.url}
            self.tabs: dict[int, Console] = {
                tab: opened.enter_context(console(browser, self.stage, robot, url=url, script=script))
                for tab, url in urls.items()
            }
            self._opened = opened.pop_all()

    def close(self) -> None:
        self.stage.server.thaw()
        self._proxy.resume()
        self._opened.close()

    def perform(self, schedule: Schedule) -> list[str]:
        """Returns what was violated."""
        self.events, self._presses = [], []
        self._begin()
        began = time.monotonic()
        for step in sorted(_with_ends(schedule.steps), key=lambda one: one.at):
            self._pause(began + step.at - time.monotonic())
            self._log(f"{step.what} {step.key} {step.axes} {step.seconds or ''}")
            getattr(self, "_" + step.what.replace(" ", "_").replace("'", ""))(step)
        self._pause(began + ACTIVE_S - time.monotonic())
        left = self._rest()
        now = time.monotonic()
        found = list(problems(self._presses, self.motors(began), now))
        return found + left

    def motors(self, since: float) -> Motors:
        """The changes of the motors since then, in seconds, and the state in which they were."""
        changes = [(ns / 1e9, wheels) for ns, wheels in self.stage.motors(self.robot)]
        before = [(since, wheels) for at, wheels in changes if at < since][-1:]
        return before + [(at, wheels) for at, wheels in changes if at >= since]

    # -- the beginning, and the end: everything works, and a new press drives

    def _begin(self) -> None:
        self._hidden = self._latched = self._obstructed = False
        self._server_away = False
        self._pending: list[Press] = []
        self._holder: int | None = 1
        self.tabs[1].page.evaluate("document.activeElement.blur()")
        self.tabs[1].take()

    def _rest(self) -> list[str]:
        for tab in self.tabs.values():
            tab.let_go()
        self._drop_stick(None)
        self._end(1, PAGE_S, "it was released")
        self._end(2, PAGE_S, "it was released")
        self._show(None)
        self._pause(PAGE_S + BUSY_S + 0.1)  # nothing may turn from then on
        self._log("rest")
        quiet = time.monotonic()
        self._pause(0.15)
        moved = self.stage.wheels_turning(self.robot, since_ns=int(1e9 * quiet))
        left = ["the wheels turn though nothing is held"] if moved else []
        return left + self._use()

    def _use(self) -> list[str]:
        one = self.tabs[1]
        try:
            one.take()
        except AssertionError:
            return [f"it cannot be driven any more: {one.reason}"]
        began = time.monotonic()
        self._log("a new press")
        one.page.evaluate(_REFUSALS)
        drives = one.drive()
        page = "" if drives else one.page.evaluate(_PAGE)
        lines = len([entry for entry in self.stage.lines(self.robot) if entry.ns > 1e9 * began])
        one.let_go()
        ended = time.monotonic()
        rests = one.rests()
        last = Press(1, "KeyW", (0, 1), began)
        last.end(ended, 1.0, "it was released")
        self._presses.append(last)
        failed = f"a new press does not drive, the MCU received {lines} lines: {page}"
        return [text for text, good in ((failed, drives), ("it does not rest", rests)) if not good]

    # -- what happens at tab 1

    def _press(self, step: Step) -> None:
        if step.key not in self.tabs[1].held and not self._opposed(step):
            self._begins(1, step.key, step.axes)
            self.tabs[1].down(step.key)

    def _release(self, _: Step) -> None:
        self.tabs[1].let_go()
        self._end(1, PAGE_S, "it was released", but="stick")

    def _stick(self, step: Step) -> None:
        left, top, size = self.tabs[1].place("stick")
        mouse = self.tabs[1].page.mouse
        self._drop_stick(step)
        if self._opposed(step):
            return
        mouse.move(left, top)
        self._begins(1, "stick", step.axes)
        mouse.down()
        mouse.move(left + 0.4 * step.axes[0] * size, top - 0.4 * step.axes[1] * size)

    def _drop_stick(self, _: Step | None) -> None:
        self.tabs[1].page.mouse.up()
        self._end(1, PAGE_S, "the stick was released", only="stick")

    def _blur(self, _: Step) -> None:
        self.tabs[1].tab.blur()
        self._end(1, PAGE_S, "another window has the focus")

    def _hide(self, _: Step) -> None:
        self.tabs[1].tab.hide()
        self._hidden = True
        self._end(1, PAGE_S, "the page is hidden")

    def _show(self, _: Step | None) -> None:
        self._hidden = False
        self.tabs[1].tab.hide(hidden=False)

    def _menu(self, _: Step) -> None:
        self.tabs[1].page.evaluate("() => { document.dispatchEvent(new Event('contextmenu')) }")
        self._end(1, PAGE_S, "a menu was opened")

    def _space(self, _: Step) -> None:
        self._space_by(1, 2)

    def _reload(self, _: Step) -> None:
        if self._server_away or self._obstructed:
            return  # there would be no page
        self.tabs[1].page.reload(wait_until="domcontentloaded")
        self._hidden = False
        self._end(1, PAGE_S, "the page was loaded anew")
        self.tabs[1].because("", "free", "lease", "stopped", within=5)

    def _take(self, _: Step) -> None:
        self._taken_by(1, 2)

    def _give_back(self, _: Step) -> None:
        self.tabs[1].page.evaluate("window.pebble.driver.release()")
        self._end(1, PAGE_S, "the robot was released")
        if self._holder == 1 and until(lambda: not self._has(1), _ANSWER_S):
            self._holder = 0 if self._clear else None

    def _stop(self, _: Step) -> None:
        self._stopped_by(1)

    # -- what happens at tab 2

    def _other_takes(self, _: Step) -> None:
        self._taken_by(2, 1)

    def _other_drives(self, _: Step) -> None:
        if self._holder == 2:
            self._begins(2, "KeyS", (0, -1))
            self.tabs[2].down("KeyS")
            self._pause(0.25)
            self.tabs[2].let_go()
            self._end(2, PAGE_S, "it was released")

    def _others_space(self, _: Step) -> None:
        self._space_by(2, 1)

    def _other_stops(self, _: Step) -> None:
        self._stopped_by(2)

    def _reset(self, _: Step) -> None:
        self._latched = False
        if self.tabs[2].reason == "stopped":
            self.tabs[2].reset()

    # -- what fails

    def _stall(self, step: Step) -> None:
        self._obstructed = True
        self._proxy.blackhole()
        self._fails(1, SILENCE_S, "its connection stalls", step)

    def _stall_ends(self, _: Step) -> None:
        self._proxy.resume()
        self._obstructed = False
        self._acknowledge()

    def _cut(self, _: Step) -> None:
        self._proxy.drop()
        self._holder = None
        for press in self._alive(1):
            press.end(time.monotonic(), PAGE_S, "its connection was cut")

    def _busy(self, step: Step) -> None:
        self.tabs[1].page.evaluate(_BUSY, 1000 * step.seconds)
        self._fails(1, SILENCE_S, "its page stands still", step)

    def _freeze(self, step: Step) -> None:
        self.tabs[1].tab.freeze()
        self._fails(1, SILENCE_S, "its page is suspended", step)
        time.sleep(step.seconds)
        self.tabs[1].tab.thaw()

    def _suspend_server(self, step: Step) -> None:
        self._server_away = True
        self.stage.server.freeze()
        for tab in self.tabs:
            self._fails(tab, VALID_S, "the server stands still", step)

    def _suspend_server_ends(self, _: Step) -> None:
        self.stage.server.thaw()
        self._server_away = False
        self._acknowledge()

    def _kill_server(self, _: Step) -> None:
        self.stage.server.kill()
        self._holder = None
        for press in [*self._alive(1), *self._alive(2)]:
            press.end(time.monotonic(), VALID_S, "the server was killed")
        self._pending.clear()
        self.stage.restart_server()
        self._server_away = False

    # -- what is alive

    def _begins(self, tab: int, name: str, axes: tuple[int, int]) -> None:
        """An input is pressed now. One of a page that may not drive stays dead."""
        dead = (tab == 1 and self._hidden) or self._latched or self._holder not in (tab, None)
        self._presses.append(Press(tab, name, axes, float("inf") if dead else time.monotonic()))

    def _opposed(self, step: Step) -> bool:
        """Whether the opposite is held: together they are no gesture that anything could end."""
        x, z = step.axes
        return any(one.axes == (-x, -z) for one in self._alive(1))

    def _alive(self, tab: int) -> list[Press]:
        return [one for one in self._presses if one.tab == tab and one.until == float("inf")]

    def _end(self, tab: int, within: float, why: str, *, by: int = 0, only: str = "", but: str = "") -> None:
        """Its inputs are over, or will be once what obstructs the way of tab ``by`` is over."""
        for press in self._alive(tab):
            if press.name == but or (only and press.name != only):
                continue
            if self._server_away or (self._obstructed and (by or tab) == 1):
                self._pending.append(press)
            else:
                press.end(time.monotonic(), within, why)

    def _fails(self, tab: int, within: float, why: str, step: Step) -> None:
        """A fault begins; one that is short may end a gesture."""
        self._holder = None
        if step.seconds >= CERTAIN_S:
            for press in self._alive(tab):
                press.end(time.monotonic(), within, why)

    def _acknowledge(self) -> None:
        """What was on its way has arrived."""
        if self._clear:
            for press in self._pending:
                press.end(time.monotonic(), SILENCE_S, "it was ended before a fault was over")
            self._pending.clear()

    @property
    def _clear(self) -> bool:
        return not (self._server_away or self._obstructed)

    def _taken_by(self, tab: int, other: int) -> None:
        self.tabs[tab].page.evaluate("window.pebble.driver.take(true)")
        self._end(tab, PAGE_S, "its tab has taken control anew")
        taken = self._clear and until(lambda: self._has(tab), _ANSWER_S)
        self._holder = tab if taken else None
        if taken:
            self._end(other, PAGE_S, "the other tab has taken control")

    def _space_by(self, tab: int, other: int) -> None:
        connected = self._connected(tab)
        self.tabs[tab].page.keyboard.press("Space")
        self._end(tab, PAGE_S, "the space bar")
        if connected and self._connected(tab):
            self._end(other, PAGE_S, "the space bar of the other tab", by=tab)

    def _connected(self, tab: int) -> bool:
        return bool(self.tabs[tab].page.evaluate("window.pebble?.connection.isOpen"))

    def _has(self, tab: int) -> bool:
        """Whether this tab has the lease, by what it was sent."""
        return bool((self.tabs[tab].state("web/driver") or {}).get("you"))

    def _stopped_by(self, tab: int) -> None:
        self.tabs[tab].page.evaluate("(ref) => window.pebble.commands.stop(ref)", self.tabs[tab].ref)
        if self._clear and until(lambda: self.tabs[2].reason == "stopped", 2 * _ANSWER_S):
            self._latched = True
            for press in [*self._alive(1), *self._alive(2)]:
                press.end(time.monotonic(), SILENCE_S, "the robot is stopped")

    # -- time

    def _pause(self, seconds: float) -> None:
        if seconds > 0:
            self.tabs[2].page.wait_for_timeout(1000 * seconds)

    def _log(self, text: str) -> None:
        self.events.append((time.monotonic(), text))


def _with_ends(steps: tuple[Step, ...]) -> list[Step]:
    """Stalls and suspended servers end with a step of their own."""
    ends = [Step(one.at + one.seconds, f"{one.what} ends") for one in steps if one.what in ("stall", "suspend server")]
    return [*steps, *ends]
