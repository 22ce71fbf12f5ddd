"""The demo as a user starts it: real brokers, real launchers, and nothing left behind."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest

from pebble.demo.main import SHORTEST_S
from tests.support import ROOT, until

pytestmark = pytest.mark.alone

START_S, SLOW_S, END_S = 40.0, 60.0, 5.0
MARK = "PEBBLE_TEST_DEMO"


class Demo:
    """One run, with everything it starts marked by a variable that children inherit."""

    def __init__(self, folder: Path, code: str, terminal: int | None = None) -> None:
        self.temporary = folder
        self.log = folder / "demo.log"
        self._mark = uuid.uuid4().hex
        with self.log.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-c", code],
                cwd=ROOT,
                env={**os.environ, MARK: self._mark, "TMPDIR": str(folder)},
                stdout=output if terminal is None else terminal,
                stderr=output,
            )

    @property
    def output(self) -> str:
        return self.log.read_text()

    def leftovers(self) -> list[str]:
        """Command lines of living processes that this demo started."""
        entry = f"{MARK}={self._mark}".encode()
        return [line for pid in _pids() if entry in _read(pid, "environ") and (line := _command(pid))]

    def folders(self) -> list[Path]:
        return list(self.temporary.glob("pebble-demo-*"))

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(10)


def _pids() -> list[str]:
    return [path.name for path in Path("/proc").iterdir() if path.name.isdecimal() and int(path.name) != os.getpid()]


def _read(pid: str, name: str) -> bytes:
    try:
        return Path("/proc", pid, name).read_bytes()
    except OSError:  # it has ended meanwhile
        return b""


def _command(pid: str) -> str:
    return _read(pid, "cmdline").replace(b"\0", b" ").decode()


@pytest.fixture
def temporary() -> Iterator[Path]:
    """A short path: the robots' unix sockets are below it, and their paths are limited to 108 bytes."""
    with tempfile.TemporaryDirectory(prefix="pebble-", dir="/tmp") as folder:
        yield Path(folder)
        assert until(lambda: not any(folder in _command(pid) for pid in _pids()))  # of a demo that was killed


@pytest.fixture
def demos(temporary: Path) -> Iterator[list[Demo]]:
    """Ends every demo that a test appends."""
    running: list[Demo] = []
    yield running
    for demo in running:
        demo.end()


def start(demos: list[Demo], folder: Path, arguments: str, terminal: int | None = None) -> Demo:
    imports = "import sys; from pebble.demo.brokers import BrokerKind; from pebble.demo.main import run"
    demos.append(Demo(folder, f"{imports}; sys.exit(run({arguments}))", terminal))
    return demos[-1]


def page_of(demo: Demo) -> str:
    """The address of the operator page, once it was printed."""
    printed = re.compile(r"in a browser: (http://127.0.0.1:\d+/)\n").findall
    assert until(lambda: printed(demo.output), START_S), demo.output
    return str(printed(demo.output)[0])


def requested(url: str) -> str:
    with urllib.request.urlopen(url, timeout=5) as answer:
        return str(answer.read().decode())


@pytest.mark.parametrize("broker", ["EMBEDDED", pytest.param("MOSQUITTO", marks=pytest.mark.thorough)])
def test_all_robots_do_what_they_are_commanded(demos: list[Demo], temporary: Path, broker: str) -> None:
    demo = start(demos, temporary, f"{SHORTEST_S}, broker=BrokerKind.{broker}")
    page = page_of(demo)
    assert re.findall(r"https?:|//", requested(page)) == []  # everything it loads is on its own server
    assert until(lambda: requested(f"{page}healthz") == "ok")
    assert demo.process.wait(START_S + SHORTEST_S + SLOW_S + END_S) == 0, demo.output
    media, _, driven = demo.output.partition("Measured by the MCUs")
    driven, _, script = driven.partition("Measured by goob's MCU, room and loudspeaker")
    assert driven.count("ok ") == 20, demo.output  # four steps and an emergency stop, four robots
    assert script.count("ok ") == 6, demo.output
    # two robots; four encodings of pictures, two of sound
    received = media.partition("Received by the operator")[2]
    assert received.count("ok ") + received.count("slow ") >= 12, demo.output
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


def ended_by(demo: Demo, sign: signal.Signals) -> int:
    """It ends within some seconds, and leaves no process; returns its exit code."""
    demo.process.send_signal(sign)
    began = time.monotonic()
    code = demo.process.wait(30)
    assert time.monotonic() - began <= END_S
    assert demo.leftovers() == []
    return code


def ends_by(demo: Demo, sign: signal.Signals) -> None:
    """It ends as one that succeeded, and leaves nothing."""
    assert ended_by(demo, sign) == 0, demo.output
    assert demo.folders() == []


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
    assert re.search(r"Recorded [\d,]+ messages \(.+\) of 4 robots;", recorded()), recorded()
    ended_by(demo, signal.SIGINT)


def shell(line: str) -> str:
    """What a line prints that must succeed."""
    done = subprocess.run(line, shell=True, cwd=ROOT, capture_output=True, text=True, timeout=20, check=False)
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


def test_a_closed_terminal_ends_everything_though_its_signal_goes_elsewhere(demos: list[Demo], temporary: Path) -> None:
    """SIGHUP reaches the session leader, for example make, which only waits."""
    ours, terminal = pty.openpty()
    demo = start(demos, temporary, "", terminal)
    os.close(terminal)
    shown = bytearray()

    def shows(text: bytes) -> bool:
        shown.extend(os.read(ours, 65536))  # a frame comes ten times a second
        return text in shown

    try:
        assert until(lambda: shows(b"forward, stop"), START_S), shown
    finally:
        os.close(ours)
    assert demo.process.wait(END_S) == 0, demo.output
    assert demo.output == ""
    assert demo.leftovers() == []
    assert demo.folders() == []


@pytest.mark.thorough
def test_without_the_packages_of_the_page_everything_else_goes_on(demos: list[Demo], temporary: Path) -> None:
    code = """
import sys
import pebble.client.page_packages as extra
extra.find_spec = lambda name: None if name == "starlette" else object()
import pebble.demo.main as main
sys.exit(main.run())
"""
    demos.append(demo := Demo(temporary, code))
    assert until(lambda: "forward, stop" in demo.output, START_S), demo.output
    assert [line for line in demo.output.splitlines() if "starlette" in line] == [
        "Without the operator page, which needs packages that are not installed (starlette): "
        "pip install 'pebble-robot[web]'"
    ]
    assert not any("pebble.web.program" in line for line in demo.leftovers())
    ends_by(demo, signal.SIGTERM)


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
import pebble.demo.main as main
import pebble.rig.testbed as testbed
main._DISCOVERY_S = 1.0
testbed.LinuxRobot.bring_up = lambda self, ending: None
sys.exit(main.run(main.SHORTEST_S))
"""
    demos.append(Demo(temporary, code))
    assert demos[0].process.wait(START_S) == 1
    assert "goob did not become ready to drive" in demos[0].output
    (folder,) = demos[0].folders()
    assert str(folder) in demos[0].output
