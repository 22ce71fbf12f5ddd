"""What the operator of a trial records, as JSON lines between processes, and the cells of results made of it. Pure.

All times are ns of CLOCK_MONOTONIC. Late is not lost: sound captured in a window counts as delivered if it arrived
before the trial's end; its delay is in the latencies.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import msgspec

from pebble.extensions.lab.bench.bridge_operator import arrivals
from pebble.extensions.lab.bench.results import Cell, percentile, round_cell
from pebble.extensions.lab.simulation.loudspeaker import Playback
from pebble.extensions.lab.simulation.trace import Entry
from pebble.extensions.operator.client.robot_view import Liveness

SOUND, PICTURES, HEARTBEAT_GAP = "audio latency", "video latency", "heartbeat gap"
DRIVE, DRIVE_ALONE, DRIVE_VIDEO, DRIVE_AUDIO = "drive", "drive alone", "drive during video", "drive during audio"
AFTER_VIDEO, AFTER_AUDIO, CLIP = "heartbeat gap after video", "heartbeat gap after audio", "clip"

ON_TIME_S = 1.0  # older sound is useless in a conversation
FROZEN_S = 1.0  # a picture shown for longer counts as frozen
_POLL_NS = 10_000_000  # interval at which the operator's page checks the heartbeat
_STOP = (0.0, 0.0)


class Plan(msgspec.Struct, kw_only=True):
    """What the operator does in each trial. An encoding of None leaves the choice to the robot."""

    video: str | None
    audio: str | None
    alone_s: float  # driving and heartbeat only
    window_s: float  # of video, and then of audio
    grace_s: float  # for sound of the window that is still in flight
    off_s: float  # after video was switched off, and after audio was
    clip_s: float  # at most, for a clip to be played to its end
    quiet_s: float  # between two trials, at least


class Command(msgspec.Struct, array_like=True, frozen=True):
    """A drive command, identified by the wheel speeds that it sets."""

    left: float
    right: float
    sent_ns: int


class Arrival(msgspec.Struct, array_like=True, frozen=True):
    """What was received; ``sent_ns`` is when it was sent, or when a picture or the first sample was captured."""

    sent_ns: int
    arrived_ns: int

    @property
    def ms(self) -> float:
        """Its latency."""
        return (self.arrived_ns - self.sent_ns) / 1e6


class Heartbeat(Arrival, array_like=True, frozen=True):
    online: bool = True


class Sound(Arrival, array_like=True, frozen=True):
    """A sound packet."""

    seconds: float
    sequence: int


class Window(msgspec.Struct, frozen=True):
    """A measured time window."""

    began_ns: int
    ended_ns: int

    @property
    def seconds(self) -> float:
        return (self.ended_ns - self.began_ns) / 1e9

    def holds(self, ns: int) -> bool:
        return self.began_ns <= ns < self.ended_ns

    def overlap_s(self, began_ns: int, ended_ns: int) -> float:
        """The part of another window that lies in this one."""
        return max(0, min(ended_ns, self.ended_ns) - max(began_ns, self.began_ns)) / 1e9


class Record(msgspec.Struct, kw_only=True):
    """Everything the operator recorded in one trial."""

    commands: list[Command]
    heartbeats: list[Heartbeat]
    pictures: list[Arrival]  # that could be decoded
    sounds: list[Sound]
    windows: dict[str, Window]  # by phase: "alone", "video", "video off", "audio" and "audio off"
    clip_ns: int  # when it was commanded

    @property
    def driven(self) -> Window:
        """The time in which the robot was driven."""
        return Window(self.windows["alone"].began_ns, self.windows["audio"].ended_ns)


class OperatorReport(msgspec.Struct, kw_only=True, omit_defaults=True):
    """A line from the operator: one of these, or that what was requested is done."""

    phase: str | None = None  # begins now; "": it ended
    record: Record | None = None
    problem: str | None = None


# -- sound


def received(sounds: Iterable[Sound], window: Window) -> list[Sound]:
    """The packets with sound captured in the window, each once, ordered by sequence number."""
    numbered = {sound.sequence: sound for sound in sounds}
    return [sound for _, sound in sorted(numbered.items()) if overlap_s(sound, window) > 0]


def overlap_s(sound: Sound, window: Window) -> float:
    """Seconds of the packet that were captured in the window."""
    return window.overlap_s(sound.sent_ns, sound.sent_ns + round(1e9 * sound.seconds))


def sound_percent(sounds: Iterable[Sound], window: Window, within_s: float = math.inf) -> float:
    """Share of the window's sound that arrived within that many seconds."""
    arrived_s = [overlap_s(one, window) for one in received(sounds, window) if one.ms <= 1e3 * within_s]
    return min(100.0, 100 * sum(arrived_s) / window.seconds)


