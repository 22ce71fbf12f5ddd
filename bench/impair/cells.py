"""Turns recorded trials into cells of results. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pebble.bench.impair import metrics
from pebble.bench.impair.metrics import Record, Window
from pebble.bench.impair.network import Traffic
from pebble.bench.results import OVER_TIME, Cell, Value, rounded
from pebble.simulation.loudspeaker import Playback
from pebble.simulation.trace import Entry

SOUND, PICTURES, PICTURE_GAP = "audio latency", "video latency", "picture gap"
HEARTBEAT_GAP, HEARTBEAT_DELAY = "heartbeat gap", "heartbeat delay"
DRIVE, DRIVE_ALONE, DRIVE_VIDEO, DRIVE_AUDIO = "drive", "drive alone", "drive during video", "drive during audio"
AFTER_VIDEO, AFTER_AUDIO, CLIP = "heartbeat gap after video", "heartbeat gap after audio", "clip"
SOUND_OVER_TIME, DRIVE_OVER_TIME = f"audio{OVER_TIME}", f"drive{OVER_TIME}"


@dataclass(frozen=True, slots=True)
class Trial:
    """One subject in one condition. ``carried``: the network's counters before and after each phase."""

    subject: str
    name: str
    record: Record
    entries: Sequence[Entry]  # of the MCU
    traffic: dict[str, tuple[Traffic, Traffic]]
    playbacks: Sequence[Playback] = ()  # of the robot's loudspeaker, in any trial

    @property
    def phases(self) -> dict[str, Window]:
        return {DRIVE_ALONE: self.record.alone, DRIVE_VIDEO: self.record.video, DRIVE_AUDIO: self.record.audio}


def cells_of(trials: Iterable[Trial], fps: float) -> list[Cell]:
    """The cells of all trials; ``fps`` is the configured rate of pictures."""
    return [
        cell
        for trial in trials
        for cell in (_sound(trial), *_pictures(trial, fps), *_heartbeats(trial), *_drive(trial), *_afterwards(trial))
    ]


def over_time(trials: Iterable[Trial], began_ns: int) -> list[Cell]:
    """Each subject's sound and commands of the whole run. Two rounds: seconds since the start, latencies in ms."""
    sound: dict[str, list[tuple[int, float]]] = {}
    drive: dict[str, list[tuple[int, float]]] = {}
    for trial in trials:
        sound.setdefault(trial.subject, []).extend(
            (one.arrived_ns, (one.arrived_ns - one.captured_ns) / 1e6) for one in trial.record.sounds
        )
        drive.setdefault(trial.subject, []).extend(
            (command.sent_ns + round(1e6 * ms), ms)
            for command, ms in metrics.driven_ms(trial.record.commands, trial.entries)
        )
    return [
        _series(subject, measure, points, began_ns)
        for measure, series in ((SOUND_OVER_TIME, sound), (DRIVE_OVER_TIME, drive))
        for subject, points in series.items()
    ]


def _series(subject: str, measure: str, points: list[tuple[int, float]], began_ns: int) -> Cell:
    points = sorted(points)
    times, values = [(ns - began_ns) / 1e9 for ns, _ in points], [ms for _, ms in points]
    return Cell(variant=subject, measure=measure, unit="ms", rounds=[times, values])


def _cell(trial: Trial, measure: str, unit: str, samples: list[float], **more: Value) -> Cell:
    return Cell(
        variant=trial.subject,
        params={"trial": trial.name},
        measure=measure,
        unit=unit,
        rounds=[samples],
        figures={name: rounded(value, 3) if isinstance(value, float) else value for name, value in more.items()},
    )


def _sound(trial: Trial) -> Cell:
    sounds, window = trial.record.sounds, trial.record.audio
    packets = metrics.received(sounds, window)
    delivered = metrics.sound_percent(sounds, window)
    on_time = metrics.sound_percent(sounds, window, metrics.ON_TIME_S)
    return _cell(
        trial,
        SOUND,
        "ms",
        [(packet.arrived_ns - packet.captured_ns) / 1e6 for packet in packets],
        delivered_percent=delivered,
        on_time_percent=on_time,
        late_percent=delivered - on_time,
        sent=metrics.sent_packets(packets, delivered),
        first_s=window.first_s,
        **_wire(trial, "audio", window),
    )


