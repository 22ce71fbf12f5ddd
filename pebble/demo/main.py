"""Four simulated robots, on Zenoh, on MQTT and on MCUs, driven by an operator who cannot tell which is which."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

from rich.console import Console

from pebble.demo.broker import BrokerKind, best_kind
from pebble.demo.judge import Verdict, judge
from pebble.demo.media import ROUND_S as MEDIA_ROUND_S
from pebble.demo.media import VIDEO, MediaShow
from pebble.demo.media_judge import MediaVerdict
from pebble.demo.operator import Operator
from pebble.demo.script import ROUND_S, SCRIPT, Done
from pebble.demo.stage import ROBOTS, Stage
from pebble.demo.view import View, show_media_results, show_results
from pebble.errors import PebbleError

_DISCOVERY_S = 30.0  # until all robots can be driven, on the smallest machine
_MEDIA_START_S = 2.0  # from the first request to the first picture, with some to spare
_LOOK_S = 0.1
_SETTLED_S = 0.3  # an MCU reports ten times a second: how a step ended is known a little later
_REMEMBERED = 200  # verdicts


def run(seconds: float | None = None, *, broker: BrokerKind | None = None, console: Console | None = None) -> int:
    """Show the demo until Ctrl-C, or for ``seconds`` of driving; 0 if every robot did what it was told.

    With ``seconds`` at least one whole round of the script must have been driven. ``broker`` asks for a kind instead of
    the best one there is. Nothing is left running; a folder with logs stays only after a failure. Raises PebbleError if
    the demo cannot be set up.
    """
    console = console or Console()
    if seconds is not None and seconds < ROUND_S:
        raise PebbleError(f"one round of driving takes {ROUND_S:.0f} s: give it at least that many seconds")
    kind = broker or best_kind()
    with _ending_on_signals() as ending, Stage(ending) as stage:
        verdicts, media, problems = _play(stage, kind, seconds, ending, console)
        with_media = [robot.name for robot in stage.robots if robot.has_media]
        if seconds is not None:
            problems += _not_driven(verdicts)
        if seconds is not None and seconds >= MEDIA_ROUND_S + _MEDIA_START_S:
            problems += _not_seen(with_media, media)
        problems += [f"{verdict.robot}, {verdict.step}: {wrong}" for verdict in verdicts for wrong in verdict.wrong]
        problems += [f"{verdict.robot}: {wrong}" for verdict in media for wrong in verdict.wrong]
        stage.keep = bool(problems)
        show_media_results(console, with_media, media)
        show_results(console, ROBOTS, verdicts, problems)
        if problems:
            console.print(f"Logs, configs and traces: {stage.folder}", soft_wrap=True)
    return 1 if problems else 0


def _play(
    stage: Stage, kind: BrokerKind, seconds: float | None, ending: threading.Event, console: Console
) -> tuple[list[Verdict], list[MediaVerdict], list[str]]:
    """Set up, drive and watch. Returns what the steps and the media came to, and what went wrong besides."""
    console.print(f"Two brokers ({kind}): a remote one, and the one that Fred carries.")
    stage.start_brokers(kind)
    console.print("Goob on Zenoh and Fred on MQTT, each with a simulated motor MCU, camera and microphone;")
    console.print("Goob also with an inertial sensor that describes itself.")
    console.print("MiniLAMP and BenJr are MCUs that speak MQTT themselves: their firmware, on simulated pins.")
    stage.start_robots()
    operator = Operator(stage.remote_port)
    operator.connect()
    show = MediaShow(stage.remote_port)
    try:
        with View(console, operator, show, stage.robots, ending) as view:
            if not _discovered(operator, view, ending):
                return [], [], [] if ending.is_set() else [*_unseen(operator), *stage.fallen()]
            operator.begin()
            show.begin([seen for seen in operator.discovery.everybody() if seen.offers("video")])
            verdicts = _watch(stage, operator, view, math.inf if seconds is None else seconds, ending)
        unfelt = [] if ending.is_set() else _unfelt(stage, operator)  # who ends it early has not seen everything
        return verdicts, list(show.verdicts), [*stage.fallen(), *unfelt]
    finally:
        show.end()
        operator.end()


def _discovered(operator: Operator, view: View, ending: threading.Event) -> bool:
    end = time.monotonic() + _DISCOVERY_S
    while not operator.ready(len(ROBOTS)):
        view.update()
        if time.monotonic() > end or ending.wait(_LOOK_S):
            return False
    return True


def _unseen(operator: Operator) -> list[str]:
    now = time.monotonic()
    ready = [seen.name for seen in operator.discovery.everybody() if seen.ready(now)]
    return [f"{name} did not become ready to drive within {_DISCOVERY_S:.0f} s" for name in ROBOTS if name not in ready]


def _unfelt(stage: Stage, operator: Operator) -> list[str]:
    heard = {seen.name for seen in operator.discovery.everybody() if seen.attitude is not None}
    wanted = [robot.name for robot in stage.robots if robot.has_imu]
    return [f"{name}: nothing came of its inertial sensor" for name in wanted if name not in heard]


def _watch(stage: Stage, operator: Operator, view: View, seconds: float, ending: threading.Event) -> list[Verdict]:
    """Judge each step once its traces are complete."""
    verdicts: deque[Verdict] = deque(maxlen=_REMEMBERED)
    end = time.monotonic() + seconds
    while time.monotonic() < end and not ending.wait(_LOOK_S) and not stage.fallen():
        view.update()
        _judge_settled(stage, operator, verdicts, time.monotonic() - _SETTLED_S)
    operator.end()
    time.sleep(_SETTLED_S)
    _judge_settled(stage, operator, verdicts, math.inf)
    return list(verdicts)


def _judge_settled(stage: Stage, operator: Operator, verdicts: deque[Verdict], until: float) -> None:
    while operator.done and operator.done[0].ended < until:
        verdicts.append(_judge(stage, operator, operator.done.popleft()))


def _judge(stage: Stage, operator: Operator, done: Done) -> Verdict:
    robot = next(robot for robot in stage.robots if robot.name == done.robot)
    seen = next(seen for seen in operator.discovery.everybody() if seen.name == done.robot)
    has_lights = seen.lights_topic(flash=False) is not None
    return judge(done, list(robot.looks), robot.entries(), stop_s=robot.stop_s, has_lights=has_lights)


def _not_driven(verdicts: list[Verdict]) -> list[str]:
    driven = {(verdict.robot, verdict.step) for verdict in verdicts}
    return [f"{name}, {step.name}: not done" for name in ROBOTS for step in SCRIPT if (name, step.name) not in driven]


def _not_seen(names: Sequence[str], media: list[MediaVerdict]) -> list[str]:
    judged = {(verdict.robot, verdict.encoding) for verdict in media}
    return [
        f"{name}: no {encoding} was looked at" for name in names for encoding in VIDEO if (name, encoding) not in judged
    ]


@contextmanager
def _ending_on_signals() -> Iterator[threading.Event]:
    """Ctrl-C, a closed terminal and SIGTERM only ask for the end: what was started is ended in order."""
    ending = threading.Event()

    def ask(_signal: int, _frame: FrameType | None) -> None:
        # Not from here: the signal may have interrupted this thread inside ending.wait(), where it holds the lock.
        threading.Thread(target=ending.set, name="ending", daemon=True).start()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield ending
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
