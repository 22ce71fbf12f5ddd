"""Robots behind impaired networks, the paper's section 4.2: in each trial one is driven, and its media are received.

Whole robots, each behind a network of its own whose uplink is limited, loses packets, or both, trial after trial:
driving alone, then with video, then with audio. ``original`` is this program with the original's
encodings (JSON video, PCM audio), a stand-in for the original; ``h264 opus`` are those with rate control. All use MQTT
across the network: ``mqtt`` and ``zenoh`` differ inside the robot.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import chain
from typing import Final

import msgspec
from rich.console import Console
from rich.table import Table

from pebble.config.raw import deep_merge
from pebble.errors import PebbleError
from pebble.extensions.lab.bench.impair import metrics
from pebble.extensions.lab.bench.impair.metrics import Plan, Report, cells_of, value_of
from pebble.extensions.lab.bench.impair.network import REMOTE_HOST, Condition, NamespaceNetwork, why_no_namespaces
from pebble.extensions.lab.bench.impair.pictures import over_trials
from pebble.extensions.lab.bench.results import STAND_IN, Cell, Results, begin, grouped
from pebble.extensions.lab.bench.rounds import Progress, in_turn, measure_rounds
from pebble.extensions.lab.bench.show import Shown, digits, plain_table
from pebble.extensions.lab.rig.processes import BROKERS, Processes, Program, Worker
from pebble.extensions.lab.rig.robot import BASE, MEDIA, Config, Robot

#: The paper's conditions (section 4.2), in the order of a run.
CONDITIONS = (
    Condition("base-start"),
    *(Condition(f"{kbit}k", kbit=kbit) for kbit in (1024, 512, 256, 128, 64)),
    *(Condition(f"{percent}%", loss=percent / 100) for percent in (1, 2, 5, 10)),
    *(
        Condition(f"{kbit}k+{percent}%", kbit=kbit, loss=percent / 100)
        for kbit, percent in ((256, 1), (128, 2), (64, 5))
    ),
    Condition("base-end"),
)
CLEAN: Final = Condition("clean")
TRIALS: Final = tuple(condition.name for condition in CONDITIONS)
_AUDIO_RATE = 16_000
_UP_S = 80.0  # for a robot to be ready; its operator waits for a shorter time

_SOUND: Final[Config] = {"rate": _AUDIO_RATE, "channels": 1}
#: The original's keys and values where it has them.
SERVICES: Final[dict[str, Config]] = deep_merge(
    MEDIA,  # 640x480, 15 a second, as the original is configured
    {
        "mqtt_bridge": {
            "media": {
                "video_publisher": {"keyframe_interval": 5, "jpeg_quality": 10},
                "audio_publisher": {**_SOUND, "chunk_ms": 20},
            }
        },
        "av_daemon": {"audio": _SOUND},
    },
)

#: What the operator requests; None: as the robot is configured, with the original's JSON pictures and PCM.
FORMS: Final = {"original": (None, None), "h264 opus": ("h264", "opus")}
SUBJECTS: Final = tuple(f"{transport} {form}" for form in FORMS for transport in ("mqtt", "zenoh"))


@dataclass(frozen=True, slots=True)
class Settings:
    """The variants and trials, and the seconds of each phase of a trial (see Plan)."""

    trials: Sequence[str] = TRIALS
    subjects: Sequence[str] = SUBJECTS
    window_s: float = 8.0
    alone_s: float = 3.0
    grace_s: float = 2.0
    off_s: float = 2.0
    quiet_s: float = 2.0


FULL: Final = Settings()
QUICK: Final = Settings(
    trials=("base-start", "256k", "64k+5%", "base-end"), window_s=4.0, alone_s=2.0, grace_s=1.0, off_s=1.0, quiet_s=1.0,
)  # fmt: skip


def run(settings: Settings, console: Console) -> Shown:
    """Run all trials with all subjects. Raises PebbleError."""
    if why := why_no_namespaces():
        raise PebbleError(f"no network namespaces: {why}; run it as root, or in `unshare --map-root-user`")
    results = begin("impair", settings)
    ended: list[str] = []
    measure_rounds(results, 1, lambda _number, progress: measure(settings, progress, ended), console)
    results.notes += ended
    # measure_rounds counts a cell without samples as incomplete; but in the worst trials nothing may arrive.
    results.complete = not ended
    return shown(results, settings.window_s)


def shown(results: Results, window_s: float) -> Shown:
    """Return the tables and charts of the results."""
    caption = f"windows of {window_s:g} s; “original”: this program with the original's encodings"
    return Shown(results, [table(results.cells)], over_trials(results.cells, caption))


# -- the robots, as processes


@dataclass(frozen=True, slots=True)
class ImpairedRobot:
    """A subject: the robot and its local broker on their side of the network, the rest on the other side."""

    subject: str
    network: NamespaceNetwork
    robot: Robot
    remote: Program  # its broker
    operator: Worker
    limit_s: float  # for the operator's next report; the operator's own limits are shorter

    def report(self) -> Report:
        """Return the operator's next report. Raises PebbleError for a problem, a timeout, or an ended process."""
        try:
            report = msgspec.convert(self.operator.answer(self.limit_s), Report)
        except PebbleError as error:
            report = Report(problem=str(error))  # raised below, unless an ended program explains it
        if ended := next((program for program in (self.remote, *self.robot.programs) if program.ended), None):
            raise PebbleError(f"{self.subject}: {ended.name} has ended\n{ended.tail()}".rstrip())
        if report.problem is not None:
            raise PebbleError(f"{self.subject}: {report.problem}\n{self.robot.log()}".rstrip())
        return report

    def trial(self, condition: Condition) -> list[Cell]:
        """Run a trial once all messages of the last one have arrived or are lost. Raises PebbleError."""
        self.operator.send("recover")
        self.report()
        self.network.apply(condition)
        began_ns = time.monotonic_ns()
        self.operator.send("trial")
        report = self.report()
        self.network.apply(CLEAN)
        return list(cells_of(self.subject, condition.name, report, self.robot.lines(began_ns)))


