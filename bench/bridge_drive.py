"""One segment of driving a whole robot, and which of its commands and of the MCU's reports arrived. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pebble.bench.bridge_operator import Wheels
from pebble.services.serial_mcu_bridge.text.goob_base import Touch, parse
from pebble.simulation.trace import Entry

RATE_HZ = 20.0


@dataclass(frozen=True, slots=True)
class DriveSegment:
    """``sent`` maps each pair of wheel speeds to the time of its command; all times are CLOCK_MONOTONIC, ns."""

    began: int
    ended: int
    sent: Mapping[Wheels, int]
    cpu_s: float = 0.0  # of all the robot's processes


@dataclass(slots=True)
class Arrived:
    """Latencies of one segment, ms, and how many commands and reports were sent."""

    down: list[float] = field(default_factory=list)
    up: list[float] = field(default_factory=list)
    sent: int = 0
    reports: int = 0


def arrivals(entries: Sequence[Entry]) -> dict[Wheels, int]:
    """Maps each command to the time at which it first reached the MCU."""
    return {line.drive: line.ns for line in reversed(entries) if line.drive is not None}


def matched(entries: Sequence[Entry], received: Sequence[tuple[int, Touch]]) -> list[tuple[int, int | None]]:
    """Pairs the time each report was sent with the time it was received; None if it was not.

    A report is identified by its values: while the wheels turn, the sensors never report the same values for long.
    Values that were sent more than once do not count.
    """
    published = [(entry.ns, touch) for entry in entries if entry.event == "said" for touch in _touches(entry)]
    times = Counter(touch for _, touch in published)
    wanted = {touch: ns for ns, touch in published if times[touch] == 1}
    first = {touch: ns for ns, touch in reversed(received) if touch in wanted and ns >= wanted[touch]}
    return [(ns, first.get(touch)) for touch, ns in wanted.items()]


def all_arrived(
    segment: DriveSegment, commands: Mapping[Wheels, int], reports: Sequence[tuple[int, int | None]]
) -> bool:
    """Whether the last command and report arrived. What is still missing then was overtaken or lost: order is kept."""
    own = [received for published, received in reports if segment.began <= published <= segment.ended]
    return list(segment.sent)[-1] in commands and (not own or own[-1] is not None)


def arrived_of(
    segment: DriveSegment, commands: Mapping[Wheels, int], reports: Sequence[tuple[int, int | None]]
) -> Arrived:
    """Selects the commands and reports that belong to the segment."""
    arrived = sorted((commands[wheels], sent) for wheels, sent in segment.sent.items() if wheels in commands)
    own = [(published, received) for published, received in reports if segment.began <= published <= segment.ended]
    return Arrived(
        down=[(ns - sent) / 1e6 for ns, sent in arrived],
        up=[(received - published) / 1e6 for published, received in own if received is not None],
        sent=len(segment.sent),
        reports=len(own),
    )


def _touches(entry: Entry) -> list[Touch]:
    return [report for report in parse(entry.line.encode()) if isinstance(report, Touch)]
