"""Measures the emergency stop: until the wheels are at rest, until every motor owner has confirmed it, and a hold.

Two Linux robots, one on each local transport, and a fleet of boards with Wi-Fi share one remote broker. Each is driven
all the time by a process of its own; this one stops and resets them with the code that ``pebble estop`` is made of.
Real processes, stock mosquitto, loopback.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import NamedTuple

from pebble.bench import drivers
from pebble.bench.aims import Aim, outcome, with_lost
from pebble.bench.comparison import Budget, Comparison, Option, Round, Run, rounds
from pebble.bench.fleet import read_moves
from pebble.bench.pictures import ecdf
from pebble.bench.results import Cell, Judged, Value
from pebble.bench.tables import COUNT, Claims, Grid, figure, percentile_column
from pebble.client.connection import Listener, Target, connected
from pebble.client.discovery import ALL_OUTGOING
from pebble.client.estop import StopSender, new_name
from pebble.client.estop_states import Reset, RobotEstop
from pebble.contract import CAPABILITIES, DRIVE, ESTOP_STATE
from pebble.contract import ESTOP as ESTOP_COMMAND
from pebble.errors import PebbleError
from pebble.rig.processes import Processes
from pebble.rig.robot import KINDS, Robot
from pebble.rig.stock_client import StockClient
from pebble.simulation.fleet import MOST, Moved, members
from pebble.transports import Message, Transport

REST, CONFIRMED, HOLD, WIRE = MEASURES = ("wheels at rest", "confirmed", "latched under a hold", "first stop sent")
STOP, COMMAND, ZERO = "emergency stop", "pebble estop", "plain zero"
ALL, BOARD = "all together", "board"
_BY = "bench"
_STARTED_S = 90.0  # boards start one after the other
_CONFIRMED_S = 10.0
_MOVING_S = 10.0
_ANSWER_S, _COMMAND_S = 5.0, 30.0
_WATCH_S = 0.3  # after a stop, while driving goes on; the fleet writes its trace ten times a second
_POLL_S = 0.05
_LONGEST_WAIT_S = 0.25
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


def sample(measure: str, robot: str, variant: str, began: int, ended: int | None, *, again: bool = False) -> Cell:
    """One time (CLOCK_MONOTONIC, ns); ``robot`` is a Linux robot's transport, BOARD or ALL. None: it did not happen."""
    ms = [] if ended is None else [(ended - began) / 1e6]
    more: dict[str, Value] = {"sent": 1, "again": int(again)}  # again: wheels turned while the robot was stopped
    return Cell(variant=variant, params={"robot": robot}, measure=measure, unit="ms", rounds=[ms], figures=more)


class Stop:
    """One emergency stop over a connection that is open, from its construction on.

    Times are CLOCK_MONOTONIC, ns. A robot that has not confirmed it is missing.
    """

    def __init__(self, transport: Transport, robots: Collection[str] | None, *, hold: bool = False) -> None:
        """``robots`` None: all, which are found as ``--all`` finds them."""
        self._transport = transport
        self.received: dict[str, int] = {}  # when each robot's first message arrived
        self.latched: dict[str, int] = {}  # when the first state arrived that says so
        self.confirmed: dict[str, int] = {}
        self.began = time.monotonic_ns()
        self._sender = StopSender(new_name(), by=_BY, why="", now=self.began / 1e9, robots=robots, hold=hold)
        self._publish()
        channels = (ESTOP_STATE, CAPABILITIES)
        filters = [ALL_OUTGOING] if robots is None else [one.filter(base) for one in channels for base in robots]
        self._listener = Listener(transport, filters)

    def wait_until_confirmed(self, robots: Collection[str], timeout: float) -> None:
        """Send and receive until these robots have confirmed it. Raises PebbleError after ``timeout`` seconds."""
        end = time.monotonic() + timeout
        while not self.confirmed.keys() >= {*robots}:
            if time.monotonic() > end:
                missing = [f"{base}: {robot.why}" for base, robot in self._sender.robots.items() if robot.why]
                raise PebbleError(f"a stop was not confirmed within {timeout:.0f} s: {'; '.join(missing)}")
            due = self._sender.due
            left = _LONGEST_WAIT_S if due is None else min(_LONGEST_WAIT_S, due - time.monotonic())
            while (message := self._listener.next(left)) is not None:
                self._receive(message, time.monotonic_ns())
                left = 0.0
            self._publish()

    def _receive(self, message: Message, now: int) -> None:
        self._sender.receive(message, now / 1e9)
        base = message.topic.partition("/outgoing/")[0]
        robot = self._sender.robots.get(base)
        if robot is not None:
            self.received.setdefault(base, now)
            if robot.estop.latched:
                self.latched.setdefault(base, now)
            if robot.confirmed_s is not None:
                self.confirmed.setdefault(base, now)

    def _publish(self) -> None:
        for message in self._sender.tick(time.monotonic()):
            self._transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)


