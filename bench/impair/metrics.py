"""What the operator of a trial records, as JSON lines between processes, and the metrics of it. Pure.

All times are ns of CLOCK_MONOTONIC. Late is not lost: sound captured in a window counts as delivered if it arrived
before the trial's end; its delay is in the latencies.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from itertools import groupby, pairwise

import msgspec

from pebble.bench.bridge_operator import arrivals
from pebble.client.discovery import Liveness
from pebble.simulation.trace import Entry

ON_TIME_S = 1.0  # older sound is useless in a conversation
FROZEN_S = 1.0  # a picture shown for longer counts as frozen
_POLL_NS = 10_000_000  # interval at which the operator's page checks the heartbeat
_STOP = (0.0, 0.0)


class TrialRequest(msgspec.Struct, kw_only=True, tag="trial"):
    """Requests one trial. An encoding of None leaves the choice to the robot."""

    video: str | None
    audio: str | None
    alone_s: float  # driving and heartbeat only
    window_s: float  # of video, and then of audio
    grace_s: float  # for sound of the window that is still in flight
    off_s: float  # after video was switched off, and after audio was
    clip_s: float  # at most, for a clip to be played to its end


class RecoveryRequest(msgspec.Struct, kw_only=True, tag="recover"):
    """Requests a wait until the last trial is ``quiet_s`` ago, and heartbeats arrive without delay."""

    quiet_s: float


class Command(msgspec.Struct, array_like=True, frozen=True):
    """A drive command, identified by the wheel speeds that it sets."""

    left: float
    right: float
    sent_ns: int


class Heartbeat(msgspec.Struct, array_like=True, frozen=True):
    sent_ns: int
    arrived_ns: int
    online: bool = True

    @property
    def ms(self) -> float:
        """Its delay."""
        return (self.arrived_ns - self.sent_ns) / 1e6


class Picture(msgspec.Struct, array_like=True, frozen=True):
    """A decoded picture; ``captured_ns`` is None if its message did not contain it."""

    captured_ns: int | None
    arrived_ns: int


class Sound(msgspec.Struct, array_like=True, frozen=True):
    """A sound packet."""

    captured_ns: int  # its first sample
    arrived_ns: int
    seconds: float
    sequence: int

    @property
    def ms(self) -> float:
        """Its latency."""
        return (self.arrived_ns - self.captured_ns) / 1e6


class Window(msgspec.Struct, frozen=True):
    """A measured time window; ``first_s``: from the request to the first picture or sound, if any arrived."""

    began_ns: int
    ended_ns: int
    first_s: float | None = None

    @property
    def seconds(self) -> float:
        return (self.ended_ns - self.began_ns) / 1e9

    def holds(self, ns: int) -> bool:
        return self.began_ns <= ns < self.ended_ns


class ClipCommand(msgspec.Struct, array_like=True, frozen=True):
    """The command to play a clip; ``playing_ns`` is when the robot's status arrived, None if it did not in time."""

    sent_ns: int
    playing_ns: int | None = None


class Record(msgspec.Struct, kw_only=True):
    """Everything the operator recorded in one trial."""

    commands: list[Command]
    heartbeats: list[Heartbeat]
    pictures: list[Picture]
    sounds: list[Sound]
    alone: Window
    video: Window
    audio: Window
    video_off: Window
    audio_off: Window
    clip: ClipCommand
    payloads: int  # of video that arrived, decoded or not

    @property
    def whole(self) -> Window:
        """The time in which the robot was driven."""
        return Window(self.alone.began_ns, self.audio.ended_ns)


class OperatorReport(msgspec.Struct, kw_only=True, omit_defaults=True):
    """A line from the operator; one of the fields is set."""

    ready: bool = False  # the robot is ready, or has recovered
    phase: str | None = None  # "alone", "video", "video off", "audio" or "audio off" begins now; "": it ended
    record: Record | None = None
    problem: str | None = None


# -- sound


def received(sounds: Iterable[Sound], window: Window) -> list[Sound]:
    """The packets with sound captured in the window, each once, ordered by sequence number."""
    numbered = {sound.sequence: sound for sound in sounds}
    return [sound for _, sound in sorted(numbered.items()) if overlap_s(sound, window) > 0]


def overlap_s(sound: Sound, window: Window) -> float:
    """Seconds of the packet that were captured in the window."""
    began, ended = sound.captured_ns, sound.captured_ns + round(1e9 * sound.seconds)
    return max(0, min(ended, window.ended_ns) - max(began, window.began_ns)) / 1e9


def sound_percent(sounds: Iterable[Sound], window: Window, within_s: float | None = None) -> float:
    """Share of the window's sound that arrived, or arrived within that many seconds."""
    packets = received(sounds, window)
    arrived_s = [overlap_s(one, window) for one in packets if within_s is None or one.ms <= 1e3 * within_s]
    return min(100.0, 100 * sum(arrived_s) / window.seconds)


def sent_packets(sounds: Sequence[Sound], percent: float) -> int | None:
    """The number of packets sent in the window, estimated from those received; None if none arrived."""
    return max(len(sounds), round(100 * len(sounds) / percent)) if sounds and percent else None


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


def overtaken(commands: Sequence[Command], entries: Sequence[Entry]) -> int:
    """The number of commands that did not reach the MCU although a newer one did."""
    arrived = arrivals(entries)
    reached = [number for number, command in enumerate(commands, 1) if (command.left, command.right) in arrived]
    return reached[-1] - len(reached) if reached else 0


def trips(commands: Sequence[Command], entries: Iterable[Entry]) -> int:
    """How often the robot stopped by itself while being driven."""
    wheels = {(command.left, command.right) for command in commands}
    drives = [entry for entry in entries if entry.drive is not None and commands and entry.ns <= commands[-1].sent_ns]
    return sum(a.drive in wheels and b.drive == _STOP for a, b in pairwise(drives))


def rest_s(commands: Sequence[Command], entries: Iterable[Entry]) -> float:
    """Seconds in which the wheels were at rest between the first and the last command."""
    if not commands:
        return 0.0
    since, ended, rest = commands[0].sent_ns, commands[-1].sent_ns, True
    rest_ns = 0
    for entry in (*(entry for entry in entries if entry.motors is not None), Entry(ended, "motors")):
        now = min(max(entry.ns, since), ended)
        rest_ns += now - since if rest else 0
        since, rest = now, entry.motors == _STOP
    return rest_ns / 1e9
