"""The network's impairment in each trial: the paper's conditions (section 4.2), which shape the robot's uplink only."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Shape:
    """One direction of a network."""

    kbit: float | None = None  # per second; None: no limit
    loss: float = 0.0  # share of the packets


@dataclass(frozen=True)
class Condition:
    """Both directions; up is from the robot to the broker."""

    name: str
    up: Shape = Shape()
    down: Shape = Shape()


#: In the order of a run.
CONDITIONS = (
    Condition("base-start"),
    *(Condition(f"{kbit}k", Shape(kbit=kbit)) for kbit in (1024, 512, 256, 128, 64)),
    *(Condition(f"{percent}%", Shape(loss=percent / 100)) for percent in (1, 2, 5, 10)),
    *(
        Condition(f"{kbit}k+{percent}%", Shape(kbit=kbit, loss=percent / 100))
        for kbit, percent in ((256, 1), (128, 2), (64, 5))
    ),
    Condition("base-end"),
)
