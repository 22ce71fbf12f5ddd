"""What an operator of a thin link did, as JSON lines between processes, and what became of it at the wheels. Pure.

All times are ns of CLOCK_MONOTONIC. The wheels are those of the simulated MCU, by its own trace.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import msgspec

from pebble.bench.bridge_operator import arrivals
from pebble.bench.impair.metrics import Command, Heartbeat, Window, driven_ms, gaps_s, rest_s
from pebble.bench.results import OVER_TIME, Cell, Value, rounded
from pebble.simulation.trace import Entry

COMMAND, RELEASE, STOP, CONFIRMED = "command", "release", "stop", "stop confirmed"
TAKE, LOST, HEARTBEAT, HEARTBEAT_AGE, QUEUE = "take", "taken over", "heartbeat gap", "heartbeat age", "queue"
COMMANDED, WHEELS, RELEASED, STOPPED = (f"{what}{OVER_TIME}" for what in ("commanded", "wheels", "released", "stopped"))
LONG_QUEUE_MS = 500
_STEPS = 800
_AT_REST = (0.0, 0.0)


class Gesture(msgspec.Struct, array_like=True, frozen=True):
    """The robot is driven for ``drive_s``, then let go or stopped; for ``rest_s`` it must not move again."""

    kind: Literal["release", "stop"]
    drive_s: float
    rest_s: float


class Login(msgspec.Struct, frozen=True):
    name: str = ""  # "": none
    password: str = ""


class Orders(msgspec.Struct, kw_only=True):
    """What an operator does. ``foreign_hz``: it knows nothing of links and control, and drives at this rate."""

    host: str
    port: int
    base: str
    ca_cert: str | None = None
    people: list[Login]  # who drive; a second one only takes over
    gestures: list[Gesture] = []
    limit_s: float = 0.0  # after so long no further gesture begins: where nothing is answered, each takes long
    video: bool = False
    foreign_hz: float = 0.0
    takes: int = 0  # so often control is taken over


class Driven(msgspec.Struct, array_like=True, frozen=True):
    """A gesture as it was: when its first command, and its zero or stop, were sent; until when it was watched."""

    kind: str
    began_ns: int
    ended_ns: int
    until_ns: int
    confirmed_ns: int = 0  # 0: the stop was not


class Take(msgspec.Struct, array_like=True, frozen=True):
    """Control was asked for; it was there, and the one before knew of it (0: not, or there was none)."""

    began_ns: int
    held_ns: int
    lost_ns: int


class LinkSeen(msgspec.Struct, array_like=True, frozen=True):
    """``outgoing/link`` arrived."""

    ns: int
    level: str
    queue_ms: int


class WheelRecord(msgspec.Struct, kw_only=True):
    """Everything an operator recorded."""

    began_ns: int
    ended_ns: int
    commands: list[Command]
    gestures: list[Driven]
    heartbeats: list[Heartbeat]
    links: list[LinkSeen]
    takes: list[Take]
    pictures: int
    controlled: bool  # it had control


class WheelReport(msgspec.Struct, kw_only=True, omit_defaults=True):
    """A line from the operator."""

    ready_s: float | None = None  # so long the robot took to be ready, as far as the operator could see
    record: WheelRecord | None = None
    problem: str | None = None


def hand(number: int, seconds: float) -> tuple[float, float]:
    """The wheel speeds of command ``number`` of a hand that steers to and fro: no two of 8,000 are equal."""
    left = round(0.6 + 0.28 * math.sin(2 * math.pi * seconds / 5), 2)
    return round(left + number // _STEPS % 10 / 1000, 3), round(0.1 + number % _STEPS / 1000, 3)


# -- what the wheels did


def moves(entries: Iterable[Entry]) -> list[tuple[int, tuple[float, float]]]:
    return [(entry.ns, entry.motors) for entry in entries if entry.motors is not None]


def rest_ms(moved: Sequence[tuple[int, tuple[float, float]]], driven: Driven) -> float | None:
    """From the zero or the stop until the wheels were at rest for good.

    None: they were at rest, and stayed so; infinite: they still moved when the robot was watched no longer.
    """
    state = next((motors for ns, motors in reversed(moved) if ns <= driven.ended_ns), _AT_REST)
    rested: int | None = None
    moving = was_moving = state != _AT_REST
    for ns, motors in moved:
        if driven.ended_ns < ns <= driven.until_ns:
            if (now := motors != _AT_REST) != moving and not now:
                rested = ns
            moving, was_moving = now, was_moving or now
    if not was_moving:
        return None
    return math.inf if moving or rested is None else (rested - driven.ended_ns) / 1e6


def longest_above_s(links: Sequence[LinkSeen], ended_ns: int) -> float:
    """The longest time for which the robot reported a queue above :data:`LONG_QUEUE_MS`."""
    longest, since = 0, None
    for seen, after in pairwise([*links, LinkSeen(ended_ns, "", 0)]):
        if seen.queue_ms <= LONG_QUEUE_MS:
            since = None
            continue
        since = seen.ns if since is None else since
        longest = max(longest, after.ns - since)
    return longest / 1e9


# -- cells


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelTrial:
    """One subject in one trial. ``silences``: how often its robot took a connection for dead that was not."""

    subject: str
    trial: str
    record: WheelRecord
    entries: Sequence[Entry]
    ready_s: float
    silences: int
    scene: int  # so many gestures, from the second one on, are drawn
    more: dict[str, Value] = field(default_factory=dict)

    def cell(self, measure: str, unit: str, *rounds: Sequence[float], **figures: float | str | None) -> Cell:
        known: dict[str, Value] = {
            name: rounded(value, 3) if isinstance(value, float) else value for name, value in figures.items()
        }
        return Cell(
            variant=self.subject, params={"trial": self.trial}, measure=measure, unit=unit,
            rounds=[list(one) for one in rounds], figures=known,
        )  # fmt: skip


def cells_of(trial: WheelTrial) -> Iterator[Cell]:
    """The longest gesture is that of commands; all count for releases and stops."""
    record, moved = trial.record, moves(trial.entries)
    if record.gestures:
        yield _commands(trial)
        for kind in (RELEASE, STOP):
            times = [rest_ms(moved, one) for one in record.gestures if one.kind == kind]
            judged = [ms for ms in times if ms is not None]
            if times:
                yield trial.cell(
                    kind, "ms", [ms for ms in judged if ms < math.inf], sent=len(judged), asked=len(times)
                )  # fmt: skip
        stops = [one for one in record.gestures if one.kind == STOP]
        if stops:
            confirmed = [(one.confirmed_ns - one.ended_ns) / 1e6 for one in stops if one.confirmed_ns]
            yield trial.cell(CONFIRMED, "ms", confirmed, sent=len(stops))
    if record.takes:
        held = [(one.held_ns - one.began_ns) / 1e6 for one in record.takes if one.held_ns]
        lost = [(one.lost_ns - one.began_ns) / 1e6 for one in record.takes if one.lost_ns]
        yield trial.cell(TAKE, "ms", held, sent=len(record.takes))
        yield trial.cell(LOST, "ms", lost, sent=len(record.takes) - 1)  # at first none has control
    window = Window(record.began_ns, record.ended_ns)
    gaps = gaps_s([one.arrived_ns for one in record.heartbeats], window)
    yield trial.cell(
        HEARTBEAT, "s", gaps, longest_gap_s=max(gaps), silences=trial.silences, minutes=window.seconds / 60,
        ready_s=trial.ready_s,
    )  # fmt: skip
    yield trial.cell(HEARTBEAT_AGE, "ms", [one.ms for one in record.heartbeats])
    queue = [float(seen.queue_ms) for seen in record.links]
    levels = "/".join(dict.fromkeys(seen.level for seen in record.links))
    yield trial.cell(
        QUEUE, "ms", queue, longest_s=longest_above_s(record.links, record.ended_ns), level=levels or "–",
        pictures=record.pictures,
    )  # fmt: skip
    yield from _scene(trial, moved)


def _commands(trial: WheelTrial) -> Cell:
    record = trial.record
    longest = max(record.gestures, key=lambda one: one.ended_ns - one.began_ns)
    window = Window(longest.began_ns, longest.ended_ns)
    commands = [one for one in record.commands if window.holds(one.sent_ns)]
    entries = [entry for entry in trial.entries if entry.ns >= longest.began_ns]
    reached = arrivals(entries)
    own = sum((one.left, one.right) in reached for one in commands)
    return trial.cell(
        COMMAND, "ms", [ms for _, ms in driven_ms(commands, entries)], sent=len(commands),
        delivered_percent=100 * own / len(commands) if commands else None,
        rest_percent=100 * rest_s(commands, entries) / window.seconds, window_s=window.seconds,
        control="yes" if record.controlled else "no",
    )  # fmt: skip


def _scene(trial: WheelTrial, moved: Sequence[tuple[int, tuple[float, float]]]) -> Iterator[Cell]:
    """A few gestures, drawn: the speed of the left wheel as commanded, and as it was."""
    shown = trial.record.gestures[1 : 1 + trial.scene]
    if not shown:
        return
    window = Window(shown[0].began_ns - 500_000_000, shown[-1].until_ns)

    def curve(measure: str, points: Iterable[tuple[int, float]]) -> Cell:
        inside = [(max(0, ns - window.began_ns) / 1e9, value) for ns, value in points if ns < window.ended_ns]
        return trial.cell(measure, "s", [at for at, _ in inside], [value for _, value in inside])

    commanded = [(one.sent_ns, one.left) for one in trial.record.commands if window.holds(one.sent_ns)]
    commanded += [(one.ended_ns, 0.0) for one in shown]
    before = [0.0, *(motors[0] for ns, motors in moved if ns <= window.began_ns)][-1]
    wheels = [(window.began_ns, before), *((ns, motors[0]) for ns, motors in moved if window.holds(ns))]
    yield curve(COMMANDED, [(window.began_ns, 0.0), *sorted(commanded), (window.ended_ns - 1, 0.0)])
    yield curve(WHEELS, [*wheels, (window.ended_ns - 1, wheels[-1][1])])
    for measure, kind in ((RELEASED, RELEASE), (STOPPED, STOP)):
        yield curve(measure, [(one.ended_ns, 0.0) for one in shown if one.kind == kind])
