"""Measures fleets of several sizes at one broker: what each robot costs, and what a person at the page notices.

Processes on this machine: a stock mosquitto; a server of the operator page, with a viewer; a crowd of cheap robots
(:mod:`pebble.simulation.crowd`); and some boards with the real firmware (:mod:`pebble.simulation.fleet`), which the
operator drives: ``python -m pebble.bench.fleet PORT SECONDS ID…`` writes a JSON line when every board is online, and
after a line of input drives them for ``SECONDS`` and writes the results.
"""

from __future__ import annotations

import itertools
import json
import os
import resource
import sys
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Final

import msgspec
from paho.mqtt.client import MQTTMessage

from pebble.bench.clients import MANY, StockClient, axes_of
from pebble.bench.comparison import Budget, Case, Comparison, Measuring, Option, Report, Run, rounds, seconds
from pebble.bench.judging.aims import Aim, with_lost
from pebble.bench.pictures import ecdf, growth
from pebble.bench.results import Cell, grouped, rounded
from pebble.bench.tables import COUNT, LOST, Grid, figure, median_column, medians, percentile_column, single_column
from pebble.bench.usage import cpu_s, pss_mb
from pebble.bench.viewer import Viewer
from pebble.contract import DRIVE, ONLINE
from pebble.contract.identity import Identity
from pebble.errors import PebbleError
from pebble.rig.processes import OPERATORS, Broker, Processes, Worker
from pebble.rig.testbed import PageServer
from pebble.rig.worker_end import answer, serve_on_thread
from pebble.simulation import crowd
from pebble.simulation.fleet import Moved, members
from pebble.simulation.trace import complete_lines
from pebble.simulation.wireless import KINDS

#: Wheel speeds, left and right, in sequence: no robot gets the same command twice within eight commands.
STEPS: Final = ((1, 1), (-1, -1), (1, 0), (-1, 0), (1, -1), (0, 1), (-1, 1), (0, -1))
RATE_HZ: Final = 10.0  # of each board
MOST: Final = 5000
_UP_S, _ARRIVE_S, _POLL_S, _QUIET_S = 90.0, 1.0, 0.05, 3.0
_NOTICED_S = 10.0  # of a robot that ends, or of a stop, until the page shows it
_BETWEEN_S = 0.2  # two robots that end
_FILES = 64  # of a process besides one for each robot
_TEN_THOUSAND = 10_000
#: What mosquitto's log has where it may open no more files: the second where it cannot open the file of tcpd's rules.
_NO_FILES = ("socket count has been exceeded", "denied access by tcpd")

PINS, LAST, CONFIRMED = "command to pins", "stop of all, until the last has it", "stop of all, until all have confirmed"
KILLED, MUTE = "connection lost, until the page shows it", "silent, until the page shows it"
BROKER_CPU, PAGE_CPU, VIEWER_CPU = "CPU, broker", "CPU, page server", "CPU, page server with a viewer"
BROKER_MB, PAGE_MB, VIEWER_RATE = "memory, broker", "memory, page server", "to a viewer"
UNITS = {
    **dict.fromkeys((PINS, LAST, CONFIRMED, KILLED, MUTE), "ms"),
    **dict.fromkeys((BROKER_CPU, PAGE_CPU, VIEWER_CPU), "%"),
    **dict.fromkeys((BROKER_MB, PAGE_MB), "MB"),
    VIEWER_RATE: "kB/s",
}
#: What grows with the fleet, and is told for ten thousand.
_GROWS = (BROKER_CPU, BROKER_MB, VIEWER_CPU, PAGE_MB, VIEWER_RATE)


