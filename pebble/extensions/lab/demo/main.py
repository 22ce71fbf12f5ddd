"""Four simulated robots, on Zenoh, on MQTT and on MCUs, driven by an operator through one broker."""

from __future__ import annotations

import math
import shlex
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any
from urllib.request import urlopen

from rich.console import Console

from pebble.contract import DRIVE
from pebble.contract.identity import Identity
from pebble.errors import PebbleError
from pebble.extensions.lab.demo.brokers import EMBEDDED, broker_program
from pebble.extensions.lab.demo.operator import FIRST_ROUND_S, STEPS, TAKE_OVER, Operator
from pebble.extensions.lab.demo.outcome import Outcomes, outcome_of
from pebble.extensions.lab.demo.phone import Phone, require_terminal
from pebble.extensions.lab.demo.view import View, show_outcomes
from pebble.extensions.lab.rig.processes import HOST
from pebble.extensions.lab.rig.robot import SimulatedRobot
from pebble.extensions.lab.rig.testbed import ROBOTS, PageServer, Testbed
from pebble.extensions.operator.client.page_packages import require_packages
from pebble.extensions.operator.signals import handled_by
from pebble.extensions.page.setting import DEFAULT_PORT

SHORTEST_S = FIRST_ROUND_S
_DISCOVERY_S = 30.0  # until all robots can be driven, on the smallest machine
_SLOW_S = 60.0  # how much longer the first round may take, on the smallest machine
_POLL_S = 0.1
_ROBOTS = """\
Goob on Zenoh and Fred on MQTT, with simulated motor MCU, camera and microphone;
Goob also with inertial sensor, loudspeaker and scripts, in a room with tags.
MiniLAMP and BenJr are MCUs that use MQTT themselves: their firmware, on
simulated pins."""
_GOOB = Identity("pebble", "robots", "goob")
_INDEX_S = 40.0
_RECORDED = ("--keep", "256M", "--rotate", "5min")


def run(seconds: float | None = None, *, embedded: bool = False, for_phones: bool = False) -> int:
    """Run the demo until Ctrl-C, or for ``seconds`` of driving; return 0 if every robot moved and stopped as commanded.

    With ``seconds`` at least one whole round of the script must have been driven. ``embedded``: with the brokers that
    are used where mosquitto is not installed. ``for_phones``: other machines reach the page, see Phone. Every process
    ends with the demo; its folder of logs stays only after a failure. Raises PebbleError if the demo cannot be set up.
    """
    console = Console()
    if seconds is not None and seconds < SHORTEST_S:
        raise PebbleError(f"one round of driving takes {SHORTEST_S:.0f} s: give it at least that many seconds")
    require_packages()
    if for_phones:
        require_terminal()
    program = EMBEDDED if embedded else broker_program()
    with ending_on_signals() as ending, Testbed(ending) as testbed:
        demo = Demo(testbed, console, ending, seconds)
        demo.start(program, Phone(testbed.folder) if for_phones else None)
        problems = demo.play()
        testbed.keep = bool(problems)
        demo.show_results(problems)
    return 1 if problems else 0


