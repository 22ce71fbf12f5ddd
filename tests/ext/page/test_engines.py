"""The page in Firefox and in WebKitGTK: one drives and stops a robot, and the keys of a stop work in every state."""

from __future__ import annotations

import http.client
import itertools
import json
import os
import re
import shutil
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from tests.ext.page.served import Served
from tests.kit.played_robot import RecordingRobot
from tests.support import WAIT_S, Broker, Child, free_port, listening, until

pytestmark = [pytest.mark.page, pytest.mark.timeout(400)]

#: Keys that a character cannot name, as WebDriver has them (W3C WebDriver, 17.4.2).
KEYS = {"Escape": "\ue00c", "Enter": "\ue007", "Control": "\ue009", "Meta": "\ue03d", "Space": " "}
SIZE = (1280, 800)
#: Of a Firefox that asks no other host for anything.
QUIET = {
    "app.update.enabled": False,
    "browser.shell.checkDefaultBrowser": False,
    "browser.startup.homepage_override.mstone": "ignore",
    "datareporting.policy.dataSubmissionEnabled": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
    "services.settings.server": "http://127.0.0.1:1",
    "toolkit.telemetry.enabled": False,
}
_WAIT_S = 60.0


class Engine(ABC):
    """One window of a browser that shows one page."""

    name: str

    @abstractmethod
    def open(self, url: str) -> None:
        """Show ``url``; return once it has been loaded."""

    @abstractmethod
    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; a promise is awaited."""

    @abstractmethod
    def perform(self, actions: list[dict[str, Any]]) -> None:
        """Perform input as WebDriver's actions describe it, then release everything that is pressed."""

    def until(self, expression: str, timeout: float = _WAIT_S) -> bool:
        """Wait until an expression is true; assert on the result."""
        return until(lambda: self.evaluate(f"Boolean({expression})"), timeout)

    def press(self, chord: str, times: int = 1, ms: int = 0) -> None:
        """Press keys together, such as "Control+Enter", for some milliseconds; some times in quick succession."""
        codes = [KEYS.get(key, key) for key in chord.split("+")]
        keys: list[dict[str, Any]] = [{"type": "keyDown", "value": code} for code in codes]
        keys += [{"type": "pause", "duration": ms}, *({"type": "keyUp", "value": code} for code in reversed(codes))]
        self.perform([{"type": "key", "id": "keys", "actions": [*keys, {"type": "pause", "duration": 100}] * times}])

    def click(self, selector: str, hold_ms: int = 0) -> None:
        """Press the middle of an element with the mouse, once it is shown and rests."""
        found = f"[...document.querySelectorAll({json.dumps(selector)})].find((one) => one.getClientRects().length)"
        scrolled = f"({found}?.scrollIntoView({{ block: 'nearest' }}), {found})"
        assert self.until(scrolled), f"{self.name} shows no {selector}"
        box = f"{found}?.getBoundingClientRect()"
        middle = f"((box) => box && [box.x + box.width / 2, box.y + box.height / 2])({box}) ?? null"
        places: list[Any] = [None]
        while places[-1] is None or places[-1] != places[-2]:
            assert len(places) < 400, f"{self.name}: {selector} does not rest"
            time.sleep(0.15)
            places.append(self.evaluate(middle))
        x, y = places[-1]
        steps: list[dict[str, Any]] = [
            {"type": "pointerMove", "x": int(x), "y": int(y)},
            {"type": "pointerDown", "button": 0},
            {"type": "pause", "duration": hold_ms},
            {"type": "pointerUp", "button": 0},
        ]
        self.perform([{"type": "pointer", "id": "mouse", "actions": steps}])


class Firefox(Engine):
    """Debian's Firefox without a window, by the protocol that it speaks itself."""

    name = "Firefox"

    def __init__(self, connection: ClientConnection) -> None:
        self._connection, self._numbers = connection, itertools.count(1)
        self._send("session.new", capabilities={})
        self._context = self._send("browsingContext.create", type="tab")["context"]
        viewport = dict(zip(("width", "height"), SIZE, strict=True))
        self._send("browsingContext.setViewport", context=self._context, viewport=viewport)

    def open(self, url: str) -> None:
        self._send("browsingContext.navigate", context=self._context, url=url, wait="complete")

    def evaluate(self, expression: str) -> Any:
        answer = self._send(
            "script.evaluate",
            expression=f"(async () => JSON.stringify(await ({expression})))()",
            target={"context": self._context},
            awaitPromise=True,
            userActivation=True,
        )
        assert answer["type"] == "success", answer["exceptionDetails"]["text"]
        return json.loads(answer["result"].get("value", "null"))

    def perform(self, actions: list[dict[str, Any]]) -> None:
        self._send("input.performActions", context=self._context, actions=actions)
        self._send("input.releaseActions", context=self._context)

    def _send(self, method: str, **parameters: Any) -> Any:
        """Return the result of a command."""
        number = next(self._numbers)
        self._connection.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(120))
            if answer.get("id") == number:
                assert answer["type"] == "success", f"{method}: {answer.get('message')}"
                return answer["result"]


