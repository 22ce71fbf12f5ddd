"""The checker finds every planted violation of the sample robot, and passes it as it is, and our own robots."""

from __future__ import annotations

import json
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from pebble.check_result import State
from pebble.extensions.checks.check import Check
from pebble.extensions.checks.check import run as run_checks
from pebble.extensions.checks.conform.checks import CHECKS, LAST
from pebble.extensions.checks.conform.control import CONTROL, UNSEEN
from pebble.extensions.checks.conform.motion import MOVING
from pebble.extensions.checks.observer import Observer, observed
from pebble.extensions.lab.rig import testbed
from pebble.extensions.operator.client.connection import Target
from pebble.transports import MqttSettings, QoS
from pebble.transports.mqtt.transport import MqttTransport
from tests.commands.command_line import Run
from tests.ext.checks.conform.programs import (
    ROBOT_PY,
    ROBOTS,
    WITHOUT_NATS,
    Command,
    Hall,
    Sample,
    at_named,
    at_open,
    believing,
    mutant,
    named_by_nats,
    named_by_the_fleet,
    switched_on,
)
from tests.ext.fleet.conftest import cheap_hashes as cheap_hashes
from tests.ext.page.stage import Stage
from tests.support import THOROUGH, Broker, beside, further, some

pytestmark = pytest.mark.alone  # deadlines of wheels are checked

ALL = {check.name: check for check in (*CHECKS, *CONTROL, *MOVING, *LAST)}

#: The check that finds it, how that names it, and what is written into the robot's program, in place of what.
VIOLATIONS = (
    ("heartbeat", "in the time of observation", "HEARTBEAT_MS = 250", "HEARTBEAT_MS = 5000"),
    ("identity", "it calls itself", '"id": robot_id', '"id": "other"'),
    ("own topics", "drive.topic is", '"controls": True', '"controls": True, "topic": "pebble/robots/other/incoming/x"'),
    ("clock", "3600 s ahead", "time.time_ns() // 1_000_000", "time.time_ns() // 1_000_000 + 3_600_000"),
    ("payloads", "online: Expected `int`", '"online", {"t": self.epoch_ms()}', '"online", {"t": str(self.epoch_ms())}'),
    (
        "numbers",
        "not JSON: outgoing/status",
        '{"wheels": self.wheels}',
        '{"wheels": self.wheels, "amperes": float("nan")}',
    ),
    ("sizes", "outgoing/estop/motors has", '"by": "", "why": ""', '"by": "", "why": 400 * "x"'),
    ("retained", "not retained:", "qos, retain=True", "qos, retain=False"),
    (
        "parked commands",
        "incoming/control",
        "    def save(self, text):",
        '        client.publish(self.base + "/incoming/control", "{}", 1, True)\n\n    def save(self, text):',
    ),
    ("capabilities", "Expected `bool`", '"available": True', '"available": "yes"'),
    ("junk", "its heartbeats ended", "except (ValueError, RuntimeError, MemoryError)", "except KeyError"),
    ("stop states", "no state of outgoing/estop/motors", '"estop/" + OWNER', '"estop/others"'),
    ("stop", "no state has its name", '{"latched": True', '{"latched": False'),
    ("stop once", "its repetition counts again", 'if name in self.stop["recent"]:', "if False:"),
    (
        "stop once",
        "its repetition after a reset stops it again",
        'self.stop["latched"] = False',
        "self.stop.update(latched=False, recent=[])",
    ),
    (
        "stop unread",
        "a stop that is no JSON does nothing",
        '"estop" and payload:',
        '"estop" and command:',
    ),
    (
        "stop holds",
        "a drive command ends the stop",
        "self.halt()  # a zero",
        'self.stop.stop["latched"], self.stop.is_new = False, True\n            self.halt()  # a zero',
    ),
    ("reset refused", "a reset with an older count ends it", 'command.get("count") != self.count', "False"),
    ("control", "a second request takes it", "elif is_holder or take or self.is_free:", "elif True:"),
    ("control asked", "a second request is not shown", "self._asks_id = own_id", 'self._asks_id = ""'),
    ("control released", "it is kept after its release", "self.pass_to(NO_HOLDER)\n        elif", "pass\n        elif"),
    ("control taken", "the one who has it keeps it", "elif is_holder or take or", "elif is_holder or"),
    ("control ends", "it stays with who went away", "not self.is_free and now > self._ends_at", "False"),
    (
        "control ends",
        "it ends in the middle of its commands",
        "self.control.renew(self.now())",
        "pass",
    ),
    ("dead man", "it still moves after the last command", "DEAD_MAN_MS = 750", "DEAD_MAN_MS = 3000"),
    ("validity", "it still moves after the last command", 'command.get("valid_ms", DEAD_MAN_MS)', "DEAD_MAN_MS"),
    ("validity", "valid_ms 4000: it", "clamp(valid_ms, 0, DEAD_MAN_MS)", "valid_ms"),
    ("zero", "after a zero with another key", "self.halt()  # a zero needs no key", "pass"),
    (
        "steering",
        "at x 0.4, z 0 its wheels do [0.4, 0.4]",
        "        x = clamp(x, -1, 1)\n        z = clamp(z, -1, 1)",
        "        x, z = clamp(z, -1, 1), clamp(x, -1, 1)",
    ),
    ("steering", "within value its wheels do []", "inner if isinstance(inner, dict) else value", "value"),
    ("no number", "no number", " and -INFINITY < value < INFINITY", ""),
    ("clamps", "a wheel got 3", "self.move(clamp(z + x, -1, 1)", "self.move(z - 2 * x"),
    ("foreign key", "it moves by another's key", "and (by_holder or keyless)", ""),
    (
        "foreign key",
        "while no one has control",
        "(by_holder or keyless)",
        "(self.control.is_free or by_holder or keyless)",
    ),
    (
        "control passes",
        "after another took control",
        "self.halt()  # the next driver",
        "pass  # the next driver",
    ),
    ("stop moving", "after the stop", "elif not self.stop.latched and", "elif"),
    ("reset waits", "a stick that is held down", "elif self.now() < self.paused_until:", "elif False:"),
    ("reset waits", "a stick that is held down", "if by_holder or self.control.is_free:", "if True:"),
    (
        "long messages",
        "no stop reaches it",
        "client.on_message = on_message",
        "client.manual_ack_set(True)\n"
        "client.on_message = lambda client, data, message: (\n"
        "    on_message(client, data, message),\n"
        "    len(message.payload) < 1024 and client.ack(message.mid, message.qos))",
    ),
)