class World(Processes):
    """A broker, a page server and a fleet of ``robots``, of which ``boards`` are real firmware."""

    def __init__(self, robots: int, boards: int, show: Callable[[str], None], files: int | None = None) -> None:
        """``files``: that the broker may open."""
        super().__init__()
        self.robots, self.boards, self._show, self._files = robots, boards, show, files

    def start(self) -> None:
        """Raises PebbleError if a process does not start, or not all robots come online."""
        limited = () if self._files is None else ("prlimit", f"--nofile={self._files}")
        self.server_of_robots = self.broker(wrap=lambda command: [*limited, *command])
        self.server_of_robots.wait()
        port = self.server_of_robots.port
        self.page = self.add(PageServer(self.folder, port, port=0), OPERATORS)
        self.page.wait()
        self._show(f"{self.robots} robots are connecting")
        self.crowd = self.worker("crowd", "pebble.simulation.crowd", port, self.robots - self.boards)
        check_online(self.crowd.answer(_UP_S), self.robots - self.boards, self.server_of_robots)
        self.trace = self.folder / "trace.jsonl"
        where = ("--kinds", ",".join(KINDS), "--broker", f"127.0.0.1:{port}", "--trace", self.trace)
        self.fleet = self.robot("fleet", "pebble.simulation.fleet_program", "--robots", self.boards, *where)

    @property
    def pids(self) -> dict[str, int]:
        return {"broker": self.server_of_robots.pid, "page": self.page.pid, "fleet": self.fleet.pid,
                "crowd": self.crowd.pid}  # fmt: skip

    def cpu(self, during: Callable[[], object]) -> dict[str, float]:
        """Per cent of a core, by process."""
        pids, began = self.pids, time.monotonic()
        before = {name: cpu_s([pid]) for name, pid in pids.items()}
        during()
        took = time.monotonic() - began
        return {name: 100 * (cpu_s([pid]) - before[name]) / took for name, pid in pids.items()}

    def notes(self) -> Iterator[str]:
        """Where a limit was met."""
        dropped = self.server_of_robots.log.read_text(errors="replace").count("messages are being dropped for client")
        if dropped:
            yield (
                f"{self.robots} robots: the broker's queue for a client was full {dropped} times: messages are lost;"
                " raise max_queued_messages in mosquitto.conf"
            )


def check_online(found: Mapping[str, Any], wanted: int, broker: Broker) -> None:
    """Raises PebbleError with one line that names the limit, if not all robots are online."""
    if found["online"] == wanted:
        return
    why = found["problem"] or "no reason is known"
    log = broker.log.read_text(errors="replace")
    if any(sign in log for sign in _NO_FILES):
        why = "the broker may open no more files: raise LimitNOFILE in its unit, or ulimit -n"
    raise PebbleError(f"{found['online']} of {wanted} robots are online: {why}")