class Robots(Processes):
    """Two Linux robots, one of each kind, and boards; who drives and stops them, and each way of stopping, measured.

    Each measurement ends with the stopped robots reset. Every stop has a connection of its own, which is open before it
    begins.
    """

    def __init__(self, boards: int) -> None:
        super().__init__()
        self._boards = {identity.id: identity.base for _, identity in members(boards)} if boards else {}
        self._linux: dict[str, Robot] = {}
        self._trace = self.folder / "trace.jsonl"

    def start(self) -> None:
        """Starts what the robots need. Raises PebbleError if a process does not start."""
        broker = self.broker("remote")
        broker.wait()
        self._port, self._target = broker.port, Target(url=f"mqtt://127.0.0.1:{broker.port}")
        for kind in KINDS:
            name, folder = f"rover-{kind}", self.folder / kind
            self._linux[kind] = Robot(self, kind, ("127.0.0.1", broker.port), name=name, folder=folder)
            self._linux[kind].prepare()
        self._driver = self.worker("driver", "pebble.bench.drivers", broker.port)

    # -- what is measured

    def hold(self, *, boards: bool = False) -> Iterator[Cell]:
        """Start the Linux robots one after the other, or all boards, while a stop of all robots is held."""
        started: list[tuple[str, Callable[[], object], list[str]]]
        started = [(kind, robot.launch, [robot.base]) for kind, robot in self._linux.items()]
        if boards:
            started = [(BOARD, self._start_boards, [*self._boards.values()])]
        with connected(self._target) as (transport, _):
            stop = Stop(transport, None, hold=True)
            for kind, start, bases in started:
                start()
                stop.wait_until_confirmed(bases, _STARTED_S)
                for base in bases:
                    yield sample(HOLD, kind, STOP, stop.received[base], stop.latched[base])
        self._reset(self._bases if boards else self._linux_bases)

    def stop_one(self, kind: str) -> Iterator[Cell]:
        """Stop a driven robot by an emergency stop, and by a plain zero as a stock client sends it."""
        base = self._linux[kind].base
        yield from self._stop(kind, [base], [base])
        self._drive([base])
        client = StockClient(at_once=False).open(self._port)
        client.wait()
        began = time.monotonic_ns()
        client.paho.publish(DRIVE.topic(base), drivers.ZERO, qos=DRIVE.default_qos).wait_for_publish(_ANSWER_S)
        client.close()
        yield self._rest(kind, ZERO, [base], began)
        self._release([base])

    def stop_by_command(self, kind: str) -> Iterator[Cell]:
        """Stop a driven robot by the shell command; times begin with the start of its process."""
        base, received = self._linux[kind].base, list[int]()
        words = [sys.executable, "-m", "pebble.cli", "estop", base, "--url", str(self._target.url)]
        self._drive([base])
        with connected(self._target) as (transport, _):
            topic = ESTOP_COMMAND.topic(base)
            transport.subscribe(topic, lambda _message: received.append(time.monotonic_ns()), direct=True)
            began = time.monotonic_ns()
            done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=_COMMAND_S)
            ended = time.monotonic_ns()
        if done.returncode or not received:
            raise PebbleError(f"pebble estop ended with code {done.returncode}: {done.stdout}{done.stderr}")
        yield sample(WIRE, kind, COMMAND, began, received[0])
        yield self._rest(kind, COMMAND, [base], began)
        yield sample(CONFIRMED, kind, COMMAND, began, ended)
        self._reset([base])

    def stop_all(self) -> Iterator[Cell]:
        """Stop all robots, which are driven, by one emergency stop."""
        yield from self._stop(ALL, self._bases, None)

    def _stop(self, robot: str, bases: Sequence[str], named: Sequence[str] | None) -> Iterator[Cell]:
        """Stop these driven robots by one emergency stop that names them, or all."""
        self._drive(bases)
        with connected(self._target) as (transport, _):
            stop = Stop(transport, named)
            stop.wait_until_confirmed(bases, _CONFIRMED_S)
        yield self._rest(robot, STOP, bases, stop.began)
        yield sample(CONFIRMED, robot, STOP, stop.began, max(stop.confirmed[base] for base in bases))
        self._reset(bases)

    # -- how

    @property
    def _linux_bases(self) -> list[str]:
        return [robot.base for robot in self._linux.values()]

    @property
    def _bases(self) -> list[str]:
        return [*self._linux_bases, *self._boards.values()]

    def _start_boards(self) -> None:
        where = ("--broker", f"127.0.0.1:{self._port}", "--trace", self._trace)
        self.robot("the fleet", "pebble.simulation.fleet_program", "--robots", len(self._boards), *where)

    def _drive(self, bases: Sequence[str]) -> None:
        """Drive these robots from now on; returns at a random moment after all of them move."""
        self._driver.send(" ".join(bases))
        self._wait_until(bases, moving=True)
        time.sleep(random.random() / drivers.RATE_HZ)  # noqa: S311  (no secret)

    def _release(self, bases: Sequence[str]) -> None:
        """Drive no robot."""
        self._driver.send("")
        self._wait_until(bases, moving=False)

    def _reset(self, bases: Sequence[str]) -> None:
        """Let these robots, which are stopped, move again. Raises PebbleError if one does not confirm it."""
        self._release(bases)
        robots = [RobotEstop(base) for base in bases]
        with connected(self._target) as (transport, _):
            for robot in robots:
                robot.subscribe(transport)
            _wait(lambda: all(robot.has_capabilities and robot.latched for robot in robots), "no stop to reset")
            resets = [Reset(robot, _BY) for robot in robots]
            for message in (message for reset in resets for message in reset.messages()):
                transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)
            _wait(lambda: all(reset.free for reset in resets), "a reset was not obeyed")
        time.sleep(_QUIET_S)

    def _wait_until(self, bases: Sequence[str], *, moving: bool) -> None:
        end = time.monotonic() + _MOVING_S
        while others := [base for base, moves in self._moves(bases).items() if is_moving(moves) != moving]:
            if time.monotonic() > end:
                what = "do not move when they are driven" if moving else "do not come to rest"
                raise PebbleError(f"{len(others)} robots {what}, among them {others[0]}")
            time.sleep(_POLL_S)

    def _rest(self, robot: str, variant: str, bases: Sequence[str], began: int) -> Cell:
        """When the last of these robots came to rest, and whether one of them moved again meanwhile."""
        time.sleep(_WATCH_S)
        found = [rest(moves, began) for moves in self._moves(bases).values()]
        times = [one.ns for one in found if one.ns is not None]
        last = max(times) if len(times) == len(found) else None
        return sample(REST, robot, variant, began, last, again=any(one.again for one in found))

    def _moves(self, bases: Collection[str]) -> dict[str, list[Moved]]:
        """Every change of their motors so far, by base."""
        moves = {
            robot.base: [Moved(one.ns, robot.base, one.motors) for one in robot.lines(0) if one.motors is not None]
            for robot in self._linux.values()
            if robot.base in bases
        }
        boards = {name: base for name, base in self._boards.items() if base in bases}
        changes = read_moves(self._trace) if boards else {}
        return moves | {base: changes.get(name, []) for name, base in boards.items()}


