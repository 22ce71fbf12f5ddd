"""Robots behind impaired networks, the paper's section 4.2: in each trial one is driven, and its media are received.

Whole robots, each behind a network of its own whose uplink is limited, loses packets, or both, trial after trial:
heartbeats and driving alone, then with video, then with audio, then a clip for its loudspeaker. ``original`` is this
program with the original's encodings (JSON video, PCM audio), a stand-in for the original; ``h264 opus`` are those with
rate control. All use MQTT across the network: ``mqtt`` and ``zenoh`` differ inside the robot.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import msgspec
from rich.console import Console
from rich.table import Table

from pebble.config.raw import deep_merge
from pebble.errors import PebbleError
from pebble.extensions.lab.bench.impair import metrics
from pebble.extensions.lab.bench.impair.conditions import CONDITIONS, Condition
from pebble.extensions.lab.bench.impair.metrics import OperatorReport, Plan, Trial, cells_of, with_lost
from pebble.extensions.lab.bench.impair.network import REMOTE_HOST, NamespaceNetwork, require_namespaces
from pebble.extensions.lab.bench.impair.operator import CLIP
from pebble.extensions.lab.bench.impair.pictures import over_trials
from pebble.extensions.lab.bench.results import STAND_IN, Cell, Results, begin, grouped
from pebble.extensions.lab.bench.rounds import Progress, measure_rounds, paired
from pebble.extensions.lab.bench.show import RATIOS, Shown, digits, plain_table
from pebble.extensions.lab.rig.processes import BROKERS, Processes, Program, Worker
from pebble.extensions.lab.rig.robot import BASE, Config, Robot, synthetic_media
from pebble.extensions.lab.simulation.loudspeaker import playbacks
from pebble.extensions.media.pcm import to_bytes
from pebble.extensions.media.sound_file import write_wav
from pebble.extensions.media.speech import Speech

CLEAN: Final = Condition("clean")
TRIALS: Final = tuple(condition.name for condition in CONDITIONS)
PICTURES = WIDTH, HEIGHT, FPS = 640, 480, 15  # as the original is configured
CLIP_S = 0.5
_AUDIO_RATE = 16_000
_UP_S = 80.0  # for a robot to be ready; its operator waits for a shorter time
_Value = str | Callable[[Cell], float]  # the name of a figure, or a function

#: What the operator requests; None: as the robot is configured, with the original's JSON pictures and PCM.
FORMS: Final = {"original": (None, None), "h264 opus": ("h264", "opus")}
SUBJECTS: Final = tuple(f"{transport} {form}" for form in FORMS for transport in ("mqtt", "zenoh"))


@dataclass(frozen=True, slots=True)
class Settings:
    """The variants and trials, and the seconds of each phase of a trial, see Plan.

    Without ``all_at_once`` only the transports of one form run at the same time, to limit the load on small machines.
    """

    trials: Sequence[str] = TRIALS
    subjects: Sequence[str] = SUBJECTS
    window_s: float = 8.0
    alone_s: float = 3.0
    grace_s: float = 2.0
    off_s: float = 2.0
    quiet_s: float = 2.0
    clip_s: float = 5.0
    all_at_once: bool = False


FULL: Final = Settings()
QUICK: Final = Settings(
    trials=("base-start", "256k", "64k+5%", "base-end"), window_s=4.0, alone_s=2.0, grace_s=1.0, off_s=1.0, quiet_s=1.0,
    all_at_once=True,
)  # fmt: skip


def run(settings: Settings, console: Console) -> Shown:
    """Run all trials with all subjects. Raises PebbleError."""
    require_namespaces()
    results = begin("impair", settings)
    ended: list[str] = []
    measure_rounds(results, 1, lambda _number, progress: measure(settings, progress, ended), console)
    results.notes += ended
    results.complete = not ended  # in the worst trials nothing may arrive
    return shown(results, settings.window_s)


def shown(results: Results, window_s: float) -> Shown:
    """Return the tables and pictures of results."""
    caption = f"windows of {window_s:g} s; “original”: this program with the original's encodings"
    return Shown(results, [*tables(results.cells), transports(results)], over_trials(results.cells, caption))


# -- the robots, as processes


@dataclass(frozen=True, slots=True)
class ImpairedRobot:
    """One subject. The local broker and the robot's processes are on its side of the network; the rest is beyond it."""

    subject: str
    network: NamespaceNetwork
    robot: Robot
    remote: Program  # its broker
    operator: Worker
    limit_s: float  # for its operator's next report; the limits of that are shorter

    def next_report(self) -> OperatorReport:
        """Return the operator's next report. Raises PebbleError for a problem, a timeout, or if a process has ended."""
        try:
            report = msgspec.convert(self.operator.answer(self.limit_s), OperatorReport)
        except PebbleError as error:
            report = OperatorReport(problem=str(error))
        if ended := next((program for program in (self.remote, *self.robot.programs) if program.ended), None):
            raise PebbleError(f"{self.subject}: {ended.name} has ended\n{ended.tail()}".rstrip())
        if report.problem is not None:
            raise PebbleError(f"{self.subject}: {report.problem}\n{self.robot.log()}".rstrip())
        return report

    def recover(self) -> None:
        self.operator.send("recover")
        self.next_report()

    def trial(self, name: str) -> Trial:
        """Run a trial; the network is impaired already. Raises PebbleError."""
        began_ns, traffic = time.monotonic_ns(), dict[str, tuple[int, int]]()
        phase, before = "", 0
        self.operator.send("trial")
        while (report := self.next_report()).record is None:
            if report.phase:
                phase, before = report.phase, self.network.bytes_up()
            else:
                traffic[phase] = before, self.network.bytes_up()
        entries, played = self.robot.lines(began_ns), playbacks(self.robot.folder)
        return Trial(self.subject, name, report.record, entries, traffic, played)