def start(subject: str, settings: Settings, processes: Processes) -> ImpairedRobot:
    """Start all processes of a subject, and return it, not yet ready. Raises PebbleError."""
    transport, _, form = subject.partition(" ")
    folder = processes.folder / str(SUBJECTS.index(subject))
    folder.mkdir()
    network = processes.add(NamespaceNetwork(subject), BROKERS)
    remote = processes.broker("remote broker", folder=folder, host=REMOTE_HOST, wrap=network.on_remote)
    address = (REMOTE_HOST, remote.port)
    robot = Robot(processes, transport, address, folder=folder, services=SERVICES, wrap=network.on_robot)
    robot.prepare()
    robot.launch()
    video, audio = FORMS[form]
    lengths = {name: value for name, value in asdict(settings).items() if name in Plan.__struct_fields__}
    plan = msgspec.json.encode(Plan(video=video, audio=audio, **lengths)).decode()
    arguments = "pebble.extensions.lab.bench.impair.operator", REMOTE_HOST, remote.port, BASE, plan
    operator = processes.worker(f"the operator of {subject}", *arguments, wrap=network.on_remote)
    return ImpairedRobot(subject, network, robot, remote, operator, limit_s=_UP_S + 2 * settings.window_s)


# -- the course of the trials


def measure(settings: Settings, progress: Progress, ended: list[str]) -> Iterator[Cell]:
    """Yield the results of all trials.

    If a trial fails, stop, add the reason to ``ended`` and keep the earlier results. Raises PebbleError if there are
    no results.
    """
    progress("starting the robots")
    with Processes() as processes:
        robots = [start(subject, settings, processes) for subject in SUBJECTS if subject in settings.subjects]
        yield from _trials(settings, robots, progress, ended)


def _trials(settings: Settings, robots: Sequence[ImpairedRobot], progress: Progress, ended: list[str]) -> list[Cell]:
    """Return the results of all trials; ``ended``: see :func:`measure`.

    To limit the load, only robots of one form (encodings) run at a time.
    """
    cells: list[Cell] = []
    by_form = grouped(robots, lambda robot: robot.subject.partition(" ")[2])
    with ThreadPoolExecutor(len(robots), thread_name_prefix="subject") as pool:
        try:
            list(pool.map(ImpairedRobot.report, robots))  # an operator's first report: its robot is ready
            for number, condition in enumerate(trial for trial in CONDITIONS if trial.name in settings.trials):
                for of_form in in_turn(list(by_form.values()), number):
                    progress(f"{condition.name}: {', '.join(robot.subject for robot in of_form)}")
                    cells += chain(*pool.map(ImpairedRobot.trial, of_form, [condition] * len(of_form)))
        except PebbleError as error:
            if not cells:
                raise
            ended.append(f"The trials ended early: {error}")
        finally:
            for robot in robots:
                robot.operator.ask_to_end()  # unblocks threads that wait for it
    return cells


# -- the tables

_STAND_IN: Final = f"original: its encodings, sent by this program; a {STAND_IN} for the original itself."
#: Each column's measure, and the percentile that is shown.
_COLUMNS: Final[tuple[tuple[str, str, int], ...]] = (
    ("audio\n%", metrics.DELIVERED, 50),
    ("in 1 s\n%", metrics.ON_TIME, 50),
    ("p95\nms", metrics.SOUND, 95),
    ("video\nfps", metrics.FPS, 50),
    ("drive\np95 ms", metrics.DRIVE, 95),
)


def table(cells: Sequence[Cell]) -> Table:
    """Return a table with a row for each subject in each trial."""
    grid = plain_table("Trials", ["trial", "subject", *(head for head, *_ in _COLUMNS)], left=2, caption=_STAND_IN)
    for trial, of_trial in grouped(cells, lambda cell: str(cell.params["trial"])).items():
        grid.add_section()
        for number, (subject, of_subject) in enumerate(grouped(of_trial, lambda cell: cell.variant).items()):
            measured = {cell.measure: cell for cell in of_subject}
            values = (digits(value_of(measured[measure], percent)) for _, measure, percent in _COLUMNS)
            grid.add_row("" if number else trial, subject, *values)
    return grid
