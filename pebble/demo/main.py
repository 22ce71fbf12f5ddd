"""Four simulated robots, on Zenoh, on MQTT and on MCUs, driven by an operator through one broker."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from types import FrameType
from typing import Any, NamedTuple, cast

from rich.console import Console

from pebble.client.page.packages import require_packages
from pebble.client.page.settings import DEFAULT_PORT
from pebble.contract.encodings import ALL_VIDEO
from pebble.demo import emergency, following, invitation, phone
from pebble.demo.brokers import BrokerKind, best_kind
from pebble.demo.machine import Machine
from pebble.demo.media import ROUND_S as MEDIA_ROUND_S
from pebble.demo.media import MediaCheck
from pebble.demo.media_assessment import MediaResult
from pebble.demo.operator import (
    BY_ITSELF,
    EMERGENCY_S,
    EMERGENCY_STOP,
    ROUND_S,
    SCRIPT,
    TAKEOVER_S,
    CompletedFollow,
    CompletedStep,
    CompletedStop,
    Operator,
)
from pebble.demo.phone import Phone
from pebble.demo.results import Result, Results
from pebble.demo.steps import assess
from pebble.demo.view import View, show_media_results, show_results
from pebble.errors import PebbleError
from pebble.rig.testbed import ROBOTS, PageServer, RoomRobot, Testbed
from pebble.runtime.signals import handled_by

SHORTEST_S = ROUND_S + EMERGENCY_S + TAKEOVER_S
_DISCOVERY_S = 30.0  # until all robots can be driven, on the smallest machine
_MEDIA_START_S = 2.0  # from the first request to the first picture, with some to spare
_POLL_S = 0.1
_REPORTED_S = 0.3  # an MCU reports ten times a second: the end of a step is reported a little later
_RECORDED = ("--keep", "256M", "--rotate", "5min")
_SLOW_S = 60.0  # how much longer an overloaded machine may take for the first round, and to repeat steps of it


class _Observed(NamedTuple):
    """The results of the steps and of the media, all other problems, and the names of robots that people drove."""

    results: Results
    media: list[MediaResult]
    problems: list[str]
    left_alone: set[str]


def run(
    seconds: float | None = None,
    *,
    broker: BrokerKind | None = None,
    console: Console | None = None,
    for_phones: bool = False,
) -> int:
    """Run the demo until Ctrl-C, or for ``seconds`` of driving; 0 if every robot moved and stopped as commanded.

    With ``seconds`` at least one whole round of the script must have been driven, and steps that went wrong while the
    machine was overloaded are repeated; pictures that such a machine lost are shown, but no failure. ``broker`` selects
    a kind instead of the best one available. ``for_phones``: other machines reach the page, see Phone. Every process
    ends with the demo; its folder of logs stays only after a failure. Raises PebbleError if the demo cannot be set up.
    """
    console = console or Console()
    if seconds is not None and seconds < SHORTEST_S:
        raise PebbleError(f"one round of driving takes {SHORTEST_S:.0f} s: give it at least that many seconds")
    if for_phones:
        require_packages()
        phone.require_terminal()
    kind = broker or best_kind()
    with ending_on_signals() as ending, Testbed(ending) as testbed:
        opened = Phone(testbed.folder) if for_phones else None
        results, media, problems, left_alone = _run_demo(testbed, kind, seconds, ending, console, opened)
        with_media = [robot.name for robot in testbed.robots.values() if robot.has_media]
        if seconds is not None:
            problems += _steps_not_done(testbed, results.all(), left_alone)
        if seconds is not None and seconds >= MEDIA_ROUND_S + _MEDIA_START_S:
            problems += _encodings_not_checked(with_media, media)
        problems += results.problems()
        problems += [f"{result.robot}: {wrong}" for result in media for wrong in result.wrong]
        testbed.keep = bool(problems)
        show_media_results(console, with_media, media)
        show_results(console, ROBOTS, results.all(), problems)
        if left_alone:
            console.print(f"Left to people, and not judged meanwhile: {', '.join(sorted(left_alone))}.")
        if problems:
            console.print(f"Logs, configs and traces: {testbed.folder}", soft_wrap=True)
    return 1 if problems else 0


def _run_demo(
    testbed: Testbed,
    kind: BrokerKind,
    seconds: float | None,
    ending: threading.Event,
    console: Console,
    opened: Phone | None,
) -> _Observed:
    """Set up, drive and observe."""
    console.print(f"Two brokers ({kind}): a remote one, and the one that Fred carries.")
    testbed.start_brokers(kind.program)
    console.print("Goob on Zenoh and Fred on MQTT, each with a simulated motor MCU, camera and microphone;")
    console.print(
        "Goob also with an inertial sensor that describes itself, a loudspeaker and scripts, in a room with tags."
    )
    console.print("MiniLAMP and BenJr are MCUs that use MQTT themselves: their firmware, on simulated pins.")
    url = _start_page(testbed, ending, console, opened)
    _invite(testbed.broker_port, console)
    testbed.start_robots()
    operator = Operator(testbed.broker_port)
    operator.connect()
    addresses = ([f"Operator page: {url}"] if url else []) + [f"Broker: {invitation.broker_url(testbed.broker_port)}"]
    counting = [robot.name for robot in testbed.robots.values() if robot.has_counter]
    machine = Machine()
    media_check = MediaCheck(testbed.broker_port, counting, partial(machine.overloaded, on_average=True))
    try:
        with View(console, operator, media_check, list(testbed.robots.values()), ending, addresses) as view:
            if not _discovered(operator, view, ending):
                problems = [] if ending.is_set() else [*_not_ready(operator), *testbed.unexpected_exits()]
                return _Observed(Results(), [], problems, set())
            for_visitors = bool(url) and seconds is None
            operator.begin(f"the robots are yours: {url}" if for_visitors else "")
            filmed = [seen for seen in operator.discovery.all_robots() if seen.offers("video")]
            media_check.begin(filmed, once=for_visitors)
            results = _watch(testbed, operator, view, machine, math.inf if seconds is None else seconds, ending)
        problems = testbed.unexpected_exits()
        if not ending.is_set():  # a demo that is ended early may not have received everything
            problems += _without_imu(testbed, operator)
        return _Observed(results, list(media_check.results), problems, operator.left_alone)
    finally:
        media_check.end()
        operator.close()


def _start_page(testbed: Testbed, ending: threading.Event, console: Console, opened: Phone | None) -> str:
    """Start it with a recorder. Returns its address; empty without the packages that it needs."""
    try:
        require_packages()
    except PebbleError as error:
        what, _, remedy = str(error).partition(" needs ")
        print_line(console, f"Without {what}, which needs {remedy}")
        return ""
    recordings = testbed.folder / "recordings"
    recordings.mkdir()
    testbed.start_recorder(recordings, *_RECORDED)
    page = usual_or_free(testbed, ending, recordings=recordings, **({} if opened is None else opened.settings))
    print_line(console, f"See and drive them in a browser: {page.url}")
    print_line(console, f"Its Recordings show what they do, from {recordings}, which is deleted when the demo ends.")
    if opened is not None:
        opened.show(page.url, console)
    return page.url


def _invite(port: int, console: Console) -> None:
    """Print the broker's address, and what can be pasted into another terminal."""
    print_line(console, f"Or from another terminal, by their broker at {invitation.broker_url(port)}:")
    for what, line in invitation.lines(port):
        print_line(console, f"  # {what}\n  {line}")


