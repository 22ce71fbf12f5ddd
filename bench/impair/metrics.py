"""What the operator of a trial records, as JSON lines between processes, and the cells of results made of it. Pure.

All times are ns of CLOCK_MONOTONIC. Late is not lost: sound captured in a window counts as delivered if it arrived
before the trial's end; its delay is in the latencies.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby, pairwise

import msgspec

from pebble.bench.bridge_operator import arrivals
from pebble.bench.impair.network import Traffic
from pebble.bench.results import OVER_TIME, Cell, Value, grouped, rounded
from pebble.client.discovery import Liveness
from pebble.simulation.loudspeaker import Playback
from pebble.simulation.trace import Entry

SOUND, PICTURES, PICTURE_GAP = "audio latency", "video latency", "picture gap"
HEARTBEAT_GAP, HEARTBEAT_DELAY = "heartbeat gap", "heartbeat delay"
DRIVE, DRIVE_ALONE, DRIVE_VIDEO, DRIVE_AUDIO = "drive", "drive alone", "drive during video", "drive during audio"
AFTER_VIDEO, AFTER_AUDIO, CLIP = "heartbeat gap after video", "heartbeat gap after audio", "clip"
SOUND_OVER_TIME, DRIVE_OVER_TIME = f"audio{OVER_TIME}", f"drive{OVER_TIME}"

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


class Arrival(msgspec.Struct, array_like=True, frozen=True):
    """What was received; ``sent_ns`` is when it was sent, or its first sample was captured."""

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


class Picture(msgspec.Struct, array_like=True, frozen=True):
    """A decoded picture; ``captured_ns`` is None if its message did not contain it."""

    captured_ns: int | None
    arrived_ns: int


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
    began, ended = sound.sent_ns, sound.sent_ns + round(1e9 * sound.seconds)
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


# -- cells


@dataclass(frozen=True, slots=True)
class Trial:
    """One subject in one condition. ``traffic``: the network's counters before and after each phase."""

    subject: str
    name: str
    record: Record
    entries: Sequence[Entry]  # of the MCU
    traffic: dict[str, tuple[Traffic, Traffic]]
    playbacks: Sequence[Playback] = ()  # of the robot's loudspeaker, in any trial

    def cell(self, measure: str, unit: str, samples: list[float], **more: Value) -> Cell:
        figures = {name: rounded(value, 3) if isinstance(value, float) else value for name, value in more.items()}
        about: dict[str, Value] = {"trial": self.name}
        return Cell(variant=self.subject, params=about, measure=measure, unit=unit, rounds=[samples], figures=figures)

    def wire(self, phase: str, window: Window) -> dict[str, Value]:
        """What the network carried and dropped in a phase."""
        before, after = map(asdict, self.traffic[phase])
        by = {name: after[name] - before[name] for name in after}
        kbit = {f"kbit_{way}": 8e-3 * by[f"bytes_{way}"] / window.seconds for way in ("up", "down")}
        counted = {name: by[name] for name in ("bytes_up", "dropped_up", "dropped_down")}
        return {"window_s": window.seconds, **counted, **kbit}


def cells_of(trials: Iterable[Trial], fps: float) -> list[Cell]:
    """The cells of all trials; ``fps`` is the configured rate of pictures."""
    return [
        cell
        for trial in trials
        for cell in (_sound(trial), *_pictures(trial, fps), *_heartbeats(trial), *_drive(trial), *_afterwards(trial))
    ]


def over_time(trials: Iterable[Trial], began_ns: int) -> list[Cell]:
    """Each subject's sound and commands of the whole run. Two rounds: seconds since the start, latencies in ms."""
    cells = []
    for subject, own in grouped(trials, lambda trial: trial.subject).items():
        sounds = [(one.arrived_ns, one.ms) for trial in own for one in trial.record.sounds]
        driven = [pair for trial in own for pair in driven_ms(trial.record.commands, trial.entries)]
        arrived = [(command.sent_ns + round(1e6 * ms), ms) for command, ms in driven]
        for measure, points in ((SOUND_OVER_TIME, sorted(sounds)), (DRIVE_OVER_TIME, sorted(arrived))):
            rounds = [[(ns - began_ns) / 1e9 for ns, _ in points], [ms for _, ms in points]]
            cells.append(Cell(variant=subject, measure=measure, unit="ms", rounds=rounds))
    return cells