# -- gaps between pictures and heartbeats


def gaps_s(arrivals_ns: Sequence[int], window: Window) -> list[float]:
    """The gaps between arrivals within the window, including its ends; never empty."""
    inside = sorted(ns for ns in arrivals_ns if window.holds(ns))
    return [(b - a) / 1e9 for a, b in pairwise([window.began_ns, *inside, window.ended_ns])]


def offline_s(heartbeats: Sequence[Heartbeat], window: Window) -> list[float]:
    """Durations for which an operator's page showed the robot offline; ``heartbeats`` may begin before the window."""
    liveness, pending = Liveness(), deque(sorted(heartbeats, key=lambda heartbeat: heartbeat.arrived_ns))

    def is_offline(at_ns: int) -> bool:
        while pending and pending[0].arrived_ns <= at_ns:
            heartbeat = pending.popleft()
            liveness.heartbeat(heartbeat.arrived_ns / 1e9, heartbeat.ms / 1e3, online=heartbeat.online)
        return liveness.online(at_ns / 1e9) is False

    polls = range(window.began_ns, window.ended_ns, _POLL_NS)
    periods = [list(period) for offline, period in groupby(polls, is_offline) if offline]
    return [(min(period[-1] + _POLL_NS, window.ended_ns) - period[0]) / 1e9 for period in periods]


# -- driving


def driven_ms(commands: Sequence[Command], entries: Sequence[Entry]) -> list[tuple[Command, float]]:
    """Each command with the time until it, or a newer one that overtook it, reached the MCU; lost ones are left out."""
    arrived = arrivals(entries)
    driven, soonest = [], math.inf
    for command in reversed(commands):
        soonest = min(soonest, arrived.get((command.left, command.right), math.inf))
        if soonest < math.inf:
            driven.append((command, (soonest - command.sent_ns) / 1e6))
    return driven[::-1]


def trips(commands: Sequence[Command], entries: Iterable[Entry]) -> int:
    """How often the robot stopped by itself while being driven."""
    wheels = {(command.left, command.right) for command in commands}
    drives = [entry.drive for entry in entries if entry.drive and commands and entry.ns <= commands[-1].sent_ns]
    return sum(before in wheels and after == _STOP for before, after in pairwise(drives))


def rest_s(commands: Sequence[Command], entries: Iterable[Entry]) -> float:
    """Seconds in which the wheels were at rest between the first and the last command."""
    if not commands:
        return 0.0
    driven = Window(commands[0].sent_ns, commands[-1].sent_ns)
    moves = [(entry.ns, entry.motors) for entry in entries if entry.motors is not None]
    spans = pairwise([(driven.began_ns, _STOP), *moves, (driven.ended_ns, _STOP)])
    return sum((driven.overlap_s(began, ended) for (began, motors), (ended, _) in spans if motors == _STOP), 0.0)


# -- cells


@dataclass(frozen=True, slots=True)
class Trial:
    """A subject in one condition. ``traffic``: bytes that the robot had sent before and after each phase."""

    subject: str
    name: str
    record: Record
    entries: Sequence[Entry]  # of the MCU
    traffic: dict[str, tuple[int, int]]
    playbacks: Sequence[Playback] = ()  # of the robot's loudspeaker, in any trial

    def cell(self, measure: str, unit: str, samples: list[float], **figures: float) -> Cell:
        return round_cell(self.subject, measure, unit, samples, {"trial": self.name}, **figures)

    def wire(self, phase: str) -> dict[str, float]:
        """What the robot sent in a phase."""
        (before, after), seconds = self.traffic[phase], self.record.windows[phase].seconds
        return {"bytes_up": after - before, "kbit_up": 8e-3 * (after - before) / seconds}


