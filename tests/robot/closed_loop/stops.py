"""How long the wheels turn after a script was ended, in every way in which it can be. Times by the MCU's trace."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass

from pebble.config import load
from pebble.extensions.operator.client.scripted_operator import paced
from pebble.runtime.connections import local_transport
from pebble.transports import QoS
from tests.robot.closed_loop.aims import Samples
from tests.robot.rig import STOP
from tests.robot.world_rig import STOP_TIMEOUT_S, WorldRig
from tests.support import gone, until

DRIVE = "incoming/drive-values"
PERSON_S = 1.0
_CRUISE = {"x": 0.0, "z": 0.3, "rate_hz": 20.0}
_BACK = {"x": 0.0, "z": -0.4}
_WHEELS_BACK = (-0.4, -0.4)
_REST_S = 0.5  # without a motion the wheels are at rest


@dataclass(frozen=True, slots=True)
class Ending:
    """One way to end a script that drives; ``act(rig, pid)`` does it, ``then(rig, began)`` waits until others can run.

    ``gone_s`` after it its process must have ended.
    """

    key: str
    act: Callable[[WorldRig, int], object]
    gone_s: float = 1.0
    gone: str = "gone"
    then: Callable[[WorldRig, float], object] = lambda rig, began: until(lambda: rig.fresh_status(began), 10)


def _freeze(rig: WorldRig, pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)


ENDINGS = (
    Ending("kill", lambda _rig, pid: os.kill(pid, signal.SIGKILL)),
    Ending("terminate", lambda _rig, pid: os.kill(pid, signal.SIGTERM)),
    Ending("stop", lambda rig, _pid: rig.end()),
    Ending("freeze", _freeze, STOP_TIMEOUT_S + 1.0, "gone frozen"),
    Ending("manager", lambda rig, _pid: rig.kill("autonomy_manager"), then=WorldRig.wait_for_scripts),
    Ending("launcher", lambda rig, _pid: rig.kill_launcher(), then=lambda rig, _: rig.start()),
)


def ended(rig: WorldRig, ending: Ending) -> Samples:
    """End a script that drives, and wait until the robot can be used again."""
    pid = rig.driving("cruise", _CRUISE)
    began = time.monotonic()
    ending.act(rig, pid)
    if ending.key == "freeze":
        assert until(lambda: not rig.mcu.turning(), 3)
        asked = rig.end()
    else:
        asked = began
    until(lambda: gone(pid), ending.gone_s + 2)
    lasted = time.monotonic() - asked if gone(pid) else math.inf
    until(lambda: time.monotonic() > began + _REST_S and not rig.mcu.turning(), 3)
    found = {ending.key: [1000 * rest_s(rig, began)], ending.gone: [lasted]}
    ending.then(rig, began)
    return found


def rest_s(rig: WorldRig, since: float) -> float:
    """From ``since`` until the wheels stayed at rest; infinite if they turn now, or did not turn at all."""
    motors = rig.mcu.motors()
    later = [(at, speeds) for at, speeds in motors if at >= since]
    before = [speeds for at, speeds in motors if at < since]
    if not before or before[-1] == STOP or not later or later[-1][1] != STOP:
        return math.inf
    first = len(later) - 1
    while first and later[first - 1][1] == STOP:
        first -= 1
    return later[first][0] - since


def overridden_on_the_robot(rig: WorldRig) -> Samples:
    """The same person as a program on the robot, with a connection to the local transport."""
    with local_transport(load(rig.config), "person") as transport:
        topic = f"{rig.operator.base}/{DRIVE}"
        return overridden(rig, lambda body: transport.publish(topic, json.dumps(body).encode(), qos=QoS.DELIVERED))


def overridden(rig: WorldRig, send: Callable[[dict[str, float]], object] | None = None) -> Samples:
    """A person drives for a second against a script that drives at 20 Hz."""
    send = send or (lambda body: rig.operator.send(DRIVE, body))
    rig.driving("cruise", _CRUISE)
    began = time.monotonic()
    for _ in paced(PERSON_S):
        send(_BACK)
    send({"x": 0, "z": 0})
    released = time.monotonic()
    assert until(lambda: any(speeds[0] > 0 for _, speeds in rig.mcu.drives(released)), 5), "the script did not resume"
    lines = rig.mcu.drives(began)
    rig.idle()
    first = next(index for index, (_, speeds) in enumerate(lines) if speeds == _WHEELS_BACK)
    resumed = next(at for at, speeds in lines[first:] if at > released and speeds[0] > 0)
    passed = [speeds for at, speeds in lines[first:] if at < resumed and speeds not in (STOP, _WHEELS_BACK)]
    passed += [speeds for at, speeds in lines[first:] if at < released + 0.1 and speeds[0] > 0]
    return {
        "override": [1000 * (lines[first][0] - began)],
        "script lines": [float(len(passed))],
        "resume": [resumed - released],
    }


def stopped_once(rig: WorldRig) -> Samples:
    """One stop of a person, who has not driven, against a script that publishes 500 commands a second."""
    rig.driving("flood")
    since = time.monotonic()
    time.sleep(0.25)
    began = time.monotonic()
    lines = [at for at, _ in rig.mcu.drives(since) if at < began]
    rig.operator.send(DRIVE, {"x": 0, "z": 0})
    until(lambda: time.monotonic() > began + _REST_S, 3)
    rest = rest_s(rig, began)
    rig.idle()
    return {
        "single stop": [1000 * rest],
        "lost stops": [float(not math.isfinite(rest))],
        "flood lines": [len(lines) / (began - since)],
    }
