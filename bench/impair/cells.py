"""Turns recorded trials into cells of results. Pure."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
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
    """One subject in one condition. ``traffic``: the network's counters before and after each phase."""

    subject: str
    name: str
    record: Record
    entries: Sequence[Entry]  # of the MCU
    traffic: dict[str, tuple[Traffic, Traffic]]
    playbacks: Sequence[Playback] = ()  # of the robot's loudspeaker, in any trial

    def cell(self, measure: str, unit: str, samples: list[float], **more: Value) -> Cell:
        return Cell(
            variant=self.subject,
            params={"trial": self.name},
            measure=measure,
            unit=unit,
            rounds=[samples],
            figures={name: rounded(value, 3) if isinstance(value, float) else value for name, value in more.items()},
        )

    def wire(self, phase: str, window: Window) -> dict[str, Value]:
        """What the network carried and dropped in a phase."""
        before, after = self.traffic[phase]
        up, down = after.bytes_up - before.bytes_up, after.bytes_down - before.bytes_down
        return {
            "window_s": window.seconds,
            "bytes_up": up,
            "kbit_up": 8e-3 * up / window.seconds,
            "kbit_down": 8e-3 * down / window.seconds,
            "dropped_up": after.dropped_up - before.dropped_up,
            "dropped_down": after.dropped_down - before.dropped_down,
        }


def cells_of(trials: Iterable[Trial], fps: float) -> list[Cell]:
    """The cells of all trials; ``fps`` is the configured rate of pictures."""
    return [
        cell
        for trial in trials
        for cell in (_sound(trial), *_pictures(trial, fps), *_heartbeats(trial), *_drive(trial), *_afterwards(trial))
    ]


def over_time(trials: Iterable[Trial], began_ns: int) -> list[Cell]:
    """Each subject's sound and commands of the whole run. Two rounds: seconds since the start, latencies in ms."""
    series: dict[tuple[str, str], list[tuple[int, float]]] = defaultdict(list)
    for trial in trials:
        driven = metrics.driven_ms(trial.record.commands, trial.entries)
        series[trial.subject, SOUND_OVER_TIME] += [(one.arrived_ns, one.ms) for one in trial.record.sounds]
        series[trial.subject, DRIVE_OVER_TIME] += [(command.sent_ns + round(1e6 * ms), ms) for command, ms in driven]
    cells = []
    for (subject, measure), points in series.items():
        points.sort()
        rounds = [[(ns - began_ns) / 1e9 for ns, _ in points], [ms for _, ms in points]]
        cells.append(Cell(variant=subject, measure=measure, unit="ms", rounds=rounds))
    return cells


def _sound(trial: Trial) -> Cell:
    sounds, window = trial.record.sounds, trial.record.audio
    packets = metrics.received(sounds, window)
    delivered = metrics.sound_percent(sounds, window)
    on_time = metrics.sound_percent(sounds, window, metrics.ON_TIME_S)
    return trial.cell(
        SOUND,
        "ms",
        [packet.ms for packet in packets],
        delivered_percent=delivered,
        on_time_percent=on_time,
        late_percent=delivered - on_time,
        sent=metrics.sent_packets(packets, delivered),
        first_s=window.first_s,
        **trial.wire("audio", window),
    )


def _pictures(trial: Trial, wanted_fps: float) -> Iterator[Cell]:
    record, window = trial.record, trial.record.video
    pictures = [picture for picture in record.pictures if window.holds(picture.arrived_ns)]
    gaps = metrics.gaps_s([picture.arrived_ns for picture in pictures], window)
    fps = len(pictures) / window.seconds
    yield trial.cell(
        PICTURES,
        "ms",
        [(one.arrived_ns - one.captured_ns) / 1e6 for one in pictures if one.captured_ns is not None],
        fps=fps,
        delivered_percent=min(100.0, 100 * fps / wanted_fps),
        frozen_s=sum((gap for gap in gaps if gap > metrics.FROZEN_S), 0.0),
        longest_gap_s=max(gaps),
        decoded=len(record.pictures),
        arrived=record.payloads,
        first_s=window.first_s,
        **trial.wire("video", window),
    )
    yield trial.cell(PICTURE_GAP, "s", gaps)


def _heartbeats(trial: Trial) -> Iterator[Cell]:
    heartbeats, whole = trial.record.heartbeats, trial.record.whole
    gaps = metrics.gaps_s([heartbeat.arrived_ns for heartbeat in heartbeats], whole)
    offline_periods = metrics.offline_s(heartbeats, whole)
    yield trial.cell(
        HEARTBEAT_GAP,
        "s",
        gaps,
        longest_gap_s=max(gaps),
        offline_s=sum(offline_periods, 0.0),
        longest_offline_s=max(offline_periods, default=0.0),
        window_s=whole.seconds,
    )
    delays = [heartbeat.ms for heartbeat in heartbeats if whole.holds(heartbeat.arrived_ns)]
    yield trial.cell(HEARTBEAT_DELAY, "ms", delays)


def _drive(trial: Trial) -> Iterator[Cell]:
    record, commands = trial.record, trial.record.commands
    driven = metrics.driven_ms(commands, trial.entries)
    overtaken = metrics.overtaken(commands, trial.entries)
    yield trial.cell(
        DRIVE,
        "ms",
        [ms for _, ms in driven],
        sent=len(commands),
        delivered_percent=100 * (len(driven) - overtaken) / len(commands) if commands else None,
        overtaken=overtaken,
        trips=metrics.trips(commands, trial.entries),
        rest_s=metrics.rest_s(commands, trial.entries),
        window_s=record.whole.seconds,
    )
    for measure, window in ((DRIVE_ALONE, record.alone), (DRIVE_VIDEO, record.video), (DRIVE_AUDIO, record.audio)):
        took = [ms for command, ms in driven if window.holds(command.sent_ns)]
        sent = sum(window.holds(command.sent_ns) for command in commands)
        wire = trial.wire("alone", window) if measure == DRIVE_ALONE else {"window_s": window.seconds}
        yield trial.cell(measure, "ms", took, sent=sent, **wire)


def _afterwards(trial: Trial) -> Iterator[Cell]:
    """What is sent and received while nothing is requested any more, and the clip."""
    record, clip = trial.record, trial.record.clip
    for measure, phase, window in (
        (AFTER_VIDEO, "video off", record.video_off),
        (AFTER_AUDIO, "audio off", record.audio_off),
    ):
        arrivals = [heartbeat.arrived_ns for heartbeat in record.heartbeats if window.holds(heartbeat.arrived_ns)]
        gaps, wire = metrics.gaps_s(arrivals, window), trial.wire(phase, window)
        yield trial.cell(measure, "s", gaps, heartbeats=len(arrivals), longest_gap_s=max(gaps), **wire)
    played = [(one.began_ns - clip.sent_ns) / 1e6 for one in trial.playbacks if one.began_ns >= clip.sent_ns]
    status_ms = None if clip.playing_ns is None else (clip.playing_ns - clip.sent_ns) / 1e6
    yield trial.cell(CLIP, "ms", sorted(played)[:1], sent=1, status_ms=status_ms)
