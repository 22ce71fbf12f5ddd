"""``pebble impair --trials thin``: robots that connect over links as thin as a radio modem's, driven, let go, stopped.

Each trial has robots and networks of its own, so that even the first connection is made over the link.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec

from pebble.bench.comparison import Budget, Comparison, Measuring, Option, Report, Round, Run
from pebble.bench.impair import rsa_chain, wheels
from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.impair.network import REMOTE_HOST, NamespaceNetwork, require_namespaces
from pebble.bench.impair.wheels import Gesture, Login, Orders, WheelRecord, WheelReport, WheelTrial, cells_of
from pebble.bench.judging.aims import Aim, single, with_lost
from pebble.bench.pictures import Drawn
from pebble.bench.results import LONGEST_S, Cell
from pebble.bench.tables import Column, Grid, figure
from pebble.config.raw import deep_merge
from pebble.errors import PebbleError
from pebble.fleet import applying
from pebble.fleet.broker_files import new_password
from pebble.fleet.certificates import CA_CERT
from pebble.fleet.folder import CONF, Fleet, Server, load
from pebble.fleet.roles import Account
from pebble.rig.processes import BROKERS, Processes, Program, Worker, Wrap, free_port, mosquitto_path
from pebble.rig.robot import BASE, NAME, Config, Robot, synthetic_media

NODELAY: Final = "set_tcp_nodelay true"
_PICTURES: Final = (320, 240, 10)
_PEOPLE: Final = ("ann", "otto")
_BRIDGE, _SILENCE = "remote_bridge: ", "has not answered for"  # in the log: its connection was taken for dead
_READY_S, _STARTED_S = 150.0, 45.0  # half a minute after its start a bridge looks for what has remained
_TAKES_S = 25.0  # one take-over and its drive, at most
_SCENE = (Gesture("release", 7, 4), Gesture("release", 5, 4), Gesture("stop", 5, 4))
_RELEASE, _STOP = Gesture("release", 1.5, 2.5), Gesture("stop", 1.5, 2.5)
_GESTURE_S = 45.0  # one of these, at most: without control, a stop that is not confirmed, and a reset
_PATIENCE = 1.5  # times as long as all gestures take where everything is answered
_ALONE, _WATCHED, _DRIVEN = "parked", "watched", "driven"
_HOUR_S = 3600


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """A robot, and how it is connected; ``profile`` None: of today, without any key of this."""

    profile: str | None = None
    tls: bool = False
    named: bool = False
    stock: bool = False  # its broker holds small messages back


SUBJECTS: Final[Mapping[str, Subject]] = {
    "wide": Subject(),
    "thin": Subject(profile="thin"),
    "thin TLS": Subject(profile="thin", tls=True),
    "thin stock": Subject(profile="thin", stock=True),
    "auto": Subject(profile="auto"),
    "named": Subject(profile="thin", named=True),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkTrial:
    """One link and what happens on it; the subjects run at the same time. ``share``: of all releases and stops."""

    link: Shape
    subjects: Sequence[str]
    share: float = 0.0
    video: bool = False
    foreign_hz: float = 0.0
    takes: bool = False
    operator_behind: bool = False  # the operator is behind the link, robot and broker are not
    metered: bool = False  # bytes are counted, nothing else


_PLAIN, _LOSSY = Shape(kbit=9.6, delay_ms=300), Shape(kbit=9.6, delay_ms=300, loss=0.05)
TRIALS: Final[Mapping[str, LinkTrial]] = {
    "thin-9.6k+5%": LinkTrial(link=_LOSSY, subjects=("wide", "thin", "thin TLS"), share=1, video=True),
    "thin-9.6k": LinkTrial(link=_PLAIN, subjects=("wide", "thin", "thin TLS", "thin stock"), share=0.3),
    "thin-19.2k+2%": LinkTrial(
        link=Shape(kbit=19.2, delay_ms=150, loss=0.02), subjects=("wide", "thin", "thin TLS"), share=0.3
    ),
    "thin-64k+2%": LinkTrial(link=Shape(kbit=64, delay_ms=50, loss=0.02), subjects=("wide", "auto"), share=0.3),
    "thin-foreign": LinkTrial(link=_PLAIN, subjects=("wide", "auto"), share=0.2, foreign_hz=20),
    "thin-named": LinkTrial(link=_LOSSY, subjects=("named",), takes=True),
    "thin-page": LinkTrial(
        link=Shape(kbit=64, delay_ms=50), subjects=("wide",), share=0.3, video=True, operator_behind=True
    ),
    "thin-sim": LinkTrial(link=Shape(delay_ms=50), subjects=("wide", "thin"), metered=True),
}


# -- one robot and its operator, as processes


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkRobot:
    """One subject in one trial. ``on_operator`` puts a command on its operator's side of the link."""

    subject: str
    network: NamespaceNetwork
    robot: Robot
    broker: Program
    orders: Orders
    on_operator: Wrap

    def operator(self, processes: Processes) -> Worker:
        """Starts one, which reports when the robot is ready."""
        operator = processes.worker(
            f"operator of {self.subject}", "pebble.bench.impair.thin_operator", wrap=self.on_operator
        )
        operator.send(msgspec.json.encode(self.orders).decode())  # not as an argument: there may be passwords in it
        return operator

    def report(self, operator: Worker, limit_s: float) -> WheelReport:
        """The operator's next one. Raises PebbleError for a problem, or a process that has ended."""
        report = msgspec.convert(operator.answer(limit_s), WheelReport)
        if ended := next((one for one in (self.broker, *self.robot.programs) if one.ended), None):
            raise PebbleError(f"{self.subject}: {ended.name} has ended\n{ended.tail()}".rstrip())
        if report.problem is not None:
            raise PebbleError(f"{self.subject}: {report.problem}\n{self.robot.log()}".rstrip())
        return report

    def record(self, operator: Worker, limit_s: float) -> WheelRecord:
        operator.send("go")
        if (record := self.report(operator, limit_s).record) is None:
            raise PebbleError(f"{self.subject}: the operator recorded nothing")
        return record

    def silences(self) -> int:
        """How often the bridge took its connection to the remote broker for dead: none of these links ever is."""
        lines = self.robot.launcher.log.read_text(errors="replace").splitlines()
        return sum(_BRIDGE in line and _SILENCE in line for line in lines)


