"""The measures of a trial, from the messages that its operator sent and received. Pure.

All times are ns of CLOCK_MONOTONIC. Late is not lost: sound captured in a window counts as delivered if it arrived
before the trial's end; its delay is in the latencies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import msgspec

from pebble.extensions.lab.bench.bridge_operator import arrivals
from pebble.extensions.lab.bench.results import Cell, percentile, round_cell
from pebble.extensions.lab.simulation.trace import Entry

DELIVERED, ON_TIME, SOUND = "audio delivered", "audio within 1 s", "audio latency"
FPS, FROZEN, PICTURES, DRIVE = "video rate", "video frozen", "video latency", "drive"

ON_TIME_MS = 1000  # older sound is useless in a conversation
FROZEN_S = 1.0  # a picture shown for longer counts as frozen


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
    """A received message; ``sent_ns``: the time of sending, or of the capture of a picture or a first sample."""

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


class Seen(msgspec.Struct):
    """The pictures of a window that could be decoded: their latencies, their rate, and how long they stood still."""

    ms: list[float]
    fps: float
    frozen_s: float


class Report(msgspec.Struct, kw_only=True, omit_defaults=True):
    """A line from the operator: the answer to a request; after a trial, the measurements.

    ``problem``: why the request was not carried out; None if it was.
    """

    problem: str | None = None
    commands: list[Command] = []
    heard: Heard | None = None
    seen: Seen | None = None


def heard(sounds: Iterable[Arrival], window: Window) -> Heard:
    """Return the figures of a window's sound. A packet that came twice counts once."""
    packets = [packet for packet in {sound.number: sound for sound in sounds}.values() if window.overlap_s(packet) > 0]

    def percent(within_ms: float) -> float:
        arrived_s = sum(window.overlap_s(packet) for packet in packets if packet.ms <= within_ms)
        return min(100.0, 100 * arrived_s / window.seconds)

    return Heard([packet.ms for packet in packets], percent(math.inf), percent(ON_TIME_MS))


def seen(pictures: Iterable[Arrival], window: Window) -> Seen:
    """Return the figures of a window's pictures. Those that arrived outside of the window do not count."""
    inside = [picture for picture in pictures if window.began_ns <= picture.arrived_ns < window.ended_ns]
    moments = [window.began_ns, *sorted(picture.arrived_ns for picture in inside), window.ended_ns]
    gaps_s = [(after - before) / 1e9 for before, after in pairwise(moments)]
    frozen_s = sum((gap for gap in gaps_s if gap > FROZEN_S), 0.0)
    return Seen([picture.ms for picture in inside], len(inside) / window.seconds, frozen_s)


def driven_ms(commands: Sequence[Command], entries: Sequence[Entry]) -> list[float]:
    """Return the time that each command, or a newer one that overtook it, took to reach the MCU.

    Lost ones are left out.
    """
    arrived = arrivals(entries)
    driven, soonest = [], math.inf
    for command in reversed(commands):
        soonest = min(soonest, arrived.get((command.left, command.right), math.inf))
        if soonest < math.inf:
            driven.append((soonest - command.sent_ns) / 1e6)
    return driven[::-1]


def cells_of(subject: str, trial: str, report: Report, entries: Sequence[Entry]) -> Iterator[Cell]:
    """Yield the results of a subject in one trial; ``entries`` are from its MCU."""
    params = {"trial": trial}
    if report.heard is not None and report.seen is not None:
        yield round_cell(subject, DELIVERED, "%", [report.heard.delivered_percent], params)
        yield round_cell(subject, ON_TIME, "%", [report.heard.on_time_percent], params)
        yield round_cell(subject, SOUND, "ms", report.heard.ms, params)
        yield round_cell(subject, FPS, "1/s", [report.seen.fps], params)
        yield round_cell(subject, FROZEN, "s", [report.seen.frozen_s], params)
        yield round_cell(subject, PICTURES, "ms", report.seen.ms, params)
    yield round_cell(subject, DRIVE, "ms", driven_ms(report.commands, entries), params, sent=len(report.commands))


def value_of(cell: Cell, percent: float) -> float:
    """Return a percentile, in which lost messages are infinitely late."""
    return percentile([sample for samples in cell.with_lost() for sample in samples], percent)
