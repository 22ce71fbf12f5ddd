"""What is measured, its limits, and the reference's figures: those of the design's first trial on two busy cores."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Samples = dict[str, list[float]]


@dataclass(frozen=True, slots=True)
class Aim:
    """One figure. ``statistic`` of its samples must be from ``least`` to ``most``."""

    name: str
    unit: str
    most: float = math.inf
    least: float = -math.inf
    statistic: str = "worst"  # or p95, p50
    zenoh: str = ""
    mqtt: str = ""

    def holds(self, samples: Sequence[float]) -> bool:
        if not samples or not all(map(math.isfinite, samples)):
            return False
        if self.statistic == "worst":
            return self.least <= min(samples) and max(samples) <= self.most
        return self.least <= float(np.percentile(samples, int(self.statistic[1:]))) <= self.most

    @property
    def limit(self) -> str:
        bounds = [f"≥ {self.least:g}"] if math.isfinite(self.least) else []
        bounds += [f"≤ {self.most:g}"] if math.isfinite(self.most) else []
        return " ".join(bounds) + ("" if self.statistic == "worst" or not bounds else f" ({self.statistic})")


AIMS = {
    "running": Aim("start command to running", "s", 1.0, zenoh="0.05", mqtt="0.05"),
    "first tag": Aim("start command to the first apriltag-data", "s", zenoh="0.66", mqtt="0.81"),
    "settled": Aim("settled within 5 cm", "s", 25.0, zenoh="16.4", mqtt="14.1"),
    "distance": Aim("final distance", "m", 0.65, 0.55, zenoh="0.613", mqtt="0.613"),
    "bearing": Aim("final bearing", "°", 5.0, -5.0, zenoh="0.0", mqtt="0.0"),
    "latency": Aim(
        "picture captured to command published", "ms", 40.0, statistic="p95", zenoh="6.6/20/43", mqtt="6.5/13/23"
    ),
    "command rate": Aim("drive commands while following", "Hz", 12.0, 8.0, zenoh="10", mqtt="10"),
    "kill": Aim("script killed: wheels at rest", "ms", 100.0, zenoh="5.6-15.9", mqtt="6.2-15.8"),
    "terminate": Aim("script gets SIGTERM: wheels at rest", "ms", 50.0, zenoh="1.8-2.4", mqtt="1.8-4.5"),
    "stop": Aim("stop command: wheels at rest", "ms", 100.0, zenoh="3.6-7.3", mqtt="5.7-11.9"),
    "freeze": Aim("script frozen: wheels at rest", "ms", 850.0, zenoh="715, 748", mqtt="723, 740"),
    "manager": Aim("manager killed: wheels at rest", "ms", 100.0, zenoh="8", mqtt=""),
    "launcher": Aim("launcher killed: wheels at rest", "ms", 100.0, zenoh="4, 18", mqtt=""),
    "gone": Aim("its process has ended", "s", 1.0, zenoh="< 0.35", mqtt=""),
    "gone frozen": Aim("a frozen script's process, stopped, has ended", "s", 3.0, zenoh="timeout", mqtt="timeout"),
    "override": Aim("person's first command to wheel line", "ms", 100.0, zenoh="2.2-4.6", mqtt="2.1-12.2"),
    "script lines": Aim("script's lines while the person drives", "", 0.0, zenoh="0", mqtt="0"),
    "resume": Aim("script resumes after the person's last", "s", 2.5, 1.9, zenoh="2.01-2.09", mqtt="2.01-2.05"),
    "single stop": Aim("one stop against 500 Hz: wheels at rest", "ms", 100.0, zenoh="1.6-14.8", mqtt="1.6-10.7"),
    "flood lines": Aim("that script's lines at the MCU", "Hz"),
    "lost stops": Aim("stops lost", "", 0.0, zenoh="0 of 10", mqtt="0 of 10"),
    "corners": Aim("tag corner error", "px", 2.0),
    "locations rate": Aim("apriltag-locations", "Hz", 14.4, 9.6, zenoh="12", mqtt="12"),
    "overlays": Aim("overlays that differ from locations", "", 0.0),
    "empty": Aim("empty locations and overlays at the end", "", 2.0, 2.0),
    "exit code": Aim("error names the crashed dependency and its code", "", 1.0, 1.0),
    "alive": Aim("scripts alive after the crash", "", 0.0),
    "odometry": Aim("wheel odometry, 2 m straight: error", "mm", 60.0, -60.0, zenoh="9", mqtt="9"),
    "odometry rate": Aim("wheel-odometry while moving", "Hz", 24.0, 16.0, zenoh="13-16", mqtt="13-16"),
    "touch rate": Aim("touch-sensors at the operator", "Hz", least=45.0, zenoh="42.8", mqtt="50.1"),
    "lag": Aim("lag behind a robot at 95 mm/s", "m", 0.3, zenoh="0.16"),
    "follower": Aim("final distance behind that robot", "m", 0.7, 0.5, zenoh="0.59"),
    "original settled": Aim("a script of the original's shape: settled", "s", 30.0, zenoh="6.4", mqtt="6.4"),
    "original distance": Aim("its final distance", "m", 0.68, 0.52, zenoh="0.644", mqtt="0.645"),
    "unsigned": Aim("its commands without a signature", "", 0.0, zenoh="0", mqtt="0"),
    "memory": Aim("whole robot while following, without the renderer", "MB PSS", 230.0),
}


def table(found: Samples, kind: str) -> list[str]:
    """A line for each figure: its samples, its limit, the reference, and whether it holds."""
    head = f"{'':<52}{'n':>4}{'p50':>10}{'p95':>10}{'worst':>10}  {'limit':<20}{'reference':<12}"
    lines = [head]
    for key, samples in found.items():
        aim = AIMS[key]
        cells = "".join(f"{value:>10.4g}" for value in _statistics(aim, samples))
        reference = aim.mqtt if kind != "zenoh" else aim.zenoh
        name = f"{aim.name}, {aim.unit}" if aim.unit else aim.name
        holds = "ok" if aim.holds(samples) else "MISSED"
        lines.append(f"{name:<52}{len(samples):>4}{cells}  {aim.limit:<20}{reference:<12}{holds}")
    return lines


def _statistics(aim: Aim, samples: Sequence[float]) -> tuple[float, float, float]:
    """The worst is the one farthest from the middle of the limits, or the largest."""
    if not samples:
        return math.nan, math.nan, math.nan
    two_sided = math.isfinite(aim.least) and math.isfinite(aim.most)
    worst = max(samples, key=lambda value: abs(value - (aim.least + aim.most) / 2) if two_sided else value)
    if math.isfinite(aim.least) and not two_sided:
        worst = min(samples)
    return float(np.percentile(samples, 50)), float(np.percentile(samples, 95)), worst