class WebKit(Engine):
    """WebKitGTK's own small browser, by its WebDriver."""

    name = "WebKitGTK"

    def __init__(self, port: int, browser: str) -> None:
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
        options = {"binary": browser, "args": ["--automation"]}
        self._path = ""
        session = self._send("POST", "/session", capabilities={"alwaysMatch": {"webkitgtk:browserOptions": options}})
        self._path = f"/session/{session['sessionId']}"
        self._send("POST", "/window/rect", width=SIZE[0], height=SIZE[1])

    def open(self, url: str) -> None:
        self._send("POST", "/url", url=url)

    def evaluate(self, expression: str) -> Any:
        script = f"""const done = arguments[0];
            (async () => ({expression}))().then((value) => done([value]), (error) => done(String(error)))"""
        answer = self._send("POST", "/execute/async", script=script, args=[])
        assert isinstance(answer, list), answer
        return answer[0]

    def perform(self, actions: list[dict[str, Any]]) -> None:
        self._send("POST", "/actions", actions=actions)
        self._send("DELETE", "/actions")

    def close(self) -> None:
        self._send("DELETE", "")
        self._connection.close()

    def _send(self, method: str, path: str, **body: Any) -> Any:
        """Return the value of the answer."""
        text = json.dumps(body) if method == "POST" else None
        self._connection.request(method, self._path + path, text, {"content-type": "application/json"})
        value = json.loads(self._connection.getresponse().read())["value"]
        assert not (isinstance(value, dict) and "error" in value), value
        return value


@contextmanager
def firefox(folder: Path) -> Iterator[Firefox]:
    """A Firefox with a new profile in ``folder``."""
    program = shutil.which("firefox-esr") or pytest.skip("no Firefox: apt install firefox-esr")
    lines = [f"user_pref({json.dumps(key)}, {json.dumps(value)});\n" for key, value in QUIET.items()]
    (folder / "user.js").write_text("".join(lines))
    command = [program, "--headless", "--no-remote", "--profile", str(folder), "--remote-debugging-port", "0"]
    with running(command, folder / "output") as output:
        found = lambda: re.search(r"BiDi listening on (ws://\S+)", output.read_text(errors="replace"))
        assert until(lambda: found() is not None, 60), output.read_text(errors="replace")
        match = found()
        assert match is not None
        with connect(f"{match[1]}/session", max_size=None, open_timeout=30, ping_interval=None) as connection:
            yield Firefox(connection)


@contextmanager
def webkit(folder: Path) -> Iterator[WebKit]:
    """WebKitGTK's browser on a screen that nobody sees, with everything that it stores in ``folder``."""
    browsers = sorted(Path("/usr/lib").glob("*/webkit2gtk-4.*/MiniBrowser"))
    if not browsers or not shutil.which("WebKitWebDriver") or not shutil.which("Xvfb"):
        pytest.skip("no WebKitGTK: apt install webkit2gtk-driver xvfb")
    port = free_port()
    with ExitStack() as stack:
        screen = ["Xvfb", "-displayfd", "1", "-nolisten", "tcp", "-screen", "0", "1400x1000x24"]
        number = stack.enter_context(running(screen, folder / "display"))
        assert until(lambda: number.read_text().endswith("\n")), "Xvfb did not start"
        homes = {name: str(folder) for name in ("HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")}
        environment = {**os.environ, **homes, "DISPLAY": f":{number.read_text().strip()}", "LC_ALL": "C"}
        environment |= {"NO_AT_BRIDGE": "1", "LIBGL_ALWAYS_SOFTWARE": "1"}
        driver = ["WebKitWebDriver", "--host=127.0.0.1", f"--port={port}"]
        stack.enter_context(running(driver, folder / "driver", environment))
        assert until(lambda: listening(port)), "WebKitWebDriver did not start"
        yield stack.enter_context(closing(WebKit(port, str(browsers[-1]))))


