"""What must be true of the wheels, recomputed from the MCU's trace and what persons did; and of scripts.

Persons drive forward, scripts backward or on the spot, so each line shows whose it is. ``stalls`` are the times in
which the machine did not let processes run, or the MCU's stand-in by its own trace: a deadline is as much later then.
Wheels that turn for 1.00 s were stopped by the MCU, whose own dead-man's switch needs a second: the motor owner did not
write for as long.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tests.kit.stalls import Stall, lost_s
from tests.robot.stop_schedules.history import Event, History

Lines = list[tuple[float, tuple[float, float]]]

_DEADLINE_S, _DEADMAN_S, _BUSY_S = 0.75, 1.0, 0.15  # and what is not measured of a busy machine
_HOLD_S = 1.9  # of the two seconds for which a person's command holds a script
_REACTION_S = 0.5  # from a stop to wheels at rest
_UNSURE_S = 0.6  # before and after a fault, nothing is expected to arrive
_SAME_READ_S = 0.005  # lines of one read have one time
_LATE_S = 1.2  # until the kernel and the guard have ended the scripts of a manager that was killed
_OWNER_FAULTS = ("serial_mcu_bridge", "launcher")


def by_person(wheels: tuple[float, float]) -> bool:
    return wheels[0] > 0 and wheels[1] > 0


def by_script(wheels: tuple[float, float]) -> bool:
    return wheels != (0.0, 0.0) and not by_person(wheels)


def problems(
    history: History,
    lines: Lines,
    motors: Lines,
    overlaps: list[tuple[float, list[int]]],
    stalls: Sequence[Stall] = (),
) -> list[str]:
    """What does not hold, in words; empty if everything does."""
    faults = history.events("fault")
    return [
        *(f"{at:.3f}: two scripts are alive: {pids}" for at, pids in overlaps),
        *_too_long(lines, motors, faults, stalls),
        *_beside_persons(lines),
        *_after_stops(history, lines, faults, stalls),
    ]


def _too_long(lines: Lines, motors: Lines, faults: list[Event], stalls: Sequence[Stall]) -> Iterator[str]:
    """Wheels that turn 0.75 s after the last command, or 1 s if the process that stops them could not."""
    for index, (at, wheels) in enumerate(lines):
        following = lines[index + 1][0] if index + 1 < len(lines) else float("inf")
        helpless = any(_may_affect(fault, at, at + _DEADLINE_S) and _of_owner(fault) for fault in faults)
        limit = at + _BUSY_S + (_DEADMAN_S if helpless else _DEADLINE_S)
        if wheels == (0.0, 0.0) or following <= limit:
            continue
        stops = (when for when, turning in (*motors, *lines[index:]) if when >= at and turning == (0.0, 0.0))
        rest = min(stops, default=float("inf"))
        if rest > limit + lost_s(stalls, at, rest):
            yield f"{at:.3f}: the wheels turn for {rest - at:.2f} s after a command"


def _beside_persons(lines: Lines) -> Iterator[str]:
    """A script's line soon after a person's."""
    person = float("-inf")
    for at, wheels in lines:
        if by_person(wheels):
            person = at
        elif by_script(wheels) and _SAME_READ_S < at - person < _HOLD_S:
            yield f"{at:.3f}: a script moves the wheels {at - person:.2f} s after a person"


def _after_stops(history: History, lines: Lines, faults: list[Event], stalls: Sequence[Stall]) -> Iterator[str]:
    """What moves the wheels after a stop, before a person or a start commands anew."""
    commands = sorted(history.events("drives") + history.events("start"), key=lambda event: event.at)
    for stop in (event for event in history.events() if event.what in ("zero", "estop", "end", "manager killed")):
        if stop.what == "zero" and not stop.details["final"]:
            continue
        unsure = stop.what != "manager killed" and any(_may_affect(fault, stop.at, stop.at) for fault in faults)
        recent = any(0 <= stop.at - start.at < _REACTION_S for start in history.events("start"))
        reaction = _LATE_S if stop.what == "manager killed" else _REACTION_S
        if unsure or recent:
            continue
        until = next((command.at for command in commands if command.at > stop.at), float("inf"))
        moving = [at for at, wheels in lines if stop.at + reaction < at < until and by_script(wheels)]
        moved = [at for at in moving if at > stop.at + reaction + lost_s(stalls, stop.at, at)]
        if moved:
            yield f"{moved[0]:.3f}: a script moves the wheels {moved[0] - stop.at:.2f} s after {stop.what}"


def _may_affect(fault: Event, since: float, until: float) -> bool:
    return fault.at - _UNSURE_S < until and since < fault.details["until"] + _UNSURE_S


def _of_owner(fault: Event) -> bool:
    return str(fault.details["which"]).endswith(_OWNER_FAULTS)