def cells_of(trials: Iterable[Trial]) -> Iterator[Cell]:
    for trial in trials:
        for part in (_sound, _pictures, _heartbeats, _drive, _afterwards):
            yield from part(trial)


def with_lost(percent: float) -> Callable[[Cell], float]:
    """Return a function for a percentile in which lost messages are infinitely late."""
    return lambda cell: percentile([sample for samples in cell.with_lost() for sample in samples], percent)


def _sound(trial: Trial) -> Iterator[Cell]:
    sounds, window = trial.record.sounds, trial.record.windows["audio"]
    packets, delivered = received(sounds, window), sound_percent(sounds, window)
    yield trial.cell(
        SOUND, "ms", [packet.ms for packet in packets],
        delivered_percent=delivered, on_time_percent=sound_percent(sounds, window, ON_TIME_S), **trial.wire("audio"),
    )  # fmt: skip


def _pictures(trial: Trial) -> Iterator[Cell]:
    window = trial.record.windows["video"]
    pictures = [picture for picture in trial.record.pictures if window.holds(picture.arrived_ns)]
    gaps = gaps_s([picture.arrived_ns for picture in pictures], window)
    yield trial.cell(
        PICTURES, "ms", [picture.ms for picture in pictures], fps=len(pictures) / window.seconds,
        frozen_s=sum((gap for gap in gaps if gap > FROZEN_S), 0.0), longest_gap_s=max(gaps), **trial.wire("video"),
    )  # fmt: skip


def _heartbeats(trial: Trial) -> Iterator[Cell]:
    heartbeats, driven = trial.record.heartbeats, trial.record.driven
    gaps, offline = gaps_s([one.arrived_ns for one in heartbeats], driven), offline_s(heartbeats, driven)
    longest = {"longest_gap_s": max(gaps), "longest_offline_s": max(offline, default=0.0)}
    yield trial.cell(HEARTBEAT_GAP, "s", gaps, **longest)


def _drive(trial: Trial) -> Iterator[Cell]:
    record, commands = trial.record, trial.record.commands
    driven, reached = driven_ms(commands, trial.entries), arrivals(trial.entries)
    own = sum((command.left, command.right) in reached for command in commands)  # the others were overtaken or lost
    yield trial.cell(
        DRIVE, "ms", [ms for _, ms in driven],
        sent=len(commands), delivered_percent=100 * own / len(commands) if commands else 0.0,
        trips=trips(commands, trial.entries), rest_s=rest_s(commands, trial.entries),
    )  # fmt: skip
    for measure, phase in ((DRIVE_ALONE, "alone"), (DRIVE_VIDEO, "video"), (DRIVE_AUDIO, "audio")):
        window = record.windows[phase]
        took = [ms for command, ms in driven if window.holds(command.sent_ns)]
        yield trial.cell(measure, "ms", took, sent=sum(window.holds(command.sent_ns) for command in commands))


def _afterwards(trial: Trial) -> Iterator[Cell]:
    """What is sent and received while nothing is requested any more, and the clip."""
    record = trial.record
    for measure, phase in ((AFTER_VIDEO, "video off"), (AFTER_AUDIO, "audio off")):
        gaps = gaps_s([heartbeat.arrived_ns for heartbeat in record.heartbeats], record.windows[phase])
        yield trial.cell(measure, "s", gaps, heartbeats=len(gaps) - 1, longest_gap_s=max(gaps), **trial.wire(phase))
    played = [(one.began_ns - record.clip_ns) / 1e6 for one in trial.playbacks if one.began_ns >= record.clip_ns]
    yield trial.cell(CLIP, "ms", sorted(played)[:1], sent=1)
