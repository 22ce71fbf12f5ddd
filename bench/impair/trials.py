"""Robots behind impaired networks: in each trial it is impaired, and an operator drives and watches."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import msgspec

from pebble.bench.comparison import Budget, Comparison, Option, Round, Run
from pebble.bench.impair.conditions import TRIALS, Condition, chosen
from pebble.bench.impair.metrics import OperatorReport, RecoveryRequest, Trial, TrialRequest, cells_of, over_time
from pebble.bench.impair.network import KINDS, Traffic, open_network, resolved
from pebble.bench.impair.operator import CLIP
from pebble.bench.impair.report import AIMS, QUOTED, SENTENCES, TABLES
from pebble.bench.pictures import Drawn
from pebble.bench.results import LONGEST_S, Cell, grouped
from pebble.config.raw import deep_merge
from pebble.errors import PebbleError
from pebble.media.pcm import to_bytes
from pebble.media.sound_file import write_wav
from pebble.media.speech import Speech
from pebble.rig.processes import Processes
from pebble.rig.programs import Program, Worker
from pebble.rig.robot import BASE, Config, Robot, synthetic_media
from pebble.simulation.loudspeaker import Playback, playbacks
from pebble.simulation.trace import Entry

CLEAN = Condition("clean")
QUICK = ("base-start", "256k", "64k+5%", "base-end")
PICTURES = WIDTH, HEIGHT, FPS = 640, 480, 15  # as the original is configured
CLIP_S = 0.5
_AUDIO_RATE = 16_000
_UP_S, _RECOVERED_S, _PHASE_S = 80.0, 30.0, 30.0  # limits for an operator's next report; its own limits are shorter
_LINKS = {"namespaces": "network namespaces,", "proxy": "a userspace proxy, loss modelled;"}


@dataclass(frozen=True, slots=True)
class Subject:
    """One robot under test. Encodings are requested by the operator; None: as the robot is configured."""

    transport: str  # inside the robot
    form: str  # its encodings in words
    video: str | None = None
    audio: str | None = None

    @property
    def name(self) -> str:
        return f"{self.transport} {self.form}"


#: The robots are configured with the original's settings: JSON pictures and PCM.
SUBJECTS = (
    Subject("mqtt", "original"),
    Subject("zenoh", "original"),
    Subject("mqtt", "h264 opus", "h264", "opus"),
    Subject("zenoh", "h264 opus", "h264", "opus"),
)
NAMES = tuple(subject.name for subject in SUBJECTS)


# -- the robots, as processes


class ImpairedRobot:
    """One subject. The local broker and the robot's processes are on its side of the network; the rest is beyond it."""

    operator: Worker  # both since the start
    _robot: Robot

    def __init__(self, subject: Subject, kind: str, processes: Processes, folder: Path) -> None:
        self.subject = subject
        self.programs: list[Program] = []
        self.network = open_network(kind, name=subject.name)
        self._processes, self._folder, self._played = processes, folder, folder / "played"
        self._folder.mkdir()

    def start(self) -> None:
        """Starts all processes; the robot is not yet ready. Raises PebbleError."""
        host, beyond = self.network.broker_host, self.network.on_remote
        remote = self._processes.broker("remote broker", folder=self._folder, host=host, wrap=beyond)
        self._robot = Robot(
            self._processes,
            self.subject.transport,
            self.network.broker_address(remote.port),
            folder=self._folder,
            services=_services(self._folder, self._played),
            reports=None,
            wrap=self.network.on_robot,
        )
        self._robot.prepare()
        self._robot.launch()
        self.programs += [remote, *self._robot.programs]
        module, name = "pebble.bench.impair.operator", f"the operator of {self.subject.name}"
        self.operator = self._processes.worker(name, module, host, remote.port, BASE, wrap=beyond)

    def send(self, request: TrialRequest | RecoveryRequest) -> None:
        self.operator.send(msgspec.json.encode(request).decode())

    def next_report(self, timeout: float) -> OperatorReport:
        """The operator's next report. Raises PebbleError for a problem, a timeout, or if a process has ended."""
        try:
            report = msgspec.convert(self.operator.answer(timeout), OperatorReport)
        except PebbleError as error:
            report = OperatorReport(problem=str(error))
        if ended := next((each for each in self.programs if each.ended), None):
            raise PebbleError(f"{self.subject.name}: {ended.name} has ended\n{ended.tail()}".rstrip())
        if report.problem is not None:
            raise PebbleError(f"{self.subject.name}: {report.problem}\n{self._robot.log()}".rstrip())
        return report

    def entries(self, since_ns: int) -> list[Entry]:
        """What the MCU received and did after ``since_ns``."""
        return self._robot.lines(since_ns)

    def playbacks(self) -> list[Playback]:
        """All clips that the loudspeaker has played."""
        return playbacks(self._played)


