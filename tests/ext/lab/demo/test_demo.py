"""The demo's page for a phone and its operators, which let people go first; and the processes of its rig."""

from __future__ import annotations

import io
import json
import re
import ssl
import subprocess
import threading
import time
import urllib.error
import urllib.request
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from pebble.contract import CONTROL, CONTROL_TAKE, DRIVE, channel_of, codec
from pebble.contract.payloads import Drive
from pebble.errors import PebbleError
from pebble.extensions.lab.demo.main import run
from pebble.extensions.lab.demo.operator import Operator
from pebble.extensions.lab.demo.phone import NAME, Phone, qr_lines
from pebble.extensions.lab.demo.visitors import DRIVES_S, Visitors
from pebble.extensions.lab.rig.processes import BROKERS, MCUS, OPERATORS, ROBOTS, Processes, Program, end_all, python
from pebble.extensions.lab.rig.scripted_operator import VALID_MS, ScriptedOperator
from pebble.extensions.lab.rig.testbed import PageServer
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message, QoS
from tests.ext.operator.client.estop_robot import KeepingRobot, Robot, capabilities
from tests.kit.played_robot import RecordingRobot
from tests.support import WAIT_S, Broker, until


def test_the_code_is_read_as_the_address() -> None:
    lines = list(qr_lines(url := "https://192.168.100.100:45678/"))
    halves = [[one in signs for one in line] for line in lines for signs in ("▀█", "▄█")]
    picture = np.where(np.array(halves), 0, 255).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == url
    assert len(lines[0]) <= 45, "it fits beside nothing else into the smallest terminal"
    assert len(lines) <= 23