def start(subject: str, trial: LinkTrial, orders: Orders, processes: Processes, folder: Path) -> LinkRobot:
    """Starts a robot that connects over the link, and its operator."""
    about = SUBJECTS[subject]
    folder.mkdir()
    network = processes.add(NamespaceNetwork(subject), BROKERS)
    shape = trial.link
    network.apply(Condition(subject, shape, shape))
    on_robot, on_operator = network.on_robot, network.on_remote
    host = REMOTE_HOST
    if trial.operator_behind:
        on_robot, on_operator = on_operator, on_robot
    ca_cert: Path | None = None
    passwords: dict[str, str] = {}
    if about.named:
        broker, port, passwords = _fleet_broker(processes, folder / "fleet", network)
        ca_cert = folder / "fleet" / CA_CERT
    else:
        extra = [] if about.stock else [NODELAY]
        if about.tls:
            chain = rsa_chain.make(folder, host)
            ca_cert, extra = chain.root, [*extra, f"certfile {chain.sent}", f"keyfile {chain.key}"]
        broker = processes.broker("remote broker", folder=folder, host=host, wrap=network.on_remote, extra=extra)
        port = broker.port
    remote: dict[str, Any] = {} if ca_cert is None else {"tls": {"enabled": True, "ca_cert": str(ca_cert)}}
    if about.named:
        remote |= {"username": NAME, "password": passwords[NAME]}
    services: dict[str, Config] = synthetic_media(_PICTURES, _PICTURES) if trial.video else {}
    bridge: Config = {"remote_mqtt": remote} | ({"link": {"profile": about.profile}} if about.profile else {})
    robot = Robot(
        processes, "mqtt", (host, port), folder=folder, services=deep_merge(services, {"mqtt_bridge": bridge}),
        reports=None, wrap=on_robot, more={"security": {"level": "named"}} if about.named else None,
    )  # fmt: skip
    robot.prepare()
    robot.config.chmod(0o600)
    robot.launch()
    people = [Login(name, passwords[name]) for name in _PEOPLE] if about.named else [Login()]
    orders = msgspec.structs.replace(
        orders, host=host, port=port, ca_cert=None if ca_cert is None else str(ca_cert), people=people
    )
    return LinkRobot(
        subject=subject, network=network, robot=robot, broker=broker, orders=orders, on_operator=on_operator
    )  # fmt: skip


