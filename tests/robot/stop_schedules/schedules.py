"""Random schedules of people, stops, resets and faults, as data: the same seed makes the same schedule."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

ROVER, BOARD = "rover", "board"
ROBOTS = (ROVER, BOARD)
ACTIVE_S = 2.6  # steps begin within this time

_KILL_MIRROR = "kill mqtt_mirror"  # only robots on Zenoh have it
#: Faults that any schedule may have besides that of its set-up, with the longest time in seconds that each lasts.
_COMMON = {
    "kill serial_mcu_bridge": 0.0,
    "kill mqtt_bridge": 0.0,
    _KILL_MIRROR: 0.0,
    "kill local transport": 0.3,
    "kill launcher": 0.0,
    "kill remote broker": 0.5,
    "freeze serial_mcu_bridge": 1.5,
    "freeze mqtt_bridge": 2.5,
    "freeze remote broker": 2.5,
    "freeze local transport": 1.5,
    "blackhole": 2.5,
    "cut": 1.5,
    "power cut rover": 0.0,
    "power cut board": 0.0,
}
_ORDINARY = {
    *("drive", "let go", "lose", "final zero", "look", "reset"),
    *("stop", "stop at the robot", "wait for confirmations"),
}


@dataclass(frozen=True, slots=True)
class Step:
    """What happens ``at`` seconds after the beginning, not counting the time of earlier steps that wait."""

    at: float
    what: str
    robot: str = ""
    amount: float = 0.0  # seconds, of most steps

    def __str__(self) -> str:
        words = f"{self.at:6.3f}  {self.what}"
        return f"{words} {self.robot} {self.amount:g}".rstrip(" 0") if self.amount or self.robot else words


@dataclass(frozen=True, slots=True)
class Schedule:
    setup: str
    seed: int
    steps: tuple[Step, ...]

    @property
    def faults(self) -> set[str]:
        return {step.what for step in self.steps} - _ORDINARY


def setups(transport: str) -> tuple[str, ...]:
    """How robot and brokers are arranged; each is named after what it adds to the others."""
    second = ("mirror", "mirror is the remote broker") if transport == "zenoh" else ("two brokers",)
    more = ("remote-mirror", "failover", "older save", "retained stop", "killed before the state", "power cut")
    return ("one broker", *second, *more)


def make(transport: str, setup: str, seed: int) -> Schedule:
    """The schedule with this seed."""
    chance = random.Random(f"{transport} {setup} {seed}")
    steps = [*_driving(chance), *_stops(chance), *_resets(chance)]
    special = _SPECIAL.get(setup)
    if special is not None:
        steps += special(chance)
    common = sorted(_COMMON) if transport == "zenoh" else sorted(set(_COMMON) - {_KILL_MIRROR})
    for name in chance.sample(common, chance.choice((0, 1) if special else (1, 1, 2))):
        steps.append(_at(chance, name, amount=chance.uniform(0.2, 1.0) * _COMMON[name]))
    return Schedule(setup, seed, tuple(sorted(steps, key=lambda step: step.at)))


def _at(chance: random.Random, what: str, robot: str = "", *, first: float = 0.2, amount: float = 0.0) -> Step:
    return Step(round(chance.uniform(first, ACTIVE_S), 3), what, robot, round(amount, 3))


def _driving(chance: random.Random) -> list[Step]:
    """A person drives each robot most of the time."""
    steps = []
    for robot in ROBOTS:
        steps.append(Step(0.0, "drive", robot))
        if chance.random() < 0.4:
            steps.append(_at(chance, chance.choice(("let go", "lose", "final zero")), robot, first=0.6))
            steps.append(_at(chance, "drive", robot, first=1.4))
    return steps


def _stops(chance: random.Random) -> list[Step]:
    steps = []
    for _ in range(chance.choice((1, 2, 2, 3))):
        robot = chance.choice((*ROBOTS, ROVER, "both"))
        where = chance.choice(("stop", "stop", "stop", "stop at the robot")) if robot == ROVER else "stop"
        steps.append(_at(chance, where, robot))
    return steps


def _resets(chance: random.Random) -> list[Step]:
    """Some are sent long after the state was read, so that a stop may have been given in between."""
    steps = []
    for _ in range(chance.choice((0, 1, 1, 2))):
        robot = chance.choice(ROBOTS)
        looked = _at(chance, "look", robot, first=0.5)
        later = chance.choice((0.0, 0.0, 0.3, 0.8))
        steps += [looked, *_reset(looked.at + later, robot)]
    if chance.random() < 0.3:
        steps += _late_reset(chance.choice(ROBOTS))
    return steps


def _reset(at: float, robot: str) -> list[Step]:
    """Adds what a person does who wants to drive on: who holds the stick all the time is refused."""
    return [Step(round(at + later, 3), what, robot) for later, what in ((0, "reset"), (0.1, "let go"), (0.2, "drive"))]


def _late_reset(robot: str) -> list[Step]:
    """Between look and reset another stop is given."""
    stop, wait = Step(0.5, "stop", robot), Step(0.6, "wait for confirmations", amount=1.0)
    return [stop, wait, Step(0.9, "look", robot), Step(1.0, "stop", robot), *_reset(1.5, robot)]


# -- what set-ups add


def _failover(chance: random.Random) -> list[Step]:
    return [_at(chance, "failover", amount=chance.choice((0.0, 0.4))) for _ in range(chance.choice((1, 1, 2)))]


def _older_save(chance: random.Random) -> list[Step]:
    saved = Step(round(chance.uniform(0.0, 0.8), 3), "save the broker")
    return [saved, _at(chance, "restore the broker", first=1.4), *([_planted(chance)] if chance.random() < 0.3 else [])]


def _planted(chance: random.Random) -> Step:
    """A stop that reaches the broker while the robots are away, retained: they receive only the copy."""
    return _at(chance, "plant a retained stop", first=0.4, amount=chance.uniform(0.1, 0.5))


def _retained(chance: random.Random) -> list[Step]:
    steps = [_planted(chance)]
    if chance.random() < 0.5:
        steps.append(_at(chance, "retained stop", chance.choice(ROBOTS)))
    return steps + [_at(chance, "reconnect") for _ in range(chance.choice((1, 2, 3)))]


def _killed_before_the_state(chance: random.Random) -> list[Step]:
    victim = chance.choice(("serial_mcu_bridge", "mqtt_bridge", "both", "board"))
    return [_at(chance, f"stop, then kill {victim}", first=0.8, amount=chance.choice((0.0, chance.uniform(0, 0.05))))]


def _power_cut(chance: random.Random) -> list[Step]:
    """After a confirmed stop, or at once; or twice, with a reset of what was read in between."""
    robot = chance.choice(ROBOTS)
    wait = Step(1.2, "wait for confirmations", amount=1.5)
    if chance.random() < 0.3:
        cut, stop = f"power cut {robot}", Step(0.5, "stop", robot)
        wait = Step(0.5, "wait for confirmations", amount=5.0)
        look, again, late = (
            Step(0.6, "look", robot),
            Step(0.6, "stop", robot),
            Step(0.6, "wait for confirmations", amount=5.0),
        )
        return [Step(0.1, cut), stop, wait, look, Step(0.6, cut), again, late, *_reset(0.9, robot)]
    stop = Step(0.7, "stop", robot)
    return [stop, *([wait] if chance.random() < 0.7 else []), Step(1.3, f"power cut {robot}")]


_SPECIAL: dict[str, Callable[[random.Random], list[Step]]] = {
    "failover": _failover,
    "older save": _older_save,
    "retained stop": _retained,
    "killed before the state": _killed_before_the_state,
    "power cut": _power_cut,
}
