"""The demo's page for a phone, its scripted operator beside people, and which robots people have."""

from __future__ import annotations

import io
import json
import re
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from pebble.contract import CONTROL, CONTROL_TAKE, DRIVE, codec
from pebble.contract.payloads import Drive
from pebble.errors import PebbleError
from pebble.extensions.lab.demo.main import run
from pebble.extensions.lab.demo.operator import Operator
from pebble.extensions.lab.demo.phone import NAME, Phone, qr_lines
from pebble.extensions.lab.demo.visitors import DRIVES_S, Visitors
from pebble.extensions.lab.rig.processes import end_all
from pebble.extensions.lab.rig.testbed import PageServer
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message
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


@pytest.fixture
def phone(tmp_path: Path) -> Phone:
    return Phone(tmp_path)


@pytest.fixture
def page(tmp_path: Path, phone: Phone) -> Iterator[PageServer]:
    broker = Broker(tmp_path)
    server = PageServer(tmp_path, broker.port, port=0, **phone.settings)
    try:
        server.wait()
        yield server
    finally:
        end_all([server])
        broker.stop()


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


def test_the_password_that_is_printed_opens_the_page(tmp_path: Path, phone: Phone, page: PageServer) -> None:
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


# -- the scripted operator


BASE = "pebble/robots/goob"
ANNA = {"id": "3f2a91c0", "by": "anna", "for_ms": 10_000}


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, BASE, keeps=True) as running:
        yield running


@pytest.fixture
def operator(broker: Broker, robot: RecordingRobot) -> Iterator[Operator]:
    running = Operator(broker.port)
    running.connect()
    assert until(lambda: running.not_ready(["goob"]) == [])
    yield running
    running.close()


def test_a_robot_that_a_person_has_taken_is_left_alone_until_the_step_after(
    robot: RecordingRobot, operator: Operator
) -> None:
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