def _fleet_broker(processes: Processes, folder: Path, network: NamespaceNetwork) -> tuple[Program, int, dict[str, str]]:
    """A broker as `pebble fleet init --level named` makes it; its port, and the passwords of its accounts."""
    folder.mkdir()
    port = free_port()
    fleet = Fleet(level="named", brokers=(Server(host=REMOTE_HOST, port=port),))
    applying.make(folder, fleet, applying.found_plugin())
    people = {name: Account(roles=("driver", "safety")) for name in _PEOPLE}
    accounts = {NAME: Account(roles=("robot",), bases=(BASE,)), **people}
    before = after = load(folder)
    for name, account in accounts.items():
        after = after.with_account(name, account)
    passwords = {name: new_password() for name in accounts}
    applying.apply(folder, before, after, passwords)
    command = network.on_remote([str(mosquitto_path()), "-c", str(folder / CONF)])
    return processes.add(Program("remote broker", command, folder / "broker.log"), BROKERS), port, passwords


# -- the course


def chosen(run: Run) -> list[str]:
    return [name for name in TRIALS if {"thin", name} & {*run["trials"]}]


def gestures(run: Run, trial: LinkTrial) -> list[Gesture]:
    count = math.ceil(run["gestures"] * trial.share)
    if not count:
        return []
    return [Gesture("release", run["window_s"], 4), *_SCENE, *[_RELEASE] * count, *[_STOP] * count]


def measure(round_: Round) -> Iterator[Cell]:
    """All trials, one after the other; one that fails ends them, and the earlier ones count."""
    run, done = round_.run, False
    for name in chosen(run):
        trial = TRIALS[name]
        subjects = [one for one in trial.subjects if one in run["variants"]]
        if not subjects:
            continue
        run.show(f"{name}: {', '.join(subjects)}")
        run.recorded[f"load at {name}"] = round(os.getloadavg()[0], 1)
        try:
            with Processes() as processes:
                part = metered if trial.metered else driven
                yield from part(run, name, trial, subjects, processes)
            done = True
        except PebbleError as error:
            run.problem = run.problem or PebbleError(f"{name} ended early: {error}")
            run.console.print(f"{name}: {error}", style="red", highlight=False, markup=False)
    if not done and run.problem is not None:
        raise run.problem


