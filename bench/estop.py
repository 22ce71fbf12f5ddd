"""Measures the emergency stop: until the wheels are at rest, until every motor owner has confirmed it, and a hold.

Two Linux robots, one on each local transport, and a fleet of boards with Wi-Fi share one remote broker. Each is driven
all the time by a process of its own; this one stops and resets them with the code that ``pebble estop`` is made of.
"""

from __future__ import annotations

import random
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence

from pebble.bench import drivers
from pebble.bench.aims import Aim, single, with_lost
from pebble.bench.comparison import Budget, Comparison, Round, rounds
from pebble.bench.fleet import read_moves
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
_TICK_S = 0.01  # late at most is a repeated stop
_REACHED = 3  # what is noted of a robot that is stopped
_QUIET_S = 0.8  # after a reset: motor owners publish few states a second, so a stop at once is confirmed later


def rest(moves: Sequence[Moved], since: int) -> tuple[int | None, bool]:
    """When the motors came to rest after ``since`` (CLOCK_MONOTONIC, ns; None: not), and if they moved again."""
    after = [move for move in moves if move.ns >= since]
    off = next((move.ns for move in after if not any(move.motors)), None)
    return off, off is not None and any(any(move.motors) for move in after if move.ns > off)


def is_moving(moves: Sequence[Moved]) -> bool:
    return bool(moves) and any(moves[-1].motors)


def sample(measure: str, robot: str, variant: str, began: int, ended: int | None, *, again: bool = False) -> Cell:
    """One time (CLOCK_MONOTONIC, ns); ``robot`` is a Linux robot's transport, BOARD or ALL. None: it did not happen."""
    return Cell(
        variant=variant, params={"robot": robot}, measure=measure, unit="ms",
        rounds=[[] if ended is None else [(ended - began) / 1e6]],
        figures={"sent": 1, "again": int(again)},  # again: wheels turned while the robot was stopped
    )  # fmt: skip


def send(transport: Transport, messages: Iterable[Message]) -> None:
    for message in messages:
        transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)


