"""Scripts that follow a tag, on a wall or on another robot, and odometry: compared with the true poses."""

from __future__ import annotations

import math
import random
import time
from dataclasses import dataclass
from itertools import pairwise

from tests.robot.closed_loop.aims import Samples
from tests.robot.operator import Operator
from tests.robot.rig import Rig
from tests.robot.world_rig import FOLLOW, TAG, World, WorldRig
from tests.support import until

TARGET_M, WITHIN_M, ORIGINAL_WITHIN_M = 0.6, 0.05, 0.08
_LONGEST_S, _STEP_S = 30.0, 0.05
TAG_BEHIND_M, TAG_ON_ROBOT_M = 0.08, 0.12  # the tag on a robot of 0.1 m radius: from its middle, and its size


@dataclass(frozen=True, slots=True)
class Start:
    """Where the robot stands: metres from the tag, degrees beside the tag's front, degrees from looking at it."""

    distance: float
    beside: float
    off: float

    @property
    def pose(self) -> tuple[float, float, float]:
        """x, y and heading in degrees in the room, whose tag is at (2, 0) and looks to the robot."""
        angle = math.radians(self.beside)
        return 2.0 - self.distance * math.cos(angle), self.distance * math.sin(angle), self.off - self.beside


def starts(count: int, seed: int = 1) -> list[Start]:
    """Random ones."""
    pick = random.Random(seed)
    return [Start(pick.uniform(1.0, 2.5), pick.uniform(-35, 35), pick.uniform(-60, 60)) for _ in range(count)]


def followed(rig: WorldRig, start: Start, stay_s: float = 5.0) -> Samples:
    """Follow the tag from ``start`` until the robot has stayed at its distance for ``stay_s``."""
    rig.world.place(rig.name, *start.pose)
    already = len(rig.timings())
    began = rig.run("timed-follow", FOLLOW)
    took = _arrival(rig, stay_s, WITHIN_M) - began
    distance, bearing = rig.world.tag_from(rig.name)
    statuses = [seen.at for seen in rig.operator.on("outgoing/autonomy-status", began) if seen.json["running"]]
    tags = [seen.at for seen in rig.operator.on("outgoing/apriltag-data", began)]
    running, first_tag = ((found[0] if found else math.inf) - began for found in (statuses, tags))
    rig.idle()
    timings = rig.timings()[already:]
    spans = [later - earlier for (_, earlier), (_, later) in pairwise(timings)]
    return {
        "running": [running],
        "first tag": [first_tag],
        "settled": [took],
        "distance": [distance],
        "bearing": [math.degrees(bearing)],
        "latency": [1000 * (published - captured) for captured, published in timings],
        "command rate": [len(spans) / sum(spans)] if spans else [],
    }


def _arrival(rig: WorldRig, stay_s: float, within_m: float) -> float:
    """When the robot began to stay at its distance for ``stay_s``; infinite if it does not within 30 s."""
    since, end = math.inf, time.monotonic() + _LONGEST_S
    while time.monotonic() < end and time.monotonic() - since < stay_s:
        time.sleep(_STEP_S)
        distance, _ = rig.world.tag_from(rig.name)
        since = min(since, time.monotonic()) if abs(distance - TARGET_M) <= within_m else math.inf
    return since


def followed_by_an_original(kind: str, count: int, seed: int) -> Samples:
    """A stand-in for a script of the original follows the tag, through the gate."""
    found: Samples = {"original settled": [], "original distance": [], "unsigned": []}
    with WorldRig(kind, mirror=kind == "zenoh") as rig:
        assert rig.local is not None
        local = Operator(rig.local.port, rig.operator.base)
        for start in starts(count, seed):
            rig.world.place(rig.name, *start.pose)
            began = rig.run("original-follow", FOLLOW)
            found["original settled"].append(_arrival(rig, 3.0, ORIGINAL_WITHIN_M) - began)
            found["original distance"].append(rig.world.tag_from(rig.name)[0])
            rig.idle()
        sources = [seen.json.get("source") for seen in local.on("incoming/drive-values")]
        local.close()
    assert len(sources) > 10 * count, "its commands are published"
    found["unsigned"].append(len(sources) - sources.count("autonomy"))
    return found


