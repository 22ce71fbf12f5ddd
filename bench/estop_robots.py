"""The robots of the comparison of emergency stops, who drives them, and each way of stopping them, measured."""

from __future__ import annotations

import random
import time
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from pebble.bench.estop_driver import RATE_HZ
from pebble.bench.estop_operator import StopOperator
from pebble.bench.estop_report import ALL, BOARD, COMMAND, CONFIRMED, ESTOP, HOLD, REST, WIRE, ZERO, Samples
from pebble.bench.fleet import read_moves
from pebble.errors import PebbleError
from pebble.rig.processes import Processes
from pebble.rig.robot import KINDS, Robot
from pebble.simulation.fleet import Moved, members

_STARTED_S = 90.0  # boards start one after the other
_CONFIRMED_S = 10.0
_MOVING_S = 10.0
_WATCH_S = 0.3  # after a stop, while driving goes on; the fleet writes its trace ten times a second
_POLL_S = 0.05
_QUIET_S = 0.8  # after a reset: motor owners publish few states a second, so a stop at once is confirmed later


class Rest(NamedTuple):
    """When motors came to rest after a stop (CLOCK_MONOTONIC, ns), None: not; and whether they moved again."""

    ns: int | None
    again: bool


def rest(moves: Iterable[Moved], since: int) -> Rest:
    """The first moment from ``since`` at which the motors are off."""
    after = [move for move in moves if move.ns >= since]
    off = next((move.ns for move in after if not any(move.motors)), None)
    return Rest(off, off is not None and any(any(move.motors) for move in after if move.ns > off))


def is_moving(moves: Sequence[Moved]) -> bool:
    return bool(moves) and any(moves[-1].motors)


