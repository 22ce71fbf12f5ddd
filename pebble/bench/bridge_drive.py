"""One stretch of driving a whole robot, and what became of its commands and of the MCU's reports meanwhile."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pebble.bench.bridge_operator import Operator, Wheels
from pebble.bench.bridge_robot import Robot
from pebble.bench.usage import cpu_s
from pebble.services.serial_mcu_bridge.goob_base import Touch, parse
from pebble.simulation.trace import Entry

RATE_HZ = 20.0
_ARRIVE_S = 1.0  # what is later than that is lost
_LOOK_S = 0.1


@dataclass(frozen=True, slots=True)
class Stretch:
    """``sent`` tells when each pair of wheel speeds was asked for; all times are CLOCK_MONOTONIC, ns."""

    began: int
    ended: int
    sent: Mapping[Wheels, int]
    cpu_s: float = 0.0  # the robot's processes together


@dataclass(slots=True)
class Found:
    """What arrived of one stretch, ms, and how much there was to arrive."""

    down: list[float] = field(default_factory=list)
    up: list[float] = field(default_factory=list)
    sent: int = 0
    reports: int = 0


def drive(
    robot: Robot,
    operator: Operator,
    seconds: float,
    rate_hz: float,
    *,
    work_us: float,
    slowed: bool,
) -> Stretch:
    """``work_us`` and ``slowed`` are the operator's."""
    pids = robot.pids()
    began, used = time.monotonic_ns(), cpu_s(pids)
    sent = operator.drive(seconds, rate_hz, work_us=work_us, slowed=slowed)
    return Stretch(began, time.monotonic_ns(), sent, cpu_s(pids) - used)


def look_up(robot: Robot, operator: Operator, stretches: Sequence[Stretch]) -> list[Found]:
    """One of each stretch, in the order in which they were driven, once the last things have arrived, or are lost."""
    since = min(stretch.began for stretch in stretches)
    end = time.monotonic() + _ARRIVE_S
    while True:
        late = time.monotonic() > end
        entries = robot.lines(since)
        commands, reports = arrivals(entries), matched(entries, operator.heard(since))
        if late or settled(stretches[-1], commands, reports):
            return [found_of(stretch, commands, reports) for stretch in stretches]
        time.sleep(_LOOK_S)


def arrivals(entries: Sequence[Entry]) -> dict[Wheels, int]:
    """When each command first reached the MCU."""
    return {line.drive: line.ns for line in reversed(entries) if line.drive is not None}


def matched(entries: Sequence[Entry], heard: Sequence[tuple[int, Touch]]) -> list[tuple[int, int | None]]:
    """When each report was said, and when it was heard.

    A report is known by what it says: while the wheels turn, the sensors never say the same for long. What is said more
    than once does not count.
    """
    said = [(entry.ns, touch) for entry in entries if entry.event == "said" for touch in _touches(entry)]
    times = Counter(touch for _, touch in said)
    wanted = {touch: ns for ns, touch in said if times[touch] == 1}
    first = {touch: ns for ns, touch in reversed(heard) if touch in wanted and ns >= wanted[touch]}
    return [(ns, first.get(touch)) for touch, ns in wanted.items()]


def settled(stretch: Stretch, commands: Mapping[Wheels, int], reports: Sequence[tuple[int, int | None]]) -> bool:
    """Has the last of it arrived? Then what is missing was overtaken, or lost: everything keeps its order."""
    own = [heard for said, heard in reports if stretch.began <= said <= stretch.ended]
    return list(stretch.sent)[-1] in commands and (not own or own[-1] is not None)


def found_of(stretch: Stretch, commands: Mapping[Wheels, int], reports: Sequence[tuple[int, int | None]]) -> Found:
    """What of all this belongs to the stretch."""
    arrived = sorted((commands[wheels], sent) for wheels, sent in stretch.sent.items() if wheels in commands)
    own = [(said, heard) for said, heard in reports if stretch.began <= said <= stretch.ended]
    return Found(
        down=[(ns - sent) / 1e6 for ns, sent in arrived],
        up=[(heard - said) / 1e6 for said, heard in own if heard is not None],
        sent=len(stretch.sent),
        reports=len(own),
    )


def _touches(entry: Entry) -> list[Touch]:
    return [report for report in parse(entry.line.encode()) if isinstance(report, Touch)]
