"""Measures the emergency stop: until the wheels are at rest, until every motor owner has confirmed it, and a hold.

Two Linux robots, one on each local transport, and a fleet of boards with Wi-Fi share one remote broker. Each is driven
all the time by a process of its own; this one stops and resets them with the code that ``pebble estop`` is made of.
"""

from __future__ import annotations

import random
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

from pebble.bench import clients
from pebble.bench.comparison import Budget, Case, Comparison, Measuring, Report, Round, rounds
from pebble.bench.fleet import read_moves
from pebble.bench.judging.aims import Aim, single, with_lost
from pebble.bench.pictures import ecdf
from pebble.bench.results import Cell
from pebble.bench.tables import COUNT, Claims, Grid, percentile_column
from pebble.client.connection import Listener, Target, connected
from pebble.client.discovery import ALL_OUTGOING
from pebble.client.estop import StopSender, new_name
from pebble.client.estop_states import Reset, RobotEstop
from pebble.contract import CAPABILITIES, DRIVE, ESTOP_STATE
from pebble.errors import PebbleError
from pebble.rig.processes import Processes
from pebble.rig.robot import KINDS, Robot
from pebble.simulation.fleet import Moved, members
from pebble.transports import Message, Transport

REST, CONFIRMED, HOLD = MEASURES = ("wheels at rest", "confirmed", "latched under a hold")
STOP, ZERO = "emergency stop", "plain zero"
ALL, BOARD = "all together", "board"
_BY = "bench"
_STARTED_S = 90.0  # boards start one after the other
_ANSWER_S = 10.0
_WATCH_S = 0.3  # after a stop, while driving goes on; the fleet writes its trace ten times a second
_POLL_S = 0.05
_TICK_S = 0.01  # late at most is a stop that is repeated
_REACHED = 3  # what is noted of a robot that is stopped
_QUIET_S = 0.8  # after a reset: motor owners publish few states a second, so a stop at once is confirmed later


def rest(moves: Sequence[Moved], since: int) -> tuple[int | None, bool]:
    """When the motors came to rest after ``since`` (CLOCK_MONOTONIC, ns; None: not), and if they moved again."""
    after = [move for move in moves if move.ns >= since]
    off = next((move.ns for move in after if not any(move.motors)), None)
    return off, off is not None and any(any(move.motors) for move in after if move.ns > off)


def cell_of(case: Case, measure: str, began: int, ended: int | None, **figures: Any) -> Cell:
    """One time (CLOCK_MONOTONIC, ns). None: it did not happen."""
    return case.cell(measure, "ms", [] if ended is None else [(ended - began) / 1e6], sent=1, **figures)


def send(transport: Transport, messages: Iterable[Message]) -> None:
    for message in messages:
        transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)