def allow_files(robots: int) -> None:
    """Let this process, and those that it starts, have a file for each robot. Raises PebbleError if they may not."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needs = robots + _FILES
    if hard < needs and hard != resource.RLIM_INFINITY:
        raise PebbleError(
            f"{robots} robots need {needs} open files in one process, and this user may have {hard}: raise ulimit -n"
        )
    if soft < needs and soft != resource.RLIM_INFINITY:
        resource.setrlimit(resource.RLIMIT_NOFILE, (needs, hard))


def prepare(run: Run) -> None:
    allow_files(max(run["robots"]))


def measure(case: Case) -> Iterator[Cell]:
    """One fleet, with processes of its own. Raises PebbleError if a process does not start, or not all are online."""
    run, robots = case.run, int(str(case.condition["robots"]))
    boards = min(run["boards"], robots - 1)
    with World(robots, boards, run.show) as world:
        for name, values, figures in _phases(world, run):
            yield case.cell(name, UNITS[name], values, **figures)
        run.notes.extend(world.notes())


def _phases(world: World, run: Run) -> Iterator[tuple[str, list[float], dict[str, Any]]]:
    ids = [identity.id for _, identity in members(world.boards, KINDS)]
    operator = world.worker("operator", "pebble.bench.fleet", world.server_of_robots.port, run["seconds"], *ids)
    operator.answer(_UP_S)
    time.sleep(_QUIET_S)
    run.show(f"{world.robots} robots beat")
    idle = world.cpu(lambda: time.sleep(run["seconds"]))
    yield BROKER_CPU, [idle["broker"]], {"crowd": rounded(idle["crowd"], 1)}
    yield PAGE_CPU, [idle["page"]], {}
    with Viewer(world.page.url) as viewer:
        _show_all(world, run, viewer)
        run.show(f"a viewer sees {world.robots} robots")
        before, began = viewer.bytes, time.monotonic()
        seen = world.cpu(lambda: time.sleep(run["seconds"]))
        yield VIEWER_CPU, [seen["page"]], {}
        yield VIEWER_RATE, [(viewer.bytes - before) / (time.monotonic() - began) / 1000], {}
        yield BROKER_MB, [pss_mb(world.server_of_robots.pid)], {}
        yield PAGE_MB, [pss_mb(world.page.pid)], {}
        run.show(f"{world.boards} of {world.robots} robots are driven")
        yield PINS, *_driven(world, operator, run)
        for _ in range(run["stops"]):
            yield from _stopped(world, viewer)
        yield from _ended(world, viewer, run["ends"])


def _show_all(world: World, run: Run, viewer: Viewer) -> None:
    """The page has a limit of its own."""
    viewer.until(
        lambda: len(viewer.online) >= world.robots or viewer.omitted > 0,
        _UP_S,
        lambda: f"the page shows {len(viewer.online)} of {world.robots} robots",
    )
    if viewer.omitted:
        run.notes.append(f"{world.robots} robots are more than a page shows: give each page server fewer")


def _driven(world: World, operator: Worker, run: Run) -> tuple[list[float], dict[str, Any]]:
    operator.send("drive")
    found: dict[str, Any] = {}
    cpu = world.cpu(lambda: found.update(operator.answer(run["seconds"] + _UP_S)))
    time.sleep(_ARRIVE_S)  # commands in flight arrive, or count as lost
    return driven(found, read_moves(world.trace), {**cpu, "mb": pss_mb(world.fleet.pid) / world.boards})


def driven(
    found: Mapping[str, Any], moves: Mapping[str, Sequence[Moved]], cost: Mapping[str, float]
) -> tuple[list[float], dict[str, Any]]:
    """``found`` is the operator's answer; ``cost`` has the CPU by process, %, and the memory of a board, MB."""
    sent = found["sent"]
    began, ended = min(map(min, sent.values())), max(map(max, sent.values()))
    heartbeats = [[ns for ns in own if began <= ns <= ended] for own in found["heartbeats"]]
    return latencies_ms(sent, moves), {
        "sent": sum(map(len, sent.values())),
        "late": found["late"],
        "longest_gap_s": rounded(longest_gap_s(heartbeats, began, ended), 3),
        "mb_per_board": rounded(cost["mb"], 3),
        **{f"cpu_{name}": rounded(cost[name], 1) for name in ("broker", "fleet")},
    }


def _stopped(world: World, viewer: Viewer) -> Iterator[tuple[str, list[float], dict[str, Any]]]:
    name, at = viewer.stop_all()
    viewer.until(
        lambda: viewer.confirmed(name) >= world.robots,
        _NOTICED_S,
        lambda: f"{viewer.confirmed(name)} of {world.robots} robots have confirmed a stop of all",
    )
    confirmed = time.monotonic_ns()
    last = max(world.crowd.ask("stops", _NOTICED_S).values())
    yield LAST, [(last - at) / 1e6], {}
    yield CONFIRMED, [(confirmed - at) / 1e6], {}


def _ended(world: World, viewer: Viewer, ends: int) -> Iterator[tuple[str, list[float], dict[str, Any]]]:
    """Robots that lose their connection, and robots that fall silent; the page must tell both."""
    victims = [one.base for one in crowd.names(min(2 * ends, world.robots - world.boards))]
    ways = {KILLED: ("kill", victims[::2]), MUTE: ("mute", victims[1::2])}
    for measure_, (command, bases) in ways.items():
        at = {}
        for base in bases:
            at[base] = world.crowd.ask(f"{command} {base.rpartition('/')[2]}", _NOTICED_S)["ns"]
            time.sleep(_BETWEEN_S)
        viewer.until(partial(viewer.all_offline, bases), _NOTICED_S, lambda: "dead robots look alive")
        yield measure_, [(viewer.offline_at[base] - ns) / 1e6 for base, ns in at.items()], {}


