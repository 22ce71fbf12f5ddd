"""The demo as a user starts it: real brokers, real launchers, and nothing left behind."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import socket
import ssl
import subprocess
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest

from pebble.extensions.lab.demo.main import SHORTEST_S
from pebble.extensions.lab.demo.operator import STEPS
from pebble.extensions.lab.rig.testbed import ROBOTS
from tests.kit.demo import START_S, Demo, demos, page_of, start, temporary
from tests.support import ROOT, WAIT_S, until

__all__ = ["demos", "temporary"]

pytestmark = pytest.mark.alone

SLOW_S, END_S = 60.0, 5.0


def requested(url: str) -> str:
    unverified = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    unverified.check_hostname, unverified.verify_mode = False, ssl.CERT_NONE
    with urllib.request.urlopen(url, timeout=WAIT_S, context=unverified) as answer:
        return str(answer.read().decode())


@pytest.mark.solo
@pytest.mark.parametrize("embedded", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_all_robots_do_what_they_are_commanded(demos: list[Demo], temporary: Path, embedded: bool) -> None:
    demo = start(demos, temporary, f"{SHORTEST_S}, embedded={embedded}")
    page = page_of(demo)
    assert re.findall(r"https?:|[\"'=(]//", requested(page)) == []  # everything it loads is on its own server
    assert until(lambda: requested(f"{page}healthz") == "ok")
    assert demo.process.wait(START_S + SHORTEST_S + SLOW_S + END_S) == 0, demo.output
    driven = demo.output.partition("Measured by the MCUs")[2]
    assert driven.count("ok ") == len(ROBOTS) * len(STEPS) + 1, demo.output  # goob is driven beside its script
    with pytest.raises(urllib.error.URLError):
        requested(page)
    for event in ("STARTS: apriltag-follow", "TAKES OVER: drives goob", "LETS GO", "GIVES BACK", "ENDS"):
        assert f"operator {event}" in demo.output
    for name, inside in {"goob": "zenoh", "fred": "mqtt", "minilamp": "mqtt", "benjr": "mqtt"}.items():
        assert re.search(rf"s  {name} is online: .+, {inside} inside\n", demo.output), demo.output
    steps = re.findall(r"(?m)^ *[\d.]+ s  (?:operator:? )?(.+)$", demo.output)
    assert not [step for step, after in pairwise(steps) if step == after]  # a line at each step
    assert len(steps) < SHORTEST_S + SLOW_S
    assert demo.leftovers() == []
    assert demo.folders() == []


@pytest.mark.solo
def test_what_is_printed_can_be_pasted_and_a_signal_ends_everything_within_five_seconds(
    demos: list[Demo], temporary: Path
) -> None:
    demo = start(demos, temporary, "")
    assert until(lambda: "forward, stop" in demo.output, START_S), demo.output
    (broker,) = set(re.findall(r"mqtt://127.0.0.1:\d+", demo.output))
    assert f"by their broker at {broker}:" in demo.output
    echo, drive, record, stop, reset = re.findall(r"(?m)^  # .+\n  (.+)$", demo.output)
    with pasted(echo, temporary / "echo") as echoed, pasted(record, temporary / "record") as recorded:
        assert until(lambda: "Recording" in recorded() and '"z"' in echoed()), (recorded(), echoed())
        shell(drive)
        assert until(lambda: '"z": 0.3}' in echoed()), echoed()
        assert "goob" in shell(stop)
        assert "goob" in shell(reset)
    assert re.search(r"Recorded [\d,]+ messages \(.+\);", recorded()), recorded()
    (folder,) = re.findall(r"Its Recordings show what they do, from (\S+), which", demo.output)
    assert Path(folder).is_relative_to(temporary)
    assert until(lambda: recorded_robots(page_of(demo)) == ["benjr", "fred", "goob", "minilamp"])
    demo.process.send_signal(signal.SIGINT)
    assert demo.process.wait(END_S) == 0, demo.output
    assert (demo.leftovers(), demo.folders()) == ([], [])
    assert "Left to people, and not judged meanwhile: goob" in demo.output


def recorded_robots(page: str) -> list[str]:
    """The robots of the newest day of the page's Recordings."""
    days = json.loads(requested(f"{page}archive/days"))
    return sorted(base.rpartition("/")[2] for base in days[0]["robots"]) if days else []


def shell(line: str) -> str:
    """What a line prints that must succeed."""
    done = subprocess.run(line, shell=True, cwd=ROOT, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode == 0, (line, done.stdout, done.stderr)
    return done.stdout


@contextmanager
def pasted(line: str, output: Path) -> Iterator[Callable[[], str]]:
    """Runs a line until Ctrl-C at the end of the block; what it has printed. It leaves nothing in the checkout."""
    output.mkdir()
    log = output / "log"
    absolute = line if line.startswith("/") else f"{ROOT}/{line}"
    with log.open("wb") as file:
        running = subprocess.Popen(["sh", "-c", f"exec {absolute}"], cwd=output, stdout=file, stderr=file)
    try:
        yield log.read_text
    finally:
        running.send_signal(signal.SIGINT)
        assert running.wait(20) in (0, 130), log.read_text()


@pytest.mark.thorough
def test_a_phone_can_log_in_and_a_closed_terminal_ends_everything_though_its_signal_goes_elsewhere(
    demos: list[Demo], temporary: Path
) -> None:
    """SIGHUP reaches the session leader, for example make, which only waits."""
    ours, terminal = pty.openpty()
    demo = start(demos, temporary, "for_phones=True", terminal)
    os.close(terminal)
    shown = bytearray()

    def shows(text: bytes) -> bool:
        shown.extend(os.read(ours, 65536))  # a frame comes ten times a second
        return text in shown

    try:
        assert until(lambda: shows(b"forward, stop"), START_S), shown
        ((host, port),) = re.findall(rb"in a browser: https://([^:/]+):(\d+)/", shown)
        (broker,) = set(re.findall(rb"mqtt://127.0.0.1:(\d+)", shown))
        assert re.findall(rb"Log in as visitor with the password \w{8}\r", shown)
        assert "Log in" in requested(f"https://127.0.0.1:{int(port)}/")
        with pytest.raises(OSError):  # the broker is on loopback
            socket.create_connection((host.decode(), int(broker)), 5)
    finally:
        os.close(ours)
    assert demo.process.wait(END_S) == 0, demo.output
    assert demo.output == ""
    assert demo.leftovers() == []
    assert demo.folders() == []


def test_nothing_outlives_a_demo_that_is_killed(demos: list[Demo], temporary: Path) -> None:
    demo = start(demos, temporary, "")
    assert until(lambda: "forward, stop" in demo.output, START_S), demo.output
    assert len(demo.leftovers()) >= 13  # the demo, two brokers, four MCUs, two launchers with their programs, the page
    demo.process.kill()
    demo.process.wait(10)
    assert until(lambda: demo.leftovers() == [], END_S), demo.leftovers()


def test_a_robot_that_does_not_come_up_is_a_failure_with_a_place_to_look(demos: list[Demo], temporary: Path) -> None:
    code = """
import sys
import pebble.extensions.lab.demo.main as main
import pebble.extensions.lab.rig.testbed as testbed
main._DISCOVERY_S = 1.0
testbed.LinuxRobot.bring_up = lambda self, ending: None
sys.exit(main.run(main.SHORTEST_S))
"""
    demos.append(Demo(temporary, code))
    assert demos[0].process.wait(START_S) == 1
    assert "goob did not become ready to drive" in demos[0].output
    (folder,) = demos[0].folders()
    assert str(folder) in demos[0].output
