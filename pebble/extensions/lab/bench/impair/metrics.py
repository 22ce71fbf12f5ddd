"""The measures of a trial, from the messages that its operator sent and received. Pure.

All times are ns of CLOCK_MONOTONIC. Late is not lost: sound captured in a window counts as delivered if it arrived
before the trial's end; its delay is in the latencies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import msgspec

from pebble.extensions.lab.bench.bridge_operator import arrivals
from pebble.extensions.lab.bench.results import Cell, percentile, round_cell
from pebble.extensions.lab.simulation.trace import Entry

DELIVERED, ON_TIME, SOUND = "audio delivered", "audio within 1 s", "audio latency"
FPS, DRIVE = "video rate", "drive"

ON_TIME_MS = 1000  # older sound is useless in a conversation


class Plan(msgspec.Struct, kw_only=True):
    """The operator's actions in each trial. An encoding of None leaves the choice to the robot."""

    video: str | None
    audio: str | None
    alone_s: float  # driving only
    window_s: float  # of video, and then of audio
    grace_s: float  # for sound of the window that is still in flight
    off_s: float  # after video was switched off
    quiet_s: float  # between two trials, at least


class Arrival(NamedTuple):
    """A received message; ``sent_ns``: the time of sending, or of the capture of the first sample of sound."""

    sent_ns: int
    arrived_ns: int
    seconds: float = 0.0  # of sound
    number: int = 0  # of a sound packet

    @property
    def ms(self) -> float:
        """The latency of the message, in ms."""
        return (self.arrived_ns - self.sent_ns) / 1e6


class Command(NamedTuple):
    """A drive command, identified by the wheel speeds that it sets."""

    left: float
    right: float
    sent_ns: int


class Window(NamedTuple):
    """A measured time window."""

    began_ns: int
    ended_ns: int

    @property
    def seconds(self) -> float:
        return (self.ended_ns - self.began_ns) / 1e9

    def overlap_s(self, sound: Arrival) -> float:
        """Return how many seconds of the packet were captured in the window."""
        ended_ns = sound.sent_ns + round(1e9 * sound.seconds)
        return max(0, min(ended_ns, self.ended_ns) - max(sound.sent_ns, self.began_ns)) / 1e9


class Heard(msgspec.Struct):
    """The sound of a window: the latencies of its packets, and the shares that arrived at all, and in time."""

    ms: list[float]
    delivered_percent: float
    on_time_percent: float


class Report(msgspec.Struct, kw_only=True, omit_defaults=True):
    """A line from the operator: the answer to a request; after a trial, the measurements.

    ``problem``: why the request was not carried out; None if it was.
    """

    problem: str | None = None
    commands: list[Command] = []
    heard: Heard | None = None
    fps: float = 0.0  # decoded pictures per second


def heard(sounds: Iterable[Arrival], window: Window) -> Heard:
    """Return the figures of a window's sound. A packet that came twice counts once."""
    by_number = {sound.number: sound for sound in sounds}
    packets = [packet for packet in by_number.values() if window.overlap_s(packet) > 0]

    def percent(within_ms: float) -> float:
        arrived_s = sum(window.overlap_s(packet) for packet in packets if packet.ms <= within_ms)
        return min(100.0, 100 * arrived_s / window.seconds)  # packets whose stamps overlap would give more

    return Heard([packet.ms for packet in packets], percent(math.inf), percent(ON_TIME_MS))


def fps(pictures_ns: Iterable[int], window: Window) -> float:
    """Return the rate of the pictures that arrived in a window."""
    return sum(window.began_ns <= arrived_ns < window.ended_ns for arrived_ns in pictures_ns) / window.seconds


def driven_ms(commands: Sequence[Command], entries: Sequence[Entry]) -> list[float]:
    """Return the time until each command, or a newer one that overtook it, reached the MCU, in ms.

    Commands after which nothing reached it are left out.
    """
    arrived_ns = arrivals(entries)
    driven, soonest_ns = [], math.inf  # the first arrival of the command or of a newer one
    for command in reversed(commands):
        soonest_ns = min(soonest_ns, arrived_ns.get((command.left, command.right), math.inf))
        if soonest_ns < math.inf:
            driven.append((soonest_ns - command.sent_ns) / 1e6)
    return driven[::-1]


def cells_of(subject: str, trial: str, report: Report, entries: Sequence[Entry]) -> Iterator[Cell]:
    """Yield the results of a subject in one trial; ``entries`` are from its MCU. ``heard`` None: media not measured."""
    params = {"trial": trial}
    if report.heard is not None:
        yield round_cell(subject, DELIVERED, "%", [report.heard.delivered_percent], params)
        yield round_cell(subject, ON_TIME, "%", [report.heard.on_time_percent], params)
        yield round_cell(subject, SOUND, "ms", report.heard.ms, params)
        yield round_cell(subject, FPS, "1/s", [report.fps], params)
    yield round_cell(subject, DRIVE, "ms", driven_ms(report.commands, entries), params, sent=len(report.commands))


def value_of(cell: Cell, percent: float) -> float:
    """Return a percentile, in which lost messages are infinitely late."""
    return percentile([sample for samples in cell.with_lost() for sample in samples], percent)