def _services(folder: Path, played: Path) -> dict[str, Config]:
    """The original's keys and values where it has them; the loudspeaker records into ``played``."""
    sound: Config = {"rate": _AUDIO_RATE, "channels": 1}
    publishers = {
        "video_publisher": {"keyframe_interval": 5, "jpeg_quality": 10},
        "audio_publisher": {**sound, "chunk_ms": 20},
    }
    loudspeaker = [sys.executable, "-m", "pebble.simulation.loudspeaker", "--record", str(played)]
    playback = {"directory": str(_write_clip(folder / "sounds")), "player_command": loudspeaker}
    own = {
        "mqtt_bridge": {"media": publishers},
        "av_daemon": {"audio": sound},
        "soundboard_handler": {"playback": playback},
    }
    services: dict[str, Config] = deep_merge(synthetic_media(PICTURES, PICTURES), own)
    return services


def _write_clip(folder: Path) -> Path:
    """The folder, with the clip that is played at the end of each trial."""
    folder.mkdir()
    samples = Speech(_AUDIO_RATE).samples(0, round(CLIP_S * _AUDIO_RATE))
    write_wav(folder / CLIP, to_bytes(samples), _AUDIO_RATE)
    return folder


class TestBed(Processes):
    """All robots; they are not yet ready when the ``with`` block begins."""

    def __init__(self, subjects: Sequence[Subject], kind: str) -> None:
        super().__init__()
        self.robots: list[ImpairedRobot] = []
        self._subjects, self._kind = subjects, kind

    def start(self) -> None:
        """Raises PebbleError if something does not start."""
        for number, subject in enumerate(self._subjects):
            self.robots.append(ImpairedRobot(subject, self._kind, self, self.folder / str(number)))
        for robot in self.robots:
            robot.start()

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        for robot in self.robots:
            robot.network.close()

    def end_trials(self) -> None:
        """Stops all operators."""
        for operator in self.workers:
            operator.ask_to_end()


# -- the course of the trials


def prepare(run: Run) -> None:
    """Chooses the kind of network; the recorded command line uses the same kind. Raises PebbleError."""
    run.options["link"], why_proxy = resolved(run["link"])
    if why_proxy is not None:
        run.console.print(f"A proxy replaces the network namespaces: {why_proxy}", highlight=False, soft_wrap=True)
    impaired = "both directions impaired" if run["both_ways"] else "robot's uplink impaired"
    words = f"{_LINKS[run['link']]} {impaired}"
    run.recorded |= {"link_words": words, "why_proxy": why_proxy}  # None: no proxy, or a requested one


def conditions(run: Run) -> list[Condition]:
    """The requested ones in the paper's order."""
    return chosen(run["trials"], run["both_ways"])


def test_bed(run: Run) -> TestBed:
    run.show("starting the robots")
    return TestBed([one for one in SUBJECTS if one.name in run["variants"]], run["link"])


def groups(run: Run, robots: Sequence[ImpairedRobot]) -> list[list[ImpairedRobot]]:
    """Those that run at the same time: the transports of one form, to limit the load on small machines; or all."""
    return [list(robots)] if run["all_at_once"] else [*grouped(robots, lambda robot: robot.subject.form).values()]


def measure(round_: Round) -> Iterator[Cell]:
    """All trials; one that fails ends them, and the earlier ones count. Raises PebbleError if there are none."""
    run, bed = round_.run, round_.env
    began_ns, trials, marks = time.monotonic_ns(), list[Trial](), list[str]()
    with ThreadPoolExecutor(len(bed.robots), thread_name_prefix="subject") as pool:
        try:
            list(pool.map(lambda robot: robot.next_report(_UP_S), bed.robots))
            cases = round_.cases()
            for number, condition in enumerate(conditions(run)):
                list(islice(cases, len(bed.robots)))  # for the progress that is shown
                turn = slice(None, None, -1 if number % 2 else 1)
                for place, group in enumerate(one[turn] for one in groups(run, bed.robots)[turn]):
                    run.show(f"{condition.name}: {', '.join(robot.subject.name for robot in group)}")
                    list(pool.map(partial(_recover, run), group))
                    if not place:
                        marks.append(f"{condition.name}@{(time.monotonic_ns() - began_ns) / 1e9:.1f}")
                    list(pool.map(partial(_apply, condition), group))
                    trials += list(pool.map(partial(_trial, run, condition.name), group))
                    list(pool.map(partial(_apply, CLEAN), group))
        except PebbleError as error:
            if not trials:
                raise
            run.problem = PebbleError(f"the trials ended early: {error}")
        finally:
            bed.end_trials()  # unblocks threads that wait for an operator
    run.recorded["marks"] = ";".join(marks)
    yield from cells_of(trials, FPS)
    yield from over_time(trials, began_ns)