def _pictures(trial: Trial, wanted_fps: float) -> list[Cell]:
    window = trial.record.video
    pictures = metrics.seen(trial.record.pictures, window)
    gaps = metrics.gaps_s([picture.arrived_ns for picture in pictures], window)
    latencies = [(one.arrived_ns - one.captured_ns) / 1e6 for one in pictures if one.captured_ns is not None]
    fps = len(pictures) / window.seconds
    more: dict[str, Value] = {
        "fps": fps,
        "delivered_percent": min(100.0, 100 * fps / wanted_fps),
        "frozen_s": sum((gap for gap in gaps if gap > metrics.FROZEN_S), 0.0),
        "longest_gap_s": max(gaps),
        "decoded": len(trial.record.pictures),
        "arrived": trial.record.payloads,
        "first_s": window.first_s,
        **_wire(trial, "video", window),
    }
    return [_cell(trial, PICTURES, "ms", latencies, **more), _cell(trial, PICTURE_GAP, "s", gaps)]


def _heartbeats(trial: Trial) -> list[Cell]:
    whole = trial.record.whole
    heartbeats = [heartbeat for heartbeat in trial.record.heartbeats if trial.record.whole.holds(heartbeat.arrived_ns)]
    gaps = metrics.gaps_s([heartbeat.arrived_ns for heartbeat in heartbeats], whole)
    offline_periods = metrics.offline_s(trial.record.heartbeats, whole)
    return [
        _cell(
            trial,
            HEARTBEAT_GAP,
            "s",
            gaps,
            longest_gap_s=max(gaps),
            offline_s=sum(offline_periods, 0.0),
            longest_offline_s=max(offline_periods, default=0.0),
            window_s=whole.seconds,
        ),
        _cell(
            trial, HEARTBEAT_DELAY, "ms", [(heartbeat.arrived_ns - heartbeat.sent_ns) / 1e6 for heartbeat in heartbeats]
        ),
    ]


def _drive(trial: Trial) -> list[Cell]:
    commands = trial.record.commands
    driven = metrics.driven_ms(commands, trial.entries)
    overtaken = metrics.overtaken(commands, trial.entries)
    cells = [
        _cell(
            trial,
            DRIVE,
            "ms",
            [ms for _, ms in driven],
            sent=len(commands),
            delivered_percent=100 * (len(driven) - overtaken) / len(commands) if commands else None,
            overtaken=overtaken,
            trips=metrics.trips(commands, trial.entries),
            rest_s=metrics.rest_s(commands, trial.entries),
            window_s=trial.record.whole.seconds,
        )
    ]
    for measure, window in trial.phases.items():
        sent = metrics.within(commands, window)
        took = [ms for command, ms in driven if window.holds(command.sent_ns)]
        wire = _wire(trial, "alone", window) if measure == DRIVE_ALONE else {"window_s": window.seconds}
        cells.append(_cell(trial, measure, "ms", took, sent=len(sent), **wire))
    return cells


def _afterwards(trial: Trial) -> list[Cell]:
    """What is sent and received while nothing is requested any more, and the clip."""
    record, clip_ms = trial.record, metrics.clip_ms(trial.record.clip, trial.playbacks)
    playing_ns = record.clip.playing_ns
    status_ms = None if playing_ns is None else (playing_ns - record.clip.sent_ns) / 1e6
    return [
        _after(trial, AFTER_VIDEO, "video off", record.video_off),
        _after(trial, AFTER_AUDIO, "audio off", record.audio_off),
        _cell(trial, CLIP, "ms", [] if clip_ms is None else [clip_ms], sent=1, status_ms=status_ms),
    ]


def _after(trial: Trial, measure: str, phase: str, window: Window) -> Cell:
    arrivals = [heartbeat.arrived_ns for heartbeat in trial.record.heartbeats if window.holds(heartbeat.arrived_ns)]
    gaps, wire = metrics.gaps_s(arrivals, window), _wire(trial, phase, window)
    return _cell(trial, measure, "s", gaps, heartbeats=len(arrivals), longest_gap_s=max(gaps), **wire)


def _wire(trial: Trial, phase: str, window: Window) -> dict[str, Value]:
    before, after = trial.traffic[phase]
    return {
        "window_s": window.seconds,
        "bytes_up": after.bytes_up - before.bytes_up,
        "kbit_up": 8e-3 * (after.bytes_up - before.bytes_up) / window.seconds,
        "kbit_down": 8e-3 * (after.bytes_down - before.bytes_down) / window.seconds,
        "dropped_up": after.dropped_up - before.dropped_up,
        "dropped_down": after.dropped_down - before.dropped_down,
    }