@contextmanager
def running(command: list[str], output: Path, env: Mapping[str, str] | None = None) -> Iterator[Path]:
    """A program and all that it starts; yields the file with its output."""
    with output.open("wb") as file:
        process = Child(command, stdout=file, stderr=file, env=env, start_new_session=True)
    try:
        yield output
    finally:
        process.terminate()
        try:
            process.wait(WAIT_S)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


_NUMBERS = itertools.count(1)


@pytest.fixture(scope="module", params=["Firefox", "WebKitGTK"])
def engine(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    folder = tmp_path_factory.mktemp(request.param)
    with firefox(folder) if request.param == "Firefox" else webkit(folder) as running:
        yield running


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, f"pebble/robots/robot{next(_NUMBERS)}", keeps=True) as running:
        yield running


def shown(engine: Engine, served: Served, robot: RecordingRobot) -> None:
    """Open the robot's page."""
    engine.open(f"{served.origin}/r/{robot.base}")
    assert engine.until("globalThis.pebble?.connection?.isOpen && document.querySelector('[data-test=take]')")


def test_a_person_drives_and_stops_a_robot(engine: Engine, served: Served, robot: RecordingRobot) -> None:
    engine.open(served.origin)
    card = f"[href$='/r/{robot.base}']"
    assert engine.until(f"document.querySelectorAll('.fleet-card').length === 1 && document.querySelector({card!r})")
    engine.click(card)  # the cards of earlier robots have left, and none moves
    engine.click("[data-test=take]")
    assert engine.until("document.querySelector('[data-test=release]')")
    for _ in range(5):  # the first command waits until the page knows how long messages take
        engine.press("w", ms=800)
        if any(drive.get("z", 0) > 0 for drive in robot.drives()):
            break
    assert any(drive.get("z", 0) > 0 for drive in robot.drives())
    assert until(lambda: robot.drives()[-1].get("z") == 0)
    engine.click("[data-test=release]")
    assert engine.until("document.querySelector('[data-test=take]')")
    engine.click("[data-test=stop-one]")
    assert until(lambda: robot.latched)
    engine.click("[data-test=reset]")
    assert engine.until("document.querySelector('[data-test=reset-hold]')")
    engine.click("[data-test=reset-hold]", hold_ms=2000)
    assert until(lambda: not robot.latched)


def _full_screen(engine: Engine) -> None:
    if engine.evaluate("Boolean(document.fullscreenElement)"):
        return
    full = "document.documentElement.requestFullscreen()"
    engine.evaluate(f"void addEventListener('click', () => {full}, {{ once: true }})")
    engine.click("h2")
    assert engine.until("document.fullscreenElement")


def _list(engine: Engine) -> None:
    engine.click("[data-test=picker]")
    time.sleep(0.5)


def _dialog(engine: Engine) -> None:
    """Open the settings, if they are not open yet: a click beside an open dialog would close it."""
    if not engine.until("document.querySelector('dialog[open]')", 1):
        engine.click("[data-test=settings]")
        assert engine.until("document.querySelector('dialog[open]')")


WHERE: dict[str, Callable[[Engine], object]] = {
    "nothing": lambda _: None,
    "full screen": _full_screen,
    "an open list": _list,
    "a dialog": _dialog,
    "another window": lambda engine: engine.evaluate("void dispatchEvent(new Event('blur'))"),
}
CHORDS = {"Ctrl+Enter": 1, "⌘+Enter": 1, "Ctrl+Space": 1, "Escape": 2}


@pytest.mark.parametrize(("where", "chord"), list(itertools.product(WHERE, CHORDS)))
def test_the_keys_of_a_stop_work_and_one_escape_stops_nothing(
    engine: Engine, served: Served, robot: RecordingRobot, where: str, chord: str
) -> None:
    shown(engine, served, robot)
    WHERE[where](engine)
    engine.press("Escape")
    assert not until(lambda: robot.latched, 1)

    def stops() -> bool:
        """True if it stops; a busy machine may take too long between two presses of Escape."""
        WHERE[where](engine)
        engine.press(chord.replace("⌘", "Meta").replace("Ctrl", "Control"), CHORDS[chord])
        return until(lambda: robot.latched, 3)

    assert until(stops, 60)
