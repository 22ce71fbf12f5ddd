"""Measures the processes of one robot, idle and active.

Shared libraries divide their memory among the processes that map them: nothing large is imported here, since that would
reduce the robot's PSS.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from pebble.bench.robot_subscriber import RobotSubscriber
from pebble.bench.usage import cpu_s, pss_mb
from pebble.errors import PebbleError
from pebble.rig.robot import BASE, MEDIA, Robot, one_robot

RATE_HZ = 20.0  # of driving
IDLE, DRIVING = "idle", "driving"
#: The encodings requested in each media phase, by the name of the phase.
STREAMS = {"json+pcm": ("json", "pcm"), "h264+opus": ("h264", "opus")}
_UP_S = _FLOW_S = 20.0
_STARTUP_S = 0.5  # for start-up work, or a change of the streams, to finish
_FIRST = 5  # pictures and sound packets until a stream counts as flowing


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """One robot in one phase. By process: memory in MB, CPU in per cent of one core, threads."""

    phase: str
    memory: Mapping[str, float]
    cpu: Mapping[str, float]
    threads: Mapping[str, int]
    pictures_per_s: float | None = None  # delivered to the operator; None: none were requested


def measure(kind: str, seconds: float, streams: Sequence[str]) -> list[Reading]:
    """Measures all phases of a fresh robot. Raises PebbleError with its log if a phase does not start."""
    with one_robot(kind, services=MEDIA) as robot, closing(RobotSubscriber(robot.remote_port, BASE)) as subscriber:
        subscriber.wait()
        robot.launch()
        robot.expect(lambda: subscriber.ready_ns is not None, "not every service is ready", _UP_S)
        readings = [
            _read(robot, subscriber, IDLE, lambda: time.sleep(seconds)),
            _read(robot, subscriber, DRIVING, lambda: subscriber.drive(seconds, RATE_HZ)),
        ]
        for name in streams:
            _start_streams(robot, subscriber, name)
            readings.append(_read(robot, subscriber, name, lambda: time.sleep(seconds)))
        return readings


def _start_streams(robot: Robot, subscriber: RobotSubscriber, name: str) -> None:
    subscriber.ask_for(*STREAMS[name])
    due = {form: subscriber.arrived[form] + _FIRST for form in STREAMS[name]}
    robot.expect(
        lambda: all(subscriber.arrived[form] >= count for form, count in due.items()) and robot.complete(),
        f"{name} does not flow",
        _FLOW_S,
    )


def _read(robot: Robot, subscriber: RobotSubscriber, phase: str, work: Callable[[], object]) -> Reading:
    """Measures the robot's processes while ``work`` runs; memory is read afterwards."""
    time.sleep(_STARTUP_S)
    processes = robot.processes()
    before = {name: cpu_s([pid]) for name, pid in processes.items()}
    pictures, began = _pictures(subscriber, phase), time.monotonic()
    work()
    took = time.monotonic() - began
    cpu = {name: 100 * (cpu_s([pid]) - before[name]) / took for name, pid in processes.items()}
    arrived = _pictures(subscriber, phase) - pictures
    if robot.processes() != processes:
        raise PebbleError(f"{phase}: processes of the robot ended or started meanwhile\n{robot.log()}")
    return Reading(
        phase=phase,
        memory={name: pss_mb(pid) for name, pid in processes.items()},
        cpu=cpu,
        threads={name: _threads(pid) for name, pid in processes.items()},
        pictures_per_s=arrived / took if phase in STREAMS else None,
    )


def _pictures(subscriber: RobotSubscriber, phase: str) -> int:
    return subscriber.arrived[STREAMS[phase][0]] if phase in STREAMS else 0


def _threads(pid: int) -> int:
    try:
        return len(list(Path(f"/proc/{pid}/task").iterdir()))
    except OSError:  # it has gone
        return 0