def measured_odometry(rig: WorldRig) -> Samples:
    """An operator drives 2 m straight; ``wheel-odometry`` is compared with the true pose."""
    rig.world.place(rig.name, -3.0, 0.0, 0.0)
    began = rig.run("wheel-odometry")
    assert until(lambda: rig.operator.on("outgoing/wheel-odometry", began), 10), "no wheel-odometry"
    first, origin = rig.operator.last("outgoing/wheel-odometry").json["value"], rig.world.pose(rig.name)
    driven = due = time.monotonic()
    while rig.world.pose(rig.name).x - origin.x < 1.95:
        rig.operator.send("incoming/drive-values", {"x": 0, "z": 0.6})
        due += 0.05
        time.sleep(max(0.0, due - time.monotonic()))
    stopped = time.monotonic()
    rig.operator.send("incoming/drive-values", {"x": 0, "z": 0})
    seconds = stopped - driven - 0.5
    rates = [len([s for s in rig.operator.on(f"outgoing/{name}", driven + 0.5) if s.at < stopped]) / seconds
             for name in ("wheel-odometry", "touch-sensors")]  # fmt: skip
    assert until(lambda: not rig.mcu.turning(), 3)
    time.sleep(1.2)  # the wheels run out, and the last step is published at 2 Hz
    last, pose = rig.operator.last("outgoing/wheel-odometry").json["value"], rig.world.pose(rig.name)
    reckoned = math.hypot(last["x_mm"] - first["x_mm"], last["y_mm"] - first["y_mm"])
    true = 1000 * math.hypot(pose.x - origin.x, pose.y - origin.y)
    rig.idle()
    return {"odometry": [reckoned - true], "odometry rate": [rates[0]], "touch rate": [rates[1]]}


TWO = {
    "tags": [],
    "room": {"x_min": -2.0, "x_max": 6.0, "y_min": -2.0, "y_max": 2.0},
    "robots": {"goob": {"x": 0.0, "y": 0.0}, "fred": {"kind": "fred", "x": 0.72, "y": 0.0, "tag": TAG}},
}


def followed_robot(kind: str) -> Samples:
    """Goob follows the tag on Fred's back, which an operator drives 1.2 m at 95 mm/s."""
    world = World(TWO)
    try:
        with (
            WorldRig(kind, world) as goob,
            Rig(kind, name="fred", motors=world.motors("fred"), remote=goob.remote) as fred,
        ):
            return _pair(goob, fred, world)
    finally:
        world.close()


def _pair(goob: WorldRig, fred: Rig, world: World) -> Samples:
    def apart() -> float:
        """From Goob's camera to the tag on Fred's back."""
        one, other = world.pose("goob"), world.pose("fred")
        return math.hypot(other.x - one.x, other.y - one.y) - TAG_BEHIND_M

    tag = {"tag_id": TAG, "tag_size_m": TAG_ON_ROBOT_M}
    began = goob.run("apriltag-follow", tag)
    assert until(lambda: goob.operator.on("outgoing/apriltag-data", began), 15)
    assert until(lambda: abs(apart() - TARGET_M) < WITHIN_M, 15)
    start, lags, due = world.pose("fred").x, [], time.monotonic()
    while world.pose("fred").x - start < 1.2:
        fred.operator.send("incoming/drive-values", {"x": 0, "z": 0.25})
        lags.append(apart() - TARGET_M)
        due += 0.05
        time.sleep(max(0.0, due - time.monotonic()))
    fred.operator.send("incoming/drive-values", {"x": 0, "z": 0})
    until(lambda: not fred.mcu.turning(), 3)
    time.sleep(3.0)
    final = apart()
    goob.idle()
    return {"lag": [max(lags)], "follower": [final]}