#: The same at level named.
NAMED_VIOLATIONS = (
    ("control", "its state tells that 'conform' has it", '(account + "/" + only', '("" + only'),
    (
        "nameless",
        "a reset without an account",
        "(self.named and not account)",
        '(self.named and not account and metric != "estop-reset")',
    ),
    ("nameless", "a request without an account", "(self.named and not account)", "False"),
    ("keyless", "without a key", '"key" not in command and not self.named', '"key" not in command'),
    ("foreign account", "a key that another sends", " and account == self._account\n\n", "\n\n"),
)


def changed(folder: Path, old: str, new: str) -> Command:
    """Return the sample in Python with ``new`` in place of ``old``."""
    return [sys.executable, mutant(ROBOT_PY, folder, old, new)]


Results = dict[str, tuple[State, str]]


def judged(robot: Observer, *checks: Check[Observer]) -> Results:
    results = run_checks(checks, robot, refresh=robot.read)
    return {check.name: (result.state, result.text) for check, result in results}


def lacking(results: Results) -> Results:
    return {name: result for name, result in results.items() if result[0] is not State.OK}


@pytest.mark.parametrize("sample", [ROBOTS[0], *map(further, ROBOTS[1:])])
def test_a_sample_robot_passes(broker: Broker, tmp_path: Path, sample: Sample) -> None:
    with switched_on(sample(tmp_path), at_open(broker), tmp_path) as (_, robot):
        results = judged(robot, *ALL.values())
    assert lacking(results) == {}
    assert len(results) >= 20


#: What a driver's account is not shown at a broker that checks names.
REFUSED = {
    "parked commands": (State.SKIPPED, "its broker does not let this account read incoming/: use an admin's"),
    "nameless": (State.SKIPPED, UNSEEN),
    "foreign account": (State.SKIPPED, UNSEEN),
}


@pytest.mark.usefixtures("cheap_hashes")
@pytest.mark.parametrize(
    ("hall", "sample", "unseen"),
    [
        (named_by_the_fleet, ROBOTS[0], REFUSED),
        *(further(named_by_the_fleet, one, REFUSED) for one in ROBOTS[1:]),
        pytest.param(named_by_nats, ROBOTS[0], REFUSED, marks=(pytest.mark.thorough, WITHOUT_NATS)),
        *(further(believing, one, {}) for one in ROBOTS),
    ],
)
def test_it_passes_where_names_are_checked(hall: Hall, tmp_path: Path, sample: Sample, unseen: Results) -> None:
    program = sample(tmp_path)
    with hall(tmp_path / "hall") as broker, switched_on(program, at_named(broker, tmp_path), tmp_path) as (_, robot):
        by_names = ("parked commands", "control", "nameless", "keyless", "foreign account")  # judged in another way
        checks = [check for name, check in ALL.items() if THOROUGH or name in by_names]
        assert lacking(judged(robot, *checks)) == unseen


@pytest.mark.parametrize(
    ("violation", "named"),
    [*((one, False) for one in some(VIOLATIONS, 15)), *((one, True) for one in some(NAMED_VIOLATIONS, 5))],
)
def test_a_violation_is_found(broker: Broker, tmp_path: Path, violation: tuple[str, ...], named: bool) -> None:
    name, reason, old, new = violation
    with ExitStack() as stack:
        hall = stack.enter_context(believing(tmp_path / "hall")) if named else broker
        place = at_named(hall, tmp_path) if named else at_open(broker)
        _, robot = stack.enter_context(switched_on(changed(tmp_path, old, new), place, tmp_path))
        state, text = judged(robot, ALL[name])[name]
    assert (state, reason in text) == (State.FAILED, True), text


def test_what_was_not_judged_is_no_pass(broker: Broker, run: Run) -> None:
    """A robot that offers nothing: most checks cannot be made, and some were not asked for."""
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
    assert {"stop", "control", "dead man"} <= set(found["not_judged"])


@pytest.mark.thorough
@pytest.mark.parametrize("name", testbed.ROBOTS)
def test_a_robot_of_ours_passes(name: str) -> None:
    """Their motors are seen in the traces of their simulated boards."""
    with (
        Stage(name) as stage,
        observed(Target(url=f"mqtt://127.0.0.1:{stage.broker_port}", robot=name), 4.0) as robot,
    ):
        robot.eyes = lambda: [(ns / 1e9, [*wheels]) for ns, wheels in stage.motors(name)]
        assert lacking(judged(robot, *ALL.values())) == {}
