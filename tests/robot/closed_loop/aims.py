"""Figures of a robot that drives by itself, and their limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Samples = dict[str, list[float]]


@dataclass(frozen=True, slots=True)
class Aim:
    """One figure. ``statistic`` of its samples must be from ``least`` to ``most``."""

    name: str  # with the unit
    most: float = math.inf
    least: float = -math.inf
    statistic: str = "worst"  # or p95, p50

    def holds(self, samples: Sequence[float]) -> bool:
        if not samples or not all(map(math.isfinite, samples)):
            return False
        if self.statistic == "worst":
            return self.least <= min(samples) and max(samples) <= self.most
        return self.least <= float(np.percentile(samples, int(self.statistic[1:]))) <= self.most


AIMS = {
    "running": Aim("start command to running, s", 1.0),
    "first tag": Aim("start command to the first apriltag-data, s"),
    "settled": Aim("settled within 5 cm, s", 25.0),
    "distance": Aim("final distance, m", 0.65, 0.55),
    "bearing": Aim("final bearing, °", 5.0, -5.0),
    "latency": Aim("picture captured to command published, ms", 40.0, statistic="p95"),
    "command rate": Aim("drive commands while following, Hz", 12.0, 8.0),
    "kill": Aim("script killed: wheels at rest, ms", 100.0),
    "terminate": Aim("script gets SIGTERM: wheels at rest, ms", 50.0),
    "stop": Aim("stop command: wheels at rest, ms", 100.0),
    "freeze": Aim("script frozen: wheels at rest, ms", 850.0),
    "manager": Aim("manager killed: wheels at rest, ms", 100.0),
    "launcher": Aim("launcher killed: wheels at rest, ms", 100.0),
    "gone": Aim("its process has ended, s", 1.0),
    "gone frozen": Aim("a frozen script's process, stopped, has ended, s", 3.0),
    "override": Aim("person's first command to wheel line, ms", 100.0),
    "script lines": Aim("script's lines while the person drives", 0.0),
    "resume": Aim("script resumes after the person's last, s", 2.5, 1.9),
    "single stop": Aim("one stop against 500 Hz: wheels at rest, ms", 100.0),
    "flood lines": Aim("that script's lines at the MCU, Hz"),
    "lost stops": Aim("stops lost", 0.0),
    "corners": Aim("tag corner error, px", 2.0),
    "locations rate": Aim("apriltag-locations, Hz", 14.4, 9.6),
    "overlays": Aim("overlays that differ from locations", 0.0),
    "empty": Aim("empty locations and overlays at the end", 2.0, 2.0),
    "exit code": Aim("error names the crashed dependency and its code", 1.0, 1.0),
    "alive": Aim("scripts alive after the crash", 0.0),
}
