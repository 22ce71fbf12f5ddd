"""The checker finds every planted violation of the smallest honest robot, and passes it as it is."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pebble.client.connection import Target
from pebble.conform.checks import CHECKS, Check, run
from pebble.conform.component import Component, reached
from pebble.conform.motion import MOVING
from pebble.conform.power import CUT
from pebble.selftest import State
from tests.support import ROOT, Broker

pytestmark = pytest.mark.alone  # deadlines of wheels are checked

SOURCE = (ROOT / "examples" / "your-robot" / "robot.py").read_text()
ALL = {check.name: check for check in (*CHECKS, *MOVING, *CUT)}
LOOKS_S = 2.0

#: By check: what is written into the robot's program, and in place of what.
VIOLATIONS: dict[str, tuple[str, str]] = {
    "heartbeat": ("heartbeat_at = now() + 0.25", "heartbeat_at = now() + 5"),
    "clock": ("int(1000 * time.time())", "int(1000 * time.time()) + 3_600_000"),
    "payloads": ('{"t": epoch_ms()}), qos=0', '{"t": str(time.time())}), qos=0'),
    "numbers": ('{"wheels": wheels}', '{"wheels": wheels, "amperes": math.nan}'),
    "sizes": ('"why": stop.get("why", "")', '"why": 400 * "x"'),
    "retained": ("qos=0, retain=True", "qos=0, retain=False"),
    "parked commands": ("publish_control()\n\n\nclient", 'client.publish(IN + "control", "{}", 1, True)\n\n\nclient'),
    "capabilities": ('"available": True', '"available": "yes"'),
    "own topics": ('"topic": IN + "drive-values"', '"topic": "pebble/robots/other/incoming/drive-values"'),
    "identity": ('BASE.split("/")', '("pebble", "robots", "other")'),
    "junk": ("(ValueError, KeyError, TypeError, OverflowError, RecursionError)", "KeyError"),
    "stop states": ('publish(f"estop/{OWNER}"', 'publish("estop/others"'),
    "stop": ("latched=True", "latched=False"),
    "stop once": ('if name not in stop["recent"]:', "if True:"),
    "stop unread": ("        claims = {}\n", "        return\n"),
    "stop holds": (
        "        return turn(0.0, 0.0, 0.0)\n",
        '        stop["latched"] = False\n        return publish_stop()\n',
    ),
    "reset refused": ("    if refused is None and", "    if"),
    "control": ('elif take or not holder["key"]', "elif True or take"),
    "control released": ('if asker["id"] == holder["id"]:\n            pass_on', "if False:\n            pass_on"),
    "control ends": ('now() > holder["ends"]:', "False:"),
    "dead man": ("DEAD_MAN_S, PAUSE_S, LONGEST = 0.75", "DEAD_MAN_S, PAUSE_S, LONGEST = 3.0"),
    "validity": ("max(0.0, valid / 1000)", "valid + DEAD_MAN_S"),
    "zero": ("        return turn(0.0, 0.0, 0.0)\n", "        return None\n"),
    "no number": ("if not all(map(math.isfinite, numbers)):", "if False:"),
    "clamps": ("turn(max(-1.0, min(1.0, z + x))", "turn(z - 2 * x"),
    "foreign key": ("elif allowed and", "elif"),
    "stop moving": ('and not stop["latched"]', ""),
    "will": ('json.dumps({"t": epoch_ms(), "online": False})', 'json.dumps({"t": epoch_ms()})'),
    "retained commands": ("if message.retain or found is None", "if found is None"),
    "stop survives": ("os.path.exists(STOP_FILE)", "False"),
}


class Machine:
    """The computer of the robot, which can be switched off and on."""

    def __init__(self, broker: Broker, folder: Path, source: str) -> None:
        self._program = folder / "robot.py"
        self._program.write_text(source)
        self._command = [
            sys.executable,
            str(self._program),
            "mine",
            "127.0.0.1",
            str(broker.port),
            str(folder / "stop.json"),
        ]
        self._process: subprocess.Popen[bytes] | None = None

    def on(self) -> None:
        self._process = subprocess.Popen(self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def off(self) -> None:
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def ask(self, text: str) -> None:
        """What a person does who is asked to."""
        cut = "cut" in text
        if cut:
            self.off()
        if not cut or "for a moment" in text:
            self.on()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.stop()


@contextmanager
def robot(broker: Broker, folder: Path, source: str) -> Iterator[Component]:
    machine = Machine(broker, folder, source)
    machine.on()
    try:
        with reached(Target(url=f"mqtt://127.0.0.1:{broker.port}", robot="mine"), LOOKS_S) as component:
            component.wait(lambda: component.view.capabilities, 10)
            component.look(LOOKS_S)
            component.ask, component.person_s = machine.ask, 15.0
            yield component
    finally:
        machine.off()


def judged(component: Component, *checks: Check) -> dict[str, tuple[State, str]]:
    return {check.name: (outcome.state, outcome.text) for check, outcome in run(component, checks)}


def test_the_smallest_honest_robot_passes(broker: Broker, tmp_path: Path) -> None:
    with robot(broker, tmp_path, SOURCE) as component:
        found = judged(component, *ALL.values())
    assert {name: one for name, one in found.items() if one[0] is not State.OK} == {}
    assert len(found) >= 20


@pytest.mark.parametrize("name", ALL)
def test_a_violation_is_found(broker: Broker, tmp_path: Path, name: str) -> None:
    old, new = VIOLATIONS[name]
    assert old in SOURCE
    needs = [ALL["will"]] if name == "retained commands" else []
    with robot(broker, tmp_path, SOURCE.replace(old, new)) as component:
        assert judged(component, *needs, ALL[name])[name][0] is State.FAILED
