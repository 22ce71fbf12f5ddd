"""Robots behind impaired networks: in each trial it is impaired, and an operator drives and watches."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import msgspec

from pebble.bench.comparison import Budget, Comparison, Option, Round, Run
from pebble.bench.impair.conditions import CONDITIONS, Condition
from pebble.bench.impair.metrics import OperatorReport, Plan, Trial, cells_of, over_time
from pebble.bench.impair.network import ImpairedNetwork, Traffic, open_network, why_no_namespaces
from pebble.bench.impair.operator import CLIP
from pebble.bench.impair.report import AIMS, QUOTED, SENTENCES, TABLES
from pebble.bench.pictures import Drawn
from pebble.bench.results import LONGEST_S, Cell, grouped
from pebble.config.raw import deep_merge
from pebble.errors import PebbleError
from pebble.media.pcm import to_bytes
from pebble.media.sound_file import write_wav
from pebble.media.speech import Speech
from pebble.rig.processes import BROKERS, Processes
from pebble.rig.programs import Program, Worker
from pebble.rig.robot import BASE, Config, Robot, synthetic_media
from pebble.simulation.loudspeaker import playbacks

CLEAN = Condition("clean")
TRIALS = [one.name for one in CONDITIONS]
QUICK = ("base-start", "256k", "64k+5%", "base-end")
PICTURES = WIDTH, HEIGHT, FPS = 640, 480, 15  # as the original is configured
CLIP_S = 0.5
_AUDIO_RATE = 16_000
_UP_S = 80.0
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


@dataclass(frozen=True, slots=True)
class ImpairedRobot:
    """One subject. The local broker and the robot's processes are on its side of the network; the rest is beyond it."""

    subject: Subject
    network: ImpairedNetwork
    robot: Robot
    remote: Program  # its broker
    operator: Worker
    limit_s: float  # for its operator's next report; the limits of that are shorter

    def next_report(self) -> OperatorReport:
        """The operator's next report. Raises PebbleError for a problem, a timeout, or if a process has ended."""
        try:
            report = msgspec.convert(self.operator.answer(self.limit_s), OperatorReport)
        except PebbleError as error:
            report = OperatorReport(problem=str(error))
        if ended := next((each for each in (self.remote, *self.robot.programs) if each.ended), None):
            raise PebbleError(f"{self.subject.name}: {ended.name} has ended\n{ended.tail()}".rstrip())
        if report.problem is not None:
            raise PebbleError(f"{self.subject.name}: {report.problem}\n{self.robot.log()}".rstrip())
        return report

    def recover(self) -> None:
        self.operator.send("recover")
        self.next_report()

    def trial(self, name: str) -> Trial:
        """The network is impaired already. Raises PebbleError."""
        began_ns, traffic = time.monotonic_ns(), dict[str, tuple[Traffic, Traffic]]()
        phase, before = "", Traffic()
        self.operator.send("trial")
        while (report := self.next_report()).record is None:
            if report.phase:
                phase, before = report.phase, self.network.traffic()
            else:
                traffic[phase] = before, self.network.traffic()
        entries, played = self.robot.lines(began_ns), playbacks(self.robot.folder)
        return Trial(self.subject.name, name, report.record, entries, traffic, played)


def start(subject: Subject, run: Run, processes: Processes) -> ImpairedRobot:
    """Starts all its processes; it is not yet ready. Raises PebbleError."""
    folder = processes.folder / str(NAMES.index(subject.name))
    folder.mkdir()
    network = processes.add(open_network(run["link"], subject.name), BROKERS)
    remote = processes.broker("remote broker", folder=folder, host=network.broker_host, wrap=network.on_remote)
    robot = Robot(
        processes, subject.transport, network.broker_address(remote.port), folder=folder, services=_services(folder),
        reports=None, wrap=network.on_robot,
    )  # fmt: skip
    robot.prepare()
    robot.launch()
    lengths = {name: run[name] for name in Plan.__struct_fields__ if name.endswith("_s")}
    plan = msgspec.json.encode(Plan(video=subject.video, audio=subject.audio, **lengths)).decode()
    arguments = "pebble.bench.impair.operator", network.broker_host, remote.port, BASE, plan
    operator = processes.worker(f"the operator of {subject.name}", *arguments, wrap=network.on_remote)
    return ImpairedRobot(subject, network, robot, remote, operator, limit_s=_UP_S + run["window_s"])