def print_line(console: Console, line: str) -> None:
    """To be copied: neither wrapped nor coloured."""
    console.print(line, highlight=False, markup=False, soft_wrap=True)


def usual_or_free(testbed: Testbed, ending: threading.Event, **settings: Any) -> PageServer:
    """The page at its usual port, or at a free one if another program has that."""
    with suppress(PebbleError):
        usual = testbed.start_page(DEFAULT_PORT, **settings)
        usual.wait(ending)
        return usual
    page = testbed.start_page(**settings)
    page.wait(ending)
    return page


def _discovered(operator: Operator, view: View, ending: threading.Event) -> bool:
    end = time.monotonic() + _DISCOVERY_S
    while not operator.ready(len(ROBOTS)):
        view.update()
        if time.monotonic() > end or ending.wait(_POLL_S):
            return False
    return True


def _not_ready(operator: Operator) -> list[str]:
    now = time.monotonic()
    ready = [seen.name for seen in operator.discovery.all_robots() if seen.ready(now)]
    return [f"{name} did not become ready to drive within {_DISCOVERY_S:.0f} s" for name in ROBOTS if name not in ready]


def _without_imu(testbed: Testbed, operator: Operator) -> list[str]:
    received = {seen.name for seen in operator.discovery.all_robots() if seen.attitude is not None}
    wanted = [robot.name for robot in testbed.robots.values() if robot.has_imu]
    return [f"{name}: its inertial sensor published nothing" for name in wanted if name not in received]


