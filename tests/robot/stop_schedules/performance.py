"""Performs one schedule in a world, and afterwards shows that everything can be ended.

``python -m tests.kit.schedules robot_stops`` runs hundreds.
"""

from __future__ import annotations

import time
from concurrent.futures import Future
from contextlib import closing

from tests.kit.schedules import Engine, Outcome
from tests.robot.stop_schedules.people import Sender
from tests.robot.stop_schedules.rules import violations
from tests.robot.stop_schedules.schedules import BOARD, ROBOTS, ROVER, Schedule, Step, make, setups
from tests.robot.stop_schedules.world import World
from tests.support import until

_CONFIRMED_S = 15.0  # after all faults; a killed robot takes some seconds to start
_UP_S = 15.0
_ANSWER_S = 1.5
_MOVES_S = 2.0
_STILL_S = 1.5
_REPEATED_S = 6.0  # a broker that was restored may have an older state until its owner repeats it
_RESETS = 9  # tries of _ANSWER_S: an owner that was killed five times in a minute starts after ten seconds


class Performance:
    """One schedule in one world."""

    def __init__(self, world: World, schedule: Schedule) -> None:
        self.world, self.schedule = world, schedule
        self.history = world.begin()
        self._senders: list[Sender] = []
        self._faults: list[Future[None]] = []
        self._looked = {robot: world.subscriber.look(robot) for robot in ROBOTS}

    def run(self) -> Outcome:
        try:
            self._perform()
            problems = self._rest()
        finally:
            for sender in self._senders:
                sender.end()
        problems = violations(self.history, self.world, self._resting) + problems
        confirmed = self.history.events("confirmed")
        counts = {
            "stops": len(self.history.events("stop given")),
            "confirmed": len(confirmed),
            "resets": len(self.history.events("reset")),
            "slowest stop": round(max((event.details["took"] for event in confirmed), default=0.0), 3),
        }
        return Outcome(problems, counts, self.schedule.faults, self._described)

    # -- the active part

    def _perform(self) -> None:
        began = self.history.began
        for step in self.schedule.steps:
            time.sleep(max(0.0, began + step.at - time.monotonic()))
            at = self.history.add(f"> {step.what}", step.robot, amount=step.amount)
            self._do(step)
            if step.what.startswith("wait"):
                began += time.monotonic() - at
        time.sleep(0.6)

    def _do(self, step: Step) -> None:
        world, robot = self.world, step.robot
        match step.what:
            case "drive":
                world.persons[robot].drive()
            case "let go":
                world.persons[robot].zero()
            case "lose":
                world.persons[robot].lose()
            case "final zero":
                world.persons[robot].zero(final=True)
            case "stop":
                self._stop([*ROBOTS] if robot == "both" else [robot], world.access.port)
            case "stop at the robot":
                self._stop([robot], world.local_port)
            case "retained stop":
                self._stop([robot], world.access.port, retain=True)
            case "look":
                self._looked[robot] = world.subscriber.look(robot)
            case "reset":
                self._reset(robot)
            case "wait for confirmations":
                until(lambda: not self._waiting(), step.amount)
            case what if what.startswith("stop, then kill "):
                victim = what.rpartition(" ")[2]
                self._stop([BOARD if victim == "board" else ROVER], world.access.port)
                time.sleep(step.amount)
                world.fault(f"kill {victim}", 0.0)
            case _:
                self._faults.append(world.threads.submit(world.fault, step.what, step.amount))

    def _stop(self, robots: list[str], port: int, *, retain: bool = False) -> None:
        self._senders.append(Sender(port, robots, self.history, retain=retain))

    def _reset(self, robot: str) -> bool:
        """Send what was read by the last look; False if nothing was latched there."""
        looked = self._looked[robot]
        for state, message in zip(looked.shown.values(), looked.messages(), strict=True):
            self.history.add("reset", robot, shown=state)
            self.world.subscriber.publish(message)
        return bool(looked.shown)

    def _waiting(self) -> list[str]:
        """The stops that must be confirmed and are not."""
        return [
            f"stop {sender.name} of {' and '.join(sender.robots)}: {sender.why}"
            for sender in self._senders
            if not sender.confirmed
        ]

    # -- the end

    def _rest(self) -> list[str]:
        """Everything works again: senders come to rest, stops can be ended, and the robots can be driven."""
        for fault in self._faults:
            fault.result()
        healed = self.history.add("> all faults are over")
        problems = [] if self.world.is_up(healed, _UP_S) else ["a robot is not up again"]
        until(lambda: not self._waiting(), _CONFIRMED_S)
        problems += [f"a sender does not come to rest: {waiting}" for waiting in self._waiting()]
        time.sleep(0.5)  # what is latched is driven a little longer
        self._resting = self.history.add("> people end everything")
        for sender in self._senders:
            sender.end()
        for robot in ROBOTS:
            self.world.persons[robot].zero(final=True)
        for robot in ROBOTS:
            problems += self._end(robot)
        return problems

    def _end(self, robot: str) -> list[str]:
        watch, wheels, person = self.world.subscriber, self.world.wheels[robot], self.world.persons[robot]
        if not until(lambda: not wheels.speed, _STILL_S):
            return [f"{robot}: the wheels turn on after everybody has let go"]
        for _ in range(_RESETS):
            self._looked[robot] = watch.look(robot)
            if self._reset(robot):
                until(lambda: not self._looked[robot].waiting, _ANSWER_S)
                continue
            person.zero()
            person.drive()
            moved = until(lambda: wheels.speed > 0, _MOVES_S)
            person.zero()
            if moved:
                still = until(lambda: not wheels.speed, _STILL_S)
                return [] if still else [f"{robot}: a person's zero does not stop the wheels"]
            if not until(lambda: watch.robot(robot).latched, _REPEATED_S):
                return [f"{robot}: does not move although its state says that it is free"]
        return [f"{robot}: a stop cannot be ended: {self._looked[robot].refusals()}"]

    # -- for reading

    def _described(self) -> str:
        """Return the steps, the whole history, the wheels, and the end of the logs."""
        lines = [*map(str, self.schedule.steps), ""]
        lines += [
            f"{event.at - self.history.began:7.3f}  {event.robot:6} {event.what} "
            + " ".join(f"{name}={value}" for name, value in event.details.items())
            for event in self.history.events()
            if event.what != "online"
        ]
        lines += [
            f"{change.at - self.history.began:7.3f}  {robot:6} wheels {change.speed:+.2f}"
            for robot in (ROVER, BOARD)
            for change in self.world.wheels[robot].read()
        ]
        return "\n".join([*lines, "", self.world.logs(), ""])


#: Its kinds of world are a transport and a set-up.
ENGINE = Engine(
    draw=lambda kind, seed, number: make(*kind.split(" ", 1), seed + number),
    world=lambda kind: closing(World(*kind.split(" ", 1))),
    perform=lambda world, schedule: Performance(world, schedule).run(),
    kinds=tuple(f"{transport} {setup}" for transport in ("zenoh", "mqtt") for setup in setups(transport)),
    schedules=400,
    per_world=10,
    repeats=False,
)