def start(subject: str, settings: Settings, processes: Processes) -> ImpairedRobot:
    """Start all its processes; it is not yet ready. Raises PebbleError."""
    transport, _, form = subject.partition(" ")
    folder = processes.folder / str(SUBJECTS.index(subject))
    folder.mkdir()
    network = processes.add(NamespaceNetwork(subject), BROKERS)
    remote = processes.broker("remote broker", folder=folder, host=REMOTE_HOST, wrap=network.on_remote)
    robot = Robot(
        processes, transport, (REMOTE_HOST, remote.port), folder=folder, services=_services(folder), reports=None,
        wrap=network.on_robot,
    )  # fmt: skip
    robot.prepare()
    robot.launch()
    video, audio = FORMS[form]
    lengths = {name: value for name, value in asdict(settings).items() if name in Plan.__struct_fields__}
    plan = msgspec.json.encode(Plan(video=video, audio=audio, **lengths)).decode()
    arguments = "pebble.extensions.lab.bench.impair.operator", REMOTE_HOST, remote.port, BASE, plan
    operator = processes.worker(f"the operator of {subject}", *arguments, wrap=network.on_remote)
    return ImpairedRobot(subject, network, robot, remote, operator, limit_s=_UP_S + settings.window_s)


def _services(folder: Path) -> dict[str, Config]:
    """Return the original's keys and values where it has them; the loudspeaker records into the folder."""
    sound: Config = {"rate": _AUDIO_RATE, "channels": 1}
    video, audio = {"keyframe_interval": 5, "jpeg_quality": 10}, {**sound, "chunk_ms": 20}
    loudspeaker = [sys.executable, "-m", "pebble.simulation.loudspeaker", "--record", str(folder)]
    (sounds := folder / "sounds").mkdir()
    write_wav(sounds / CLIP, to_bytes(Speech(_AUDIO_RATE).samples(0, round(CLIP_S * _AUDIO_RATE))), _AUDIO_RATE)
    own = {
        "mqtt_bridge": {"media": {"video_publisher": video, "audio_publisher": audio}},
        "av_daemon": {"audio": sound},
        "soundboard_handler": {"playback": {"directory": str(sounds), "player_command": loudspeaker}},
    }
    services: dict[str, Config] = deep_merge(synthetic_media(PICTURES, PICTURES), own)
    return services


@contextmanager
def robots(settings: Settings) -> Iterator[list[ImpairedRobot]]:
    """Start all robots, which are not yet ready. Raises PebbleError if something does not start."""
    with Processes() as processes:
        yield [start(subject, settings, processes) for subject in SUBJECTS if subject in settings.subjects]


# -- the course of the trials


def measure(settings: Settings, progress: Progress, ended: list[str]) -> Iterator[Cell]:
    """Measure all trials; one that fails ends them, which ``ended`` gets to know, and the earlier ones count.

    Raises PebbleError if there are none.
    """
    progress("starting the robots")
    with robots(settings) as every:
        yield from cells_of(_trials(settings, every, progress, ended))


def _trials(settings: Settings, every: Sequence[ImpairedRobot], progress: Progress, ended: list[str]) -> list[Trial]:
    trials: list[Trial] = []
    with ThreadPoolExecutor(len(every), thread_name_prefix="subject") as pool:
        try:
            list(pool.map(ImpairedRobot.next_report, every))
            conditions = [condition for condition in CONDITIONS if condition.name in settings.trials]
            for number, condition in enumerate(conditions):
                turn = slice(None, None, -1 if number % 2 else 1)
                for group in (together[turn] for together in groups(settings, every)[turn]):
                    progress(f"{condition.name}: {', '.join(robot.subject for robot in group)}")
                    list(pool.map(ImpairedRobot.recover, group))
                    list(pool.map(lambda robot, now=condition: robot.network.apply(now), group))
                    trials += list(pool.map(lambda robot, name=condition.name: robot.trial(name), group))
                    list(pool.map(lambda robot: robot.network.apply(CLEAN), group))
        except PebbleError as error:
            if not trials:
                raise
            ended.append(f"The trials ended early: {error}")
        finally:
            for robot in every:
                robot.operator.ask_to_end()  # unblocks threads that wait for it
    return trials