def latencies_ms(sent: Mapping[str, Sequence[int]], moves: Mapping[str, Sequence[Moved]]) -> list[float]:
    """Latencies of all commands that the motors obeyed before another command asked for the same speeds."""
    found = []
    for robot, times in sent.items():
        changes = grouped(moves.get(robot, ()), lambda moved: tuple(round(motor, 1) for motor in moved.motors))
        for number, time_ns in enumerate(times):
            own, again = changes.get(STEPS[number % len(STEPS)], []), number + len(STEPS)
            at = bisect_left(own, time_ns, key=lambda moved: moved.ns)
            if at < len(own) and (again >= len(times) or own[at].ns < times[again]):
                found.append((own[at].ns - time_ns) / 1e6)
    return found


def read_moves(trace: Path) -> dict[str, list[Moved]]:
    moves = (msgspec.json.decode(line, type=Moved) for line in complete_lines(trace)[0])
    return grouped(moves, lambda moved: moved.robot)


def longest_gap_s(robots: Sequence[Sequence[int]], began: int, ended: int) -> float:
    """The longest gap of any robot between the first and the last command; a robot that stops counts until the end."""
    return max(b - a for own in robots for a, b in itertools.pairwise([began, *own, ended])) / 1e9


def drive_fleet(port: int, seconds: float, ids: Sequence[str], begin: Callable[[], object]) -> None:
    """Drives a whole fleet in :data:`STEPS`, evenly spread, and subscribes to all heartbeats.

    It waits for a line when all are online. Then it answers when each robot's commands were published (CLOCK_MONOTONIC,
    ns) and its heartbeats arrived, and how many commands were more than a period late.
    """
    bases = [Identity("pebble", "robots", name).base for name in ids]
    heartbeats: dict[str, list[int]] = {ONLINE.topic(base): [] for base in bases}
    sent: dict[str, list[int]] = {name: [] for name in ids}
    topics = [DRIVE.topic(base) for base in bases]
    bodies = [json.dumps(axes_of(left, right)) for left, right in STEPS]

    def receive(message: MQTTMessage) -> None:
        if not message.retain and b"true" in message.payload:
            heartbeats[message.topic].append(time.monotonic_ns())

    client = StockClient(receive, [(topic, 0) for topic in heartbeats])
    client.paho.max_inflight_messages_set(MANY)
    client.open(port)
    while not all(heartbeats.values()):
        time.sleep(_POLL_S)
    answer({})
    begin()
    began, late, gap = time.monotonic(), 0, 1 / RATE_HZ / len(ids)
    for number in range(round(seconds * RATE_HZ) * len(ids)):
        step, robot = divmod(number, len(ids))
        left = began + number * gap - time.monotonic()
        time.sleep(max(0.0, left))
        late += left < -1 / RATE_HZ
        sent[ids[robot]].append(time.monotonic_ns())
        client.paho.publish(topics[robot], bodies[step % len(STEPS)], qos=DRIVE.default_qos)
    answer({"late": late, "sent": sent, "heartbeats": list(heartbeats.values())})
    client.close()


def at_ten_thousand(cells: Sequence[Cell]) -> Iterator[str]:
    """What one robot more costs, from the second largest to the largest fleet, and what ten thousand would."""
    for name in _GROWS:
        some = [cell for cell in cells if cell.measure == name and cell.samples]
        found = {int(str(cell.params["robots"])): median(medians(cell)) for cell in some}
        if len(found) > 1:
            less, more = sorted(found)[-2:]
            each = (found[more] - found[less]) / (more - less)
            whole, unit = found[more] + each * (_TEN_THOUSAND - more), UNITS[name]
            yield (
                f"{name}: {figure(found[more])} {unit} with {more:,} robots, {figure(1000 * each)} {unit} for each"
                f" 1,000 more; 10,000 would be {figure(whole)} {unit} if it goes on so"
            )