def driven(run: Run, name: str, trial: LinkTrial, subjects: Sequence[str], processes: Processes) -> Iterator[Cell]:
    wanted = gestures(run, trial)
    usual_s = sum(one.drive_s + one.rest_s for one in wanted)
    orders = Orders(
        host="", port=0, base=BASE, people=[], gestures=wanted, limit_s=_PATIENCE * usual_s, video=trial.video,
        foreign_hz=trial.foreign_hz, takes=run["takes"] if trial.takes else 0,
    )  # fmt: skip
    robots = [
        start(one, trial, orders, processes, processes.folder / str(number)) for number, one in enumerate(subjects)
    ]
    limit_s = orders.limit_s + orders.takes * _TAKES_S + 2 * _GESTURE_S + run["window_s"]

    operators = [robot.operator(processes) for robot in robots]

    def one(robot: LinkRobot, operator: Worker) -> WheelTrial:
        ready_s, before = robot.report(operator, _READY_S).ready_s or 0.0, robot.silences()
        record = robot.record(operator, limit_s)
        return WheelTrial(
            subject=robot.subject, trial=name, record=record, entries=robot.robot.lines(record.began_ns),
            ready_s=ready_s, silences=robot.silences() - before, scene=len(_SCENE) if orders.gestures else 0,
        )  # fmt: skip

    with ThreadPoolExecutor(len(robots), thread_name_prefix="subject") as pool:
        try:
            for found in pool.map(one, robots, operators):
                yield from cells_of(found)
        finally:
            for operator in operators:
                operator.ask_to_end()  # unblocks threads that wait for it


def metered(run: Run, name: str, trial: LinkTrial, subjects: Sequence[str], processes: Processes) -> Iterator[Cell]:
    """Bytes in both directions with all headers: of a robot alone, of one that a page shows, and of a driven one."""
    seconds = run["metered_s"]
    orders = Orders(host="", port=0, base=BASE, people=[], gestures=[Gesture("release", seconds, 0)], limit_s=seconds)
    robots = [
        start(one, trial, orders, processes, processes.folder / str(number)) for number, one in enumerate(subjects)
    ]
    time.sleep(_STARTED_S)  # its start is not counted, nor is that of what looks at it

    def count(state: str) -> Iterator[Cell]:
        before = [robot.network.traffic() for robot in robots]
        began = time.monotonic()
        time.sleep(max(0.0, seconds - 2))
        took = time.monotonic() - began
        for robot, then in zip(robots, before, strict=True):
            now = robot.network.traffic()
            up, down = now.bytes_up - then.bytes_up, now.bytes_down - then.bytes_down
            yield Cell(
                variant=robot.subject, params={"trial": name, "state": state}, measure="kB per hour", unit="kB",
                rounds=[[_HOUR_S * (up + down) / took / 1000]],
                figures={"up": round(_HOUR_S * up / took / 1000), "down": round(_HOUR_S * down / took / 1000)},
            )  # fmt: skip

    yield from count(_ALONE)
    watchers = [
        processes.worker(
            f"watcher of {one.subject}", "pebble.bench.impair.watcher", one.orders.host, one.orders.port, BASE,
            wrap=one.network.on_remote,
        )
        for one in robots
    ]  # fmt: skip
    for watcher in watchers:
        watcher.answer(_STARTED_S)
    yield from count(_WATCHED)
    operators = [robot.operator(processes) for robot in robots]
    for robot, operator in zip(robots, operators, strict=True):
        robot.report(operator, _READY_S)
    for operator in operators:
        operator.send("go")
    time.sleep(1)
    yield from count(_DRIVEN)
    for robot, operator in zip(robots, operators, strict=True):
        robot.report(operator, _READY_S)


# -- tables and aims


def _is(measure_: str, trial: str = "", subject: str = "") -> Any:
    def of(cell: Cell) -> bool:
        return (
            cell.measure == measure_
            and trial in ("", cell.params.get("trial"))
            and (subject in ("", cell.variant) or (subject.endswith("*") and cell.variant.startswith(subject[:-1])))
        )

    return of


def _late(percent: float) -> Any:
    def shown(cell: Cell) -> str:
        value = with_lost(percent)(cell)
        return "never" if math.isinf(value) else figure(value)

    return shown


def _value(name: str) -> Any:
    def shown(cell: Cell) -> str:
        value = cell.figures.get(name)
        return "" if value is None else value if isinstance(value, str) else figure(float(value))

    return shown


def _count(cell: Cell) -> str:
    return str(len(cell.samples) + (cell.lost or 0))


