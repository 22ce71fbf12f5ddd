"""What a trial comes to: what arrived, what arrived in time, and how long nothing did. Pure.

Late is not lost: what was captured in a window counts as delivered whenever it came while its trial was listened to,
and its lateness is in the latencies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

from pebble.demo.discovery import Liveness
from pebble.impair.messages import Beat, Command, Picture, Sound, Window
from pebble.simulation.trace import Entry

ON_TIME_S = 1.0  # sound that is older is of no use in a conversation
FROZEN_S = 1.0  # a picture that stands for longer has frozen
_LOOK_S = 0.01  # how finely the operator's page is imagined to look at the heart
_STOP = (0.0, 0.0)


# -- sound


def heard(sounds: Iterable[Sound], window: Window) -> list[Sound]:
    """The packets, each once, with sound that was captured in the window, in the order of their numbers."""
    return [
        sound
        for _, sound in sorted({sound.sequence: sound for sound in sounds}.items())
        if overlap_s(sound, window) > 0
    ]


def overlap_s(sound: Sound, window: Window) -> float:
    """How much of it was captured in the window."""
    began, ended = sound.captured_ns, sound.captured_ns + round(1e9 * sound.seconds)
    return max(0, min(ended, window.ended_ns) - max(began, window.began_ns)) / 1e9


def sound_percent(sounds: Iterable[Sound], window: Window, within_s: float | None = None) -> float:
    """Of the window's sound: what arrived at all, or within so many seconds of having been captured."""
    arrived = [
        overlap_s(sound, window)
        for sound in heard(sounds, window)
        if within_s is None or sound.arrived_ns - sound.captured_ns <= 1e9 * within_s
    ]
    return min(100.0, 100 * sum(arrived) / window.seconds)


def sent_packets(sounds: Sequence[Sound], percent: float) -> int | None:
    """How many the window's sound would have been, of which these are so many per cent; None if none came."""
    return max(len(sounds), round(100 * len(sounds) / percent)) if sounds and percent else None


# -- pictures, heartbeats: what matters is how long there is none


def gaps_s(arrivals_ns: Sequence[int], window: Window) -> list[float]:
    """The times without anything new, as far as they lie in the window: never empty."""
    inside = sorted(ns for ns in arrivals_ns if window.holds(ns))
    return [(b - a) / 1e9 for a, b in pairwise([window.began_ns, *inside, window.ended_ns])]


def seen(pictures: Iterable[Picture], window: Window) -> list[Picture]:
    """Those that arrived in the window."""
    return [picture for picture in pictures if window.holds(picture.arrived_ns)]


def offline_s(beats: Sequence[Beat], window: Window) -> list[float]:
    """How long each time an operator's page showed the robot as offline, by its own rule; ``beats`` before count."""
    liveness, coming = Liveness(), sorted(beats, key=lambda beat: beat.arrived_ns)
    spells, since = [], None
    at, step_ns, number = window.began_ns, round(1e9 * _LOOK_S), 0
    while at < window.ended_ns:
        while number < len(coming) and coming[number].arrived_ns <= at:
            beat = coming[number]
            delay_s = (beat.arrived_ns - beat.sent_ns) / 1e9
            liveness.heartbeat(beat.arrived_ns / 1e9, delay_s, online=beat.online)
            number += 1
        if liveness.online(at / 1e9) is False:
            since = at if since is None else since
        elif since is not None:
            spells.append((at - since) / 1e9)
            since = None
        at += step_ns
    return spells if since is None else [*spells, (window.ended_ns - since) / 1e9]


# -- driving


def driven_ms(commands: Sequence[Command], entries: Iterable[Entry]) -> list[tuple[Command, float]]:
    """Every command with the time until it, or a newer one that overtook it, reached the MCU; else it is left out."""
    arrived = _arrivals(entries)
    driven, soonest = [], math.inf
    for command in reversed(commands):
        soonest = min(soonest, arrived.get((command.left, command.right), math.inf))
        if soonest < math.inf:
            driven.append((command, (soonest - command.sent_ns) / 1e6))
    return driven[::-1]


def overtaken(commands: Sequence[Command], entries: Iterable[Entry]) -> int:
    """Commands that did not reach the MCU, but a newer one did."""
    arrived = _arrivals(entries)
    came = [(command.left, command.right) in arrived for command in commands]
    return came[: len(came) - came[::-1].index(True)].count(False) if any(came) else 0


def _arrivals(entries: Iterable[Entry]) -> dict[tuple[float, float], int]:
    """When the wheels were first told these speeds."""
    arrived: dict[tuple[float, float], int] = {}
    for entry in entries:
        if entry.drive is not None:
            arrived.setdefault(entry.drive, entry.ns)
    return arrived


def within(commands: Iterable[Command], window: Window) -> list[Command]:
    return [command for command in commands if window.holds(command.sent_ns)]


def trips(commands: Sequence[Command], entries: Iterable[Entry]) -> int:
    """How often the robot stopped by itself although it was being driven."""
    wheels = {(command.left, command.right) for command in commands}
    drives = [entry for entry in entries if entry.drive is not None and commands and entry.ns <= commands[-1].sent_ns]
    return sum(a.drive in wheels and b.drive == _STOP for a, b in pairwise(drives))


def rest_s(commands: Sequence[Command], entries: Iterable[Entry]) -> float:
    """Seconds from the first to the last command in which the wheels stood still, as they do before the first."""
    if not commands:
        return 0.0
    since, ended, rest = commands[0].sent_ns, commands[-1].sent_ns, True
    rest_ns = 0
    for entry in (*(entry for entry in entries if entry.motors is not None), Entry(ended, "motors")):
        now = min(max(entry.ns, since), ended)
        rest_ns += now - since if rest else 0
        since, rest = now, entry.motors == _STOP
    return rest_ns / 1e9