class Robots(Processes):
    """Two Linux robots, one of each kind, and boards; what drives and stops them, and each way of stopping, measured.

    ``robots`` are a Linux robot's transport, BOARD, or ALL that run. Each measurement ends with them reset. Every stop
    has a connection of its own, which is open before.
    """

    def __init__(self, boards: int) -> None:
        super().__init__()
        self._linux: list[Robot] = []
        self._bases: dict[str, list[str]] = {ALL: [], BOARD: [identity.base for _, identity in members(boards)]}
        self._starts: dict[str, Callable[[], object]] = {}
        self._trace = self.folder / "trace.jsonl"

    def start(self) -> None:
        """Starts what the robots need. Raises PebbleError if a process does not start."""
        broker = self.broker("remote")
        broker.wait()
        self._port, self._target = broker.port, Target(url=f"mqtt://127.0.0.1:{broker.port}")
        for kind in KINDS:
            name, folder = f"rover-{kind}", self.folder / kind
            robot = Robot(self, kind, ("127.0.0.1", broker.port), name=name, folder=folder)
            robot.prepare()
            self._linux.append(robot)
            self._bases[kind], self._starts[kind] = [robot.base], robot.launch
        where = ("--robots", len(self._bases[BOARD]), "--broker", f"127.0.0.1:{broker.port}", "--trace", self._trace)
        self._starts[BOARD] = partial(self.robot, "the fleet", "pebble.simulation.fleet_program", *where)
        self._driver = self.worker("driver", "pebble.bench.clients", broker.port)

    def hold(self, case: Case, robots: str) -> Iterator[Cell]:
        """Start these robots while a stop of all robots is held."""
        self._bases[ALL] += self._bases[robots]
        _, times = self._stop(ALL, self._starts[robots])
        for base in self._bases[robots]:
            received, latched, _ = times[base]
            yield cell_of(case, HOLD, received, latched)
        self._reset(ALL)

    def stop(self, case: Case, robots: str) -> Iterator[Cell]:
        """Stop driven robots by an emergency stop."""
        self._drive(robots)
        began, times = self._stop(robots)
        yield self._rest(case, robots, began)
        yield cell_of(case, CONFIRMED, began, max(times[base][-1] for base in self._bases[robots]))
        self._reset(robots)

    def stop_by_zero(self, case: Case, robots: str) -> Iterator[Cell]:
        """Stop a driven robot by a plain zero as a stock client sends it."""
        self._drive(robots)
        client = clients.StockClient(at_once=False).open(self._port)
        client.wait()
        began = time.monotonic_ns()
        client.send(DRIVE, self._bases[robots][0], clients.ZERO).wait_for_publish(_ANSWER_S)
        client.close()
        yield self._rest(case, robots, began)
        self._drive(robots, on=False)

    def _stop(self, robots: str, start: Callable[[], object] | None = None) -> tuple[int, dict[str, list[int]]]:
        """Stops robots, ALL of them as ``--all`` does, and waits until they have confirmed it.

        It is held for those that ``start`` starts. Returns when it began, and for each robot when its first message,
        the first state that says it is stopped, and its confirmation arrived (CLOCK_MONOTONIC, ns). Raises PebbleError
        if one does not confirm it.
        """
        bases, every, hold = self._bases[robots], robots == ALL, start is not None
        times, timeout = defaultdict[str, list[int]](list), _STARTED_S if hold else _ANSWER_S
        with connected(self._target) as (transport, _):
            began, named = time.monotonic_ns(), None if every else bases
            sender = StopSender(new_name(), by=_BY, why="", now=began / 1e9, robots=named, hold=hold)
            send(transport, sender.tick(time.monotonic()))
            own = [channel.filter(base) for channel in (ESTOP_STATE, CAPABILITIES) for base in bases]
            listener = Listener(transport, [ALL_OUTGOING] if every else own)
            if start is not None:
                start()
            while any(len(times[base]) < _REACHED for base in bases):
                if time.monotonic_ns() - began > timeout * 1e9:
                    seen = {base: robot.why or "its state is missing" for base, robot in sender.robots.items()}
                    lacking = [base for base in bases if len(times[base]) < _REACHED]
                    why = "; ".join(f"{base}: {seen.get(base, 'it publishes nothing')}" for base in lacking)
                    raise PebbleError(f"a stop was not confirmed within {timeout:.0f} s: {why}")
                left = _TICK_S
                while (message := listener.next(left)) is not None:
                    now, left, base = time.monotonic_ns(), 0.0, message.topic.partition("/outgoing/")[0]
                    sender.receive(message, now / 1e9)
                    if (robot := sender.robots.get(base)) is not None:
                        reached = 1 + bool(robot.estop.latched) + (robot.confirmed_s is not None)
                        times[base] += [now] * (reached - len(times[base]))
                send(transport, sender.tick(time.monotonic()))
        return began, times

    def _drive(self, robots: str, *, on: bool = True) -> None:
        """Drive only these robots from now on, or none; returns at a random moment after all of them move, or rest."""
        self._driver.send(" ".join(self._bases[robots]) if on else "")
        problem = "not all robots moved or came to rest"
        _wait(lambda: {on} == {bool(one) and any(one[-1].motors) for one in self._moves(robots)}, problem)
        time.sleep(random.random() / clients.RATE_HZ)  # noqa: S311  (no secret)

    def _reset(self, robots: str) -> None:
        """Let these robots, which are stopped, move again. Raises PebbleError if one does not confirm it."""
        self._drive(robots, on=False)
        stopped = [RobotEstop(base) for base in self._bases[robots]]
        with connected(self._target) as (transport, _):
            for robot in stopped:
                robot.subscribe(transport)
            _wait(lambda: all(robot.has_capabilities and robot.latched for robot in stopped), "no stop to reset")
            resets = [Reset(robot, _BY) for robot in stopped]
            send(transport, (message for reset in resets for message in reset.messages()))
            _wait(lambda: all(reset.free for reset in resets), "a reset was not obeyed")
        time.sleep(_QUIET_S)

    def _rest(self, case: Case, robots: str, began: int) -> Cell:
        """When the last of these robots came to rest, and whether one of them moved again meanwhile."""
        time.sleep(_WATCH_S)
        times, again = zip(*(rest(moves, began) for moves in self._moves(robots)), strict=True)
        return cell_of(case, REST, began, None if None in times else max(times), again=int(any(again) or None in times))

    def _moves(self, robots: str) -> list[list[Moved]]:
        """Every change of their motors so far, by robot."""
        changes = read_moves(self._trace) if self._trace.exists() else {}
        for robot in self._linux:
            own = [(one.ns, one.motors) for one in robot.lines(0) if one.motors is not None]
            changes[robot.name] = [Moved(ns, robot.name, motors) for ns, motors in own]
        return [changes.get(base.rpartition("/")[2], []) for base in self._bases[robots]]


