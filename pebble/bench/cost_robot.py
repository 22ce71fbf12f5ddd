"""One robot at rest and at work, and what each of its processes takes meanwhile.

Memory is shared with whoever has mapped the same libraries: nothing large is imported here, because the robot uses it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from pebble.bench.bridge_robot import BASE
from pebble.bench.measured_robot import MeasuredRobot
from pebble.bench.onlooker import Onlooker
from pebble.bench.usage import cpu_s, pss_mb
from pebble.errors import PebbleError

RATE_HZ = 20.0  # of driving
IDLE, DRIVING = "idle", "driving"
#: What is asked for in each phase with media, by the name of the phase.
STREAMS = {"json+pcm": ("json", "pcm"), "h264+opus": ("h264", "opus")}
_UP_S = _FLOW_S = 20.0
_SETTLE_S = 0.5  # start-up work, or a change of what is asked for, is over
_FIRST = 5  # pictures and packets of sound: then it flows


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """One robot in one phase. By process: MB of memory, per cent of one core, threads."""

    phase: str
    memory: Mapping[str, float]
    cpu: Mapping[str, float]
    threads: Mapping[str, int]
    pictures_per_s: float | None = None  # that reached the operator; None: none were asked for


def measure(kind: str, seconds: float, streams: Sequence[str]) -> list[Reading]:
    """All phases of a fresh robot. Raises PebbleError with its last words if one of them does not come about."""
    with MeasuredRobot(kind, media=True) as robot, closing(Onlooker(robot.remote_port, BASE)) as onlooker:
        onlooker.wait_until_listening()
        robot.launch()
        robot.expect(lambda: onlooker.ready_ns is not None, "not every service is ready", _UP_S)
        readings = [
            _read(robot, onlooker, IDLE, lambda: time.sleep(seconds)),
            _read(robot, onlooker, DRIVING, lambda: onlooker.drive(seconds, RATE_HZ)),
        ]
        for name in streams:
            _have_flow(robot, onlooker, name)
            readings.append(_read(robot, onlooker, name, lambda: time.sleep(seconds)))
        return readings


def _have_flow(robot: MeasuredRobot, onlooker: Onlooker, name: str) -> None:
    onlooker.ask_for(*STREAMS[name])
    due = {form: onlooker.arrived[form] + _FIRST for form in STREAMS[name]}
    robot.expect(
        lambda: all(onlooker.arrived[form] >= count for form, count in due.items()) and robot.complete(),
        f"{name} does not flow",
        _FLOW_S,
    )


def _read(robot: MeasuredRobot, onlooker: Onlooker, phase: str, work: Callable[[], object]) -> Reading:
    """What the robot's processes take while ``work`` is done; their memory is looked at afterwards."""
    time.sleep(_SETTLE_S)
    processes = robot.processes()
    before = {name: cpu_s([pid]) for name, pid in processes.items()}
    pictures, began = _pictures(onlooker, phase), time.monotonic()
    work()
    took = time.monotonic() - began
    cpu = {name: 100 * (cpu_s([pid]) - before[name]) / took for name, pid in processes.items()}
    arrived = _pictures(onlooker, phase) - pictures
    if robot.processes() != processes:
        raise PebbleError(f"{phase}: processes of the robot ended or were started meanwhile\n{robot.log()}")
    return Reading(
        phase=phase,
        memory={name: pss_mb(pid) for name, pid in processes.items()},
        cpu=cpu,
        threads={name: _threads(pid) for name, pid in processes.items()},
        pictures_per_s=arrived / took if phase in STREAMS else None,
    )


def _pictures(onlooker: Onlooker, phase: str) -> int:
    return onlooker.arrived[STREAMS[phase][0]] if phase in STREAMS else 0


def _threads(pid: int) -> int:
    try:
        return len(list(Path(f"/proc/{pid}/task").iterdir()))
    except OSError:  # it has gone
        return 0