def _recover(run: Run, robot: ImpairedRobot) -> None:
    robot.send(RecoveryRequest(quiet_s=run["quiet_s"]))
    robot.next_report(_RECOVERED_S)


def _apply(condition: Condition, robot: ImpairedRobot) -> None:
    robot.network.apply(condition)


def _trial(run: Run, name: str, robot: ImpairedRobot) -> Trial:
    began_ns, subject = time.monotonic_ns(), robot.subject
    lengths = {phase: run[phase] for phase in ("alone_s", "window_s", "grace_s", "off_s", "clip_s")}
    robot.send(TrialRequest(video=subject.video, audio=subject.audio, **lengths))
    traffic: dict[str, tuple[Traffic, Traffic]] = {}
    phase, before = "", Traffic()
    while True:
        report = robot.next_report(_PHASE_S + run["window_s"])
        if report.record is not None:
            return Trial(subject.name, name, report.record, robot.entries(began_ns), traffic, robot.playbacks())
        if report.phase:
            phase, before = report.phase, robot.network.traffic()
        else:
            traffic[phase] = before, robot.network.traffic()


IMPAIR = Comparison(
    name="impair",
    title="On an impaired network",
    what="Whole robots whose uplink is limited and loses packets, trial after trial, as in section 4.2 of the "
    "paper: heartbeat, driving, video, then audio in each. “original” is this Pebble with the original's encodings "
    "(JSON video, PCM audio); “h264 opus” are the encodings with rate control.",
    options=(
        Option(name="trials", many=True, known=TRIALS, metavar="NAMES", recorded=False,
               help="Some of them, separated by commas."),
        Option(name="subjects", sets="variants", many=True, known=NAMES, metavar="NAMES",
               help='Such as "mqtt original,zenoh h264 opus".'),
        Option(name="both-ways", sets="both_ways", kind=bool, help="Impair the direction to the robot, too."),
        Option(name="link", known=KINDS, metavar="KIND", help="auto, namespaces (needs root) or proxy."),
        Option(name="window", sets="window_s", kind=float, least=1.0, most=LONGEST_S,
               help="Seconds of video, and of audio, per trial."),
    ),
    full=Budget(1300, trials=list(TRIALS), both_ways=False, link="auto", window_s=8.0, alone_s=3.0, grace_s=2.0,
                off_s=2.0, quiet_s=2.0, clip_s=5.0, all_at_once=False),
    quick=Budget(85, trials=list(QUICK), window_s=4.0, alone_s=2.0, grace_s=1.0, off_s=1.0, quiet_s=1.0,
                 all_at_once=True),
    constants={
        "picture": f"{WIDTH}x{HEIGHT} at {FPS} a second, synthetic, jpeg_quality 10, keyframe_interval 5",
        "sound": "16 kHz mono, chunks of 20 ms, synthetic speech",
        "drive_hz": 10,
        "soundboard": f"a wav file of {CLIP_S:g} s, played by a simulated loudspeaker",
    },
    variants=NAMES,
    conditions=lambda run: [{"trial": condition.name} for condition in conditions(run)],
    prepare=prepare,
    environment=test_bed,
    measure_round=measure,
    figures={"sent": lambda values: values[-1]},  # of the only round; None if nothing arrived
    tables=TABLES,
    title_suffix=", over {link_words}, windows of {window_s:g} s{quick}",
    legend=lambda _cells: QUOTED,
    assessment=(*AIMS, *SENTENCES),
    complete=lambda _cells: True,  # in the worst trials nothing may arrive
    pictures=(Drawn("pebble.bench.impair.pictures:over_trials"), Drawn("pebble.bench.impair.pictures:over_time")),
    summary_lines=9,
    words=("impair",),
)  # fmt: skip