def _wait(condition: Callable[[], bool], problem: str) -> None:
    end = time.monotonic() + _ANSWER_S
    while not condition():
        if time.monotonic() > end:
            raise PebbleError(f"{problem} within {_ANSWER_S:.0f} s")
        time.sleep(_POLL_S)


def measure(round_: Round) -> Iterator[Cell]:
    """One round, with processes of its own. Raises PebbleError."""
    run, env = round_.run, round_.env
    run.show("Linux robots start while a stop is held")
    yield from env.hold()
    for number in range(run["stops"]):
        run.show(f"stop {number + 1} of {run['stops']} of one robot")
        for kind in KINDS[:: -1 if number % 2 else 1]:
            yield from env.stop_one(kind)
    for kind in KINDS:
        run.show(f"pebble estop of {kind}")
        yield from env.stop_by_command(kind)
    if run["boards"]:
        run.show(f"{run['boards']} boards start while a stop is held")
        yield from env.hold(boards=True)
    for number in range(run["all_stops"]):
        run.show(f"stop {number + 1} of {run['all_stops']} of all robots")
        yield from env.stop_all()


# -- the report


def by_command(cells: Sequence[Cell]) -> Iterator[str]:
    """The time that a person who enters the command waits."""
    for cell in cells:
        if cell.measure == WIRE:
            yield (
                f"{cell.conditions()}: pebble estop sends its first stop {figure(cell.percentile(50))} ms (p50) after"
                f" it is entered, {figure(cell.percentile(100))} ms at most"
            )