def test_without_a_terminal_nothing_is_started(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(PebbleError, match="prints a password, to a terminal only"):
        run(for_phones=True)
    assert capsys.readouterr().out == ""


def login(url: str, password: str, authority: Path) -> int:
    """The status of the answer, of a browser that trusts the authority."""
    headers = {"Content-Type": "application/json", "Origin": url.rstrip("/")}
    body = json.dumps({"user": NAME, "password": password}).encode()
    request = urllib.request.Request(f"{url}api/login", body, headers)
    try:
        with urllib.request.urlopen(
            request, timeout=WAIT_S, context=ssl.create_default_context(cafile=authority)
        ) as one:
            return int(one.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_the_password_that_is_printed_opens_the_page(tmp_path: Path, broker: Broker) -> None:
    phone = Phone(tmp_path)
    page = PageServer(tmp_path, broker.port, port=0, **phone.settings)
    try:
        page.wait()
        printed = Console(file=io.StringIO(), width=80, force_terminal=True)
        phone.show(page.url, printed)
        shown = printed.file.getvalue()  # type: ignore[attr-defined]
        (password,) = re.findall(rf"Log in as {NAME} with the password (\S+)", shown)
        authority = phone.settings["authority"]
        port = page.url.rstrip("/").rpartition(":")[2]
        for host in (page.url, f"https://localhost:{port}/"):
            assert [login(host, one, authority) for one in (password, password[::-1])] == [200, 401]
        stored = [file for file in tmp_path.rglob("*") if file.is_file() and password.encode() in file.read_bytes()]
        assert stored == []
        assert password not in Path(f"/proc/{page.pid}/cmdline").read_text()
    finally:
        end_all([page])


# -- the scripted operator


BASE = "pebble/robots/goob"
ANNA = {"id": "3f2a91c0", "by": "anna", "for_ms": 10_000}


def test_a_robot_that_a_person_has_taken_is_left_alone_until_the_step_after(broker: Broker) -> None:
    with RecordingRobot(broker.port, BASE, keeps=True) as robot, closing(Operator(broker.port)) as operator:
        operator.connect()
        assert until(lambda: operator.not_ready(["goob"]) == [])
        operator.begin()
        assert until(lambda: robot.drives(0.0))
        assert robot.keeping is not None
        assert {drive.get("key") for drive in robot.drives()} == {robot.keeping.owners[0].lease.key}
        robot.command(CONTROL_TAKE.metric, ANNA)
        assert until(lambda: operator.activity.endswith("; goob is driven by anna"))
        taken = time.monotonic()
        assert not until(lambda: robot.drives(taken + 0.1), 1.0)
        robot.command(CONTROL.metric, ANNA | {"want": "release"})
        assert until(lambda: "goob" not in operator.activity)
        assert until(lambda: robot.drives(taken + 0.1))
        assert operator.visitors.left_alone == {"goob"}
        assert [one for one in operator.completed if one.ended > taken > one.began] == []


# -- visitors


GOOB, FRED = (RobotView(f"pebble/robots/{name}") for name in ("goob", "fred"))
OURS, PASTED = codec.encode(DRIVE, Drive(z=0.6)), b'{"x": 0, "z": 0.3}'
TOPIC = DRIVE.topic(GOOB.base)


@pytest.mark.parametrize(
    ("received", "taken"),
    [
        ([Message(TOPIC, OURS)], ""),
        ([Message(TOPIC, PASTED)], "is driven by another program"),
        ([Message(TOPIC, OURS), Message(TOPIC, OURS)], "is driven by another program"),  # one of them is not ours
        ([Message(TOPIC, PASTED, retain=True)], ""),  # it moves nothing
    ],
    ids=["own", "pasted", "own and the same", "retained"],
)
def test_a_command_that_the_operator_has_not_sent_is_another_drivers(received: list[Message], taken: str) -> None:
    visitors = Visitors("me")
    visitors.note_sent(TOPIC, OURS)
    for message in received:
        visitors.receive_drive(message, 10.0)
    assert [visitors.taken(robot, 11.0) for robot in (GOOB, FRED)] == [taken, ""]
    assert visitors.taken(GOOB, 10.0 + DRIVES_S) == ""
    assert [visitors.free(robot, 20.0) for robot in (GOOB, FRED)] == [taken == "", True]
    assert visitors.left_alone == ({"goob"} if taken else set())
    visitors.begin_step(20.0)
    assert visitors.free(GOOB, 20.0)


# -- the rig


def test_operators_end_first_and_brokers_last(tmp_path: Path) -> None:
    order = tmp_path / "order"
    with Processes() as processes:
        for name, kind in (("broker", BROKERS), ("mcu", MCUS), ("robot", ROBOTS), ("operator", OPERATORS)):
            trap = f"trap 'echo {name} >> {order}; exit' TERM; touch {order}.{name}; while :; do sleep 0.01; done"
            processes.add(Program(name, ["sh", "-c", trap], tmp_path / f"{name}.log"), kind)
            assert until(Path(f"{order}.{name}").exists)
        assert processes.unexpected_exits() == []
    assert order.read_text().split() == ["operator", "robot", "mcu", "broker"]
    assert not processes.folder.exists()


def test_a_program_ends_with_the_thread_that_started_it(tmp_path: Path) -> None:
    started: list[Program] = []

    def start() -> None:
        started.append(Program("sleeper", ["sleep", "30"], tmp_path / "log"))
        assert until(lambda: Path(f"/proc/{started[0].pid}/comm").read_text() == "sleep\n")

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    assert until(lambda: started[0].ended)


def test_a_program_imports_nothing_of_the_folder_that_we_are_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "json.py").write_text("raise SystemExit('of this folder')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    assert subprocess.run(python("json.tool", "--help"), check=False).returncode == 0


def test_one_that_ended_by_itself_is_named_and_one_that_was_ended_is_not(tmp_path: Path) -> None:
    with Processes() as processes:
        ended = processes.add(Program("the hub", ["true"], tmp_path / "hub.log"), BROKERS)
        assert until(lambda: ended.ended)
        assert processes.unexpected_exits() == [f"the hub ended unexpectedly: see {ended.log}"]
        processes.end(ended)
        assert processes.unexpected_exits() == []


MINE = "pebble/robots/mine"
MOVES = f"{MINE}/incoming/drive-values"
OFFERED = {"drive": {"available": True, "control": True}, "estop": {"available": True, "owners": ["serial"]}}
ANN = {"id": "0badcafe", "by": "ann", "want": "hold", "for_ms": 3000}


class Given:
    """A robot with its real leases and latches, and its operator, whose waits take no time."""

    def __init__(self, value: dict[str, Any] | None = None) -> None:
        self.view = RobotView(MINE)
        self.keeping, self.latches = KeepingRobot(MINE), Robot(MINE, "serial")
        self.sent: list[Message] = []
        self.waited: list[float] = []
        self.operator = ScriptedOperator(self.view, self.publish, by="program", wait=self.wait)
        if value is not None:
            self.receive(capabilities(MINE, value), *self.keeping.states())

    def publish(self, message: Message) -> None:
        self.sent.append(message)
        self.take(message)

    def person(self, metric: str, body: dict[str, Any]) -> None:
        self.take(Message(f"{MINE}/incoming/{metric}", json.dumps(body).encode(), QoS.DELIVERED))

    def take(self, message: Message) -> None:
        self.receive(*self.keeping.take([message], time.monotonic()), *self.latches.take([message]))

    def receive(self, *messages: Message) -> None:
        for message in messages:
            channel = channel_of(message.topic.removeprefix(f"{MINE}/"))
            self.view.receive(channel, message, time.monotonic(), time.time())
            self.operator.receive(message)

    def wait(self, seconds: float) -> bool:
        self.waited.append(seconds)
        return False

    @property
    def drives(self) -> list[dict[str, Any]]:
        return [json.loads(message.payload) for message in self.sent if message.topic == MOVES]


def has_control(given: Given) -> bool:
    given.operator.ask_control()
    given.operator.tick()
    given.operator.tick()
    return given.operator.control.held


def test_it_drives_at_a_steady_rate_with_a_deadline_in_each_command_and_a_zero_at_the_end() -> None:
    given = Given()
    given.operator.drive(0.1, 0.5, 2.0)
    assert given.drives[:-1] == [{"x": 0.1, "z": 0.5, "y": 0, "valid_ms": VALID_MS}] * 40
    assert given.drives[-1] == {"x": 0, "z": 0, "y": 0, "valid_ms": VALID_MS}
    assert {message.qos for message in given.sent} == {QoS.DELIVERED}
    assert given.waited == sorted(given.waited)  # time does not pass: what is due moves on
    assert given.waited[-1] == pytest.approx(2.0, abs=0.5)


def interrupt() -> bool:
    raise KeyboardInterrupt


def test_whatever_ends_it_it_lets_go() -> None:
    given = Given()
    operator = ScriptedOperator(
        given.view, given.publish, by="program", wait=lambda _: len(given.drives) == 3 and interrupt()
    )
    with pytest.raises(KeyboardInterrupt):
        operator.drive(z=0.5)
    assert [(drive["x"], drive["z"]) for drive in given.drives] == [(0, 0.5)] * 3 + [(0, 0)]


def test_it_drives_with_the_key_of_control_and_gives_it_back() -> None:
    given = Given(OFFERED)
    assert has_control(given)
    given.operator.command(Drive(z=0.5))
    state = given.view.control.state
    assert state is not None
    assert given.drives[-1]["key"] == state.key != ""
    given.operator.release()
    given.operator.command(Drive())
    assert "key" not in given.drives[-1]
    assert given.view.control.who == ""


def test_while_a_person_has_control_nothing_is_sent() -> None:
    given = Given(OFFERED)
    given.person("control", ANN)
    assert not has_control(given)
    assert not given.operator.has_control
    assert given.operator.command(Drive(z=0.5)) == float("inf")
    given.operator.drive(z=0.5, seconds=0.1)
    assert given.drives == []
    assert given.keeping.owners[0].by == "ann"


def test_a_person_who_asks_gets_control() -> None:
    given = Given(OFFERED)
    assert has_control(given)
    given.person("control", ANN)
    given.operator.command(Drive(z=0.5))
    given.person("control", ANN)
    sent = len(given.drives)
    given.operator.command(Drive(z=0.5))
    assert (given.keeping.owners[0].by, len(given.drives)) == ("ann", sent)


def test_a_stop_is_repeated_until_it_is_confirmed_and_reset_by_who_pressed_it() -> None:
    given = Given()
    given.operator.stop("a test")
    given.operator.tick()
    assert not given.operator.stopped  # nobody has told what it is
    given.receive(given.latches.capabilities(), *[owner.state() for owner in given.latches.owners])
    given.operator.tick()
    assert given.operator.stopped
    assert given.view.latched
    given.operator.reset()
    assert not given.view.latched
    given.person("estop", {"stop": "00c0ffee00c0ffee", "by": "ann"})
    sent = len(given.sent)
    given.operator.reset()
    assert given.view.latched, "a person's stop is left to the person"
    assert len(given.sent) == sent
