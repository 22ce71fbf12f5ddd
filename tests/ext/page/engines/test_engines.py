"""The page in other browsers: one drives and stops a robot, and the keys of a stop work in every state."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator

import pytest

from tests.ext.page.engines.engines import Engine, firefox, webkit
from tests.ext.page.served import Served
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

pytestmark = [pytest.mark.page, pytest.mark.timeout(400)]

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