class Robots(Processes):
    """The environment of two Linux robots, one of each kind; :meth:`hold_linux` launches them.

    Each measurement ends with the stopped robots reset.
    """

    def __init__(self, boards: int) -> None:
        super().__init__()
        self._count = boards
        self._linux: dict[str, Robot] = {}
        self._boards = [identity for _, identity in members(boards)] if boards else []

    def start(self) -> None:
        """Raises PebbleError if a process does not start."""
        broker = self.broker("remote")
        broker.wait()
        self._port, self._operator = broker.port, StopOperator(broker.port)
        for kind in KINDS:
            name, folder = f"rover-{kind}", self.folder / kind
            robot = Robot(self, kind, ("127.0.0.1", broker.port), name=name, folder=folder)
            robot.prepare()
            self._linux[kind] = robot
        self._driver = self.worker("driver", "pebble.bench.estop_driver", broker.port)

    def hold_linux(self, samples: Samples) -> None:
        """Launch the Linux robots, one after the other, while a stop of all robots is held."""
        with self._operator.sending(None, hold=True) as sending:
            for kind, robot in self._linux.items():
                robot.launch()
                sending.wait_until_confirmed([robot.base], _STARTED_S)
                stop = sending.stop
                samples.add(HOLD, kind, ESTOP, stop.received[robot.base], stop.latched[robot.base])
        self._reset(self._linux_bases())

    def hold_boards(self, samples: Samples) -> None:
        """Start all boards while a stop of all robots is held."""
        boards = [board.base for board in self._boards]
        with self._operator.sending(None, hold=True) as sending:
            self._start_fleet()
            sending.wait_until_confirmed([*boards, *self._linux_bases()], _STARTED_S)
            for board in boards:
                stop = sending.stop
                samples.add(HOLD, BOARD, ESTOP, stop.received[board], stop.latched[board])
        self._reset([*boards, *self._linux_bases()])

    def stop_one(self, kind: str, samples: Samples) -> None:
        """Stop a driven robot by an emergency stop, and by a plain zero."""
        base = self._linux[kind].base
        self._drive([base])
        stop = self._operator.stop([base], every=False, timeout=_CONFIRMED_S)
        self._add_rest(kind, ESTOP, [base], stop.began, samples)
        samples.add(CONFIRMED, kind, ESTOP, stop.began, stop.confirmed[base])
        self._reset([base])
        self._drive([base])
        began = self._operator.zero(base)
        self._add_rest(kind, ZERO, [base], began, samples)
        self._release([base])

    def stop_by_command(self, kind: str, samples: Samples) -> None:
        """Stop a driven robot by the shell command; times begin with the start of its process."""
        base = self._linux[kind].base
        self._drive([base])
        began, received, ended = self._operator.command(base)
        samples.add(WIRE, kind, COMMAND, began, received)
        self._add_rest(kind, COMMAND, [base], began, samples)
        samples.add(CONFIRMED, kind, COMMAND, began, ended)
        self._reset([base])

    def stop_all(self, samples: Samples) -> None:
        """Stop all robots, which are driven, by one emergency stop."""
        bases = [*self._linux_bases(), *(board.base for board in self._boards)]
        self._drive(bases)
        stop = self._operator.stop(bases, every=True, timeout=_CONFIRMED_S)
        self._add_rest(ALL, ESTOP, bases, stop.began, samples)
        samples.add(CONFIRMED, ALL, ESTOP, stop.began, max(stop.confirmed[base] for base in bases))
        self._reset(bases)

    def _linux_bases(self) -> list[str]:
        return [robot.base for robot in self._linux.values()]

    def _start_fleet(self) -> None:
        where = ["--broker", f"127.0.0.1:{self._port}", "--trace", str(self._trace)]
        self.robot("the fleet", "pebble.simulation.fleet_program", "--robots", self._count, *where)

    @property
    def _trace(self) -> Path:
        return self.folder / "trace.jsonl"

    def _drive(self, bases: Sequence[str]) -> None:
        """Drive these robots from now on; returns at a random moment after all of them move."""
        self._driver.send(" ".join(bases))
        self._wait_until(bases, moving=True)
        time.sleep(random.random() / RATE_HZ)  # noqa: S311  (no secret)

    def _release(self, bases: Sequence[str]) -> None:
        """Drive no robot."""
        self._driver.send("")
        self._wait_until(bases, moving=False)

    def _reset(self, bases: Sequence[str]) -> None:
        self._release(bases)
        self._operator.reset(bases)
        time.sleep(_QUIET_S)

    def _wait_until(self, bases: Sequence[str], *, moving: bool) -> None:
        end = time.monotonic() + _MOVING_S
        while others := [base for base, moves in self._moves(bases).items() if is_moving(moves) != moving]:
            if time.monotonic() > end:
                what = "do not move when they are driven" if moving else "do not come to rest"
                raise PebbleError(f"{len(others)} robots {what}, among them {others[0]}")
            time.sleep(_POLL_S)

    def _add_rest(self, robot: str, variant: str, bases: Sequence[str], began: int, samples: Samples) -> None:
        """Add when the last of these robots came to rest, and whether one of them moved again meanwhile."""
        time.sleep(_WATCH_S)
        found = [rest(moves, began) for moves in self._moves(bases).values()]
        times = [one.ns for one in found if one.ns is not None]
        last = max(times) if len(times) == len(found) else None
        samples.add(REST, robot, variant, began, last, again=any(one.again for one in found))

    def _moves(self, bases: Collection[str]) -> dict[str, list[Moved]]:
        """Every change of their motors so far, by base."""
        moves = {robot.base: _changes(robot) for robot in self._linux.values() if robot.base in bases}
        boards = {board.id: board.base for board in self._boards if board.base in bases}
        changes = read_moves(self._trace) if boards else {}
        return moves | {base: changes.get(name, []) for name, base in boards.items()}


def _changes(robot: Robot) -> list[Moved]:
    entries = [(entry.ns, entry.motors) for entry in robot.lines(0)]
    return [Moved(ns, robot.base, motors) for ns, motors in entries if motors is not None]