def groups(settings: Settings, every: Sequence[ImpairedRobot]) -> list[list[ImpairedRobot]]:
    """Return those that run at the same time."""
    return [*grouped(every, lambda robot: settings.all_at_once or robot.subject.partition(" ")[2]).values()]


# -- the tables

_STAND_IN: Final = f"original: its encodings, sent by this program; a {STAND_IN} for the original itself."
_KINDS: Final = ("zenoh", "mqtt")
_COMPARED: Final = {"drive p50": metrics.DRIVE, "sound p50": metrics.SOUND, "video p50": metrics.PICTURES}
_P50, _P95 = (lambda cell: cell.percentile(50)), (lambda cell: cell.percentile(95))  # of what arrived
_COLUMNS: Final[dict[str, tuple[tuple[str, str, _Value], ...]]] = {
    "Trials": (
        ("audio\n%", metrics.SOUND, "delivered_percent"),
        ("in 1 s\n%", metrics.SOUND, "on_time_percent"),
        ("p95\nms", metrics.SOUND, _P95),
        ("video\nfps", metrics.PICTURES, "fps"),
        ("frozen\ns", metrics.PICTURES, "frozen_s"),
        ("drive\np95 ms", metrics.DRIVE, with_lost(95)),
        ("offline\ns", metrics.HEARTBEAT_GAP, "longest_offline_s"),
    ),
    "Details of media": (
        ("video\nkbit/s", metrics.PICTURES, "kbit_up"),
        ("audio\nkbit/s", metrics.SOUND, "kbit_up"),
        ("audio\np50 ms", metrics.SOUND, _P50),
        ("video\ngap s", metrics.PICTURES, "longest_gap_s"),
    ),
    "Details of driving, and a clip": (
        ("drive\np50 ms", metrics.DRIVE, with_lost(50)),
        ("drive\n%", metrics.DRIVE, "delivered_percent"),
        ("stopped\ntimes", metrics.DRIVE, "trips"),
        ("at rest\ns", metrics.DRIVE, "rest_s"),
        ("beat\ngap s", metrics.HEARTBEAT_GAP, "longest_gap_s"),
        ("clip\nms", metrics.CLIP, with_lost(100)),
    ),
    "After media were switched off": (
        ("no video\nbytes", metrics.AFTER_VIDEO, "bytes_up"),
        ("beats", metrics.AFTER_VIDEO, "heartbeats"),
        ("gap\ns", metrics.AFTER_VIDEO, "longest_gap_s"),
        ("no audio\nbytes", metrics.AFTER_AUDIO, "bytes_up"),
        ("beats", metrics.AFTER_AUDIO, "heartbeats"),
        ("gap\ns", metrics.AFTER_AUDIO, "longest_gap_s"),
    ),
}


def tables(cells: Sequence[Cell]) -> Iterator[Table]:
    """Yield tables with a row for each subject in each trial."""
    for title, columns in _COLUMNS.items():
        table = plain_table(title, ["trial", "subject", *(head for head, *_ in columns)], left=2, caption=_STAND_IN)
        for trial, some in grouped(cells, lambda cell: str(cell.params["trial"])).items():
            table.add_section()
            for number, (subject, own) in enumerate(grouped(some, lambda cell: cell.variant).items()):
                measured = {cell.measure: cell for cell in own}
                values = (_text(measured[measure], value) for _, measure, value in columns)
                table.add_row("" if number else trial, subject, *values)
        yield table


def _text(cell: Cell, value: _Value) -> str:
    if isinstance(value, str):
        counted = cell.figures.get(value, [math.nan])[0]
        return str(counted) if isinstance(counted, int) else digits(counted)
    return digits(value(cell))


def transports(results: Results) -> Table:
    """Return Zenoh inside the robot compared with MQTT, with trials as rounds: both ran at the same time."""
    title = "Zenoh to MQTT inside the robot, medians over the trials"
    grid = plain_table(title, ["form", *_COMPARED], caption=f"{_STAND_IN} {RATIOS}")
    for form in FORMS:
        intervals = []
        for measure in _COMPARED.values():
            cells = [[results.find(f"{kind} {form}", measure, trial=trial) for trial in TRIALS] for kind in _KINDS]
            zenoh, mqtt = ([cell.samples if cell else [] for cell in some] for some in cells)
            intervals.append(str(paired(zenoh, mqtt)))
        grid.add_row(form, *intervals)
    return grid