def _sound(trial: Trial) -> Cell:
    sounds, window = trial.record.sounds, trial.record.audio
    packets = received(sounds, window)
    delivered, on_time = sound_percent(sounds, window), sound_percent(sounds, window, ON_TIME_S)
    return trial.cell(
        SOUND, "ms", [packet.ms for packet in packets],
        delivered_percent=delivered, on_time_percent=on_time, late_percent=delivered - on_time,
        sent=sent_packets(packets, delivered), first_s=window.first_s, **trial.wire("audio", window),
    )  # fmt: skip


def _pictures(trial: Trial, wanted_fps: float) -> Iterator[Cell]:
    record, window = trial.record, trial.record.video
    pictures = [picture for picture in record.pictures if window.holds(picture.arrived_ns)]
    gaps = gaps_s([picture.arrived_ns for picture in pictures], window)
    fps = len(pictures) / window.seconds
    latencies = [(one.arrived_ns - one.captured_ns) / 1e6 for one in pictures if one.captured_ns is not None]
    yield trial.cell(
        PICTURES, "ms", latencies,
        fps=fps, delivered_percent=min(100.0, 100 * fps / wanted_fps),
        frozen_s=sum((gap for gap in gaps if gap > FROZEN_S), 0.0), longest_gap_s=max(gaps),
        decoded=len(record.pictures), arrived=record.payloads, first_s=window.first_s, **trial.wire("video", window),
    )  # fmt: skip
    yield trial.cell(PICTURE_GAP, "s", gaps)


def _heartbeats(trial: Trial) -> Iterator[Cell]:
    heartbeats, whole = trial.record.heartbeats, trial.record.whole
    gaps = gaps_s([heartbeat.arrived_ns for heartbeat in heartbeats], whole)
    offline = offline_s(heartbeats, whole)
    longest = {"longest_gap_s": max(gaps), "longest_offline_s": max(offline, default=0.0)}
    yield trial.cell(HEARTBEAT_GAP, "s", gaps, offline_s=sum(offline, 0.0), window_s=whole.seconds, **longest)
    delays = [heartbeat.ms for heartbeat in heartbeats if whole.holds(heartbeat.arrived_ns)]
    yield trial.cell(HEARTBEAT_DELAY, "ms", delays)


def _drive(trial: Trial) -> Iterator[Cell]:
    record, commands = trial.record, trial.record.commands
    driven, late = driven_ms(commands, trial.entries), overtaken(commands, trial.entries)
    yield trial.cell(
        DRIVE, "ms", [ms for _, ms in driven],
        sent=len(commands), delivered_percent=100 * (len(driven) - late) / len(commands) if commands else None,
        overtaken=late, trips=trips(commands, trial.entries), rest_s=rest_s(commands, trial.entries),
        window_s=record.whole.seconds,
    )  # fmt: skip
    for measure, window in ((DRIVE_ALONE, record.alone), (DRIVE_VIDEO, record.video), (DRIVE_AUDIO, record.audio)):
        took = [ms for command, ms in driven if window.holds(command.sent_ns)]
        sent = sum(window.holds(command.sent_ns) for command in commands)
        wire = trial.wire("alone", window) if measure == DRIVE_ALONE else {"window_s": window.seconds}
        yield trial.cell(measure, "ms", took, sent=sent, **wire)


def _afterwards(trial: Trial) -> Iterator[Cell]:
    """What is sent and received while nothing is requested any more, and the clip."""
    record, clip = trial.record, trial.record.clip
    off = ((AFTER_VIDEO, "video off", record.video_off), (AFTER_AUDIO, "audio off", record.audio_off))
    for measure, phase, window in off:
        times = [heartbeat.arrived_ns for heartbeat in record.heartbeats if window.holds(heartbeat.arrived_ns)]
        gaps, wire = gaps_s(times, window), trial.wire(phase, window)
        yield trial.cell(measure, "s", gaps, heartbeats=len(times), longest_gap_s=max(gaps), **wire)
    played = [(one.began_ns - clip.sent_ns) / 1e6 for one in trial.playbacks if one.began_ns >= clip.sent_ns]
    status_ms = None if clip.playing_ns is None else (clip.playing_ns - clip.sent_ns) / 1e6
    yield trial.cell(CLIP, "ms", sorted(played)[:1], sent=1, status_ms=status_ms)