def _whole(name: str) -> Any:
    return lambda cell: str(cell.figures.get(name, ""))


def _driven_trial(cell: Cell) -> bool:
    return "trial" in cell.params and "state" not in cell.params and not cell.measure.endswith("over time")


TABLES = (
    Grid(
        title="driving over thin links", rows=("trial", "variant"), heads=("trial", "robot"),
        of=lambda cell: _driven_trial(cell) and cell.params["trial"] != "thin-named",
        columns=[
            Column("delivered\n%", _value("delivered_percent"), wheels.COMMAND),
            Column("p50\nms", _late(50), wheels.COMMAND),
            Column("p95\nms", _late(95), wheels.COMMAND),
            Column("at rest\n%", _value("rest_percent"), wheels.COMMAND),
            Column("release\nn", _count, wheels.RELEASE),
            Column("p50\nms", _late(50), wheels.RELEASE),
            Column("p95\nms", _late(95), wheels.RELEASE),
            Column("stop\nn", _count, wheels.STOP),
            Column("p95\nms", _late(95), wheels.STOP),
            Column("confirmed\np95 ms", _late(95), wheels.CONFIRMED),
        ],
        caption="n: how often the wheels turned when the robot was let go, or stopped; only then there is a time",
    ),
    Grid(
        title="the links", rows=("trial", "variant"), heads=("trial", "robot"), of=_driven_trial,
        columns=[
            Column("ready\ns", _value("ready_s"), wheels.HEARTBEAT),
            Column("heartbeat\ngap s", _value("longest_gap_s"), wheels.HEARTBEAT),
            Column("age\np95 ms", lambda cell: figure(cell.percentile(95)), wheels.HEARTBEAT_AGE),
            Column("false\nsilences", _whole("silences"), wheels.HEARTBEAT),
            Column("in\nminutes", _value("minutes"), wheels.HEARTBEAT),
            Column("level", _value("level"), wheels.QUEUE),
            Column("queue\np95 ms", lambda cell: figure(cell.percentile(95)), wheels.QUEUE),
            Column("above\n500, s", _value("longest_s"), wheels.QUEUE),
            Column("pictures", _whole("pictures"), wheels.QUEUE),
        ],
    ),
    Grid(
        title="control at level named", rows=("trial", "measure"), heads=("trial", ""),
        of=lambda cell: cell.measure in (wheels.TAKE, wheels.LOST),
        columns=[
            Column("of", lambda cell: str(cell.figures["sent"])), Column("done", lambda cell: str(len(cell.samples))),
            Column("p50\nms", _late(50)), Column("p95\nms", _late(95)),
        ],
    ),
    Grid(
        title="what a SIM card pays: kB per hour, both directions, all headers", rows=("state", "variant"),
        heads=("", "robot"), of=lambda cell: cell.measure == "kB per hour",
        columns=[
            Column("kB per hour", lambda cell: f"{cell.samples[0]:,.0f}" if cell.samples else ""),
            Column("up", _whole("up")), Column("down", _whole("down")),
        ],
    ),
)  # fmt: skip


def _aim(
    what: str, measure_: str, trial: str, value: Any, unit: str, *, subject: str = "thin*",
    at_most: float | None = None, at_least: float | None = None,
) -> Aim:  # fmt: skip
    return Aim(
        what=f"{{variant}} at {trial}, {what} {'at least' if at_most is None else 'at most'} {{bound:g}} {unit}",
        of=_is(measure_, trial, subject), value=value, unit=unit, at_most=at_most, at_least=at_least, least=0,
        never="too much was lost",
    )  # fmt: skip