def _of(name: str) -> Callable[[Cell], bool]:
    return lambda cell: cell.measure == name


_FIGURES = {
    "late": "late", "gap, s": "longest_gap_s", "broker": "cpu_broker", "boards": "cpu_fleet", "MB": "mb_per_board",
}  # fmt: skip
FLEET = Comparison(
    name="fleet",
    title="A fleet on one broker",
    what="Robots of the contract at one stock broker, with a page server and one viewer. Most are cheap: a connection, "
    "a will, retained state and four heartbeats a second each, but no firmware. Some boards run the real firmware on "
    "simulated pins, and are driven by one operator at 10 Hz each: that latency is from the publish call to the change "
    "of the pins.",
    help="Fleets of several sizes at one broker: what each robot costs broker and page, how fast a stop of all, a "
    "robot's end and a drive command are. Cheap simulated robots, and some with the real firmware. Needs mosquitto.",
    options=(
        Option(name="robots", kind=int, many=True, least=2, most=MOST, metavar="NUMBERS", help="Sizes, with commas."),
        Option(name="boards", kind=int, least=1, most=100, help="How many of them run the firmware, and are driven."),
        rounds("How often each size is measured."),
        seconds("Of each phase.", least=1),
    ),
    full=Budget(240, robots=[100, 300, 1000], boards=10, rounds=1, seconds=10.0, stops=3, ends=10),
    quick=Budget(40, robots=[30, 60], boards=5, rounds=1, seconds=2.0, stops=1, ends=2),
    constants={"rate_hz": RATE_HZ},
    variants=("mqtt",),
    conditions=lambda run: [{"robots": one} for one in run["robots"]],
    measuring=Measuring(prepare=prepare, measure=measure, measures=tuple(UNITS), alone=True),
    report=Report(
        tables=(
            Grid(
                title="Idle: CPU, % of a core; PSS, MB; what a viewer of the fleet gets",
                rows=("robots",),
                columns=(
                    median_column("broker %", BROKER_CPU), median_column("page %", PAGE_CPU),
                    median_column("with viewer %", VIEWER_CPU), median_column("broker MB", BROKER_MB),
                    median_column("page MB", PAGE_MB), median_column("viewer kB/s", VIEWER_RATE),
                ),
            ),
            Grid(
                title="Driven boards: command to pins, ms; longest gap of heartbeats; CPU, %; memory of a board",
                rows=("robots",),
                of=_of(PINS),
                columns=(
                    *map(percentile_column, (50, 95, 99, 100)), COUNT, LOST, single_column("sent", "sent"),
                    *(single_column(head, name) for head, name in _FIGURES.items()),
                ),
            ),
            Grid(
                title="ms",
                rows=("measure", "robots"),
                heads=("", "robots"),
                of=lambda cell: cell.measure in (LAST, CONFIRMED, KILLED, MUTE),
                columns=(*map(percentile_column, (50, 100)), COUNT),
            ),
        ),
        assessment=(
            at_ten_thousand,
            Aim(
                what="{robots} robots, {measure}, p99 at most {bound:g} ms", of=_of(PINS), value=with_lost(99),
                at_most=50.0, unit="ms", least=100,
            ),
            Aim(
                what="{robots} robots, {measure}, at most {bound:g} ms", of=_of(CONFIRMED), value=with_lost(100),
                at_most=1000.0, unit="ms", least=1,
            ),
        ),
        pictures=(growth("A fleet on one broker", _GROWS, over="robots"), ecdf("Fleet", measures=(PINS,))),
    ),
)  # fmt: skip

if __name__ == "__main__":
    begin = threading.Event()
    serve_on_thread(lambda _line: begin.set(), lambda: os._exit(0))
    drive_fleet(int(sys.argv[1]), float(sys.argv[2]), sys.argv[3:], begin.wait)