class Robots(Processes):
    """Two Linux robots, one of each kind, and boards; what drives and stops them, and each way of stopping, measured.

    Each measurement ends with the stopped robots reset. Every stop has a connection of its own, which is open before.
    """

    def __init__(self, boards: int) -> None:
        super().__init__()
        self.linux: dict[str, Robot] = {}
        self.boards = [identity.base for _, identity in members(boards)]
        self.started: list[str] = []  # the bases of those that run
        self._trace = self.folder / "trace.jsonl"

    def start(self) -> None:
        """Starts what the robots need. Raises PebbleError if a process does not start."""
        broker = self.broker("remote")
        broker.wait()
        self._port, self._target = broker.port, Target(url=f"mqtt://127.0.0.1:{broker.port}")
        for kind in KINDS:
            name, folder = f"rover-{kind}", self.folder / kind
            self.linux[kind] = Robot(self, kind, ("127.0.0.1", broker.port), name=name, folder=folder)
            self.linux[kind].prepare()
        self._driver = self.worker("driver", "pebble.bench.drivers", broker.port)

    def start_boards(self) -> None:
        where = ("--broker", f"127.0.0.1:{self._port}", "--trace", self._trace)
        self.robot("the fleet", "pebble.simulation.fleet_program", "--robots", len(self.boards), *where)

    # -- what is measured

    def hold(self, robot: str, start: Callable[[], object], bases: Sequence[str]) -> Iterator[Cell]:
        """Start these robots while a stop of all robots is held."""
        self.started += bases
        _, times = self._stop(self.started, every=True, start=start)
        for base in bases:
            received, latched, _ = times[base]
            yield sample(HOLD, robot, STOP, received, latched)
        self._reset(self.started)

    def stop(self, robot: str, bases: Sequence[str]) -> Iterator[Cell]:
        """Stop driven robots by an emergency stop: one, or all that run."""
        self._drive(bases)
        began, times = self._stop(bases, every=robot == ALL)
        yield self._rest(robot, STOP, bases, began)
        yield sample(CONFIRMED, robot, STOP, began, max(times[base][-1] for base in bases))
        self._reset(bases)

    def stop_by_zero(self, kind: str) -> Iterator[Cell]:
        """Stop a driven robot by a plain zero as a stock client sends it."""
        bases = [self.linux[kind].base]
        self._drive(bases)
        client = drivers.StockClient(at_once=False).open(self._port)
        client.wait()
        began = time.monotonic_ns()
        client.send(DRIVE, *bases, drivers.ZERO).wait_for_publish(_ANSWER_S)
        client.close()
        yield self._rest(kind, ZERO, bases, began)
        self._drive(bases, on=False)

    # -- how

    def _stop(
        self, bases: Sequence[str], *, every: bool, start: Callable[[], object] | None = None
    ) -> tuple[int, dict[str, list[int]]]:
        """Stops these robots, or ``every`` one as ``--all`` does, and waits until these have confirmed it.

        It is held for those that ``start`` starts. Returns when it began, and for each robot when its first message,
        the first state that says it is stopped, and its confirmation arrived (CLOCK_MONOTONIC, ns). Raises PebbleError
        if one does not confirm it.
        """
        hold, times = start is not None, defaultdict[str, list[int]](list)
        filters = (
            [ALL_OUTGOING] if every else [one.filter(base) for one in (ESTOP_STATE, CAPABILITIES) for base in bases]
        )
        with connected(self._target) as (transport, _):
            began, timeout = time.monotonic_ns(), _STARTED_S if hold else _ANSWER_S
            named = None if every else bases
            sender = StopSender(new_name(), by=_BY, why="", now=began / 1e9, robots=named, hold=hold)
            send(transport, sender.tick(time.monotonic()))
            listener = Listener(transport, filters)
            if start is not None:
                start()
            while any(len(times[base]) < _REACHED for base in bases):
                if time.monotonic_ns() - began > timeout * 1e9:
                    missing = [f"{base}: {robot.why}" for base, robot in sender.robots.items() if robot.why]
                    raise PebbleError(f"a stop was not confirmed within {timeout:.0f} s: {'; '.join(missing)}")
                left = _TICK_S
                while (message := listener.next(left)) is not None:
                    now, left, base = time.monotonic_ns(), 0.0, message.topic.partition("/outgoing/")[0]
                    sender.receive(message, now / 1e9)
                    if (robot := sender.robots.get(base)) is not None:
                        reached = 1 + bool(robot.estop.latched) + (robot.confirmed_s is not None)
                        times[base] += [now] * (reached - len(times[base]))
                send(transport, sender.tick(time.monotonic()))
        return began, times

    def _drive(self, bases: Sequence[str], *, on: bool = True) -> None:
        """Drive these robots from now on, or none; returns at a random moment after all of them move, or rest."""
        self._driver.send(" ".join(bases) if on else "")
        _wait(lambda: {on} == set(map(is_moving, self._moves(bases))), "not all robots moved or came to rest")
        time.sleep(random.random() / drivers.RATE_HZ)  # noqa: S311  (no secret)

    def _reset(self, bases: Sequence[str]) -> None:
        """Let these robots, which are stopped, move again. Raises PebbleError if one does not confirm it."""
        self._drive(bases, on=False)
        robots = [RobotEstop(base) for base in bases]
        with connected(self._target) as (transport, _):
            for robot in robots:
                robot.subscribe(transport)
            _wait(lambda: all(robot.has_capabilities and robot.latched for robot in robots), "no stop to reset")
            resets = [Reset(robot, _BY) for robot in robots]
            send(transport, (message for reset in resets for message in reset.messages()))
            _wait(lambda: all(reset.free for reset in resets), "a reset was not obeyed")
        time.sleep(_QUIET_S)

    def _rest(self, robot: str, variant: str, bases: Sequence[str], began: int) -> Cell:
        """When the last of these robots came to rest, and whether one of them moved again meanwhile."""
        time.sleep(_WATCH_S)
        times, again = zip(*(rest(moves, began) for moves in self._moves(bases)), strict=True)
        return sample(REST, robot, variant, began, None if None in times else max(times), again=any(again))

    def _moves(self, bases: Sequence[str]) -> list[list[Moved]]:
        """Every change of their motors so far, by robot."""
        changes = read_moves(self._trace) if self._trace.exists() else {}
        for robot in self.linux.values():
            own = [(one.ns, one.motors) for one in robot.lines(0) if one.motors is not None]
            changes[robot.name] = [Moved(ns, robot.name, motors) for ns, motors in own]
        return [changes.get(base.rpartition("/")[2], []) for base in bases]


def _wait(condition: Callable[[], bool], problem: str) -> None:
    end = time.monotonic() + _ANSWER_S
    while not condition():
        if time.monotonic() > end:
            raise PebbleError(f"{problem} within {_ANSWER_S:.0f} s")
        time.sleep(_POLL_S)


def measure(round_: Round) -> Iterator[Cell]:
    """One round, with processes of its own. Raises PebbleError."""
    run, env = round_.run, round_.env
    for kind, robot in env.linux.items():
        run.show(f"{kind}: the robot starts while a stop is held")
        yield from env.hold(kind, robot.launch, [robot.base])
    for number in range(run["stops"]):
        run.show(f"stop {number + 1} of {run['stops']} of one robot")
        for kind in KINDS[:: -1 if number % 2 else 1]:
            yield from env.stop(kind, [env.linux[kind].base])
            yield from env.stop_by_zero(kind)
    run.show(f"{run['boards']} boards start while a stop is held")
    yield from env.hold(BOARD, env.start_boards, env.boards)
    for number in range(run["all_stops"]):
        run.show(f"stop {number + 1} of {run['all_stops']} of all robots")
        yield from env.stop(ALL, env.started)


# -- the report


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
    constants={"rate_hz": drivers.RATE_HZ},
    environment=lambda run: Robots(run["boards"]),
    measure_round=measure,
    measures=MEASURES,
    figures={"again": sum},
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
)  # fmt: skip