_p50, _p95, _WORST = with_lost(50), with_lost(95), "thin-9.6k+5%"
AIMS = (
    _aim("commands delivered", wheels.COMMAND, _WORST, single("delivered_percent"), "%", at_least=90),
    _aim("command p50", wheels.COMMAND, _WORST, _p50, "ms", at_most=350),
    _aim("command p95", wheels.COMMAND, _WORST, _p95, "ms", at_most=900),
    _aim("release to rest, p95", wheels.RELEASE, _WORST, _p95, "ms", at_most=900),
    _aim("stop to rest, p95", wheels.STOP, _WORST, _p95, "ms", at_most=900),
    _aim("false silences", wheels.HEARTBEAT, _WORST, single("silences"), "", at_most=0),
    _aim("heartbeat gap", wheels.HEARTBEAT, _WORST, single("longest_gap_s"), "s", at_most=3),
    _aim("queue above 500 ms for", wheels.QUEUE, _WORST, single("longest_s"), "s", at_most=3),
    _aim("command p95", wheels.COMMAND, "thin-9.6k", _p95, "ms", at_most=400, subject="thin"),
    _aim("command p95", wheels.COMMAND, "thin-19.2k+2%", _p95, "ms", at_most=600),
    _aim("stop to rest, the longest", wheels.STOP, "thin-foreign", with_lost(100), "ms", at_most=6000,
         subject="auto"),
    _aim("stop confirmed, p95", wheels.CONFIRMED, "thin-page", _p95, "ms", at_most=1500, subject="wide"),
    _aim("heartbeat age p95", wheels.HEARTBEAT_AGE, "thin-page", _p95, "ms", at_most=1000, subject="wide"),
    _aim("control taken over", wheels.TAKE, "thin-named", lambda cell: 100 * len(cell.samples) / cell.single("sent"),
         "% of the times", at_least=100, subject="named"),
)  # fmt: skip


def beside(cells: Sequence[Cell]) -> Iterator[str]:
    """One sentence for each link: what a robot without the keys did in the same minutes."""
    for name in TRIALS:
        found = [cell for cell in cells if _is(wheels.COMMAND, name)(cell)]
        shares = [f"{cell.variant} {figure(cell.single('delivered_percent'))} %" for cell in found]
        if len(shares) > 1:
            yield f"Commands delivered at {name.removeprefix('thin-')}: {', '.join(shares)}."


IMPAIR_THIN = Comparison(
    name="impair-thin",
    title="Over a thin link",
    what="Whole robots with MQTT inside that connect over links as thin as a radio modem's, limited both ways. “wide” "
    "is a robot without any key of this, “thin” one whose `link.profile` is thin; both run at the same time. The "
    "operator drives as the operator page does: it takes control, and follows `outgoing/link`. Then it lets go, and "
    "stops, many times; what counts is when the wheels of the simulated MCU are at rest for good. `thin-foreign`: an "
    "operator who knows of none of this sends 20 commands a second. `thin-page`: the operator is behind the link.",
    options=(
        Option(name="trials", many=True, known=["thin", *TRIALS], metavar="NAMES", recorded=False,
               help="thin: all of them; or some, separated by commas."),
        Option(name="subjects", sets="variants", many=True, known=[*SUBJECTS], metavar="NAMES", help="Some of them."),
        Option(name="window", sets="window_s", kind=float, least=1.0, most=LONGEST_S, help="Seconds of one drive."),
    ),
    full=Budget(2500, trials=["thin"], window_s=60.0, gestures=50, takes=20, metered_s=90.0),
    quick=Budget(420, trials=["thin"], window_s=12.0, gestures=4, takes=2, metered_s=15.0),
    variants=[*SUBJECTS],
    measuring=Measuring(prepare=lambda _run: require_namespaces(), measure_round=measure),
    report=Report(
        tables=TABLES,
        assessment=(*AIMS, beside),
        complete=lambda _cells: True,  # a robot without the keys may get nothing through
        pictures=(Drawn("pebble.bench.impair.pictures:what_the_wheels_did"),),
        reported=("--trials", "thin"),
    ),
    words=("impair",),
    root=True,
    by_name=True,
)  # fmt: skip