def _watch(
    testbed: Testbed, operator: Operator, view: View, machine: Machine, seconds: float, ending: threading.Event
) -> Results:
    """Drive for ``seconds``, or until the first round is complete; assess each step once its traces are."""
    results = Results()
    end = time.monotonic() + seconds
    while not ending.wait(_POLL_S) and not testbed.unexpected_exits():
        now = time.monotonic()
        complete = operator.rounds and not results.doubtful
        if now > end + (0.0 if complete else _SLOW_S):
            break
        machine.sample()
        view.update()
        _assess_completed(testbed, operator, machine, results, now - _REPORTED_S)
    operator.close()
    time.sleep(_REPORTED_S)
    _assess_completed(testbed, operator, machine, results, math.inf)
    return results


def _assess_completed(testbed: Testbed, operator: Operator, machine: Machine, results: Results, until: float) -> None:
    while operator.completed and operator.completed[0].ended < until:
        completed = operator.completed[0]
        overloaded = machine.overloaded(completed.began, completed.ended)
        result = _assess(testbed, operator, completed)
        results.add(result, overloaded)
        if result.wrong and overloaded:
            operator.show(f"REPEATS: {result.step}, {result.robot}: {result.wrong[0]}, while {overloaded}")
        operator.again = frozenset(step for _, step in results.doubtful)
        operator.completed.popleft()


def _assess(testbed: Testbed, operator: Operator, completed: CompletedStep | CompletedStop | CompletedFollow) -> Result:
    robot = testbed.robots[completed.robot]
    if isinstance(completed, CompletedStop):
        return emergency.assess(completed, robot.entries())
    if isinstance(completed, CompletedFollow):
        outcome = following.outcome(cast(RoomRobot, robot), completed.ended)  # no other one follows tags
        return following.assess(completed, robot.entries(), outcome)
    seen = next(seen for seen in operator.discovery.all_robots() if seen.name == completed.robot)
    has_lights = seen.lights_topic(flash=False) is not None
    return assess(completed, list(robot.mcu_reports), robot.entries(), stop_s=robot.stop_s, has_lights=has_lights)


def _steps_not_done(testbed: Testbed, results: list[Result], left_alone: set[str]) -> list[str]:
    """The robots that no visitor took from the operator."""
    driven = {(result.robot, result.step) for result in results}
    steps = [*(step.name for step in SCRIPT), EMERGENCY_STOP]
    wanted = [(name, step) for name in ROBOTS for step in steps]
    wanted += [(robot.name, BY_ITSELF) for robot in testbed.robots.values() if robot.has_scripts]
    return [
        f"{name}, {step}: not done" for name, step in wanted if (name, step) not in driven and name not in left_alone
    ]


def _encodings_not_checked(names: Sequence[str], media: list[MediaResult]) -> list[str]:
    checked = {(result.robot, result.encoding) for result in media}
    return [
        f"{name}: {encoding} was not checked"
        for name in names
        for encoding in ALL_VIDEO
        if (name, encoding) not in checked
    ]


@contextmanager
def ending_on_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C, a closed terminal and SIGTERM set, so that every process is ended in order."""
    ending = threading.Event()

    def ask(_signal: int, _frame: FrameType | None) -> None:
        # In another thread: the signal may have interrupted this one inside ending.wait(), where it holds the lock.
        threading.Thread(target=ending.set, name="ending", daemon=True).start()

    with handled_by(ask):
        yield ending
