"""The network's impairment in each trial: the paper's conditions (chapter 4.2) and two profiles of real networks.

The paper limits the rate of, or drops packets on, the robot's uplink only. The profiles impair both directions:

``starlink``
    Round trips of 50 ms at the median, quartiles 40 and 60 (APNIC blog, 28 Nov 2022, Belgium). The satellite changes
    every 15 s; then they take 30 ms and more longer, at worst 80 (Huston, APNIC blog, 17 May 2024, as quoted by The
    Register), and up to half of the packets are lost (Kassem et al., "A browser-side view of Starlink connectivity",
    IMC 2022, abstract). Hence per direction 25 ms ± 5 ms, and every 15 s a gap. Our choices: a gap of 100 ms, 25 ms
    more that decay within a second, the first gap after 5 s, and no rate limit, which does not constrain a robot.
``wifi-power-save``
    A Raspberry Pi with default settings: the access point holds packets for the robot until a beacon, every 102.4 ms
    (100 time units of 1.024 ms), while the robot may send at any time. With power save on, pings had a p50 of 49 to
    127 ms, off 6 ms (raspberrypi/linux, issue 7533). Hence 2 ms ± 1 ms per direction, and holding downlink packets. The
    profile never stays awake; many radios do for a while after traffic, so it is a pessimistic case.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from random import Random

_JITTER_STEP_S = 0.01  # the jitter is constant for this long: packets sent together arrive together


@dataclass(frozen=True)
class Handover:
    """A periodic gap in which no packet passes; after it the delay is longer for a while."""

    every_s: float
    first_s: float
    gap_ms: float
    extra_ms: float  # added right after the gap; decays linearly
    recovery_s: float


@dataclass(frozen=True)
class Shape:
    """One direction of a network. Times are one way."""

    kbit: float | None = None  # per second; None: no limit
    loss: float = 0.0  # share of the packets
    delay_ms: float = 0.0
    jitter_ms: float = 0.0  # delay ± so much, never out of order
    handover: Handover | None = None
    beacon_ms: float = 0.0  # packets are held until the next beacon; 0: they are not

    @property
    def timed(self) -> bool:
        """Whether it delays packets, or has gaps."""
        return bool(self.delay_ms or self.jitter_ms or self.handover or self.beacon_ms)


@dataclass(frozen=True)
class Condition:
    """Both directions; up is from the robot to the broker."""

    name: str
    up: Shape = Shape()
    down: Shape = Shape()


_SATELLITE = Shape(delay_ms=25, jitter_ms=5, handover=Handover(15, first_s=5, gap_ms=100, extra_ms=25, recovery_s=1))
_AIR = Shape(delay_ms=2, jitter_ms=1)

#: In the order of a run: those of the paper, then the profiles.
CONDITIONS = (
    Condition("base-start"),
    *(Condition(f"{kbit}k", Shape(kbit=kbit)) for kbit in (1024, 512, 256, 128, 64)),
    *(Condition(f"{percent}%", Shape(loss=percent / 100)) for percent in (1, 2, 5, 10)),
    *(
        Condition(f"{kbit}k+{percent}%", Shape(kbit=kbit, loss=percent / 100))
        for kbit, percent in ((256, 1), (128, 2), (64, 5))
    ),
    Condition("base-end"),
    Condition("starlink", _SATELLITE, _SATELLITE),
    Condition("wifi-power-save", _AIR, replace(_AIR, beacon_ms=102.4)),
)


def arrival(shape: Shape, seed: str, sent: float) -> float | None:
    """When a packet sent now arrives; the caller preserves the order. None: it is lost in a gap.

    Takes and returns seconds since the condition began; depends on nothing else, so not on traffic.
    """
    extra_ms = 0.0
    if shape.handover and sent >= shape.handover.first_s:
        since = (sent - shape.handover.first_s) % shape.handover.every_s - shape.handover.gap_ms / 1000
        if since < 0:
            return None
        extra_ms = max(0.0, 1 - since / shape.handover.recovery_s) * shape.handover.extra_ms
    jitter_ms = shape.jitter_ms * _jitter(seed, int(sent / _JITTER_STEP_S)) if shape.jitter_ms else 0.0
    arrived = sent + max(0.0, shape.delay_ms + extra_ms + jitter_ms) / 1000
    beacon_s = shape.beacon_ms / 1000
    return math.ceil(arrived / beacon_s) * beacon_s if beacon_s else arrived


@lru_cache(maxsize=4)  # the present step of each direction
def _jitter(seed: str, step: int) -> float:
    """From -1 to 1, the same for each packet of a step."""
    return Random(f"{seed} {step}").uniform(-1, 1)  # noqa: S311