def _services(folder: Path) -> dict[str, Config]:
    """The original's keys and values where it has them; the loudspeaker records into the folder."""
    sound: Config = {"rate": _AUDIO_RATE, "channels": 1}
    publishers = {
        "video_publisher": {"keyframe_interval": 5, "jpeg_quality": 10},
        "audio_publisher": {**sound, "chunk_ms": 20},
    }
    loudspeaker = [sys.executable, "-m", "pebble.simulation.loudspeaker", "--record", str(folder)]
    (sounds := folder / "sounds").mkdir()
    write_wav(sounds / CLIP, to_bytes(Speech(_AUDIO_RATE).samples(0, round(CLIP_S * _AUDIO_RATE))), _AUDIO_RATE)
    own = {
        "mqtt_bridge": {"media": publishers},
        "av_daemon": {"audio": sound},
        "soundboard_handler": {"playback": {"directory": str(sounds), "player_command": loudspeaker}},
    }
    services: dict[str, Config] = deep_merge(synthetic_media(PICTURES, PICTURES), own)
    return services


@contextmanager
def robots(run: Run) -> Iterator[list[ImpairedRobot]]:
    """All robots, which are not yet ready. Raises PebbleError if something does not start."""
    run.show("starting the robots")
    with Processes() as processes:
        yield [start(subject, run, processes) for subject in SUBJECTS if subject.name in run["variants"]]


# -- the course of the trials


def prepare(run: Run) -> None:
    """Chooses the kind of network; the recorded command line uses the same kind. Raises PebbleError."""
    wanted = run["link"]
    why_not = None if wanted == "proxy" else why_no_namespaces()
    if why_not is not None:
        if wanted == "namespaces":
            raise PebbleError(f"no network namespaces: {why_not}; or choose the proxy")
        run.console.print(f"A proxy replaces the network namespaces: {why_not}", highlight=False, soft_wrap=True)
    kind = run.options["link"] = "proxy" if wanted == "proxy" or why_not else "namespaces"
    run.recorded |= {"link_words": f"{_LINKS[kind]} robot's uplink impaired", "why_proxy": why_not}


def conditions(run: Run) -> list[Condition]:
    """The requested ones in the paper's order."""
    return [one for one in CONDITIONS if one.name in run["trials"]]


def groups(run: Run, every: Sequence[ImpairedRobot]) -> list[list[ImpairedRobot]]:
    """Those that run at the same time: the transports of one form, to limit the load on small machines; or all."""
    return [list(every)] if run["all_at_once"] else [*grouped(every, lambda robot: robot.subject.form).values()]


def measure(round_: Round) -> Iterator[Cell]:
    """All trials; one that fails ends them, and the earlier ones count. Raises PebbleError if there are none."""
    run, every, cases = round_.run, round_.env, round_.cases()
    began_ns, trials, marks = time.monotonic_ns(), list[Trial](), list[str]()
    with ThreadPoolExecutor(len(every), thread_name_prefix="subject") as pool:
        try:
            list(pool.map(lambda robot: robot.next_report(), every))
            for number, condition in enumerate(conditions(run)):
                name, turn = condition.name, slice(None, None, -1 if number % 2 else 1)
                list(islice(cases, len(every)))  # for the progress that is shown
                for place, group in enumerate(one[turn] for one in groups(run, every)[turn]):
                    run.show(f"{name}: {', '.join(robot.subject.name for robot in group)}")
                    list(pool.map(lambda robot: robot.recover(), group))
                    if not place:
                        marks.append(f"{name}@{(time.monotonic_ns() - began_ns) / 1e9:.1f}")
                    list(pool.map(lambda robot, now=condition: robot.network.apply(now), group))
                    trials += list(pool.map(lambda robot, name=name: robot.trial(name), group))
                    list(pool.map(lambda robot: robot.network.apply(CLEAN), group))
        except PebbleError as error:
            if not trials:
                raise
            run.problem = PebbleError(f"the trials ended early: {error}")
        finally:
            for robot in every:
                robot.operator.ask_to_end()  # unblocks threads that wait for it
    run.recorded["marks"] = ";".join(marks)
    yield from cells_of(trials, FPS)
    yield from over_time(trials, began_ns)


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
        Option(name="link", known=("auto", *_LINKS), metavar="KIND", help="auto, namespaces (needs root) or proxy."),
        Option(name="window", sets="window_s", kind=float, least=1.0, most=LONGEST_S,
               help="Seconds of video, and of audio, per trial."),
    ),
    full=Budget(1300, trials=TRIALS, link="auto", window_s=8.0, alone_s=3.0, grace_s=2.0, off_s=2.0, quiet_s=2.0,
                clip_s=5.0, all_at_once=False),
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
    environment=robots,
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
