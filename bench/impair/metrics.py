"""What the operator of a trial records, as JSON lines between processes, and the metrics of it. Pure.

All times are ns of CLOCK_MONOTONIC. Late is not lost: sound captured in a window counts as delivered if it arrived
before the trial's end; its delay is in the latencies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

import msgspec

from pebble.client.discovery import Liveness
from pebble.simulation.loudspeaker import Playback
from pebble.simulation.trace import Entry

ON_TIME_S = 1.0  # older sound is useless in a conversation
FROZEN_S = 1.0  # a picture shown for longer counts as frozen
_POLL_S = 0.01  # interval at which the operator's page checks the heartbeat
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
    return [
        sound
        for _, sound in sorted({sound.sequence: sound for sound in sounds}.items())
        if overlap_s(sound, window) > 0
    ]


def overlap_s(sound: Sound, window: Window) -> float:
    """Seconds of the packet that were captured in the window."""
    began, ended = sound.captured_ns, sound.captured_ns + round(1e9 * sound.seconds)
    return max(0, min(ended, window.ended_ns) - max(began, window.began_ns)) / 1e9


def sound_percent(sounds: Iterable[Sound], window: Window, within_s: float | None = None) -> float:
    """Share of the window's sound that arrived, or arrived within that many seconds."""
    arrived = [
        overlap_s(sound, window)
        for sound in received(sounds, window)
        if within_s is None or sound.arrived_ns - sound.captured_ns <= 1e9 * within_s
    ]
    return min(100.0, 100 * sum(arrived) / window.seconds)


def sent_packets(sounds: Sequence[Sound], percent: float) -> int | None:
    """The number of packets sent in the window, estimated from those received; None if none arrived."""
    return max(len(sounds), round(100 * len(sounds) / percent)) if sounds and percent else None


# -- gaps between pictures and heartbeats


def gaps_s(arrivals_ns: Sequence[int], window: Window) -> list[float]:
    """The gaps between arrivals within the window, including its ends; never empty."""
    inside = sorted(ns for ns in arrivals_ns if window.holds(ns))
    return [(b - a) / 1e9 for a, b in pairwise([window.began_ns, *inside, window.ended_ns])]


def seen(pictures: Iterable[Picture], window: Window) -> list[Picture]:
    """The pictures that arrived in the window."""
    return [picture for picture in pictures if window.holds(picture.arrived_ns)]


def offline_s(heartbeats: Sequence[Heartbeat], window: Window) -> list[float]:
    """Durations for which an operator's page showed the robot offline; ``heartbeats`` may begin before the window."""
    liveness, pending = Liveness(), sorted(heartbeats, key=lambda heartbeat: heartbeat.arrived_ns)
    offline_periods, since = [], None
    at, step_ns, number = window.began_ns, round(1e9 * _POLL_S), 0
    while at < window.ended_ns:
        while number < len(pending) and pending[number].arrived_ns <= at:
            heartbeat = pending[number]
            delay_s = (heartbeat.arrived_ns - heartbeat.sent_ns) / 1e9
            liveness.heartbeat(heartbeat.arrived_ns / 1e9, delay_s, online=heartbeat.online)
            number += 1
        if liveness.online(at / 1e9) is False:
            since = at if since is None else since
        elif since is not None:
            offline_periods.append((at - since) / 1e9)
            since = None
        at += step_ns
    return offline_periods if since is None else [*offline_periods, (window.ended_ns - since) / 1e9]


# -- a clip


def clip_ms(command: ClipCommand, playbacks: Iterable[Playback]) -> float | None:
    """From the play command until the first sample was played; None if it was not."""
    began_ns = min((one.began_ns for one in playbacks if one.began_ns >= command.sent_ns), default=None)
    return None if began_ns is None else (began_ns - command.sent_ns) / 1e6


# -- driving


def driven_ms(commands: Sequence[Command], entries: Iterable[Entry]) -> list[tuple[Command, float]]:
    """Each command with the time until it, or a newer one that overtook it, reached the MCU; lost ones are left out."""
    arrived = _arrivals(entries)
    driven, soonest = [], math.inf
    for command in reversed(commands):
        soonest = min(soonest, arrived.get((command.left, command.right), math.inf))
        if soonest < math.inf:
            driven.append((command, (soonest - command.sent_ns) / 1e6))
    return driven[::-1]


def overtaken(commands: Sequence[Command], entries: Iterable[Entry]) -> int:
    """The number of commands that did not reach the MCU although a newer one did."""
    arrived = _arrivals(entries)
    reached_mcu = [(command.left, command.right) in arrived for command in commands]
    return reached_mcu[: len(reached_mcu) - reached_mcu[::-1].index(True)].count(False) if any(reached_mcu) else 0


def _arrivals(entries: Iterable[Entry]) -> dict[tuple[float, float], int]:
    """When each pair of wheel speeds first reached the MCU."""
    arrived: dict[tuple[float, float], int] = {}
    for entry in entries:
        if entry.drive is not None:
            arrived.setdefault(entry.drive, entry.ns)
    return arrived


def within(commands: Iterable[Command], window: Window) -> list[Command]:
    return [command for command in commands if window.holds(command.sent_ns)]


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