def _aim(measure_: str, at_most: float, *robots_: str) -> Aim:
    return Aim(
        what="{robot}, {measure}, p95 at most {bound:g} ms",
        of=lambda cell: (cell.variant, cell.measure) == (STOP, measure_) and cell.params["robot"] in robots_,
        value=with_lost(95), at_most=at_most, unit="ms", least=10,
    )  # fmt: skip


def stay_at_rest(cells: Sequence[Cell]) -> Iterator[Judged]:
    """Whether wheels turned after an emergency stop, though drive commands went on."""
    stops = [cell for cell in cells if cell.measure == REST and cell.variant != ZERO]
    sent, again = (sum(int(cell.figures[name] or 0) for cell in stops) for name in ("sent", "again"))
    what, measured = "wheels stay at rest after a stop while driving goes on", f"{again} of {sent} turned again"
    yield Judged(what=what, outcome=outcome(not again), measured=measured)


def prepare(run: Run) -> None:
    run.notes.append(f"Load of the machine before the run: {os.getloadavg()[0]:.2f}")


ESTOP = Comparison(
    name="estop",
    title="Emergency stop",
    what="Times from an emergency stop until the wheels are at rest, and until every motor owner has confirmed it.",
    help="""The emergency stop: until the wheels are at rest, and until it is confirmed.

    Of a Linux robot on either transport, compared with a plain zero; of two of them and 50 boards together; and a stop
    that is held for robots which are switched on later. All robots are driven meanwhile. Needs mosquitto.

    \b
        pebble bench estop
        pebble bench estop --quick --boards 10
    """,
    options=(
        rounds("How often robots are started."),
        Option(name="boards", kind=int, least=0, most=MOST, help="Boards with Wi-Fi that are stopped together."),
    ),
    full=Budget(600, rounds=10, boards=50, stops=12, all_stops=3),
    quick=Budget(90, rounds=2, stops=3, all_stops=2),
    constants={"rate_hz": drivers.RATE_HZ},
    prepare=prepare,
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
            what="{measure}, {robot}",
            of=lambda cell: cell.measure == REST and cell.params["robot"] in KINDS and cell.variant != COMMAND,
            order=(ZERO, STOP),
            judged=lambda cell: cell.measure == REST and cell.variant == STOP,
        ),
        by_command,
        _aim(REST, 50.0, *KINDS),
        _aim(REST, 250.0, ALL),
        _aim(CONFIRMED, 500.0, *KINDS, ALL),
        _aim(HOLD, 1000.0, *KINDS, BOARD),
        stay_at_rest,
    ),
    pictures=(ecdf("Estop"),),
    reported=None,
)  # fmt: skip