class Demo:
    """The robots, their operator page, and the programs that drive and watch them: :meth:`start`, then :meth:`play`."""

    def __init__(self, testbed: Testbed, console: Console, ending: threading.Event, seconds: float | None) -> None:
        self._testbed, self._console, self._ending, self._seconds = testbed, console, ending, seconds
        self._outcomes = Outcomes()

    def start(self, broker: str | None, phone: Phone | None) -> None:
        """Start every process, and connect to the broker. ``broker``: a module to run in mosquitto's place."""
        console, testbed = self._console, self._testbed
        name = "mosquitto" if broker is None else "amqtt"
        console.print(f"Two brokers ({name}): a remote one, and the one that Fred carries.")
        testbed.start_brokers(broker)
        console.print(_ROBOTS)
        self._start_page(phone)
        self._broker_url = f"mqtt://{HOST}:{testbed.broker_port}"
        self._invite()
        testbed.start_robots()
        if phone is None and self._seconds is None:  # a page for phones asks for a login; a timed demo has no visitors
            threading.Thread(target=self._prepare_recordings, name="pebble-demo-index", daemon=True).start()
        self._operator = Operator(testbed.broker_port)  # it drives, in `play`
        self._operator.connect()

    def play(self) -> list[str]:
        """Drive until the end; return a line for each robot and each process that failed."""
        robots = list(self._testbed.robots.values())
        view = View(self._console, self._operator, robots, self._ending)
        try:
            missing = self._wait_until_ready(view)
            if not missing:
                self._drive(view)
            problems = self._testbed.unexpected_exits()
        finally:
            self._operator.close()
        if missing and not self._ending.is_set():  # at an early end the robots were not waited for
            return problems + [f"{name} did not become ready to drive within {_DISCOVERY_S:.0f} s" for name in missing]
        wrong_by_robot = ((robot, self._wrong(robot)) for robot in robots)
        return problems + [f"{robot.name}: {'; '.join(wrong)}" for robot, wrong in wrong_by_robot if wrong]

    def show_results(self, problems: list[str]) -> None:
        show_outcomes(self._console, ROBOTS, self._outcomes)
        for problem in problems:
            self._console.print(problem, style="red", highlight=False, markup=False, soft_wrap=True)
        if left_alone := self._operator.visitors.left_alone:
            self._console.print(f"Left to people, and not judged meanwhile: {', '.join(sorted(left_alone))}.")
        if problems:
            self._console.print(f"Logs, configs and traces: {self._testbed.folder}", soft_wrap=True)
        elif self._outcomes.steps():
            self._console.print("Every robot moved and stopped as commanded.", style="green")

    def _start_page(self, phone: Phone | None) -> None:
        """Start the operator page, open to other machines if ``phone`` is given, and a recorder for its Recordings."""
        console, testbed = self._console, self._testbed
        recordings = testbed.folder / "recordings"
        recordings.mkdir()
        testbed.start_recorder(recordings, *_RECORDED)
        has_visitors = self._seconds is None  # a timed demo has none: no camera is shown in turn
        settings = {"cameras_in_turn": has_visitors, **({} if phone is None else phone.settings)}
        page = usual_or_free(testbed, self._ending, recordings=recordings, **settings)  # at its usual port, if free
        self._page_url = page.url
        print_line(console, f"See and drive them in a browser: {self._page_url}")
        print_line(console, f"Its Recordings show what they do, from {recordings}, which the demo deletes at its end.")
        if phone is not None:
            phone.show(self._page_url, console)

    def _prepare_recordings(self) -> None:
        """Request from time to time what Recordings shows first, so that the server has it ready for visitors."""
        while not self._ending.wait(_INDEX_S):
            path = f"archive/timeline?day={datetime.now(UTC):%Y-%m-%d}&robot={_GOOB.base}"
            with suppress(OSError), urlopen(self._page_url + path, timeout=_INDEX_S):  # noqa: S310 - its own page
                pass

    def _invite(self) -> None:
        """Print the broker's address, and commands to paste into another terminal in this folder."""
        port, pebble, url = self._testbed.broker_port, _pebble_command(), self._broker_url
        drive = f'mosquitto_pub -h {HOST} -p {port} -t {DRIVE.topic(_GOOB.base)} -m \'{{"x": 0, "z": 0.3}}\''
        lines = {
            "look at its drive commands": f"{pebble} topic echo {DRIVE.metric} --robot {_GOOB.id} --url {url}",
            "drive Goob, by any MQTT client": drive,
            "record all robots until Ctrl-C": f"{pebble} record --url {url}",
            "stop Goob, whoever drives it": f"{pebble} estop {_GOOB.id} --url {url}",
            "let it go again": f"{pebble} estop reset {_GOOB.id} --url {url}",
        }
        print_line(self._console, f"Or from another terminal, by their broker at {url}:")
        for what, line in lines.items():
            print_line(self._console, f"  # {what}\n  {line}")

    def _wait_until_ready(self, view: View) -> list[str]:
        """Wait until all robots can be driven; return the names of those that cannot in time."""
        end = time.monotonic() + _DISCOVERY_S
        while (missing := self._operator.not_ready(ROBOTS)) and time.monotonic() < end:
            view.update()
            if self._ending.wait(_POLL_S):
                break
        return missing

    def _drive(self, view: View) -> None:
        """Drive for the given time, but at least one round. Without a time drive one round, then wait."""
        self._operator.begin(f"the robots are yours: {self._page_url}" if self._seconds is None else "")
        end = math.inf if self._seconds is None else time.monotonic() + self._seconds
        while not self._ending.wait(_POLL_S) and not self._testbed.unexpected_exits():
            more_s = 0.0 if self._operator.rounds else _SLOW_S  # for the first round
            if time.monotonic() > end + more_s:
                break
            view.update()
            self._judge_completed()
        self._operator.close()
        self._judge_completed()

    def _judge_completed(self) -> None:
        while self._operator.completed:
            driven = self._operator.completed.popleft()
            self._outcomes.add(outcome_of(driven, self._testbed.robots[driven.robot].entries()))

    def _wrong(self, robot: SimulatedRobot) -> list[str]:
        """Return what a robot did wrong. A timed demo adds what it did not do, unless a person took the robot."""
        wrong = self._outcomes.problems(robot.name)
        if self._seconds is None or robot.name in self._operator.visitors.left_alone:
            return wrong
        steps = (*STEPS, TAKE_OVER) if robot.has_scripts else STEPS
        return wrong + [f"{step}: not done" for step in steps if self._outcomes.of(robot.name, step) is None]


def _pebble_command() -> str:
    """Return the shortest text that runs this environment's program in this folder."""
    program = Path(sys.executable).with_name("pebble")
    if not program.exists():
        return f"{shlex.quote(sys.executable)} -m pebble"
    folder = Path.cwd()
    return shlex.quote(str(program.relative_to(folder) if program.is_relative_to(folder) else program))


def print_line(console: Console, line: str) -> None:
    """Print a line to be copied, neither wrapped nor coloured."""
    console.print(line, highlight=False, markup=False, soft_wrap=True)


def usual_or_free(testbed: Testbed, ending: threading.Event, **settings: Any) -> PageServer:
    """Start the page at its usual port, or at a free port if another program uses that."""
    with suppress(PebbleError):
        page = testbed.start_page(DEFAULT_PORT, **settings)
        page.wait(ending)
        return page
    page = testbed.start_page(**settings)
    page.wait(ending)
    return page


@contextmanager
def ending_on_signals() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C, a closed terminal and SIGTERM set, so that processes are ended in order."""
    ending = threading.Event()

    def ask(_signal: int, _frame: FrameType | None) -> None:
        # In another thread: the signal may have interrupted this one inside ending.wait(), where it holds the lock.
        threading.Thread(target=ending.set, name="ending", daemon=True).start()

    with handled_by(ask):
        yield ending
