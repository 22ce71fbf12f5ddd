"""The checker finds every planted violation of the smallest honest robot, and passes it as it is."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from pebble.check_result import CheckResult, State
from pebble.client.connection import Target
from pebble.conform.checks import CHECKS, LAST, Check
from pebble.conform.checks import run as results
from pebble.conform.component import Component, reached
from pebble.conform.control import CONTROL, UNSEEN
from pebble.conform.motion import MOVING
from pebble.conform.power import CUT
from pebble.contract import ONLINE
from pebble.selftest import failed, ok
from pebble.transports import MqttSettings, QoS
from pebble.transports.mqtt.transport import MqttTransport
from tests.commands.command_line import Run
from tests.commands.conftest import run as run
from tests.conform.programs import (
    NATS,
    ROBOTS,
    WITHOUT_NATS,
    Command,
    Hall,
    Language,
    at_named,
    at_open,
    believing,
    ended,
    named_by_nats,
    named_by_the_fleet,
    sketch,
    source,
)
from tests.fleet.conftest import cheap_hashes as cheap_hashes
from tests.support import Broker, Child, beside, further, some

pytestmark = pytest.mark.alone  # deadlines of wheels are checked

SOURCE = source("robot", "py").read_text()
ALL = {check.name: check for check in (*CHECKS, *CONTROL, *MOVING, *LAST, *CUT)}
LOOKS_S = 2.0

#: The check that finds it, how that names it, and what is written into the robot's program, in place of what.
VIOLATIONS = (
    ("heartbeat", "in the time of observation", "heartbeat_at = now() + 0.25", "heartbeat_at = now() + 5"),
    ("heartbeat", "one every 1.5", "heartbeat_at = now() + 0.25", "heartbeat_at = now() + 1.5"),
    ("clock", "3600 s ahead", "int(1000 * time.time())", "int(1000 * time.time()) + 3_600_000"),
    ("payloads", "online: Expected `int`", '{"t": epoch_ms()}, qos=0', '{"t": str(time.time())}, qos=0'),
    ("numbers", "not JSON: outgoing/status", '{"wheels": self.wheels}', '{"wheels": self.wheels, "amperes": math.nan}'),
    ("sizes", "outgoing/estop/motors has", '"by": "", "why": "", "since"', '"by": "", "why": 400 * "x", "since"'),
    ("retained", "not retained:", "qos, retain=True", "qos, retain=False"),
    (
        "parked commands",
        "incoming/control",
        "    def publish(self",
        '        client.publish(IN + "control", "{}", 1, True)\n\n    def publish(self',
    ),
    ("capabilities", "Expected `bool`", '"available": True', '"available": "yes"'),
    (
        "own topics",
        "drive.topic is",
        '"controls": True',
        '"controls": True, "topic": "pebble/robots/other/incoming/drive-values"',
    ),
    ("identity", "it calls itself", '"id": ID', '"id": "other"'),
    (
        "junk",
        "its heartbeats ended",
        "(ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)",
        "(KeyError)",
    ),
    ("stop states", "no state of outgoing/estop/motors", 'publish(f"estop/{OWNER}"', 'publish("estop/others"'),
    ("stop", "no state has its name", 'self.stop = {"latched": True', 'self.stop = {"latched": False'),
    ("stop once", "its repetition counts again", 'if name not in self.stop["recent"]:', "if True:"),
    (
        "stop once",
        "its repetition after a reset stops it again",
        'self.stop | {"latched": False}',
        'self.stop | {"latched": False, "recent": []}',
    ),
    (
        "stop unread",
        "a stop that is no JSON does nothing",
        "            claims = dict(json.loads(payload))",
        "            claims = {}\n        claims = dict(json.loads(payload))",
    ),
    (
        "stop holds",
        "a drive command ends the stop",
        "        if not x and not z:\n",
        "        if not x and not z:\n            self.stop = FREE\n            self.publish_stop()\n",
    ),
    ("reset refused", "a reset with an older count ends it", "if self.refused is None and", "if"),
    ("control", "a second request takes it", 'elif take or mine or not self.holder["key"]:', "elif True:"),
    ("control asked", "a second request is not shown", '{"asks": new["by"], "asks_id": new["id"]}', "UNASKED"),
    ("control asked", "it is shown after its end", "now() <= robot.asks_until", "True"),
    ("control released", "it is kept after its release", "NONE if mine else self.holder", "self.holder"),
    ("control released", "another's release ends it", "NONE if mine else self.holder", "NONE"),
    ("control taken", "the one who has it keeps it", "elif take or mine or", "elif mine or"),
    ("control taken", "its key stays", "secrets.token_hex(4)})", '"0badf00e"})'),
    ("control ends", "it stays with who went away", "now() > robot.ends:", "False:"),
    ("control ends", "it ends in the middle of its commands", "if mine else self.ends", "if False else self.ends"),
    (
        "dead man",
        "it still moves after the last command",
        'DEAD_MAN_S, PAUSE_S, LONGEST = "motors", 0.75',
        'DEAD_MAN_S, PAUSE_S, LONGEST = "motors", 3.0',
    ),
    (
        "validity",
        "it still moves after the last command",
        'command.get("valid_ms", 1000 * DEAD_MAN_S)',
        "1000 * DEAD_MAN_S",
    ),
    ("validity", "valid_ms 4000: it", "min(DEAD_MAN_S, max(", "max(0.0, max("),
    (
        "zero",
        "after a zero with another key",
        "            self.turn(0.0, 0.0, 0.0)\n            self.paused_at",
        "            self.paused_at",
    ),
    (
        "zero",
        "after a zero with another key",
        "        if not x and not z:\n",
        '        if not (x or z or mine) and "key" in command:\n            return\n        if not x and not z:\n',
    ),
    (
        "steering",
        "at x 0.4, z 0 its wheels do [0.4, 0.4]",
        'command.get("x", 0), command.get("z", 0)',
        'command.get("z", 0), command.get("x", 0)',
    ),
    (
        "steering",
        "at x 0.4, z 0 its wheels do [-0.4, 0.4]",
        "min(1.0, z + x)), max(-1.0, min(1.0, z - x))",
        "min(1.0, z - x)), max(-1.0, min(1.0, z + x))",
    ),
    ("steering", "within value its wheels do []", 'value["value"] if type', "value if type"),
    ("no number", "no number", "math.isfinite(one) for", "True for"),
    ("clamps", "a wheel got 3", "self.turn(max(-1.0, min(1.0, z + x))", "self.turn(z - 2 * x"),
    ("foreign key", "it moves by another's key", '(mine or ("key" not in command and not NAMED))', "True"),
    ("foreign key", "while no one has control", '(mine or ("key"', '(mine or not self.holder["key"] or ("key"'),
    (
        "control passes",
        "after another took control",
        "to, UNASKED\n            self.turn(0.0, 0.0, 0.0)",
        "to, UNASKED",
    ),
    ("stop moving", "after the stop", 'elif not self.stop["latched"] and', "elif"),
    ("reset waits", "a stick that is held down", "elif now() < self.paused_at + PAUSE_S:", "elif False:"),
    (
        "reset waits",
        "a stick that is held down",
        '-math.inf if mine or not self.holder["key"] else self.paused_at',
        "-math.inf",
    ),
    (
        "long messages",
        "no stop reaches it",
        "client.on_connect, client.on_message = robot.connected, robot.receive",
        "client.manual_ack_set(True)\n"
        "client.on_connect, client.on_message = robot.connected, lambda client, data, message: (\n"
        "    robot.receive(client, data, message),\n"
        "    len(message.payload) < 1024 and client.ack(message.mid, message.qos))",
    ),
    (
        "will",
        "nothing tells that it is gone",
        'json.dumps({"t": epoch_ms(), "online": False})',
        'json.dumps({"t": epoch_ms()})',
    ),
    ("retained commands", "it stops by a retained stop", "if message.retain:", "if False:"),
    ("stop survives", "it is free after a power cut", "self.stop |= json.load(open(STOP_FILE))", "self.stop = FREE"),
)

#: The same at level named.
NAMED_VIOLATIONS = (
    ("control", "its state tells that 'conform' has it", 'f"{account}/{by}".strip("/")[:40]', "by"),
    (
        "nameless",
        "a reset without an account",
        'metric == "estop-reset" and (account or not NAMED)',
        'metric == "estop-reset"',
    ),
    ("nameless", "a request without an account", '"control/take") and (account or not NAMED)', '"control/take")'),
    ("keyless", "without a key", '("key" not in command and not NAMED)', '"key" not in command'),
    (
        "foreign account",
        "a key that another sends",
        '(command.get("key"), account) == (self.holder["key"], self.account)',
        'command.get("key") == self.holder["key"]',
    ),
)


class Machine:
    """The computer of the robot, which can be switched off and on."""

    def __init__(self, command: Sequence[str | Path]) -> None:
        self._command = [str(one) for one in command]
        self._process: subprocess.Popen[bytes] | None = None

    def on(self) -> None:
        self._process = Child(self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

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


@contextmanager
def switched_on(command: Sequence[str | Path], target: Target) -> Iterator[Component]:
    """A robot, and who looks at it through its broker."""
    machine = Machine(command)
    machine.on()
    try:
        with reached(target, LOOKS_S) as component:
            component.wait(lambda: component.view.capabilities, 30)
            component.look(LOOKS_S)
            component.wait(lambda: len(component.of(ONLINE)) > 2, LOOKS_S)  # its interval is seen by three of them
            component.ask, component.person_s = machine.ask, 30.0
            yield component
    finally:
        machine.off()


def with_stop_file(arguments: Command, folder: Path) -> Command:
    return [*arguments[:3], folder / "stop.json", *arguments[3:]]


Found = dict[str, tuple[State, str]]


def judged(component: Component, *checks: Check[Component]) -> Found:
    return {check.name: (outcome.state, outcome.text) for check, outcome in results(component, checks)}


def lacking(found: Found) -> Found:
    return {name: one for name, one in found.items() if one[0] is not State.OK}


@pytest.mark.parametrize("language", [ROBOTS[0], *map(further, ROBOTS[1:])])
def test_the_smallest_honest_robot_passes(broker: Broker, tmp_path: Path, language: Language) -> None:
    program = language("robot", tmp_path)
    arguments, target = at_open(broker)
    with switched_on([*program, *with_stop_file(arguments, tmp_path)], target) as component:
        found = judged(component, *ALL.values())
    assert lacking(found) == {}
    assert len(found) >= 20


#: What a driver's account is not shown at a broker that checks names.
REFUSED = {
    "parked commands": (State.SKIPPED, "its broker does not let this account read incoming/: use an admin's"),
    "nameless": (State.SKIPPED, UNSEEN),
    "foreign account": (State.SKIPPED, UNSEEN),
}


@pytest.mark.usefixtures("cheap_hashes")
@pytest.mark.parametrize(
    ("hall", "language", "unseen"),
    [
        (named_by_the_fleet, ROBOTS[0], REFUSED),
        *(further(named_by_the_fleet, one, REFUSED) for one in ROBOTS[1:]),
        *(pytest.param(named_by_nats, one, REFUSED, marks=(pytest.mark.thorough, WITHOUT_NATS)) for one in ROBOTS),
        *(further(believing, one, {}) for one in ROBOTS),
    ],
)
def test_it_passes_where_names_are_checked(hall: Hall, tmp_path: Path, language: Language, unseen: Found) -> None:
    program = language("robot", tmp_path)
    with hall(tmp_path / "hall") as broker:
        arguments, target = at_named(broker, tmp_path, "mine", "ann")
        with switched_on([*program, *with_stop_file(arguments, tmp_path)], target) as component:
            assert lacking(judged(component, *ALL.values())) == unseen


@pytest.mark.thorough
@WITHOUT_NATS
@pytest.mark.parametrize("language", ROBOTS)
def test_it_passes_at_another_broker(tmp_path: Path, language: Language) -> None:
    program = language("robot", tmp_path)
    with ended(NATS.make(tmp_path)) as broker:
        arguments, target = at_open(broker)
        with switched_on([*program, *with_stop_file(arguments, tmp_path)], target) as component:
            assert lacking(judged(component, *ALL.values())) == {}


def mutant(folder: Path, old: str, new: str) -> Command:
    assert old in SOURCE
    (folder / "robot.py").write_text(SOURCE.replace(old, new))
    return [sys.executable, folder / "robot.py"]


@pytest.mark.parametrize(("name", "reason", "old", "new"), some(VIOLATIONS, 10))
def test_a_violation_is_found(broker: Broker, tmp_path: Path, name: str, reason: str, old: str, new: str) -> None:
    arguments, target = at_open(broker)
    needs = [ALL["will"]] if name == "retained commands" else []
    with switched_on([*mutant(tmp_path, old, new), *with_stop_file(arguments, tmp_path)], target) as component:
        state, text = judged(component, *needs, ALL[name])[name]
    assert (state, reason in text) == (State.FAILED, True), text


@pytest.mark.parametrize(("name", "reason", "old", "new"), some(NAMED_VIOLATIONS, 5))
def test_a_violation_at_level_named_is_found(tmp_path: Path, name: str, reason: str, old: str, new: str) -> None:
    with believing(tmp_path / "hall") as broker:
        arguments, target = at_named(broker, tmp_path, "mine", "ann")
        with switched_on([*mutant(tmp_path, old, new), *with_stop_file(arguments, tmp_path)], target) as component:
            state, text = judged(component, ALL[name])[name]
    assert (state, reason in text) == (State.FAILED, True), text


@pytest.mark.thorough
def test_a_library_that_acknowledges_no_long_message_is_found(broker: Broker, tmp_path: Path) -> None:
    """The sample subscribes with QoS 0, because PubSubClient is one."""
    text = source("robot", "cpp").read_text()
    (tmp_path / "robot.cpp").write_text(text.replace("mqtt.subscribe(topic, 0)", "mqtt.subscribe(topic, 1)"))
    program = sketch(tmp_path / "robot.cpp", tmp_path / "robot")
    arguments, target = at_open(broker)
    with switched_on([*program, *with_stop_file(arguments, tmp_path)], target) as component:
        assert [*lacking(judged(component, ALL["junk"], ALL["long messages"]))] == ["long messages"]


@pytest.mark.thorough
def test_a_robot_whose_disk_is_slow_passes(broker: Broker, tmp_path: Path) -> None:
    program = mutant(tmp_path, "os.fsync(file.fileno())", "time.sleep(0.7)")
    arguments, target = at_open(broker)
    with switched_on([*program, *with_stop_file(arguments, tmp_path)], target) as component:
        assert lacking(judged(component, ALL["stop"], ALL["stop moving"], ALL["reset waits"])) == {}


class Stalled:
    """What is judged while this machine stalls; only its second answer is good."""

    def __init__(self) -> None:
        self.stalled_s = 0.0
        self._answers = iter((failed("it is late", ""), ok("in time")))

    def wait(self, _condition: Callable[[], object], _seconds: float) -> bool:
        return True

    def answer(self) -> CheckResult:
        self.stalled_s = 1.0
        return next(self._answers)


@pytest.mark.parametrize(
    ("once", "found"),
    [
        (False, (State.OK, "in time; tried again, because this machine stalled: it is late, at first")),
        (True, (State.FAILED, "it is late")),
    ],
)
def test_a_check_that_was_tried_again_shows_it(once: bool, found: tuple[State, str]) -> None:
    ((_, outcome),) = results(Stalled(), [Check("answer", "", Stalled.answer, once=once)])
    assert (outcome.state, outcome.text) == found


def test_what_was_not_judged_is_no_pass(
    broker: Broker, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A robot that offers nothing: most checks cannot be made, and some were not asked for."""
    run = Run(monkeypatch, capsys)
    with MqttTransport("silent", MqttSettings(host="127.0.0.1", port=broker.port)) as robot:
        ending = threading.Event()

        def send_heartbeats() -> None:
            while not ending.wait(0.25):
                payload = b'{"t": %d}' % int(1000 * time.time())
                robot.publish("pebble/robots/mine/outgoing/online", payload, qos=QoS.LATEST, retain=True)

        with beside(send_heartbeats, ending):
            assert run("conform", "mine", "--url", f"mqtt://127.0.0.1:{broker.port}", "--json") == 1
    found = json.loads(run.out)
    failures = [one["name"] for one in found["checks"] if one["state"] == "failed"]
    assert (found["ok"], failures) == (False, ["capabilities"])
    assert {"stop", "control", "dead man", "will"} <= set(found["not_judged"])
