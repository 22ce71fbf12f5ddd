"""Measures the latency of drive commands to the wheels and of MCU reports to the operator, on MQTT and on Zenoh.

Down: from the operator's publish call to the last byte of the command's line at the MCU's pty. Up: from the moment at
which the MCU writes a report until the operator receives it. In between are a remote broker, the bridge, the robot's
local transport and the serial bridge. Real processes, stock mosquitto, loopback.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack

from rich.console import Console
from rich.progress import Progress

from pebble.bench import bridge_report
from pebble.bench.bridge_drive import Arrived, DriveSegment
from pebble.bench.bridge_driven_robot import DrivenRobot
from pebble.bench.bridge_media import MediaLoad
from pebble.bench.bridge_one_hop import HOP, OneHop
from pebble.bench.bridge_plan import BridgePlan
from pebble.bench.bridge_tally import LOADED, UNLOADED, Tally
from pebble.bench.engine import Rounds, finish
from pebble.bench.results import Stopwatch
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports.segments import sweep

_STARTUP_S = 1.0  # for start-up work to finish
_TURN_S = 1.0  # of driving one robot before the next one
_MEDIA_STARTUP_S = 1.0

RoundPart = tuple[Tally, list[DriveSegment], list[Arrived], Mapping[str, int]]
"""One robot's part of a round: its tally, what was driven, what arrived, and how much media flowed meanwhile."""


def run(plan: BridgePlan, console: Console | None = None) -> int:
    """Measure, show and write; 0 if everything has results and enough rounds are left. Raises PebbleError."""
    console = console or Console()
    plan.check()
    watch = Stopwatch("bridge", plan.command(), plan.options())
    tallies = [Tally(kind, UNLOADED) for kind in plan.kinds] + [Tally(kind, LOADED) for kind in plan.media_kinds]
    tallies.append(Tally(HOP, reports=False))
    rounds = Rounds(plan.rounds, console)
    with interrupted_by_signals():
        try:
            _measure(plan, tallies, rounds, console)
        finally:
            sweep()  # Zenoh leaves files behind even after a regular end
    cells = [cell for tally in tallies for cell in tally.cells()]
    bridge_report.show(cells, console)
    lines = [*rounds.notes(), *bridge_report.assessment(cells)]
    finish(watch.results(cells, lines, quick=plan.quick), plan.output, console)
    return rounds.code(cells)


def _measure(plan: BridgePlan, tallies: Sequence[Tally], rounds: Rounds, console: Console) -> None:
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("", total=plan.rounds)
        for number in range(plan.rounds):

            def show_step(what: str, number: int = number) -> None:
                progress.update(task, completed=number, description=f"round {number + 1} of {plan.rounds}: {what}")

            with rounds.attempt(number):
                for tally, segments, found, flowed in _round(plan, tallies, number, show_step):
                    tally.add_round(segments, found, flowed)


def _round(
    plan: BridgePlan, tallies: Sequence[Tally], number: int, show_step: Callable[[str], None]
) -> list[RoundPart]:
    """Measures one round; its parts count only if all of them succeed. Raises PebbleError."""
    by_name = {(tally.variant, tally.load): tally for tally in tallies}
    parts: list[RoundPart] = []
    with ExitStack() as stack:
        show_step("starting the robots")
        driven_robots = [stack.enter_context(DrivenRobot(kind, media=kind in plan.media_kinds)) for kind in plan.kinds]
        hop = stack.enter_context(OneHop())
        for driven_robot in driven_robots:
            driven_robot.wait()
        time.sleep(_STARTUP_S)
        show_step("driving in turns")
        participants: list[DrivenRobot | OneHop] = [*driven_robots, hop]
        for participant, segments in _in_turns(participants, plan.seconds, backwards=bool(number % 2)):
            parts.append((by_name[participant.kind, UNLOADED], segments, participant.match_arrivals(segments), {}))
        with_media = [one for one in driven_robots if one.kind in plan.media_kinds]
        for driven_robot in with_media[::-1] if number % 2 else with_media:
            show_step(f"{driven_robot.kind} with media")
            parts.append(_drive_with_media(driven_robot, plan.seconds, by_name[driven_robot.kind, LOADED]))
    return parts


def _in_turns(
    participants: Sequence[DrivenRobot | OneHop], seconds: float, *, backwards: bool
) -> list[tuple[DrivenRobot | OneHop, list[DriveSegment]]]:
    """Drives each participant for ``seconds`` in total, reversing the order after each turn."""
    turns = max(1, round(seconds / _TURN_S))
    segments: dict[str, list[DriveSegment]] = {participant.kind: [] for participant in participants}
    for turn in range(turns):
        for participant in participants[::-1] if backwards != bool(turn % 2) else participants:
            segments[participant.kind].append(participant.drive(seconds / turns))
    return [(participant, segments[participant.kind]) for participant in participants]


def _drive_with_media(driven_robot: DrivenRobot, seconds: float, tally: Tally) -> RoundPart:
    with MediaLoad(driven_robot.robot, driven_robot.operator) as media_load:
        time.sleep(_MEDIA_STARTUP_S)
        before = media_load.counts()
        segments = [driven_robot.drive(seconds)]
        after = media_load.counts()
    return tally, segments, driven_robot.match_arrivals(segments), {name: after[name] - before[name] for name in after}