def _wait(condition: Callable[[], bool], problem: str) -> None:
    end = time.monotonic() + _ANSWER_S
    while not condition():
        if time.monotonic() > end:
            raise PebbleError(f"{problem} within {_ANSWER_S:.0f} s")
        time.sleep(_POLL_S)


def measure(round_: Round) -> Iterator[Cell]:
    """One round, with processes of its own. A failure counts as a lost sample, ends the round, and is the run's."""
    run, env = round_.run, round_.env
    hold, stop, zero = {STOP: env.hold}, {STOP: env.stop}, {ZERO: env.stop_by_zero}
    plan = (
        (KINDS, 1, hold), (KINDS, run["stops"], stop | zero), ([BOARD], 1, hold), ([ALL], run["all_stops"], stop)
    )  # fmt: skip
    for robots, times, ways in plan:
        for case in round_.cases([{"robot": one} for one in robots], times):
            if case.variant not in ways:
                continue
            try:
                yield from ways[case.variant](case, case.condition["robot"])
            except PebbleError as error:
                what = HOLD if ways is hold else CONFIRMED if case.variant == STOP else REST
                yield cell_of(case, what, 0, None)
                run.problem = error
                return


def _aim(measure_: str, at_most: float, *robots_: str) -> Aim:
    return Aim(
        what="{robot}, {measure}, p95 at most {bound:g} ms",
        of=lambda cell: (cell.variant, cell.measure) == (STOP, measure_) and cell.params["robot"] in robots_,
        value=with_lost(95), at_most=at_most, unit="ms", least=10,
    )  # fmt: skip


ESTOP = Comparison(
    name="estop",
    title="Emergency stop",
    what="Times from an emergency stop until the wheels are at rest, and until every motor owner has confirmed it.",
    help="The emergency stop, until the wheels are at rest and until it is confirmed: of one robot beside a plain "
    "zero, of many together, and held for robots which are switched on later. Needs mosquitto.",
    options=(rounds("How often robots are started."),),
    full=Budget(600, rounds=10, boards=50, stops=12, all_stops=3),
    quick=Budget(90, rounds=2, stops=3, all_stops=2),
    constants={"rate_hz": clients.RATE_HZ},
    variants=(STOP, ZERO),
    measuring=Measuring(
        environment=lambda run: Robots(run["boards"]),
        measure_round=measure,
        measures=MEASURES,
        figures={"again": sum},
    ),
    report=Report(
        tables=(
            Grid(
                title="From the stop, while driving goes on; ms", rows=("measure", "robot", "variant"),
                heads=("", "robot", "by"), columns=(COUNT, *map(percentile_column, (50, 95, 100))),
            ),
        ),
        assessment=(
            Claims(
                what="{measure}, {robot}", order=(ZERO, STOP), judged=lambda cell: cell.variant == STOP,
                of=lambda cell: cell.measure == REST and cell.params["robot"] in KINDS,
            ),
            _aim(REST, 50.0, *KINDS),
            _aim(REST, 250.0, ALL),
            _aim(CONFIRMED, 500.0, *KINDS, ALL),
            _aim(HOLD, 1000.0, *KINDS, BOARD),
            Aim(
                what="wheels stay at rest after a stop while driving goes on",
                of=lambda cell: cell.measure == REST and cell.variant == STOP,
                value=single("again"), at_most=0, worst=True, shown="{:g}".format, unit="times they turned again",
            ),
        ),
        pictures=(ecdf("Estop"),),
        reported=None,
    ),
)  # fmt: skip
